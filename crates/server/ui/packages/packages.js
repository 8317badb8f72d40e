// Owns the views of packages, and uploads of new ones; it never holds the content of a large file in
// memory.
//
// This module is the list, with the versions of each package and the number of robots that run them.
// New packages can be dropped here.

import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { get } from '../api/api.js';
import { command, copyButton } from '../display/copy.js';
import { Cursor } from '../display/cursor.js';
import { change } from '../display/display.js';
import { number, plural, shortDigest, size } from '../display/format.js';
import { hrefTo, navigate, replaceQuery } from '../display/router.js';
import { timeAgo } from '../display/status.js';
import { VirtualList, isNarrow } from '../display/virtual-list.js';
import { openPushDialog } from '../orders/push.js';
import { fromDrop, fromFiles, fromFolder } from './input-files.js';
import { PackageUsage, versionNames } from './usage.js';

// As in packages.css.
const ROW = 41;
const NARROW_ROW = 89;
const REFETCH_PAUSE_MS = 1_000;

/** The sort keys; they use the newest version. */
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
  #list = new VirtualList();
  #cursor = new Cursor(this.#list, (key) => this.#openRow(key));
  /** The packages; undefined until fetched. */
  #packages;
  /** The name of each version in the address. */
  #names;
  #problem = null;
  #search = { q: '', sort: 'name', isDescending: false, expanded: new Set() };
  #timer;
  #isDropping = false;
  #end = new AbortController();

  constructor(app) {
    this.app = app;
    this.usage = new PackageUsage(app.fleet);
    this.#fetch();
    this.#listenForDrops();
  }

  onNavigate({ query }) {
    this.#list.releaseAnchor();
    this.#search = {
      q: query.q ?? '',
      sort: KEYS[query.sort] ? query.sort : 'name',
      isDescending: query.order === 'down',
      expanded: new Set(query.open?.split(',')),
    };
  }

  leave() {
    this.#end.abort();
    clearTimeout(this.#timer);
  }

  refresh() {
    this.#fetch();
  }

  onEvent({ type }) {
    if (type !== 'package') return;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#fetch(), REFETCH_PAUSE_MS);
  }

  async #fetch() {
    try {
      const { packages } = await get('/packages');
      this.#packages = packages;
      this.#names = versionNames(packages);
      this.#problem = null;
    } catch ({ message }) {
      this.#problem = message;
    }
    change();
  }

  #setSearch(search) {
    change(() => {
      this.#list.releaseAnchor();
      this.#search = { ...this.#search, ...search };
      const { q, sort, isDescending, expanded } = this.#search;
      replaceQuery({
        q,
        sort: sort === 'name' ? '' : sort,
        order: isDescending ? 'down' : '',
        open: [...expanded].join(','),
      });
    });
  }

  #toggle(name) {
    const expanded = new Set(this.#search.expanded);
    if (!expanded.delete(name)) expanded.add(name);
    this.#setSearch({ expanded });
  }

  // The list

  /** The sorted packages, each with the matching versions. */
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
      robots: versions.reduce((sum, one) => sum + this.usage.robotsRunning(one.package).length, 0),
    }));
    const sign = isDescending ? -1 : 1;
    return groups.sort((one, other) => {
      const [first, second] = [KEYS[sort](one), KEYS[sort](other)];
      return first < second ? -sign : first > second ? sign : 0;
    });
  }

  /** The rows: the newest version of each package, and the older versions of expanded packages. */
  #rowsOf(groups) {
    return groups.flatMap(({ name, versions }) =>
      versions.slice(0, this.#search.expanded.has(name) ? Infinity : 1).map((one, index) => ({
        key: one.package.manifest.digest,
        word: this.#names.get(one),
        one,
        older: index ? 0 : versions.length - 1,
        isOlder: index > 0,
      })),
    );
  }

  draw(now) {
    const { can } = this.app;
    const rows = this.#rowsOf(this.#shown);
    const { start, end } = this.#list.visibleRange(
      rows.map(({ key }) => key),
      () => (isNarrow ? NARROW_ROW : ROW),
    );
    return html`
      <header class="toolbar">
        <h1>Packages</h1>
        <input type="search" placeholder="Search" aria-label="Search packages"
          aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${this.#search.q}
          @input=${({ currentTarget }) => this.#setSearch({ q: currentTarget.value })}>
        ${can('publish') ? uploadButtons(this.app.uploads) : nothing}
      </header>
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}
      ${this.app.uploads.view()}
      ${this.#packages?.length ? this.#table(rows, start, end, now) : nothing}
      ${
        this.#packages?.length && !rows.length
          ? html`<p class="empty quiet">No packages match this filter.
              <button class="plain link"
                @click=${() => this.#setSearch({ q: '' })}>Clear filter</button></p>`
          : nothing
      }
      ${this.#packages ? this.#hint() : nothing}
      ${
        this.#isDropping
          ? html`<div class="drop"><p>Drop a <code>.tar.zst</code>, a <code>.tar</code> or a folder
              to upload it</p></div>`
          : nothing
      }`;
  }

  #table(rows, start, end, now) {
    const { sort, isDescending } = this.#search;
    const [order, arrow] = isDescending ? ['descending', '↓'] : ['ascending', '↑'];
    const sortBy = (key) =>
      this.#setSearch({ sort: key, isDescending: sort === key && !isDescending });
    return html`
      <div class="table packages-table" role="grid" aria-label="Packages"
        aria-rowcount=${rows.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">${COLUMNS.map(
          ([title, key]) => html`
          <span role="columnheader" aria-sort=${key && sort === key ? order : nothing}>${
            key
              ? html`<button class="plain" @click=${() => sortBy(key)}>${title}<span
                  class="arrow" aria-hidden="true">${sort === key ? arrow : ''}</span></button>`
              : title || html`<span class="visually-hidden">Operation</span>`
          }</span>`,
        )}</div>
        <div class="rows" role="rowgroup"><div class="rendered" role="presentation">${repeat(
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
    const count = this.usage.robotsRunning(one.package).length;
    const isExpanded = this.#search.expanded.has(name);
    const push = () => openPushDialog(this.app, null, { package: name, manifest: manifest.digest });
    return html`
      <div class="row ${isOlder ? 'is-older' : ''}" role="row"
        tabindex=${this.#cursor.tabindex(key, index)} aria-rowindex=${index + 2}
        data-key=${key} data-package=${`${name}@${version}`}
        @focusin=${() => (this.#cursor.current = key)}>
        <span class="cell name" role="gridcell"><a
          href=${hrefTo(['packages', name], { version: word })}>${
            isOlder ? html`<span class="visually-hidden">${name}</span>` : name
          }</a></span>
        <span class="cell version" role="gridcell"><a
            href=${hrefTo(['packages', name], { version: word })}>${version}</a>
          ${
            older
              ? html`<button class="plain quiet toggle" aria-expanded=${isExpanded}
                  @click=${() => this.#toggle(name)}><span
                  aria-hidden="true">${isExpanded ? '▾' : '▸'}</span>
                  ${number(older)} older</button>`
              : nothing
          }</span>
        <span class="cell size" role="gridcell">${size(content.size)}</span>
        <span class="cell digest" role="gridcell"><span class="code quiet"
            title=${manifest.digest}>${shortDigest(manifest.digest)}</span>
          ${copyButton(manifest.digest, `digest of ${name} ${version}`)}</span>
        <span class="cell distro" role="gridcell">${
          requires.ros_distro?.join(', ') ??
          html`<span class="quiet">${build.tool === 'none' ? '–' : 'any'}</span>`
        }</span>
        <span class="cell arch" role="gridcell">${
          requires.arch?.join(', ') ?? html`<span class="quiet">any</span>`
        }</span>
        <span class="cell pushed quiet" role="gridcell">${timeAgo(pushed, now)}</span>
        <span class="cell robots" role="gridcell">${
          count
            ? html`<a
                href=${hrefTo(['robots'], { q: `${name}@${version}` })}
                >${plural(count, 'robot')}</a>`
            : html`<span class="quiet">–</span>`
        }</span>
        <span class="cell operations" role="gridcell">${
          this.app.can('operate')
            ? html`<button class="plain" aria-label=${`Push ${name} ${version}`}
                @click=${push}>Push…</button>`
            : nothing
        }</span>
      </div>`;
  }

  #hint() {
    const isEmpty = !this.#packages.length;
    const { can } = this.app;
    return html`
      <section class="empty">
        ${isEmpty ? html`<h2>No packages yet</h2>` : nothing}
        <p class="quiet">${
          can('publish')
            ? html`Drop a folder, a <code>.tar.zst</code> or a <code>.tar</code> anywhere on this
                page, or push a directory from a terminal:`
            : 'Publishers push a directory with:'
        }</p>
        ${command('taskd push ./my_pkg')}
      </section>`;
  }

  #openRow(key) {
    const row = this.#rowsOf(this.#shown).find((one) => one.key === key);
    if (row) navigate(['packages', row.one.package.name], { version: row.word });
  }

  afterDraw() {
    this.#list.applyLayout();
    this.#cursor.afterDraw();
  }

  onKey(event) {
    if (event.key === 'Escape' && this.#search.q) {
      this.#setSearch({ q: '' });
      return true;
    }
    return this.#cursor.onKey(
      event,
      this.#rowsOf(this.#shown).map(({ key }) => key),
    );
  }

  // Drag and drop, anywhere on the page while this view is shown.

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
      this.app.uploads.add(fromDrop(event.dataTransfer));
    });
  }
}

/** Buttons that open the browser's file dialogs, whose inputs are hidden. */
function uploadButtons(uploads) {
  const take = (input, chosen) => {
    if (input.files.length) uploads.add(chosen(input.files));
    input.value = '';
  };
  const press = ({ currentTarget }) => currentTarget.nextElementSibling.click();
  return html`<span class="actions">
    <button class="quiet-button" @click=${press}>Upload archive…</button>
    <input type="file" class="visually-hidden" tabindex="-1" aria-label="Archive to upload"
      multiple accept=".tar,.zst,.tzst"
      @change=${({ currentTarget }) => take(currentTarget, fromFiles)}>
    <button class="quiet-button" @click=${press}>Upload folder…</button>
    <input type="file" class="visually-hidden" tabindex="-1" aria-label="Folder to upload"
      webkitdirectory
      @change=${({ currentTarget }) => take(currentTarget, (files) => [fromFolder(files)])}>
  </span>`;
}

const textOf = ({ package: { name, version, manifest }, manifest: { requires } }) =>
  [`${name}@${version}`, manifest.digest, ...(requires.ros_distro ?? []), ...(requires.arch ?? [])]
    .join(' ')
    .toLowerCase();
