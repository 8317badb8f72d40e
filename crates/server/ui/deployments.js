// The deployments, the newest first: what was ordered, for whom, and how far each has come.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import { deployments as fetchDeployments } from './api.js';
import { command } from './copy.js';
import { Cursor } from './cursor.js';
import { moment, number, tone, words } from './format.js';
import { change } from './frame.js';
import { askPush } from './push.js';
import { at, go, restate } from './router.js';
import { Rows, isNarrow } from './rows.js';
import { countBar, countWords, deploymentState, since } from './signs.js';

// As in deployments.css.
const ROW = 41;
const NARROW_ROW = 113;

const TOLD_TERMS = 6;

const failures = ({ counts }) =>
  counts.reduce((sum, { phase, count }) => sum + (tone(phase) === 'bad' ? count : 0), 0);

/** What a deployment can be shown under. */
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

export class DeploymentsView {
  #rows = new Rows();
  #cursor = new Cursor(this.#rows, (id) => go(['deployments', id]));
  #state = STATES[0];
  #text = '';
  #isFetching = false;

  constructor(app) {
    this.app = app;
  }

  arrive({ query }) {
    this.#rows.rearrange();
    this.#text = query.q ?? '';
    this.#state = STATES.find(({ id }) => id === query.state) ?? STATES[0];
  }

  #look(text, state = this.#state) {
    change(() => {
      this.#rows.rearrange();
      this.#text = text;
      this.#state = state;
      restate({ q: text, state: state.id });
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
    const { start, end } = this.#rows.sight(
      shown.map(({ id }) => id),
      () => (isNarrow ? NARROW_ROW : ROW),
    );
    return html`
      <header class="bar-of-tools">
        <h1>Deployments</h1>
        ${this.#strip()}
        <input type="search" placeholder="Search" aria-label="Search deployments" aria-keyshortcuts="/" autocomplete="off" spellcheck="false"
          .value=${this.#text} @input=${({ currentTarget }) => this.#look(currentTarget.value)}>
        ${can('operate') ? html`<button class="primary" @click=${() => askPush(this.app)}>New deployment…</button>` : nothing}
      </header>
      ${fleet.deployments.length ? this.#table(shown, start, end, now) : nothing}
      ${fleet.isLoaded && !fleet.deployments.length && !fleet.older ? noDeployments() : nothing}
      ${fleet.deployments.length && !shown.length ? html`<p class="empty quiet">No deployment is like that${fleet.older ? ' among those fetched' : ''}. <button class="plain link" @click=${() => this.#look('', STATES[0])}>Show all</button></p>` : nothing}
      ${fleet.older ? html`<p class="older"><button class="quiet-button" ?disabled=${this.#isFetching} @click=${() => this.#fetchOlder()}>Show older ones</button> <span class="quiet">The newest ${number(fleet.deployments.length)} are here.</span></p>` : nothing}`;
  }

  #strip() {
    const { deployments, isLoaded, older } = this.app.fleet;
    return html`<div class="strip" role="group" aria-label="Show deployments that are">${STATES.map(
      (state) => {
        const count = deployments.filter(state.has).length;
        return html`
        <button class="counter ${state.id === 'failures' ? 'failed' : ''}" aria-pressed=${this.#state === state} @click=${() => this.#look(this.#text, this.#state === state ? STATES[0] : state)}>
          <span class="figure">${isLoaded || count ? number(count) : '–'}${older ? '+' : ''}</span><span>${state.sign ? html`<span aria-hidden="true">${state.sign} </span>` : nothing}${state.title}</span>
        </button>`;
      },
    )}</div>`;
  }

  #table(shown, start, end, now) {
    const { fleet } = this.app;
    return html`
      <div class="table deployments-table" role="grid" aria-label="Deployments" aria-rowcount=${shown.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">${['State', 'Package', 'To', 'Progress', 'Robots', 'Ordered'].map((title) => html`<span role="columnheader">${title}</span>`)}</div>
        <div class="rows" role="rowgroup"><div class="sight" role="presentation">${repeat(
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
      <div class="row" role="row" tabindex=${this.#cursor.tabindex(id, index)} aria-rowindex=${index + 2} data-key=${id} data-deployment=${id} @focusin=${() => (this.#cursor.current = id)}>
        <span class="cell state" role="gridcell">${deploymentState(deployment)}</span>
        <span class="cell package" role="gridcell"><a href=${at(['deployments', id])} title=${id}>${name}<span class="quiet">@${version}</span></a></span>
        <span class="cell selector quiet" role="gridcell" title=${selector ?? nothing}>${wordsOf(deployment, fleet)}</span>
        <span class="cell progress" role="gridcell">${countBar(counts)}</span>
        <span class="cell counts" role="gridcell" title=${counts.map(({ phase, count }) => `${number(count)} ${words(phase)}`).join(', ')}>${countWords(counts)}</span>
        <span class="cell since quiet" role="gridcell" title=${moment(created)}>${since(created, now)}${replaced(deployment, fleet)}</span>
      </div>`;
  }

  async #fetchOlder() {
    const { fleet } = this.app;
    change(() => (this.#isFetching = true));
    const page = await this.app.attempt(() => fetchDeployments(fleet.older));
    change(() => {
      this.#isFetching = false;
      if (page) fleet.extend(page);
    });
  }

  drawn() {
    this.#rows.place();
    this.#cursor.drawn();
  }

  key(event) {
    if (event.key === 'Escape' && (this.#text || this.#state.id)) {
      this.#look('', STATES[0]);
      return true;
    }
    return this.#cursor.key(
      event,
      this.#shown.map(({ id }) => id),
    );
  }
}

const noDeployments = () => html`
  <section class="empty">
    <p class="quiet">Nothing is deployed yet. Push a directory to every robot with</p>
    ${command("taskd push ./my_pkg --to '*'")}
  </section>`;

const textOf = ({ id, package: { name, version }, selector = '', state, delivery }) =>
  `${id} ${name}@${version} ${selector} ${state} ${delivery}`.toLowerCase();

/**
 * To whom it is, as people read it: ids that were chosen on the page become names, of many only the
 * first are told, and of too many none is known.
 */
export function wordsOf({ selector, counts }, fleet) {
  if (selector === '*') return 'all robots';
  if (!selector)
    return `${number(counts.reduce((sum, { count }) => sum + count, 0))} chosen robots`;
  const terms = selector.split(',');
  const told = terms
    .slice(0, TOLD_TERMS)
    .map((term) =>
      term.replace(
        /^(!?)(r[0-9a-f]{16})$/,
        (_, not, id) => `${not}${fleet.robots.get(id)?.name ?? id}`,
      ),
    );
  const rest = terms.length - told.length;
  return `${told.join(', ')}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
}

/** Only versions: what a deployment takes the place of is always the same package. */
function replaced({ supersedes }, fleet) {
  if (!supersedes.length) return nothing;
  const versions = new Set(supersedes.map((id) => fleet.deployment(id)?.package.version ?? id));
  return html`<span title=${`supersedes ${supersedes.join(', ')}`}>, replaces ${[...versions].join(', ')}</span>`;
}
