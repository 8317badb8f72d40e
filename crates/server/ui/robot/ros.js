// A robot's ROS graph as it is now: nodes with their lifecycle and parameters, and topics with who
// is at their ends. All of it is asked of the robot, and says how old it is.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { askRobot } from '../api.js';
import { open } from '../dialog.js';
import { number, words } from '../format.js';
import { change } from '../frame.js';
import { tell } from '../notice.js';
import { Asked } from './asked.js';

/** What a lifecycle node can be asked for in each state, as `lifecycle_msgs` has it. */
const TRANSITIONS = {
  unconfigured: ['configure', 'shutdown'],
  inactive: ['activate', 'cleanup', 'shutdown'],
  active: ['deactivate', 'shutdown'],
};

/** What each does to a node. */
const TRANSITION_WORDS = {
  configure: 'It reads its parameters and becomes inactive.',
  activate: 'It begins its work.',
  deactivate: 'It stops its work until it is activated.',
  cleanup: 'It gives up what it has and becomes unconfigured.',
  shutdown: 'It ends its work for good: only a start of its task brings it back.',
};

/**
 * Keeps numbers as they were written: to ROS 1.0 and 1 are of different types, and 64 bits are more
 * than a number has here.
 */
const exactly = (_, value, context) =>
  typeof value === 'number' && context?.source && JSON.rawJSON
    ? JSON.rawJSON(context.source)
    : value;

export class Ros {
  #page;
  #nodes;
  #topics;
  /** The chosen node's name, what is asked about it, and the parameter that is being changed. */
  #chosen = null;
  #detail = null;
  #parameters = null;
  #editing = null;
  /** The node that is changing its state at our word, and why it did not. */
  #changing = null;
  #refused = null;
  #text = '';
  #isOnline = false;
  /** The parameter whose form has gone: the keyboard goes back to where it came from. */
  #left = null;
  #isRevealDue = false;

  constructor(page) {
    this.#page = page;
    this.#nodes = new Asked(page, { type: 'nodes' });
    this.#topics = new Asked(page, { type: 'topics' });
  }

  enter() {
    this.#isOnline = this.#page.robot.online;
    this.#askAll();
    this.arrive();
  }

