// The packages that can be pushed: their versions, what they are for, and on how many robots each
// runs. New ones are dropped here.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import { get } from './api.js';
import { command, copyButton } from './copy.js';
import { Cursor } from './cursor.js';
import { number, plural, short, size } from './format.js';
import { change } from './frame.js';
import { ofDrop, ofFiles, ofFolder } from './packages/chosen.js';
import { Uses, namesOf } from './packages/uses.js';
import { askPush } from './push.js';
import { at, go, restate } from './router.js';
import { Rows, isNarrow } from './rows.js';
import { since } from './signs.js';

// As in packages.css.
const ROW = 41;
const NARROW_ROW = 89;
const REFETCH_PAUSE_MS = 1_000;

/** What packages can be sorted by; by the newest of their versions. */
const KEYS = {
  name: ({ name }) => name,
  size: ({
    versions: [
      {
        package: { content },
      },
    ],
  }) => -content.size,
  pushed: ({ versions: [{ pushed_at_ms: pushed }] }) => -pushed,
  robots: ({ robots }) => -robots,
};

const COLUMNS = [
  ['Name', 'name'],
  ['Version'],
  ['Size', 'size'],
  ['Digest'],
  ['ROS'],
  ['Architecture'],
  ['Pushed', 'pushed'],
  ['Runs on', 'robots'],
  [''],
];

export class PackagesView {
  #rows = new Rows();
  #cursor = new Cursor(this.#rows, (key) => this.#openRow(key));
  /** What the server lists; absent: not yet. */
  #packages;
  /** What the address says of each. */
  #words;
  #problem = null;
  #search = { q: '', sort: 'name', isDescending: false, unfolded: new Set() };
  #timer;
  #isDropping = false;
  #end = new AbortController();

  constructor(app) {
    this.app = app;
    this.uses = new Uses(app.fleet);
    this.#fetch();
    this.#listenForDrops();
  }

