// The ROS tab: nodes with lifecycle and parameters, and topics with their publishers and
// subscribers. All data comes from the robot and shows its age.

import { repeat } from '../../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { askRobot } from '../../api/api.js';
import { openDialog } from '../../display/dialog.js';
import { change } from '../../display/display.js';
import { number, words } from '../../display/format.js';
import { notify } from '../../display/notice.js';
import { RobotRequest } from './request.js';

/** The transitions in each lifecycle state, as in `lifecycle_msgs`. */
const TRANSITIONS = {
  unconfigured: ['configure', 'shutdown'],
  inactive: ['activate', 'cleanup', 'shutdown'],
  active: ['deactivate', 'shutdown'],
};

/** The effects of the transitions. */
const TRANSITION_EFFECTS = {
  configure: 'The node reads its parameters and becomes inactive.',
  activate: 'The node starts processing.',
  deactivate: 'The node stops processing until it is activated.',
  cleanup: 'The node releases its resources and becomes unconfigured.',
  shutdown: 'The node shuts down for good; only a restart of its task brings it back.',
};

/**
 * Keeps numbers as written: in ROS, 1.0 and 1 have different types, and 64-bit integers exceed the
 * precision of numbers here.
 */
const exactly = (_, value, context) =>
  typeof value === 'number' && context?.source && JSON.rawJSON
    ? JSON.rawJSON(context.source)
    : value;

export class Ros {
  #page;
  #nodes;
  #topics;
  /** The selected node, its requests, and the parameter being edited. */
  #selected = null;
  #detail = null;
  #parameters = null;
  #editing = null;
  /** The running transition, and the error of the last one. */
  #transition = null;
  #transitionError = null;
  #filter = '';
  #isOnline = false;
  /** The parameter whose editor was closed: the focus returns to its button. */
  #closedParameter = null;
  #isRevealDue = false;

  constructor(page) {
    this.#page = page;
    this.#nodes = new RobotRequest(page, { type: 'nodes' });
    this.#topics = new RobotRequest(page, { type: 'topics' });
  }

  enter() {
    this.#isOnline = this.#page.robot.online;
    this.#refreshAll();
    this.onNavigate();
  }

