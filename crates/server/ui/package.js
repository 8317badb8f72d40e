// One package: its versions, and of one of them what it runs and needs, where it runs, its files,
// and what differs from another.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import { names } from './acts.js';
import { get, remove } from './api.js';
import { copyButton } from './copy.js';
import { Cursor } from './cursor.js';
import { open } from './dialog.js';
import { moment, number, plural, short, size } from './format.js';
import { change } from './frame.js';
import { tell } from './notice.js';
import { facts, manifestDifference } from './packages/facts.js';
import { Tree, differences, modeWords } from './packages/tree.js';
import { Uses, namesOf } from './packages/uses.js';
import { askPush } from './push.js';
import { at, go, place, restate } from './router.js';
import { Rows } from './rows.js';
import { since } from './signs.js';

// As in packages.css.
const ROW = 31;
const SHOWN_ROBOTS = 24;
const REFETCH_PAUSE_MS = 1_000;

export class PackageView {
  #rows = new Rows();
  #cursor = new Cursor(this.#rows, (path) => this.#toggle(path));
  /** The newest first; absent: not yet fetched. */
  #versions;
  /** What the address says of each. */
  #words;
  #problem = null;
  /** What was fetched of one version, or between two: `{ key, tree | difference | problem }`. */
  #content = { key: null };
  #query = {};
  #timer;

  constructor(app) {
    this.app = app;
    this.uses = new Uses(app.fleet);
  }

  arrive({ path: [, name], query }) {
    const isFirst = !this.name;
    this.name = name;
    this.#query = query;
    this.#rows.rearrange();
    if (isFirst) this.#fetch();
    else this.#fetchContent();
  }

  leave() {
    clearTimeout(this.#timer);
  }

  refresh() {
    this.#fetch();
  }

  hear({ type, name }) {
    if (type !== 'package' || name !== this.name) return;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#fetch(), REFETCH_PAUSE_MS);
  }

  #look(query) {
    change(() => {
      this.#query = { ...this.#query, ...query };
      this.#rows.rearrange();
      restate(this.#query);
    });
    this.#fetchContent();
  }

  // Fetching.

  async #fetch() {
    try {
      this.#versions = (await get(`/packages/${encodeURIComponent(this.name)}`)).versions;
      this.#words = namesOf(this.#versions);
      this.#problem = null;
    } catch ({ message }) {
      this.#problem = message;
    }
    change();
    this.#fetchContent();
  }

