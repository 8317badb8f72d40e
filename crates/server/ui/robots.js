// The first screen: all robots, what they do, and what is to be done with those that are chosen.
// Robots' texts reach the document only as text.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { guard } from './vendor/lit-html-3.3.3/directives/guard.js';
import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import { askDelete, askEdit, askLabels, askTask } from './acts.js';
import { command } from './copy.js';
import { Cursor } from './cursor.js';
import { STANDINGS, labelsOf } from './fleet.js';
import { number, size, words } from './format.js';
import { change } from './frame.js';
import { askPush } from './push.js';
import { at, go, restate } from './router.js';
import { Rows, isNarrow } from './rows.js';
import { enrolCommand, newEnrolment } from './settings.js';
import { lastSeen, phaseSign, progressBar, remarks, robotState } from './signs.js';

// As in style.css: a row's height follows from its number of lines, so rows out of sight need not
// be drawn.
const LINE = 24;
const PADDING = 17;

/**
 * The columns, each with its place in the grid. Those with `isOptional` are shown when asked for.
 */
const COLUMNS = [
  { id: 'id', title: 'ID', width: '138px', look: 'code quiet', cell: ({ id }) => id },
  {
    id: 'name',
    title: 'Name',
    width: 'minmax(96px, 1fr)',
    cell: (robot) => html`<a href=${at(['robots', robot.name])}>${robot.name}</a>`,
  },
  {
    id: 'address',
    title: 'IP',
    width: '112px',
    look: 'code quiet',
    cell: ({ address }) => (address ? hostOf(address) : '–'),
  },
  { id: 'state', title: 'State', width: '72px', cell: robotState },
  { id: 'seen', title: 'Last seen', width: '72px', look: 'quiet', cell: lastSeen },
  {
    id: 'labels',
    title: 'Labels',
    width: 'minmax(96px, 1fr)',
    isOptional: true,
    cell: (robot) =>
      html`<span class="code quiet" title=${labelsOf(robot).join(', ')}>${labelsOf(robot).join(', ')}</span>`,
  },
  {
    id: 'cpu',
    title: 'CPU',
    width: '56px',
    isOptional: true,
    cell: ({ vitals }) =>
      vitals?.cpu_percent == null ? '–' : `${Math.round(vitals.cpu_percent)} %`,
  },
  {
    id: 'memory',
    title: 'Memory',
    width: '76px',
    isOptional: true,
    cell: ({ vitals }) =>
      vitals?.memory_used_bytes == null ? '–' : size(vitals.memory_used_bytes),
  },
  {
    id: 'disk',
    title: 'Free disk',
    width: '76px',
    isOptional: true,
    cell: ({ host }) => (host?.disk_free_bytes == null ? '–' : size(host.disk_free_bytes)),
  },
  {
    id: 'rtt',
    title: 'RTT',
    width: '60px',
    isOptional: true,
    cell: ({ link }) => (link?.rtt_ms == null ? '–' : `${link.rtt_ms} ms`),
  },
  { id: 'task', title: 'Task', width: 'minmax(320px, 4fr)', cell: work },
];
/** What can be ordered of the tasks of robots that are chosen. */
const ORDERS = [
  ['start', 'Start'],
  ['stop', 'Stop'],
  ['restart', 'Restart'],
  ['rollback', 'Roll back'],
  ['remove', 'Remove task'],
];
const CHOSEN_COLUMNS = 'taskd.columns';