  onNavigate() {
    const name = this.#page.query.node ?? null;
    if (name === this.#selected) return;
    this.#selected = name;
    this.#editing = null;
    this.#transitionError = null;
    this.#isRevealDue = name !== null;
    this.#detail = name && new RobotRequest(this.#page, { type: 'node', name });
    this.#parameters =
      name && new RobotRequest(this.#page, { type: 'parameters', node: name }, exactly);
    this.#detail?.send();
    this.#parameters?.send();
  }

  /** Repeats failed requests when the robot is back online. */
  onEvent({ online }) {
    if (online && !this.#isOnline)
      for (const request of this.#requests) if (request.problem) request.send();
    this.#isOnline = online;
  }

  get #requests() {
    return [this.#nodes, this.#topics, this.#detail, this.#parameters].filter(Boolean);
  }

  #refreshAll() {
    for (const request of this.#requests) request.send();
  }

  draw(robot, now) {
    const { problem } = this.#nodes;
    // A common error is shown once.
    if (problem && problem.code === this.#topics.problem?.code && !this.#nodes.answer) {
      return html`<section class="ros">${this.#nodes.error()}<p><button class="quiet-button"
        ?disabled=${this.#nodes.isBusy}
        @click=${() => this.#refreshAll()}>Retry</button></p></section>`;
    }
    return html`
      <div class="ros">
        <p class="tools"><input type="search" placeholder="Filter nodes and topics"
          aria-label="Filter nodes and topics" aria-keyshortcuts="/" autocomplete="off"
          spellcheck="false" .value=${this.#filter}
          @input=${({ currentTarget }) => this.#setFilter(currentTarget.value)}></p>
        <div class="two-columns ${this.#selected ? 'has-selection' : ''}">
          ${this.#nodeTable(now)}
          ${
            this.#selected
              ? this.#node(now)
              : html`<section class="hint"><p class="quiet">Select a node to see its topics,
                  services and parameters.</p></section>`
          }
        </div>
        ${this.#topicTable(now)}
      </div>`;
  }

  #setFilter(text) {
    change(() => (this.#filter = text.trim().toLowerCase()));
  }

  // Nodes

  #nodeTable(now) {
    const all = this.#nodes.answer?.nodes ?? [];
    const nodes = all.filter(({ name }) => name.toLowerCase().includes(this.#filter));
    const hasLifecycle = all.some(({ lifecycle }) => lifecycle);
    return html`
      <section aria-labelledby="nodes">
        <header><h2 id="nodes">Nodes${
          this.#nodes.answer ? html` <span class="count">${number(all.length)}</span>` : nothing
        }</h2>${this.#nodes.status('nodes', now)}</header>
        ${this.#nodes.error()}
        ${
          nodes.length
            ? html`<div class="scroll" tabindex="0" role="region" aria-label="Table of nodes">
              <table>
              <thead><tr><th>Node</th><th>Task</th>${
                hasLifecycle ? html`<th>State</th>` : nothing
              }</tr></thead>
              <tbody>${nodes.map(
                (node) => html`
                <tr aria-selected=${node.name === this.#selected ? 'true' : nothing}
                  class=${node.name === this.#selected ? 'selected' : ''}>
                  <td>${this.#link(node.name)}</td>
                  <td>${node.task ?? html`<span class="quiet">–</span>`}</td>
                  ${hasLifecycle ? html`<td>${lifecycleState(node)}</td>` : nothing}
                </tr>`,
              )}</tbody>
            </table></div>`
            : this.#nodes.answer
              ? html`<p class="quiet">${
                  all.length ? 'No nodes match this filter.' : 'No nodes in the graph.'
                }</p>`
              : nothing
        }
      </section>`;
  }

  #link = (name) =>
    html`<a class="code" href=${this.#page.hrefTo('ros', { node: name })}
      aria-current=${name === this.#selected ? 'true' : nothing}>${name}</a>`;

  #node(now) {
    const detail = this.#detail.answer?.nodes ?? [];
    const node = this.#nodes.answer?.nodes.find(({ name }) => name === this.#selected) ?? detail[0];
    return html`
      <section class="node" aria-labelledby="node">
        <header><h2 id="node" class="code">${this.#selected}</h2>
          <a href=${this.#page.hrefTo('ros')}>Close</a></header>
        ${this.#lifecycle(node)}
        <section aria-labelledby="parameters">
          <header><h3 id="parameters">Parameters</h3>
            ${this.#parameters.status('parameters', now)}</header>
          ${this.#parameters.error()}
          ${this.#parameterList()}
        </section>
        <section aria-labelledby="endpoints">
          <header><h3 id="endpoints">Topics and services</h3>
            ${this.#detail.status('topics and services', now)}</header>
          ${this.#detail.error()}
          ${
            detail.length > 1
              ? html`<p class="bad"><span aria-hidden="true">▲ </span>${number(detail.length)} nodes
                  have this name.</p>`
              : nothing
          }
          ${detail.map(({ publishers, subscriptions, services, clients }) =>
            [
              ['Publishes', publishers],
              ['Subscribes to', subscriptions],
              ['Offers', services],
              ['Calls', clients],
            ]
              .filter(([, endpoints]) => endpoints.length)
              .map(([title, endpoints]) => endpointList(title, endpoints)),
          )}
        </section>
      </section>`;
  }

  #lifecycle(node) {
    if (!node?.lifecycle) return nothing;
    const transitions = this.#page.app.can('operate') ? (TRANSITIONS[node.lifecycle] ?? []) : [];
    return html`
      <p class="lifecycle">Lifecycle: ${lifecycleState(node)}
        ${transitions.map(
          (transition) =>
            html`<button class="quiet-button" ?disabled=${this.#transition !== null}
              @click=${() => this.#openTransitionDialog(node, transition)}>${transition}…</button>`,
        )}
        <span role="status">${this.#transition ? `${this.#transition}…` : ''}</span></p>
      ${
        this.#transitionError
          ? html`<p class="bad" role="alert"><span
              aria-hidden="true">▲ </span>${this.#transitionError}</p>`
          : nothing
      }`;
  }

  #openTransitionDialog({ name, lifecycle, task }, transition) {
    const robot = this.#page.robot.name;
    const title = transition.charAt(0).toUpperCase() + transition.slice(1);
    openDialog({
      title: `${title} ${name}?`,
      submitLabel: title,
      isDangerous: ['shutdown', 'cleanup', 'deactivate'].includes(transition),
      body: () =>
        html`<p>The node <code>${name}</code>${
          task ? html` of the task <strong>${task}</strong>` : nothing
        } on <strong>${robot}</strong> is ${words(lifecycle)}.
          ${TRANSITION_EFFECTS[transition]}</p>`,
      onSubmit: () => void this.#runTransition(name, transition),
    });
  }

  async #runTransition(name, transition) {
    change(() => {
      this.#transition = transition;
      this.#transitionError = null;
    });
    try {
      const { state } = await askRobot(this.#page.robot.id, {
        type: 'lifecycle',
        node: name,
        transition,
      });
      notify(`${name} is ${words(state)}.`);
      for (const answer of [this.#nodes.answer, this.#detail?.answer])
        for (const node of answer?.nodes ?? []) if (node.name === name) node.lifecycle = state;
    } catch (error) {
      this.#transitionError = this.#page.withRobotName(error.message);
    }
    change(() => (this.#transition = null));
    // Topics and services may have changed.
    this.#refreshAll();
  }

  // Parameters

  #parameterList() {
    const { answer } = this.#parameters;
    if (!answer) return nothing;
    if (!answer.parameters.length) return html`<p class="quiet">No parameters.</p>`;
    return html`<ul class="parameters">${repeat(
      answer.parameters,
      ({ name }) => name,
      (parameter) =>
        this.#editing?.name === parameter.name ? this.#form() : this.#parameter(parameter),
    )}</ul>`;
  }

  #parameter({ name, value }) {
    const text = JSON.stringify(value);
    return html`
      <li>
        <span class="code name">${name}</span>
        <span class="code value">${text}</span>
        ${
          this.#page.app.can('operate')
            ? html`<button class="plain link" data-parameter=${name} aria-label=${`Change ${name}`}
                @click=${() => this.#openEditor(name, text)}>Change</button>`
            : nothing
        }
      </li>`;
  }

  #openEditor(name, text) {
    change(() => (this.#editing = { name, text, problem: null, isBusy: false, isNew: true }));
  }

  #form() {
    const editing = this.#editing;
    const { name, text, problem, isBusy } = editing;
    return html`
      <li>
        <form @submit=${(event) => this.#setParameter(event)}>
          <label for="parameter" class="code">${name}</label>
          <input id="parameter" class="code" required autocomplete="off" autocapitalize="none"
            spellcheck="false" .value=${text} aria-invalid=${problem ? 'true' : nothing}
            aria-describedby="parameter-problem parameter-hint"
            @input=${({ currentTarget }) => (editing.text = currentTarget.value)}
            @keydown=${(event) => this.#onEditKey(event)}>
          <button class="primary" ?disabled=${isBusy}>Set</button>
          <button type="button" class="quiet-button"
            @click=${() => this.#closeEditor()}>Cancel</button>
          <p id="parameter-problem" class="bad" role="alert">${problem ? `▲ ${problem}` : ''}</p>
          <p id="parameter-hint" class="quiet">A JSON value: <code>true</code>, <code>7</code>,
            <code>7.0</code>, <code>"text"</code>, <code>[1, 2]</code>. The change lasts until the
            node restarts.</p>
        </form>
      </li>`;
  }

  #onEditKey(event) {
    if (event.key !== 'Escape') return;
    event.stopPropagation();
    this.#closeEditor();
  }

  #closeEditor() {
    change(() => {
      this.#closedParameter = this.#editing?.name;
      this.#editing = null;
    });
  }

  async #setParameter(event) {
    event.preventDefault();
    const editing = this.#editing;
    const node = this.#selected;
    change(() => Object.assign(editing, { problem: null, isBusy: true }));
    try {
      const parameter = { name: editing.name, value: valueOf(editing.text) };
      const { parameter: now } = await askRobot(
        this.#page.robot.id,
        { type: 'set_parameter', node, parameter },
        exactly,
      );
      change(() => {
        const shown =
          this.#selected === node &&
          this.#parameters.answer?.parameters.find(({ name }) => name === now.name);
        if (shown) shown.value = now.value;
        if (this.#editing === editing) this.#closeEditor();
      });
      notify(`${now.name} set to ${JSON.stringify(now.value)}.`);
    } catch (error) {
      change(() =>
        Object.assign(editing, { problem: this.#page.withRobotName(error.message), isBusy: false }),
      );
    }
  }

  afterDraw() {
    if (this.#isRevealDue)
      document.querySelector('.ros .node')?.scrollIntoView({ block: 'nearest' });
    this.#isRevealDue = false;
    if (this.#closedParameter)
      [...document.querySelectorAll('.parameters [data-parameter]')]
        .find(({ dataset }) => dataset.parameter === this.#closedParameter)
        ?.focus();
    this.#closedParameter = null;
    if (!this.#editing?.isNew) return;
    this.#editing.isNew = false;
    document.getElementById('parameter')?.select();
  }

  // Topics

  #topicTable(now) {
    const all = this.#topics.answer?.topics ?? [];
    const topics = all.filter(({ name, types }) =>
      [name, ...types].some((text) => text.toLowerCase().includes(this.#filter)),
    );
    const endpoints = (names) =>
      names.length
        ? names.map((name) => html`<div>${this.#link(name)}</div>`)
        : html`<span class="quiet">none</span>`;
    return html`
      <section aria-labelledby="topics">
        <header><h2 id="topics">Topics${
          this.#topics.answer ? html` <span class="count">${number(all.length)}</span>` : nothing
        }</h2>${this.#topics.status('topics', now)}</header>
        ${this.#topics.error()}
        ${
          topics.length
            ? html`<div class="scroll" tabindex="0" role="region" aria-label="Table of topics">
              <table class="topics">
              <thead><tr><th>Topic</th><th>Type</th>
                <th>Publishers</th><th>Subscribers</th></tr></thead>
              <tbody>${topics.map(
                ({ name, types, publishers, subscriptions }) => html`
                <tr>
                  <td class="code">${name}</td>
                  <td class="code">${types.map((type) => html`<div>${type}</div>`)}${
                    types.length > 1 ? html`<div class="bad">▲ conflicting types</div>` : nothing
                  }</td>
                  <td>${endpoints(publishers)}</td>
                  <td>${endpoints(subscriptions)}</td>
                </tr>`,
              )}</tbody>
            </table></div>`
            : this.#topics.answer
              ? html`<p class="quiet">${
                  all.length ? 'No topics match this filter.' : 'No topics in the graph.'
                }</p>`
              : nothing
        }
      </section>`;
  }
}

const endpointList = (title, endpoints) =>
  html`<details><summary>${title} <span class="count">${endpoints.length}</span></summary><ul
    class="endpoints">${endpoints.map(
      ({ name, type }) => html`<li class="code">${name} <span class="quiet">${type}</span></li>`,
    )}</ul></details>`;

const LIFECYCLE_SYMBOLS = {
  active: '● ',
  inactive: '○ ',
  unconfigured: '○ ',
  finalized: '✕ ',
  changing: '',
};

const lifecycleState = ({ lifecycle }) =>
  lifecycle
    ? html`<span class="lifecycle-state ${lifecycle}"><span
        aria-hidden="true">${LIFECYCLE_SYMBOLS[lifecycle] ?? ''}</span>${words(lifecycle)}</span>`
    : html`<span class="quiet">–</span>`;

/** Parses the entered value. */
function valueOf(text) {
  try {
    return JSON.parse(text, exactly);
  } catch {
    throw new Error('Not a valid JSON value. Enclose strings in quotation marks.');
  }
}