  /** The version that is shown: what the address says, by its version or digest, or the newest. */
  get #version() {
    return this.#find(this.#query.version) ?? this.#versions?.[0];
  }

  /** The version it is compared with, if it is with another one. */
  get #other() {
    const other = this.#query.with && this.#find(this.#query.with);
    return other && other !== this.#version ? other : null;
  }

  #find(text) {
    return this.#versions?.find(
      ({ package: { version, manifest } }) => version === text || manifest.digest === text,
    );
  }

  async #fetchContent() {
    const version = this.#version;
    if (!version) return;
    const [to, from] = [version.package.manifest.digest, this.#other?.package.manifest.digest];
    const key = `${to} ${from ?? ''}`;
    if (this.#content.key === key) return;
    // Until the other one is there the old list stays, so that nothing below it jumps.
    this.#content.key = key;
    const path = `/packages/${encodeURIComponent(this.name)}`;
    let content;
    try {
      if (from) content = { difference: differences(await get(`${path}/diff`, { from, to })) };
      else
        content = { tree: new Tree((await get(`${path}/${encodeURIComponent(to)}/files`)).files) };
    } catch ({ status, message }) {
      // Without a key it is asked again.
      content = {
        key: null,
        problem:
          status === 404 || status === 405 ? 'This server does not tell what is in it.' : message,
      };
    }
    if (this.#content.key === key) change(() => (this.#content = { key, ...content }));
  }

  // Drawing.

  draw(now) {
    const version = this.#version;
    return html`
      <p class="path"><a href=${at(['packages'])}>Packages</a></p>
      <header class="bar-of-tools package-head">
        <h1>${this.name}</h1>
        ${version ? this.#acts(version) : nothing}
      </header>
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}
      ${
        version
          ? html`
        <div class="package-body">
          <nav class="versions" aria-label="Versions">${this.#versions.map((one) => this.#versionLink(one, one === version, now))}</nav>
          <div class="version">
            ${this.#head(version, now)}
            ${facts(version.manifest)}
            ${this.#whereItRuns(version)}
            ${this.#files(version)}
          </div>
        </div>`
          : nothing
      }`;
  }

  #acts(version) {
    const { can } = this.app;
    const { manifest } = version.package;
    return html`<span class="acts">
      ${can('publish') ? html`<button class="quiet-button danger-text" @click=${() => this.#askDelete(version)}>Delete…</button>` : nothing}
      ${can('operate') ? html`<button class="primary" @click=${() => askPush(this.app, null, { package: this.name, manifest: manifest.digest })}>Push…</button>` : nothing}
    </span>`;
  }

  #versionLink(one, isShown, now) {
    const { pushed_at_ms: pushed } = one;
    const count = this.uses.of(one.package).length;
    return html`<a href=${at(['packages', this.name], { ...this.#query, version: this.#words.get(one) })} aria-current=${isShown ? 'true' : nothing}>
      <span class="number">${this.#titleOf(one)}</span><span class="quiet">${since(pushed, now)}</span><span class="quiet robots">${count ? plural(count, 'robot') : ''}</span></a>`;
  }

  #titleOf(one) {
    const { version, manifest } = one.package;
    return this.#words.get(one) === version ? version : `${version} (${short(manifest.digest)})`;
  }

  #head({ package: { version, manifest, content }, pushed_at_ms: pushed }, now) {
    return html`
      <h2>${version}</h2>
      <p class="quiet version-line row-of-copy">${size(content.size)} · pushed <span title=${moment(pushed)}>${since(pushed, now)}</span> · <span class="code" title=${manifest.digest}>${short(manifest.digest)}</span> ${copyButton(manifest.digest, 'the digest')} · <a href=${at(['deployments'], { q: `${this.name}@${version}` })}>its deployments</a></p>`;
  }

  #whereItRuns({ package: one }) {
    const robots = this.uses.of(one);
    const rest = robots.length - SHOWN_ROBOTS;
    return html`
      <section aria-labelledby="runs">
        <header><h2 id="runs">Runs on <span class="count">${number(robots.length)}</span></h2></header>
        <p>${robots.length ? nothing : html`<span class="quiet">no robot now</span>`}${robots.slice(0, SHOWN_ROBOTS).map(({ name }, index) => html`${index ? ', ' : ''}<a href=${at(['robots', name])}>${name}</a>`)}${rest > 0 ? html` and <a href=${at(['robots'], { q: `${this.name}@${one.version}` })}>${number(rest)} more</a>` : nothing}</p>
      </section>`;
  }

  #files(version) {
    const others = this.#versions.filter((one) => one !== version);
    const { tree, difference, problem } = this.#content;
    return html`
      <section class="files" aria-labelledby="files">
        <header>
          <h2 id="files">${this.#other ? 'What changed' : 'Files'} <span class="count">${tree ? `${number(tree.files)}, ${size(tree.bytes)}` : ''}</span></h2>
          <span class="acts">
            ${tree ? html`<input type="search" placeholder="Search" aria-label="Search its files" aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${this.#query.q ?? ''} @input=${({ currentTarget }) => this.#look({ q: currentTarget.value })}>` : nothing}
            ${
              others.length
                ? html`<label class="quiet">Compare with <select @change=${({ currentTarget }) => this.#look({ with: currentTarget.value })}>
              <option value="" ?selected=${!this.#other}>no other</option>
              ${others.map((one) => html`<option value=${this.#words.get(one)} ?selected=${one === this.#other}>${this.#titleOf(one)}</option>`)}</select></label>`
                : nothing
            }
          </span>
        </header>
        ${problem ? html`<p class="quiet">${problem}</p>` : nothing}
        ${difference ? this.#difference(version, difference) : nothing}
        ${tree ? this.#tree(tree) : nothing}
      </section>`;
  }

  #tree(tree) {
    const text = (this.#query.q ?? '').toLowerCase();
    const rows = tree.rows(text);
    const { start, end } = this.#rows.sight(
      rows.map(({ path }) => path),
      () => ROW,
    );
    const hasFolds = !text && rows.some(({ kind }) => kind === 'directory');
    return html`
      <div class="table files-table" role="treegrid" aria-label="Files" aria-rowcount=${rows.length}>
        <div class="rows" role="rowgroup"><div class="sight" role="presentation">${repeat(
          rows.slice(start, end),
          ({ path }) => path,
          (node, index) => this.#node(tree, node, start + index),
        )}</div></div>
      </div>
      ${rows.length ? nothing : html`<p class="quiet">No file is called that.</p>`}
      ${hasFolds ? html`<p class="folds"><button class="plain link" @click=${() => this.#toggleAll(tree, true)}>Unfold all</button> <button class="plain link" @click=${() => this.#toggleAll(tree, false)}>Fold all</button></p>` : nothing}`;
  }

  #node(tree, { path, name, kind, depth, mode, size: length, target }, index) {
    const isDirectory = kind === 'directory';
    const isUnfolded = tree.isUnfolded(path);
    return html`
      <div class="row depth-${Math.min(depth, 12)}" role="row" tabindex=${this.#cursor.tabindex(path, index)} aria-level=${depth + 1} aria-expanded=${isDirectory ? isUnfolded : nothing} aria-rowindex=${index + 1} data-key=${path} @focusin=${() => (this.#cursor.current = path)}>
        <span class="cell file code" role="gridcell" title=${path}>${
          isDirectory
            ? html`<button class="plain" tabindex="-1" @click=${() => this.#toggle(path)}><span class="fold-sign" aria-hidden="true">${isUnfolded ? '▾' : '▸'}</span>${name}/</button>`
            : html`<span class="fold-sign"></span>${name}${target ? html` <span class="quiet">→ ${target}</span>` : nothing}`
        }</span>
        <span class="cell mode code quiet" role="gridcell">${isDirectory ? '' : modeWords(mode)}</span>
        <span class="cell size ${isDirectory ? 'quiet' : ''}" role="gridcell">${kind === 'link' ? '' : size(length)}</span>
      </div>`;
  }

  #toggle(path) {
    change(() => {
      this.#rows.rearrange();
      this.#content.tree?.toggle(path);
    });
  }

  #toggleAll(tree, isUnfolded) {
    change(() => {
      this.#rows.rearrange();
      tree.toggleAll(isUnfolded);
    });
  }

  #difference(version, { rows, by }) {
    const count = (kind) => number(rows.filter((row) => row.kind === kind).length);
    const { start, end } = this.#rows.sight(
      rows.map(({ path }) => path),
      () => ROW,
    );
    const manifest = this.#other
      ? manifestDifference(this.#other.manifest, version.manifest)
      : nothing;
    return html`
      <p>From ${this.#other?.package.version} to ${version.package.version}: ${rows.length ? html`${count('added')} added, ${count('removed')} removed, ${count('changed')} changed, <span class="quiet">${signed(by)}</span>` : 'the files are the same'}</p>
      ${manifest === nothing ? nothing : html`<h3>In the manifest</h3>${manifest}`}
      <div class="table differences-table" role="grid" aria-label="Files that differ" aria-rowcount=${rows.length}>
        <div class="rows" role="rowgroup"><div class="sight" role="presentation">${repeat(
          rows.slice(start, end),
          ({ path }) => path,
          (row, index) => this.#changed(row, start + index),
        )}</div></div>
      </div>`;
  }

  #changed({ path, kind, sign, from, to, by }, index) {
    const hasMode = from && to && from.mode !== to.mode;
    return html`
      <div class="row ${kind}" role="row" tabindex=${this.#cursor.tabindex(path, index)} aria-rowindex=${index + 1} data-key=${path} @focusin=${() => (this.#cursor.current = path)}>
        <span class="cell what" role="gridcell"><span aria-hidden="true">${sign}</span> ${kind}</span>
        <span class="cell file code" role="gridcell" title=${path}>${path}</span>
        <span class="cell mode code quiet" role="gridcell">${hasMode ? `${modeWords(from.mode)} → ${modeWords(to.mode)}` : ''}</span>
        <span class="cell size" role="gridcell">${(to ?? from).kind === 'file' ? signed(by) : ''}</span>
      </div>`;
  }

  drawn() {
    this.#rows.place();
    this.#cursor.drawn();
  }

  key(event) {
    const { key } = event;
    const { tree, difference } = this.#content;
    if (key === 'Escape' && this.#query.q) {
      this.#look({ q: '' });
      return true;
    }
    const isFold =
      (key === 'ArrowRight' || key === 'ArrowLeft') && tree && event.target.matches('.row');
    if (isFold && tree.isUnfolded(this.#cursor.current) === (key === 'ArrowLeft')) {
      this.#toggle(this.#cursor.current);
      return true;
    }
    const rows = tree?.rows((this.#query.q ?? '').toLowerCase()) ?? difference?.rows ?? [];
    return this.#cursor.key(
      event,
      rows.map(({ path }) => path),
    );
  }

  // Acting.

  /** The server refuses to delete what robots should have. */
  #tellWhoNeeds(title, robots) {
    const ids = new Set(robots.map(({ id }) => id));
    open({
      title: `${title} is in use`,
      body: () =>
        html`<p>${plural(ids.size, 'robot')} should have it. Bring them another version, or remove the task from them, before it can be deleted.</p>${names(ids, this.app.fleet)}`,
    });
  }

  #askDelete(version) {
    const { manifest } = version.package;
    const title = `${this.name} ${this.#titleOf(version)}`;
    const isOnly =
      this.#versions.filter((one) => one.package.version === version.package.version).length === 1;
    const wanting = this.uses.wanting(version.package, isOnly);
    if (wanting.length) return void this.#tellWhoNeeds(title, wanting);
    const count = this.uses.of(version.package).length;
    open({
      title: `Delete ${title}?`,
      action: 'Delete',
      isDangerous: true,
      body: () =>
        html`<p>${count ? `It still runs on ${plural(count, 'robot')}, which should have another version. ` : ''}Its files are taken from the server, and it can't be pushed to robots any more.</p>`,
      act: async () => {
        await remove(
          `/packages/${encodeURIComponent(this.name)}/${encodeURIComponent(manifest.digest)}`,
        );
        tell(`${title} is deleted.`);
        if (this.#versions.length === 1) return go(['packages']);
        this.#query = { ...this.#query, version: undefined, with: undefined };
        if (place().path[0] === 'packages') restate(this.#query);
        this.#fetch();
      },
    });
  }
}

/** `+1.2 kB`. */
const signed = (bytes) =>
  bytes === 0 ? '±0 B' : `${bytes > 0 ? '+' : '−'}${size(Math.abs(bytes))}`;
