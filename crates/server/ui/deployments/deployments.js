// Owns the list of deployments, and the view of one deployment with its robots; it never decides how
// a rollout continues.
//
// This module is the list, newest first, with target and progress.

import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { deployments as fetchDeployments } from '../api/api.js';
import { command } from '../display/copy.js';
import { Cursor } from '../display/cursor.js';
import { change } from '../display/display.js';
import { moment, number, tone, words } from '../display/format.js';
import { hrefTo, navigate, replaceQuery } from '../display/router.js';
import { phaseBar, phaseCounts, deploymentState, timeAgo } from '../display/status.js';
import { VirtualList, isNarrow } from '../display/virtual-list.js';
import { openPushDialog } from '../orders/push.js';

// As in deployments.css.
const ROW = 41;
const NARROW_ROW = 113;

const NAMED_TERMS = 6;

const failures = ({ counts }) =>
  counts.reduce((sum, { phase, count }) => sum + (tone(phase) === 'bad' ? count : 0), 0);

/** The filters of the list. */
const STATES = [
  { id: '', title: 'All', sign: '', has: () => true },
  { id: 'active', title: 'Active', sign: '▸', has: ({ state }) => state === 'active' },
  { id: 'paused', title: 'Paused', sign: '‖', has: ({ state }) => state === 'paused' },
  { id: 'settled', title: 'Settled', sign: '✓', has: ({ state }) => state === 'settled' },
  { id: 'cancelled', title: 'Cancelled', sign: '✕', has: ({ state }) => state === 'cancelled' },
  {
    id: 'failures',
    title: 'With failures',
    sign: '▲',
    has: (deployment) => failures(deployment) > 0,
  },
];

const HEADS = ['State', 'Package', 'Target', 'Progress', 'Robots', 'Created'];

export class DeploymentsView {
  #list = new VirtualList();
  #cursor = new Cursor(this.#list, (id) => navigate(['deployments', id]));
  #state = STATES[0];
  #text = '';
  #isFetching = false;

  constructor(app) {
    this.app = app;
  }

  onNavigate({ query }) {
    this.#list.releaseAnchor();
    this.#text = query.q ?? '';
    this.#state = STATES.find(({ id }) => id === query.state) ?? STATES[0];
  }

