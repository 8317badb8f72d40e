// The view of a package: its versions, and for one version the manifest, robots, files and the
// comparison with another version.

import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { get, remove } from '../api/api.js';
import { copyButton } from '../display/copy.js';
import { Cursor } from '../display/cursor.js';
import { openDialog } from '../display/dialog.js';
import { change } from '../display/display.js';
import { moment, number, plural, shortDigest, size } from '../display/format.js';
import { notify } from '../display/notice.js';
import { hrefTo, navigate, currentRoute, replaceQuery } from '../display/router.js';
import { timeAgo } from '../display/status.js';
import { VirtualList } from '../display/virtual-list.js';
import { robotNames } from '../orders/orders.js';
import { openPushDialog } from '../orders/push.js';
import { manifestView, manifestDiff } from './manifest.js';
import { Tree, packageDiff, modeText } from './tree.js';
import { PackageUsage, versionNames } from './usage.js';

// As in packages.css.
const ROW = 31;
const SHOWN_ROBOTS = 24;
const REFETCH_PAUSE_MS = 1_000;

export class PackageView {
  #list = new VirtualList();
  #cursor = new Cursor(this.#list, (path) => this.#toggle(path));
  /** Newest first; undefined until fetched. */
  #versions;
  /** The name of each version in the address. */
  #names;
  #problem = null;
  /**
   * The fetched content of a version or of a comparison: `{ key, tree | difference | problem }`.
   */
  #content = { key: null };
  #query = {};
  #timer;

  constructor(app) {
    this.app = app;
    this.usage = new PackageUsage(app.fleet);
  }

  onNavigate({ path: [, name], query }) {
    const isFirst = !this.name;
    this.name = name;
    this.#query = query;
    this.#list.releaseAnchor();
    if (isFirst) this.#fetch();
    else this.#fetchContent();
  }

  leave() {
    clearTimeout(this.#timer);
  }

  refresh() {
    this.#fetch();
  }

  onEvent({ type, name }) {
    if (type !== 'package' || name !== this.name) return;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#fetch(), REFETCH_PAUSE_MS);
  }

  #setQuery(query) {
    change(() => {
      this.#query = { ...this.#query, ...query };
      this.#list.releaseAnchor();
      replaceQuery(this.#query);
    });
    this.#fetchContent();
  }

  // Fetching

  async #fetch() {
    try {
      this.#versions = (await get(`/packages/${encodeURIComponent(this.name)}`)).versions;
      this.#names = versionNames(this.#versions);
      this.#problem = null;
    } catch ({ message }) {
      this.#problem = message;
    }
    change();
    this.#fetchContent();
  }