  arrive() {
    const name = this.#page.query.node ?? null;
    if (name === this.#chosen) return;
    this.#chosen = name;
    this.#editing = null;
    this.#refused = null;
    this.#isRevealDue = name !== null;
    this.#detail = name && new Asked(this.#page, { type: 'node', name });
    this.#parameters = name && new Asked(this.#page, { type: 'parameters', node: name }, exactly);
    this.#detail?.ask();
    this.#parameters?.ask();
  }

  /** A robot that has come back is asked once more what it could not answer. */
  hear({ online }) {
    if (online && !this.#isOnline) for (const asked of this.#asked) if (asked.problem) asked.ask();
    this.#isOnline = online;
  }

  get #asked() {
    return [this.#nodes, this.#topics, this.#detail, this.#parameters].filter(Boolean);
  }

  #askAll() {
    for (const asked of this.#asked) asked.ask();
  }

  draw(robot, now) {
    const { problem } = this.#nodes;
    // One refusal for all is said once.
    if (problem && problem.code === this.#topics.problem?.code && !this.#nodes.answer) {
      return html`<section class="ros">${this.#nodes.refusal()}<p><button class="quiet-button" ?disabled=${this.#nodes.isBusy} @click=${() => this.#askAll()}>Ask again</button></p></section>`;
    }
    return html`
      <div class="ros">
        <p class="tools"><input type="search" placeholder="Filter nodes and topics" aria-label="Filter nodes and topics" aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${this.#text} @input=${({ currentTarget }) => change(() => (this.#text = currentTarget.value.trim().toLowerCase()))}></p>
        <div class="two-columns ${this.#chosen ? 'has-chosen' : ''}">
          ${this.#nodeTable(now)}
          ${this.#chosen ? this.#node(now) : html`<section class="hint"><p class="quiet">Choose a node to see its topics, services and parameters.</p></section>`}
        </div>
        ${this.#topicTable(now)}
      </div>`;
  }

  // Nodes

  #nodeTable(now) {
    const all = this.#nodes.answer?.nodes ?? [];
    const nodes = all.filter(({ name }) => name.toLowerCase().includes(this.#text));
    const hasLifecycle = all.some(({ lifecycle }) => lifecycle);
    return html`
      <section aria-labelledby="nodes">
        <header><h2 id="nodes">Nodes${this.#nodes.answer ? html` <span class="count">${number(all.length)}</span>` : nothing}</h2>${this.#nodes.line('nodes', now)}</header>
        ${this.#nodes.refusal()}
        ${
          nodes.length
            ? html`<div class="scroll" tabindex="0" role="region" aria-label="Table of nodes"><table>
              <thead><tr><th>Node</th><th>Task</th>${hasLifecycle ? html`<th>State</th>` : nothing}</tr></thead>
              <tbody>${nodes.map(
                (node) => html`
                <tr aria-selected=${node.name === this.#chosen ? 'true' : nothing} class=${node.name === this.#chosen ? 'chosen' : ''}>
                  <td>${this.#link(node.name)}</td>
                  <td>${node.task ?? html`<span class="quiet">–</span>`}</td>
                  ${hasLifecycle ? html`<td>${lifecycleState(node)}</td>` : nothing}
                </tr>`,
              )}</tbody>
            </table></div>`
            : this.#nodes.answer
              ? html`<p class="quiet">${all.length ? 'No node is like that.' : 'There is no node on its graph.'}</p>`
              : nothing
        }
      </section>`;
  }

  #link = (name) =>
    html`<a class="code" href=${this.#page.at('ros', { node: name })} aria-current=${name === this.#chosen ? 'true' : nothing}>${name}</a>`;

  #node(now) {
    const detail = this.#detail.answer?.nodes ?? [];
    const node = this.#nodes.answer?.nodes.find(({ name }) => name === this.#chosen) ?? detail[0];
    return html`
      <section class="node" aria-labelledby="node">
        <header><h2 id="node" class="code">${this.#chosen}</h2><a href=${this.#page.at('ros')}>Close</a></header>
        ${this.#lifecycle(node)}
        <section aria-labelledby="parameters">
          <header><h3 id="parameters">Parameters</h3>${this.#parameters.line('parameters', now)}</header>
          ${this.#parameters.refusal()}
          ${this.#parameterList()}
        </section>
        <section aria-labelledby="ends">
          <header><h3 id="ends">Topics and services</h3>${this.#detail.line('topics and services', now)}</header>
          ${this.#detail.refusal()}
          ${detail.length > 1 ? html`<p class="bad"><span aria-hidden="true">▲ </span>${number(detail.length)} nodes have this name.</p>` : nothing}
          ${detail.map(({ publishers, subscriptions, services, clients }) =>
            [
              ['Publishes', publishers],
              ['Subscribes to', subscriptions],
              ['Offers', services],
              ['Calls', clients],
            ]
              .filter(([, ends]) => ends.length)
              .map(
                ([title, ends]) =>
                  html`<details><summary>${title} <span class="count">${ends.length}</span></summary><ul class="ends">${ends.map(({ name, type }) => html`<li class="code">${name} <span class="quiet">${type}</span></li>`)}</ul></details>`,
              ),
          )}
        </section>
      </section>`;
  }

  #lifecycle(node) {
    if (!node?.lifecycle) return nothing;
    const transitions = this.#page.app.can('operate') ? (TRANSITIONS[node.lifecycle] ?? []) : [];
    return html`
      <p class="lifecycle">Lifecycle: ${lifecycleState(node)}
        ${transitions.map((transition) => html`<button class="quiet-button" ?disabled=${this.#changing !== null} @click=${() => this.#askChange(node, transition)}>${transition}…</button>`)}
        <span role="status">${this.#changing ? `${this.#changing}…` : ''}</span></p>
      ${this.#refused ? html`<p class="bad" role="alert"><span aria-hidden="true">▲ </span>${this.#refused}</p>` : nothing}`;
  }

  #askChange({ name, lifecycle, task }, transition) {
    const robot = this.#page.robot.name;
    const title = transition.charAt(0).toUpperCase() + transition.slice(1);
    open({
      title: `${title} ${name}?`,
      action: title,
      isDangerous: ['shutdown', 'cleanup', 'deactivate'].includes(transition),
      body: () =>
        html`<p>The node <code>${name}</code>${task ? html` of the task <strong>${task}</strong>` : nothing} on <strong>${robot}</strong> is ${words(lifecycle)}. ${TRANSITION_WORDS[transition]}</p>`,
      act: () => void this.#change(name, transition),
    });
  }

  async #change(name, transition) {
    change(() => {
      this.#changing = transition;
      this.#refused = null;
    });
    try {
      const { state } = await askRobot(this.#page.robot.id, {
        type: 'lifecycle',
        node: name,
        transition,
      });
      tell(`${name} is ${words(state)}.`);
      for (const answer of [this.#nodes.answer, this.#detail?.answer])
        for (const node of answer?.nodes ?? []) if (node.name === name) node.lifecycle = state;
    } catch (error) {
      this.#refused = this.#page.inWords(error.message);
    }
    change(() => (this.#changing = null));
    // What it publishes and offers may be something else now.
    this.#askAll();
  }

  // Parameters

  #parameterList() {
    const { answer } = this.#parameters;
    if (!answer) return nothing;
    if (!answer.parameters.length) return html`<p class="quiet">It has none.</p>`;
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
        ${this.#page.app.can('operate') ? html`<button class="plain link" data-parameter=${name} aria-label=${`Change ${name}`} @click=${() => this.#edit(name, text)}>Change</button>` : nothing}
      </li>`;
  }

  #edit(name, text) {
    change(() => (this.#editing = { name, text, problem: null, isBusy: false, isNew: true }));
  }

  #form() {
    const editing = this.#editing;
    const { name, text, problem, isBusy } = editing;
    return html`
      <li>
        <form @submit=${(event) => this.#set(event)}>
          <label for="parameter" class="code">${name}</label>
          <input id="parameter" class="code" required autocomplete="off" autocapitalize="none" spellcheck="false" .value=${text} aria-invalid=${problem ? 'true' : nothing} aria-describedby="parameter-problem parameter-hint"
            @input=${({ currentTarget }) => (editing.text = currentTarget.value)} @keydown=${(event) => this.#giveUp(event)}>
          <button class="primary" ?disabled=${isBusy}>Set</button>
          <button type="button" class="quiet-button" @click=${() => this.#close()}>Cancel</button>
          <p id="parameter-problem" class="bad" role="alert">${problem ? `▲ ${problem}` : ''}</p>
          <p id="parameter-hint" class="quiet">As JSON: <code>true</code>, <code>7</code>, <code>7.0</code>, <code>"text"</code>, <code>[1, 2]</code>. It holds until the node starts again.</p>
        </form>
      </li>`;
  }

  #giveUp(event) {
    if (event.key !== 'Escape') return;
    event.stopPropagation();
    this.#close();
  }

  #close() {
    change(() => {
      this.#left = this.#editing?.name;
      this.#editing = null;
    });
  }

  async #set(event) {
    event.preventDefault();
    const editing = this.#editing;
    const node = this.#chosen;
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
          this.#chosen === node &&
          this.#parameters.answer?.parameters.find(({ name }) => name === now.name);
        if (shown) shown.value = now.value;
        if (this.#editing === editing) this.#close();
      });
      tell(`${now.name} is ${JSON.stringify(now.value)}.`);
    } catch (error) {
      change(() =>
        Object.assign(editing, { problem: this.#page.inWords(error.message), isBusy: false }),
      );
    }
  }

  drawn() {
    if (this.#isRevealDue)
      document.querySelector('.ros .node')?.scrollIntoView({ block: 'nearest' });
    this.#isRevealDue = false;
    if (this.#left)
      [...document.querySelectorAll('.parameters [data-parameter]')]
        .find(({ dataset }) => dataset.parameter === this.#left)
        ?.focus();
    this.#left = null;
    if (!this.#editing?.isNew) return;
    this.#editing.isNew = false;
    document.getElementById('parameter')?.select();
  }

  // Topics

  #topicTable(now) {
    const all = this.#topics.answer?.topics ?? [];
    const topics = all.filter(({ name, types }) =>
      [name, ...types].some((text) => text.toLowerCase().includes(this.#text)),
    );
    const ends = (names) =>
      names.length
        ? names.map((name) => html`<div>${this.#link(name)}</div>`)
        : html`<span class="quiet">none</span>`;
    return html`
      <section aria-labelledby="topics">
        <header><h2 id="topics">Topics${this.#topics.answer ? html` <span class="count">${number(all.length)}</span>` : nothing}</h2>${this.#topics.line('topics', now)}</header>
        ${this.#topics.refusal()}
        ${
          topics.length
            ? html`<div class="scroll" tabindex="0" role="region" aria-label="Table of topics"><table class="topics">
              <thead><tr><th>Topic</th><th>Type</th><th>Publishers</th><th>Subscribers</th></tr></thead>
              <tbody>${topics.map(
                ({ name, types, publishers, subscriptions }) => html`
                <tr>
                  <td class="code">${name}</td>
                  <td class="code">${types.map((type) => html`<div>${type}</div>`)}${types.length > 1 ? html`<div class="bad">▲ its ends disagree</div>` : nothing}</td>
                  <td>${ends(publishers)}</td>
                  <td>${ends(subscriptions)}</td>
                </tr>`,
              )}</tbody>
            </table></div>`
            : this.#topics.answer
              ? html`<p class="quiet">${all.length ? 'No topic is like that.' : 'There is no topic on its graph.'}</p>`
              : nothing
        }
      </section>`;
  }
}

const LIFECYCLE_SIGNS = {
  active: '● ',
  inactive: '○ ',
  unconfigured: '○ ',
  finalized: '✕ ',
  changing: '',
};

const lifecycleState = ({ lifecycle }) =>
  lifecycle
    ? html`<span class="lifecycle-state ${lifecycle}"><span aria-hidden="true">${LIFECYCLE_SIGNS[lifecycle] ?? ''}</span>${words(lifecycle)}</span>`
    : html`<span class="quiet">–</span>`;

/** The value that somebody has typed. */
function valueOf(text) {
  try {
    return JSON.parse(text, exactly);
  } catch {
    throw new Error('This is no JSON value. A text is written in quotation marks.');
  }
}