  #setSearch(text, state = this.#state) {
    change(() => {
      this.#list.releaseAnchor();
      this.#text = text;
      this.#state = state;
      replaceQuery({ q: text, state: state.id });
    });
  }

  get #shown() {
    const parts = this.#text.toLowerCase().split(/\s+/).filter(Boolean);
    return this.app.fleet.deployments.filter(
      (deployment) =>
        this.#state.has(deployment) && parts.every((word) => textOf(deployment).includes(word)),
    );
  }

  draw(now) {
    const { fleet, can } = this.app;
    const shown = this.#shown;
    const { start, end } = this.#list.visibleRange(
      shown.map(({ id }) => id),
      () => (isNarrow ? NARROW_ROW : ROW),
    );
    return html`
      <header class="toolbar">
        <h1>Deployments</h1>
        ${this.#counters()}
        <input type="search" placeholder="Search" aria-label="Search deployments"
          aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${this.#text}
          @input=${({ currentTarget }) => this.#setSearch(currentTarget.value)}>
        ${
          can('operate')
            ? html`<button class="primary"
                @click=${() => openPushDialog(this.app)}>New deployment…</button>`
            : nothing
        }
      </header>
      ${fleet.deployments.length ? this.#table(shown, start, end, now) : nothing}
      ${fleet.isLoaded && !fleet.deployments.length && !fleet.older ? noDeployments() : nothing}
      ${
        fleet.deployments.length && !shown.length
          ? html`<p class="empty quiet">No ${fleet.older ? 'loaded ' : ''}deployments match this
              filter. <button class="plain link"
                @click=${() => this.#setSearch('', STATES[0])}>Clear filter</button></p>`
          : nothing
      }
      ${
        fleet.older
          ? html`<p class="older"><button class="quiet-button" ?disabled=${this.#isFetching}
                @click=${() => this.#fetchOlder()}>Show older</button> <span
                class="quiet">Showing the newest ${number(fleet.deployments.length)}.</span></p>`
          : nothing
      }`;
  }

  #counters() {
    const { deployments, isLoaded, older } = this.app.fleet;
    return html`<div class="counters" role="group" aria-label="Filter by state">${STATES.map(
      (state) => {
        const count = deployments.filter(state.has).length;
        return html`
        <button class="counter ${state.id === 'failures' ? 'failed' : ''}"
          aria-pressed=${this.#state === state} @click=${() => this.#toggleState(state)}>
          <span class="figure">${isLoaded || count ? number(count) : '–'}${
            older ? '+' : ''
          }</span><span>${
            state.sign ? html`<span aria-hidden="true">${state.sign} </span>` : nothing
          }${state.title}</span>
        </button>`;
      },
    )}</div>`;
  }

  #toggleState(state) {
    this.#setSearch(this.#text, this.#state === state ? STATES[0] : state);
  }

  #table(shown, start, end, now) {
    const { fleet } = this.app;
    return html`
      <div class="table deployments-table" role="grid" aria-label="Deployments"
        aria-rowcount=${shown.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">${HEADS.map(
          (title) => html`<span role="columnheader">${title}</span>`,
        )}</div>
        <div class="rows" role="rowgroup"><div class="rendered" role="presentation">${repeat(
          shown.slice(start, end),
          ({ id }) => id,
          (deployment, index) => this.#row(deployment, start + index, fleet, now),
        )}</div></div>
      </div>`;
  }

  #row(deployment, index, fleet, now) {
    const {
      id,
      package: { name, version },
      selector,
      counts,
      created_at_ms: created,
    } = deployment;
    return html`
      <div class="row" role="row" tabindex=${this.#cursor.tabindex(id, index)}
        aria-rowindex=${index + 2} data-key=${id} data-deployment=${id}
        @focusin=${() => (this.#cursor.current = id)}>
        <span class="cell state" role="gridcell">${deploymentState(deployment)}</span>
        <span class="cell package" role="gridcell"><a href=${hrefTo(['deployments', id])}
          title=${id}>${name}<span class="quiet">@${version}</span></a></span>
        <span class="cell selector quiet" role="gridcell"
          title=${selector ?? nothing}>${targetText(deployment, fleet)}</span>
        <span class="cell progress" role="gridcell">${phaseBar(counts)}</span>
        <span class="cell counts" role="gridcell" title=${counts
          .map(({ phase, count }) => `${number(count)} ${words(phase)}`)
          .join(', ')}>${phaseCounts(counts)}</span>
        <span class="cell since quiet" role="gridcell" title=${moment(created)}
          >${timeAgo(created, now)}${replacedVersions(deployment, fleet)}</span>
      </div>`;
  }

  async #fetchOlder() {
    const { fleet } = this.app;
    change(() => (this.#isFetching = true));
    const page = await this.app.attempt(() => fetchDeployments(fleet.older));
    change(() => {
      this.#isFetching = false;
      if (page) fleet.addOlder(page);
    });
  }

  afterDraw() {
    this.#list.applyLayout();
    this.#cursor.afterDraw();
  }

  onKey(event) {
    if (event.key === 'Escape' && (this.#text || this.#state.id)) {
      this.#setSearch('', STATES[0]);
      return true;
    }
    return this.#cursor.onKey(
      event,
      this.#shown.map(({ id }) => id),
    );
  }
}

const noDeployments = () => html`
  <section class="empty">
    <p class="quiet">No deployments yet. To push a directory to all robots, run:</p>
    ${command("taskd push ./my_pkg --to '*'")}
  </section>`;

const textOf = ({ id, package: { name, version }, selector = '', state, delivery }) =>
  `${id} ${name}@${version} ${selector} ${state} ${delivery}`.toLowerCase();

/**
 * The target in readable form: ids become names, and long lists are shortened. The server omits
 * selectors that are too long.
 */
export function targetText({ selector, counts }, fleet) {
  if (selector === '*') return 'all robots';
  if (!selector)
    return `${number(counts.reduce((sum, { count }) => sum + count, 0))} selected robots`;
  const terms = selector.split(',');
  const named = terms
    .slice(0, NAMED_TERMS)
    .map((term) =>
      term.replace(
        /^(!?)(r[0-9a-f]{16})$/,
        (_, not, id) => `${not}${fleet.robots.get(id)?.name ?? id}`,
      ),
    );
  const rest = terms.length - named.length;
  return `${named.join(', ')}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
}

/** Names only the versions: a deployment replaces deployments of the same package. */
function replacedVersions({ supersedes }, fleet) {
  if (!supersedes.length) return nothing;
  const versions = new Set(supersedes.map((id) => fleet.deployment(id)?.package.version ?? id));
  return html`<span title=${`supersedes ${supersedes.join(', ')}`}>, replaces
    ${[...versions].join(', ')}</span>`;
}