  arrive({ query }) {
    this.#rows.rearrange();
    this.#search = {
      q: query.q ?? '',
      sort: KEYS[query.sort] ? query.sort : 'name',
      isDescending: query.order === 'down',
      unfolded: new Set(query.open?.split(',')),
    };
  }

  leave() {
    this.#end.abort();
    clearTimeout(this.#timer);
  }

  refresh() {
    this.#fetch();
  }

  hear({ type }) {
    if (type !== 'package') return;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#fetch(), REFETCH_PAUSE_MS);
  }

  async #fetch() {
    try {
      const { packages } = await get('/packages');
      this.#packages = packages;
      this.#words = namesOf(packages);
      this.#problem = null;
    } catch ({ message }) {
      this.#problem = message;
    }
    change();
  }

  #look(search) {
    change(() => {
      this.#rows.rearrange();
      this.#search = { ...this.#search, ...search };
      const { q, sort, isDescending, unfolded } = this.#search;
      restate({
        q,
        sort: sort === 'name' ? '' : sort,
        order: isDescending ? 'down' : '',
        open: [...unfolded].join(','),
      });
    });
  }

  #toggle(name) {
    const unfolded = new Set(this.#search.unfolded);
    if (!unfolded.delete(name)) unfolded.add(name);
    this.#look({ unfolded });
  }

  // What is shown.

  /** The packages in order, each with those of its versions that are found. */
  get #shown() {
    const { q, sort, isDescending } = this.#search;
    const words = q.toLowerCase().split(/\s+/).filter(Boolean);
    const byName = new Map();
    for (const one of this.#packages ?? []) {
      if (!words.every((word) => textOf(one).includes(word))) continue;
      const { name } = one.package;
      if (byName.has(name)) byName.get(name).push(one);
      else byName.set(name, [one]);
    }
    const groups = [...byName].map(([name, versions]) => ({
      name,
      versions,
      robots: versions.reduce((sum, one) => sum + this.uses.of(one.package).length, 0),
    }));
    const sign = isDescending ? -1 : 1;
    return groups.sort((one, other) => {
      const [first, second] = [KEYS[sort](one), KEYS[sort](other)];
      return first < second ? -sign : first > second ? sign : 0;
    });
  }

  /**
   * The rows: the newest version of each package, and the older ones of those that are unfolded.
   */
  #rowsOf(groups) {
    return groups.flatMap(({ name, versions }) =>
      versions.slice(0, this.#search.unfolded.has(name) ? Infinity : 1).map((one, index) => ({
        key: one.package.manifest.digest,
        word: this.#words.get(one),
        one,
        older: index ? 0 : versions.length - 1,
        isOlder: index > 0,
      })),
    );
  }

  draw(now) {
    const { can } = this.app;
    const rows = this.#rowsOf(this.#shown);
    const { start, end } = this.#rows.sight(
      rows.map(({ key }) => key),
      () => (isNarrow ? NARROW_ROW : ROW),
    );
    return html`
      <header class="bar-of-tools">
        <h1>Packages</h1>
        <input type="search" placeholder="Search" aria-label="Search packages" aria-keyshortcuts="/" autocomplete="off" spellcheck="false"
          .value=${this.#search.q} @input=${({ currentTarget }) => this.#look({ q: currentTarget.value })}>
        ${can('publish') ? uploadButtons(this.app.uploads) : nothing}
      </header>
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}
      ${this.app.uploads.view()}
      ${this.#packages?.length ? this.#table(rows, start, end, now) : nothing}
      ${this.#packages?.length && !rows.length ? html`<p class="empty quiet">No package is like that. <button class="plain link" @click=${() => this.#look({ q: '' })}>Show all</button></p>` : nothing}
      ${this.#packages ? this.#hint() : nothing}
      ${this.#isDropping ? html`<div class="drop"><p>Drop a <code>.tar.zst</code>, a <code>.tar</code> or a folder to upload it</p></div>` : nothing}`;
  }

  #table(rows, start, end, now) {
    const { sort, isDescending } = this.#search;
    return html`
      <div class="table packages-table" role="grid" aria-label="Packages" aria-rowcount=${rows.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">${COLUMNS.map(
          ([title, key]) => html`
          <span role="columnheader" aria-sort=${key && sort === key ? (isDescending ? 'descending' : 'ascending') : nothing}>${
            key
              ? html`<button class="plain" @click=${() => this.#look({ sort: key, isDescending: sort === key && !isDescending })}>${title}<span class="arrow" aria-hidden="true">${sort === key ? (isDescending ? '↓' : '↑') : ''}</span></button>`
              : title || html`<span class="unseen">Operation</span>`
          }</span>`,
        )}</div>
        <div class="rows" role="rowgroup"><div class="sight" role="presentation">${repeat(
          rows.slice(start, end),
          ({ key }) => key,
          (row, index) => this.#row(row, start + index, now),
        )}</div></div>
      </div>`;
  }

  #row({ key, word, one, older, isOlder }, index, now) {
    const {
      package: { name, version, manifest, content },
      manifest: { requires, build },
      pushed_at_ms: pushed,
    } = one;
    const count = this.uses.of(one.package).length;
    const isUnfolded = this.#search.unfolded.has(name);
    return html`
      <div class="row ${isOlder ? 'is-older' : ''}" role="row" tabindex=${this.#cursor.tabindex(key, index)} aria-rowindex=${index + 2} data-key=${key} data-package=${`${name}@${version}`} @focusin=${() => (this.#cursor.current = key)}>
        <span class="cell name" role="gridcell"><a href=${at(['packages', name], { version: word })}>${isOlder ? html`<span class="unseen">${name}</span>` : name}</a></span>
        <span class="cell version" role="gridcell"><a href=${at(['packages', name], { version: word })}>${version}</a>
          ${older ? html`<button class="plain quiet fold" aria-expanded=${isUnfolded} @click=${() => this.#toggle(name)}><span aria-hidden="true">${isUnfolded ? '▾' : '▸'}</span> ${number(older)} older</button>` : nothing}</span>
        <span class="cell size" role="gridcell">${size(content.size)}</span>
        <span class="cell digest" role="gridcell"><span class="code quiet" title=${manifest.digest}>${short(manifest.digest)}</span> ${copyButton(manifest.digest, `the digest of ${name} ${version}`)}</span>
        <span class="cell distro" role="gridcell">${requires.ros_distro?.join(', ') ?? html`<span class="quiet">${build.tool === 'none' ? '–' : 'any'}</span>`}</span>
        <span class="cell arch" role="gridcell">${requires.arch?.join(', ') ?? html`<span class="quiet">any</span>`}</span>
        <span class="cell pushed quiet" role="gridcell">${since(pushed, now)}</span>
        <span class="cell robots" role="gridcell">${count ? html`<a href=${at(['robots'], { q: `${name}@${version}` })}>${plural(count, 'robot')}</a>` : html`<span class="quiet">–</span>`}</span>
        <span class="cell operations" role="gridcell">${this.app.can('operate') ? html`<button class="plain" aria-label=${`Push ${name} ${version}`} @click=${() => askPush(this.app, null, { package: name, manifest: manifest.digest })}>Push…</button>` : nothing}</span>
      </div>`;
  }

  #hint() {
    const isEmpty = !this.#packages.length;
    const { can } = this.app;
    return html`
      <section class="empty">
        ${isEmpty ? html`<h2>No package is here yet.</h2>` : nothing}
        <p class="quiet">${can('publish') ? html`Drop a folder, a <code>.tar.zst</code> or a <code>.tar</code> anywhere on this page, or push a directory from a terminal:` : 'Whoever may publish pushes a directory with'}</p>
        ${command('taskd push ./my_pkg')}
      </section>`;
  }

  #openRow(key) {
    const row = this.#rowsOf(this.#shown).find((one) => one.key === key);
    if (row) go(['packages', row.one.package.name], { version: row.word });
  }

  drawn() {
    this.#rows.place();
    this.#cursor.drawn();
  }

  key(event) {
    if (event.key === 'Escape' && this.#search.q) {
      this.#look({ q: '' });
      return true;
    }
    return this.#cursor.key(
      event,
      this.#rowsOf(this.#shown).map(({ key }) => key),
    );
  }

  // Dropping, anywhere on the page while this view is there.

  #listenForDrops() {
    const { signal } = this.#end;
    const on = (type, act) =>
      addEventListener(
        type,
        (event) =>
          this.app.can('publish') && event.dataTransfer?.types.includes('Files') && act(event),
        { signal },
      );
    const show = (isDropping) =>
      this.#isDropping !== isDropping && change(() => (this.#isDropping = isDropping));
    on('dragover', (event) => {
      event.preventDefault();
      show(true);
    });
    on('dragleave', ({ relatedTarget }) => relatedTarget || show(false));
    on('drop', (event) => {
      event.preventDefault();
      show(false);
      this.app.uploads.add(ofDrop(event.dataTransfer));
    });
  }
}

/** Buttons in front of the browser's own dialogs, whose inputs are out of sight. */
function uploadButtons(uploads) {
  const take = (input, chosen) => {
    if (input.files.length) uploads.add(chosen(input.files));
    input.value = '';
  };
  const press = ({ currentTarget }) => currentTarget.nextElementSibling.click();
  return html`<span class="acts">
    <button class="quiet-button" @click=${press}>Upload archive…</button>
    <input type="file" class="unseen" tabindex="-1" aria-label="Archive to upload" multiple accept=".tar,.zst,.tzst" @change=${({ currentTarget }) => take(currentTarget, ofFiles)}>
    <button class="quiet-button" @click=${press}>Upload folder…</button>
    <input type="file" class="unseen" tabindex="-1" aria-label="Folder to upload" webkitdirectory @change=${({ currentTarget }) => take(currentTarget, (files) => [ofFolder(files)])}>
  </span>`;
}

const textOf = ({ package: { name, version, manifest }, manifest: { requires } }) =>
  [`${name}@${version}`, manifest.digest, ...(requires.ros_distro ?? []), ...(requires.arch ?? [])]
    .join(' ')
    .toLowerCase();