export class RobotsView {
  #rows = new Rows();
  #cursor = new Cursor(this.#rows, (id) =>
    go(['robots', this.app.fleet.robots.get(id)?.name ?? id]),
  );
  #optional = new Set((localStorage.getItem(CHOSEN_COLUMNS) ?? '').split(',').filter(Boolean));
  #columns = this.#chosenColumns();

  constructor(app) {
    this.app = app;
  }

  arrive({ query }) {
    this.#rows.rearrange();
    this.app.fleet.look({
      text: query.q ?? '',
      standing: query.state ?? '',
      sort: query.sort ?? 'name',
      isDescending: query.order === 'down',
    });
  }

  #look(search) {
    change(() => {
      this.#rows.rearrange();
      this.app.fleet.look(search);
      const { text, standing, sort, isDescending } = this.app.fleet.search;
      restate({
        q: text,
        state: standing,
        sort: sort === 'name' ? '' : sort,
        order: isDescending ? 'down' : '',
      });
    });
  }

  draw(now) {
    const { fleet } = this.app;
    const { start, end } = this.#rows.sight(
      fleet.shown,
      (id) => heightOf(fleet.robots.get(id)),
      `${fleet.reflows} ${isNarrow}`,
    );
    return html`
      <header class="bar-of-tools">
        <h1>Robots</h1>
        ${this.#strip()}
        <input type="search" placeholder="Search" aria-label="Search robots" aria-keyshortcuts="/" autocomplete="off" spellcheck="false"
          .value=${fleet.search.text} @input=${({ currentTarget }) => this.#look({ text: currentTarget.value })}>
        ${this.#columnMenu()}
      </header>
      ${fleet.robots.size ? this.#table(fleet.shown.slice(start, end), start, now) : nothing}
      ${fleet.isLoaded && !fleet.robots.size ? this.#noRobots() : nothing}
      ${fleet.robots.size && !fleet.shown.length && fleet.isLoaded ? html`<p class="empty quiet">No robot is like that. <button class="plain link" @click=${() => this.#look({ text: '', standing: '' })}>Show all</button></p>` : nothing}
      ${this.#bulkBar()}`;
  }

  drawn() {
    this.#rows.place();
    const columns = [
      '20px',
      ...this.#columns.map(({ width }) => width),
      this.#operations.length ? `${this.#operations.length * 52}px` : '',
    ];
    document.querySelector('.table')?.style.setProperty('--columns', columns.join(' '));
    this.#cursor.drawn();
  }

  // The strip of counters, which is the filter as well.

  #strip() {
    const { fleet } = this.app;
    const all = { id: '', title: 'All', sign: '', count: fleet.robots.size };
    const standings = [
      all,
      ...STANDINGS.map((standing) => ({ ...standing, count: fleet.counts[standing.id] })),
    ];
    return html`<div class="strip" role="group" aria-label="Show robots that are">${standings.map(
      ({ id, title, sign, count }) => html`
      <button class="counter ${id}" aria-pressed=${fleet.search.standing === id} @click=${() => this.#look({ standing: fleet.search.standing === id ? '' : id })}>
        <span class="figure">${fleet.isLoaded || count ? number(count) : '–'}</span><span>${sign ? html`<span aria-hidden="true">${sign} </span>` : nothing}${title}</span>
      </button>`,
    )}</div>`;
  }

  #columnMenu() {
    return html`
      <details class="menu">
        <summary>Columns</summary>
        <div class="menu-body">${COLUMNS.filter(({ isOptional }) => isOptional).map(
          ({ id, title }) => html`
          <label><input type="checkbox" .checked=${this.#optional.has(id)} @change=${() => this.#toggleColumn(id)}> ${title}</label>`,
        )}</div>
      </details>`;
  }

  #chosenColumns() {
    return COLUMNS.filter(({ id, isOptional }) => !isOptional || this.#optional.has(id));
  }

  #toggleColumn(id) {
    change(() => {
      if (!this.#optional.delete(id)) this.#optional.add(id);
      this.#columns = this.#chosenColumns();
      localStorage.setItem(CHOSEN_COLUMNS, [...this.#optional].join());
    });
  }

  // The table.

  #table(ids, start, now) {
    const { fleet, selection } = this.app;
    const { sort, isDescending } = fleet.search;
    const operations = this.#operations;
    const isAll = this.#isAll;
    return html`
      <div class="table robots-table" role="grid" aria-label="Robots" aria-multiselectable="true" aria-rowcount=${fleet.shown.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">
          <span role="columnheader"><input type="checkbox" aria-label="Select all that are shown" .checked=${isAll} .indeterminate=${!isAll && selection.size > 0} @change=${({ currentTarget }) => this.#toggleAll(currentTarget)}></span>
          ${this.#columns.map(
            ({ id, title }) => html`
            <span role="columnheader" aria-sort=${sort === id ? (isDescending ? 'descending' : 'ascending') : 'none'}>
              <button class="plain" @click=${() => this.#look({ sort: id, isDescending: sort === id && !isDescending })}>${title}<span class="arrow" aria-hidden="true">${sort === id ? (isDescending ? '↓' : '↑') : ''}</span></button>
            </span>`,
          )}
          ${operations.length ? html`<span role="columnheader" class="operations-head">Operation</span>` : nothing}
        </div>
        <div class="rows" role="rowgroup"><div class="sight" role="presentation">${repeat(
          ids,
          (id) => id,
          (id, index) => this.#row(fleet.robots.get(id), start + index, operations, now),
        )}</div></div>
      </div>`;
  }

  /**
   * A row, which is made anew only when something in it is: of those in sight few are at a time.
   */
  #row(robot, index, operations, now) {
    if (!robot) return nothing;
    const { selection, fleet } = this.app;
    const isChosen = selection.has(robot.id);
    const tabindex = this.#cursor.tabindex(robot.id, index);
    const wrong = isNarrow ? troubles(robot) : [];
    return guard(
      [
        robot,
        index,
        isChosen,
        tabindex,
        isNarrow,
        this.#columns,
        operations.length,
        Math.floor(now / 1000),
      ],
      () => html`
      <div class="row" role="row" tabindex=${tabindex} aria-rowindex=${index + 2} aria-selected=${isChosen} data-key=${robot.id} data-robot=${robot.id} @focusin=${() => (this.#cursor.current = robot.id)}>
        <span class="choose" role="gridcell"><input type="checkbox" aria-label=${`Select ${robot.name}`} .checked=${isChosen} @click=${(event) => this.#toggle(robot.id, event)}></span>
        ${wrong.length ? html`<span class="cell trouble" role="gridcell">${wrong}</span>` : nothing}
        ${this.#columns.map(({ id, look, cell }) => html`<span class="cell ${id} ${look ?? ''}" role="gridcell">${cell(robot, now)}</span>`)}
        ${operations.length ? html`<span class="cell operations" role="gridcell">${operations.map(([title, act]) => html`<button class="plain" aria-label=${`${title} ${robot.name}`} @click=${() => act(robot)}>${title}</button>`)}</span>` : nothing}
      </div>`,
    );
  }

  // A box has turned by itself when it was clicked, also where what it stands for stays: the next
  // drawing would not find it changed.

  #toggle(id, { currentTarget, shiftKey }) {
    const { selection, fleet } = this.app;
    change(() => selection.toggle(id, fleet.shown, shiftKey));
    currentTarget.checked = selection.has(id);
  }

  #toggleAll(box) {
    const { selection, fleet } = this.app;
    change(() => selection.toggleAll(fleet.shown));
    box.checked = this.#isAll;
  }

  get #isAll() {
    const {
      fleet: { shown },
      selection,
    } = this.app;
    return shown.length > 0 && shown.every((id) => selection.has(id));
  }

  /** What this person may do with a robot, in the words of the paper. */
  get #operations() {
    const { can } = this.app;
    return [
      can('maintain') && ['Edit', (robot) => askEdit(this.app, robot)],
      ['Monitor', (robot) => go(['robots', robot.name])],
      can('operate') && ['Control', (robot) => go(['robots', robot.name, 'control'])],
      can('maintain') && ['Delete', (robot) => askDelete(this.app, new Set([robot.id]))],
    ].filter(Boolean);
  }

  // What is done with those that are chosen.

  #bulkBar() {
    const { selection, fleet, can } = this.app;
    if (!selection.size) return nothing;
    const { ids } = selection;
    const isMore = fleet.shown.length > ids.size || fleet.shown.some((id) => !ids.has(id));
    return html`
      <div class="bulk" role="toolbar" aria-label="With the selected robots">
        <p><strong>${number(ids.size)}</strong> selected</p>
        ${isMore ? html`<button class="plain link" @click=${() => change(() => fleet.shown.forEach((id) => ids.add(id)))}>Select all ${number(fleet.shown.length)} that match</button>` : nothing}
        <button class="plain link" @click=${() => change(() => selection.clear())}>Clear</button>
        <span class="acts">
          ${
            can('operate')
              ? html`
            <button class="primary" @click=${() => askPush(this.app, ids)}>Push…</button>
            ${ORDERS.map(([verb, title]) => html`<button class="quiet-button" @click=${() => askTask(this.app, verb, ids)}>${title}…</button>`)}`
              : nothing
          }
          ${
            can('maintain')
              ? html`
            <button class="quiet-button" @click=${() => askLabels(this.app, ids)}>Label…</button>
            <button class="quiet-button danger-text" @click=${() => askDelete(this.app, ids)}>Delete…</button>`
              : nothing
          }
        </span>
      </div>`;
  }

  // The first robot.

  #noRobots() {
    const { can } = this.app;
    return html`
      <section class="empty onboarding">
        <h2>Waiting for the first robot…</h2>
        ${
          can('administer')
            ? html`
          <p class="quiet">On each robot, run this once. The token in it is good for a day and 100 robots, unless the server is set up otherwise.</p>
          ${this.enrolment ? command(enrolCommand(this.enrolment)) : html`<p><button class="primary" @click=${() => this.#makeToken()}>Show the command</button></p>`}
          <p class="quiet">Then start the agent. The robot appears here by itself.</p>
          ${command('task-agent run')}`
            : html`<p class="quiet">An administrator makes the token that robots enrol with: <code>taskd enroll-token create</code></p>`
        }
      </section>`;
  }

  async #makeToken() {
    this.enrolment = await this.app.attempt(() => newEnrolment());
    change();
  }

  key(event) {
    const { key, shiftKey, target } = event;
    const { fleet, selection } = this.app;
    const { current } = this.#cursor;
    if (key === 'Escape') {
      if (fleet.search.text || fleet.search.standing) this.#look({ text: '', standing: '' });
      else change(() => selection.clear());
      return true;
    }
    if (
      (key === 'x' || key === 'X') &&
      fleet.shown.includes(current) &&
      !target.matches('input[type=search]')
    ) {
      change(() => selection.toggle(current, fleet.shown, shiftKey));
      return true;
    }
    return this.#cursor.key(event, fleet.shown);
  }
}

function heightOf(robot) {
  if (!robot) return 0;
  const { length } = robot.tasks;
  return PADDING + LINE * (isNarrow ? 3 + length : Math.max(1, length));
}

/** The address without its port. */
const hostOf = (address) => address.replace(/:\d+$/, '').replace(/^\[(.*)\]$/, '$1');

/**
 * The tasks, a line each. What is wrong is said within the lines, because a row that grew when its
 * robot gets into trouble would push those below it away from under the pointer.
 */
function work({ conditions, tasks }) {
  const beside = isNarrow ? [] : conditions;
  if (tasks.length) return tasks.map((task, index) => taskLine(task, index ? [] : beside));
  return beside.length
    ? html`<div class="line known"><span class="note">${beside.map(conditionSign)}</span></div>`
    : nothing;
}

const taskLine = (task, conditions) => html`
  <div class="line task" data-task=${task.task}>
    <span class="package" title=${task.deployment}>${task.task}<span class="quiet">@${task.version}</span></span>
    ${phaseSign(task.phase)}
    <span class="known">${known(task, conditions)}</span>
  </div>`;

/** What is known of it, and the conditions beside it, which share the room. */
function known(task, conditions) {
  const said = note(task);
  if (!conditions.length) return said;
  const wrong = html`<span class="note">${conditions.map(conditionSign)}</span>`;
  return said ? html`${said}${wrong}` : wrong;
}

function note(task) {
  const bar = progressBar(task);
  if (bar) return html`<span class="note">${bar}</span>`;
  if (task.failure && !isNarrow) return failureSign(task);
  const said = remarks(task);
  return said.length ? html`<span class="note quiet">${said.join(' · ')}</span>` : null;
}

const conditionSign = ({ code, text }) => html`
  <span class="condition" title=${text}><span class="bad"><span aria-hidden="true">▲ </span>${words(code)}</span> <span class="quiet">${text}</span></span>`;

/** Why the task failed, and what else is worth knowing of it. */
function failureSign(task) {
  const { code, text } = task.failure;
  return html`<span class="note failure" title=${`${code}: ${text}`}><span class="bad">${words(code)}</span><span class="quiet"> · ${[...remarks(task), text].join(' · ')}</span></span>`;
}

/** All that is wrong, for where there is no room beside the tasks. */
const troubles = ({ conditions, tasks }) => [
  ...conditions.map(conditionSign),
  ...tasks.filter(({ failure }) => failure).map(failureSign),
];