  /** The shown version: by version or digest as in the address, or the newest. */
  get #version() {
    return this.#find(this.#query.version) ?? this.#versions?.[0];
  }

  /** The version to compare with, if any. */
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
    // The old content stays until the new one is loaded, so that the layout is stable.
    this.#content.key = key;
    const path = `/packages/${encodeURIComponent(this.name)}`;
    let content;
    try {
      if (from) content = { difference: packageDiff(await get(`${path}/diff`, { from, to })) };
      else
        content = { tree: new Tree((await get(`${path}/${encodeURIComponent(to)}/files`)).files) };
    } catch ({ status, message }) {
      // Without a key the next call fetches again.
      content = {
        key: null,
        problem:
          status === 404 || status === 405
            ? 'This server does not list package contents.'
            : message,
      };
    }
    if (this.#content.key === key) change(() => (this.#content = { key, ...content }));
  }

  // Drawing

  draw(now) {
    const version = this.#version;
    return html`
      <p class="path"><a href=${hrefTo(['packages'])}>Packages</a></p>
      <header class="toolbar package-head">
        <h1>${this.name}</h1>
        ${version ? this.#actions(version) : nothing}
      </header>
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}
      ${
        version
          ? html`
        <div class="package-body">
          <nav class="versions" aria-label="Versions">${this.#versions.map((one) =>
            this.#versionLink(one, one === version, now),
          )}</nav>
          <div class="version">
            ${this.#head(version, now)}
            ${manifestView(version.manifest)}
            ${this.#robots(version)}
            ${this.#files(version)}
          </div>
        </div>`
          : nothing
      }`;
  }

  #actions(version) {
    const { can } = this.app;
    const { manifest } = version.package;
    return html`<span class="actions">
      ${
        can('publish')
          ? html`<button class="quiet-button danger-text"
              @click=${() => this.#openDeleteDialog(version)}>Delete…</button>`
          : nothing
      }
      ${
        can('operate')
          ? html`<button class="primary" @click=${() => this.#push(manifest)}>Push…</button>`
          : nothing
      }
    </span>`;
  }

  #push({ digest }) {
    openPushDialog(this.app, null, { package: this.name, manifest: digest });
  }

  #versionLink(one, isShown, now) {
    const { pushed_at_ms: pushed } = one;
    const count = this.usage.robotsRunning(one.package).length;
    const version = this.#names.get(one);
    return html`<a href=${hrefTo(['packages', this.name], { ...this.#query, version })}
        aria-current=${isShown ? 'true' : nothing}>
      <span class="number">${this.#titleOf(one)}</span><span
        class="quiet">${timeAgo(pushed, now)}</span><span
        class="quiet robots">${count ? plural(count, 'robot') : ''}</span></a>`;
  }

  #titleOf(one) {
    const { version, manifest } = one.package;
    return this.#names.get(one) === version
      ? version
      : `${version} (${shortDigest(manifest.digest)})`;
  }

  #head({ package: { version, manifest, content }, pushed_at_ms: pushed }, now) {
    return html`
      <h2>${version}</h2>
      <p class="quiet version-line copy-row">${size(content.size)}
        · pushed <span title=${moment(pushed)}>${timeAgo(pushed, now)}</span>
        · <span class="code" title=${manifest.digest}>${shortDigest(manifest.digest)}</span>
        ${copyButton(manifest.digest, 'digest')}
        · <a href=${hrefTo(['deployments'], { q: `${this.name}@${version}` })}>deployments</a></p>`;
  }

  #robots({ package: one }) {
    const robots = this.usage.robotsRunning(one);
    const rest = robots.length - SHOWN_ROBOTS;
    return html`
      <section aria-labelledby="runs">
        <header><h2 id="runs">Runs on
          <span class="count">${number(robots.length)}</span></h2></header>
        <p>${robots.length ? nothing : html`<span class="quiet">No robots</span>`}${robots
          .slice(0, SHOWN_ROBOTS)
          .map(
            ({ name }, index) =>
              html`${index ? ', ' : ''}<a href=${hrefTo(['robots', name])}>${name}</a>`,
          )}${
          rest > 0
            ? html` and <a
                href=${hrefTo(['robots'], { q: `${this.name}@${one.version}` })}
                >${number(rest)} more</a>`
            : nothing
        }</p>
      </section>`;
  }

  #files(version) {
    const others = this.#versions.filter((one) => one !== version);
    const { tree, difference, problem } = this.#content;
    return html`
      <section class="files" aria-labelledby="files">
        <header>
          <h2 id="files">${this.#other ? 'Changes' : 'Files'} <span class="count">${
            tree ? `${number(tree.files)}, ${size(tree.bytes)}` : ''
          }</span></h2>
          <span class="actions">
            ${
              tree
                ? html`<input type="search" placeholder="Search" aria-label="Search files"
                    aria-keyshortcuts="/" autocomplete="off" spellcheck="false"
                    .value=${this.#query.q ?? ''}
                    @input=${({ currentTarget }) => this.#setQuery({ q: currentTarget.value })}>`
                : nothing
            }
            ${
              others.length
                ? html`<label class="quiet">Compare with <select
                    @change=${({ currentTarget }) => this.#setQuery({ with: currentTarget.value })}>
              <option value="" ?selected=${!this.#other}>none</option>
              ${others.map(
                (one) =>
                  html`<option value=${this.#names.get(one)}
                    ?selected=${one === this.#other}>${this.#titleOf(one)}</option>`,
              )}</select></label>`
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
    const { start, end } = this.#list.visibleRange(
      rows.map(({ path }) => path),
      () => ROW,
    );
    const hasDirectories = !text && rows.some(({ kind }) => kind === 'directory');
    return html`
      <div class="table files-table" role="treegrid" aria-label="Files"
        aria-rowcount=${rows.length}>
        <div class="rows" role="rowgroup"><div class="rendered" role="presentation">${repeat(
          rows.slice(start, end),
          ({ path }) => path,
          (node, index) => this.#node(tree, node, start + index),
        )}</div></div>
      </div>
      ${rows.length ? nothing : html`<p class="quiet">No files match this search.</p>`}
      ${
        hasDirectories
          ? html`<p class="tree-actions"><button class="plain link"
              @click=${() => this.#toggleAll(tree, true)}>Expand all</button> <button
              class="plain link"
              @click=${() => this.#toggleAll(tree, false)}>Collapse all</button></p>`
          : nothing
      }`;
  }

  #node(tree, { path, name, kind, depth, mode, size: length, target }, index) {
    const isDirectory = kind === 'directory';
    const isExpanded = tree.isExpanded(path);
    return html`
      <div class="row depth-${Math.min(depth, 12)}" role="row"
        tabindex=${this.#cursor.tabindex(path, index)} aria-level=${depth + 1}
        aria-expanded=${isDirectory ? isExpanded : nothing} aria-rowindex=${index + 1}
        data-key=${path} @focusin=${() => (this.#cursor.current = path)}>
        <span class="cell file code" role="gridcell" title=${path}>${
          isDirectory
            ? html`<button class="plain" tabindex="-1" @click=${() => this.#toggle(path)}><span
                class="tree-toggle"
                aria-hidden="true">${isExpanded ? '▾' : '▸'}</span>${name}/</button>`
            : html`<span class="tree-toggle"></span>${name}${
                target ? html` <span class="quiet">→ ${target}</span>` : nothing
              }`
        }</span>
        <span class="cell mode code quiet" role="gridcell">${
          isDirectory ? '' : modeText(mode)
        }</span>
        <span class="cell size ${isDirectory ? 'quiet' : ''}" role="gridcell">${
          kind === 'link' ? '' : size(length)
        }</span>
      </div>`;
  }

  #toggle(path) {
    change(() => {
      this.#list.releaseAnchor();
      this.#content.tree?.toggle(path);
    });
  }

  #toggleAll(tree, isExpanded) {
    change(() => {
      this.#list.releaseAnchor();
      tree.toggleAll(isExpanded);
    });
  }

  #difference(version, { rows, by }) {
    const count = (kind) => number(rows.filter((row) => row.kind === kind).length);
    const { start, end } = this.#list.visibleRange(
      rows.map(({ path }) => path),
      () => ROW,
    );
    const manifest = this.#other ? manifestDiff(this.#other.manifest, version.manifest) : nothing;
    return html`
      <p>From ${this.#other?.package.version} to ${version.package.version}: ${
        rows.length
          ? html`${count('added')} added, ${count('removed')} removed,
              ${count('changed')} changed, <span class="quiet">${signed(by)}</span>`
          : 'no file changes'
      }</p>
      ${manifest === nothing ? nothing : html`<h3>Manifest changes</h3>${manifest}`}
      <div class="table differences-table" role="grid" aria-label="Changed files"
        aria-rowcount=${rows.length}>
        <div class="rows" role="rowgroup"><div class="rendered" role="presentation">${repeat(
          rows.slice(start, end),
          ({ path }) => path,
          (row, index) => this.#changed(row, start + index),
        )}</div></div>
      </div>`;
  }

  #changed({ path, kind, sign, from, to, by }, index) {
    const hasMode = from && to && from.mode !== to.mode;
    return html`
      <div class="row ${kind}" role="row" tabindex=${this.#cursor.tabindex(path, index)}
        aria-rowindex=${index + 1} data-key=${path}
        @focusin=${() => (this.#cursor.current = path)}>
        <span class="cell kind" role="gridcell"><span
          aria-hidden="true">${sign}</span> ${kind}</span>
        <span class="cell file code" role="gridcell" title=${path}>${path}</span>
        <span class="cell mode code quiet" role="gridcell">${
          hasMode ? `${modeText(from.mode)} → ${modeText(to.mode)}` : ''
        }</span>
        <span class="cell size" role="gridcell">${
          (to ?? from).kind === 'file' ? signed(by) : ''
        }</span>
      </div>`;
  }

  afterDraw() {
    this.#list.applyLayout();
    this.#cursor.afterDraw();
  }

  onKey(event) {
    const { key } = event;
    const { tree, difference } = this.#content;
    if (key === 'Escape' && this.#query.q) {
      this.#setQuery({ q: '' });
      return true;
    }
    const isFold =
      (key === 'ArrowRight' || key === 'ArrowLeft') && tree && event.target.matches('.row');
    if (isFold && tree.isExpanded(this.#cursor.current) === (key === 'ArrowLeft')) {
      this.#toggle(this.#cursor.current);
      return true;
    }
    const rows = tree?.rows((this.#query.q ?? '').toLowerCase()) ?? difference?.rows ?? [];
    return this.#cursor.onKey(
      event,
      rows.map(({ path }) => path),
    );
  }

  // Actions

  /** The server refuses to delete a version that robots are assigned. */
  #openInUseDialog(title, robots) {
    const ids = new Set(robots.map(({ id }) => id));
    openDialog({
      title: `${title} is in use`,
      body: () =>
        html`<p>It is assigned to ${plural(ids.size, 'robot')}. Before deleting it, deploy another
          version to them or remove the task.</p>${robotNames(ids, this.app.fleet)}`,
    });
  }

  #openDeleteDialog(version) {
    const { manifest } = version.package;
    const title = `${this.name} ${this.#titleOf(version)}`;
    const isOnly =
      this.#versions.filter((one) => one.package.version === version.package.version).length === 1;
    const assigned = this.usage.robotsAssigned(version.package, isOnly);
    if (assigned.length) return void this.#openInUseDialog(title, assigned);
    const count = this.usage.robotsRunning(version.package).length;
    const running = count
      ? `It is still running on ${plural(count, 'robot')} that ` +
        `${count === 1 ? 'is' : 'are'} assigned another version. `
      : '';
    openDialog({
      title: `Delete ${title}?`,
      submitLabel: 'Delete',
      isDangerous: true,
      body: () =>
        html`<p>${running}Its files are removed from the server, and it can no longer be
          deployed.</p>`,
      onSubmit: async () => {
        await remove(
          `/packages/${encodeURIComponent(this.name)}/${encodeURIComponent(manifest.digest)}`,
        );
        notify(`${title} deleted.`);
        if (this.#versions.length === 1) return navigate(['packages']);
        this.#query = { ...this.#query, version: undefined, with: undefined };
        if (currentRoute().path[0] === 'packages') replaceQuery(this.#query);
        this.#fetch();
      },
    });
  }
}

/** `+1.2 KB`. */
const signed = (bytes) =>
  bytes === 0 ? '±0 B' : `${bytes > 0 ? '+' : '−'}${size(Math.abs(bytes))}`;
