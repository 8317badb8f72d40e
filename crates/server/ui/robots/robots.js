// Owns the list of robots, and the view of one robot with its tabs; it never inserts a text of a
// robot as markup.
//
// This module is the list, and the actions on its selected robots.

import { guard } from '../vendor/lit-html-3.3.3/directives/guard.js';
import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { command } from '../display/copy.js';
import { Cursor } from '../display/cursor.js';
import { change } from '../display/display.js';
import { number, size, words } from '../display/format.js';
import { hrefTo, navigate, replaceQuery } from '../display/router.js';
import { lastSeen, phaseBadge, progressBar, taskNotes, robotState } from '../display/status.js';
import { VirtualList, isNarrow } from '../display/virtual-list.js';
import { STATUSES, labelsOf } from '../fleet.js';
import { createEnrollmentToken, enrollCommand } from '../orders/enrollment.js';
import {
  openDeleteDialog,
  openEditDialog,
  openLabelDialog,
  openTaskDialog,
} from '../orders/orders.js';
import { openPushDialog } from '../orders/push.js';

// As in display.css: row heights follow from the number of lines, so hidden rows need not be drawn.
const LINE_HEIGHT = 24;
const PADDING = 17;

/** The columns with their widths. Optional columns are shown on request. */
const COLUMNS = [
  { id: 'id', title: 'ID', width: '138px', look: 'code quiet', cell: ({ id }) => id },
  {
    id: 'name',
    title: 'Name',
    width: 'minmax(96px, 1fr)',
    cell: (robot) => html`<a href=${hrefTo(['robots', robot.name])}>${robot.name}</a>`,
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
    cell: (robot) => {
      const labels = labelsOf(robot).join(', ');
      return html`<span class="code quiet" title=${labels}>${labels}</span>`;
    },
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
  { id: 'task', title: 'Task', width: 'minmax(320px, 4fr)', cell: taskCell },
];
/** The task actions for selected robots. */
const TASK_ACTIONS = [
  ['start', 'Start'],
  ['stop', 'Stop'],
  ['restart', 'Restart'],
  ['rollback', 'Roll back'],
  ['remove', 'Remove task'],
];
const COLUMNS_KEY = 'taskd.columns';

export class RobotsView {
  #list = new VirtualList();
  #cursor = new Cursor(this.#list, (id) =>
    navigate(['robots', this.app.fleet.robots.get(id)?.name ?? id]),
  );
  #optional = new Set((localStorage.getItem(COLUMNS_KEY) ?? '').split(',').filter(Boolean));
  #columns = this.#selectedColumns();

  constructor(app) {
    this.app = app;
  }

  onNavigate({ query }) {
    this.#list.releaseAnchor();
    this.app.fleet.setSearch({
      text: query.q ?? '',
      status: query.state ?? '',
      sort: query.sort ?? 'name',
      isDescending: query.order === 'down',
    });
  }

  #setSearch(search) {
    change(() => {
      this.#list.releaseAnchor();
      this.app.fleet.setSearch(search);
      const { text, status, sort, isDescending } = this.app.fleet.search;
      replaceQuery({
        q: text,
        state: status,
        sort: sort === 'name' ? '' : sort,
        order: isDescending ? 'down' : '',
      });
    });
  }

  draw(now) {
    const { fleet } = this.app;
    const { start, end } = this.#list.visibleRange(
      fleet.shown,
      (id) => heightOf(fleet.robots.get(id)),
      `${fleet.heightChanges} ${isNarrow}`,
    );
    return html`
      <header class="toolbar">
        <h1>Robots</h1>
        ${this.#counters()}
        <input type="search" placeholder="Search" aria-label="Search robots"
          aria-keyshortcuts="/" autocomplete="off" spellcheck="false"
          .value=${fleet.search.text}
          @input=${({ currentTarget }) => this.#setSearch({ text: currentTarget.value })}>
        ${this.#columnMenu()}
      </header>
      ${fleet.robots.size ? this.#table(fleet.shown.slice(start, end), start, now) : nothing}
      ${fleet.isLoaded && !fleet.robots.size ? this.#noRobots() : nothing}
      ${
        fleet.robots.size && !fleet.shown.length && fleet.isLoaded
          ? html`<p class="empty quiet">No robots match this filter.
              <button class="plain link"
                @click=${() => this.#setSearch({ text: '', status: '' })}>Clear filter</button></p>`
          : nothing
      }
      ${this.#bulkBar()}`;
  }

  afterDraw() {
    this.#list.applyLayout();
    const columns = [
      '20px',
      ...this.#columns.map(({ width }) => width),
      this.#operations.length ? `${this.#operations.length * 52}px` : '',
    ];
    document.querySelector('.table')?.style.setProperty('--columns', columns.join(' '));
    this.#cursor.afterDraw();
  }

  // The counters, which are also the filter

  #counters() {
    const { fleet } = this.app;
    const all = { id: '', title: 'All', sign: '', count: fleet.robots.size };
    const statuses = [
      all,
      ...STATUSES.map((status) => ({ ...status, count: fleet.counts[status.id] })),
    ];
    return html`<div class="counters" role="group" aria-label="Filter by status">${statuses.map(
      ({ id, title, sign, count }) => html`
      <button class="counter ${id}" aria-pressed=${fleet.search.status === id}
        @click=${() => this.#setSearch({ status: fleet.search.status === id ? '' : id })}>
        <span class="figure">${fleet.isLoaded || count ? number(count) : '–'}</span><span>${
          sign ? html`<span aria-hidden="true">${sign} </span>` : nothing
        }${title}</span>
      </button>`,
    )}</div>`;
  }

  #columnMenu() {
    return html`
      <details class="menu">
        <summary>Columns</summary>
        <div class="menu-body">${COLUMNS.filter(({ isOptional }) => isOptional).map(
          ({ id, title }) => html`
          <label><input type="checkbox" .checked=${this.#optional.has(id)}
            @change=${() => this.#toggleColumn(id)}> ${title}</label>`,
        )}</div>
      </details>`;
  }

  #selectedColumns() {
    return COLUMNS.filter(({ id, isOptional }) => !isOptional || this.#optional.has(id));
  }

  #toggleColumn(id) {
    change(() => {
      if (!this.#optional.delete(id)) this.#optional.add(id);
      this.#columns = this.#selectedColumns();
      localStorage.setItem(COLUMNS_KEY, [...this.#optional].join());
    });
  }

  // The table

  #table(ids, start, now) {
    const { fleet, selection } = this.app;
    const { sort, isDescending } = fleet.search;
    const [order, arrow] = isDescending ? ['descending', '↓'] : ['ascending', '↑'];
    const sortBy = (id) =>
      this.#setSearch({ sort: id, isDescending: sort === id && !isDescending });
    const operations = this.#operations;
    const isAllSelected = this.#isAllSelected;
    return html`
      <div class="table robots-table" role="grid" aria-label="Robots" aria-multiselectable="true"
        aria-rowcount=${fleet.shown.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">
          <span role="columnheader"><input type="checkbox" aria-label="Select all shown robots"
            .checked=${isAllSelected} .indeterminate=${!isAllSelected && selection.size > 0}
            @change=${({ currentTarget }) => this.#toggleAll(currentTarget)}></span>
          ${this.#columns.map(
            ({ id, title }) => html`
            <span role="columnheader" aria-sort=${sort === id ? order : 'none'}>
              <button class="plain" @click=${() => sortBy(id)}>${title}<span
                class="arrow" aria-hidden="true">${sort === id ? arrow : ''}</span></button>
            </span>`,
          )}
          ${
            operations.length
              ? html`<span role="columnheader" class="operations-head">Operation</span>`
              : nothing
          }
        </div>
        <div class="rows" role="rowgroup"><div class="rendered" role="presentation">${repeat(
          ids,
          (id) => id,
          (id, index) => this.#row(fleet.robots.get(id), start + index, operations, now),
        )}</div></div>
      </div>`;
  }

  /** A row. It is redrawn only when its data changes. */
  #row(robot, index, operations, now) {
    if (!robot) return nothing;
    const { selection, fleet } = this.app;
    const isSelected = selection.has(robot.id);
    const tabindex = this.#cursor.tabindex(robot.id, index);
    const issues = isNarrow ? issuesOf(robot) : [];
    return guard(
      [
        robot,
        index,
        isSelected,
        tabindex,
        isNarrow,
        this.#columns,
        operations.length,
        Math.floor(now / 1000),
      ],
      () => html`
      <div class="row" role="row" tabindex=${tabindex} aria-rowindex=${index + 2}
        aria-selected=${isSelected} data-key=${robot.id} data-robot=${robot.id}
        @focusin=${() => (this.#cursor.current = robot.id)}>
        <span class="select" role="gridcell"><input type="checkbox"
          aria-label=${`Select ${robot.name}`} .checked=${isSelected}
          @click=${(event) => this.#toggle(robot.id, event)}></span>
        ${
          issues.length ? html`<span class="cell issues" role="gridcell">${issues}</span>` : nothing
        }
        ${this.#columns.map(
          ({ id, look, cell }) =>
            html`<span class="cell ${id} ${look ?? ''}" role="gridcell">${cell(robot, now)}</span>`,
        )}
        ${
          operations.length
            ? html`<span class="cell operations" role="gridcell">${operations.map(
                ([title, run]) =>
                  html`<button class="plain" aria-label=${`${title} ${robot.name}`}
                    @click=${() => run(robot)}>${title}</button>`,
              )}</span>`
            : nothing
        }
      </div>`,
    );
  }

  // A clicked checkbox toggles itself, even if the selection does not change: the next drawing
  // would not notice.

  #toggle(id, { currentTarget, shiftKey }) {
    const { selection, fleet } = this.app;
    change(() => selection.toggle(id, fleet.shown, shiftKey));
    currentTarget.checked = selection.has(id);
  }

  #toggleAll(box) {
    const { selection, fleet } = this.app;
    change(() => selection.toggleAll(fleet.shown));
    box.checked = this.#isAllSelected;
  }

  get #isAllSelected() {
    const {
      fleet: { shown },
      selection,
    } = this.app;
    return shown.length > 0 && shown.every((id) => selection.has(id));
  }

  /** The permitted actions on a robot, named as in the paper. */
  get #operations() {
    const { can } = this.app;
    return [
      can('maintain') && ['Edit', (robot) => openEditDialog(this.app, robot)],
      ['Monitor', (robot) => navigate(['robots', robot.name])],
      can('operate') && ['Control', (robot) => navigate(['robots', robot.name, 'control'])],
      can('maintain') && ['Delete', (robot) => openDeleteDialog(this.app, new Set([robot.id]))],
    ].filter(Boolean);
  }

  // The toolbar for selected robots

  #bulkBar() {
    const { selection, fleet, can } = this.app;
    if (!selection.size) return nothing;
    const { ids } = selection;
    const isMore = fleet.shown.length > ids.size || fleet.shown.some((id) => !ids.has(id));
    const selectAll = () => change(() => fleet.shown.forEach((id) => ids.add(id)));
    return html`
      <div class="bulk" role="toolbar" aria-label="Actions for selected robots">
        <p><strong>${number(ids.size)}</strong> selected</p>
        ${
          isMore
            ? html`<button class="plain link" @click=${selectAll}>Select all
                ${number(fleet.shown.length)} matching robots</button>`
            : nothing
        }
        <button class="plain link"
          @click=${() => change(() => selection.clear())}>Clear selection</button>
        <span class="actions">
          ${
            can('operate')
              ? html`
            <button class="primary" @click=${() => openPushDialog(this.app, ids)}>Push…</button>
            ${TASK_ACTIONS.map(
              ([verb, title]) =>
                html`<button class="quiet-button"
                  @click=${() => openTaskDialog(this.app, verb, ids)}>${title}…</button>`,
            )}`
              : nothing
          }
          ${
            can('maintain')
              ? html`
            <button class="quiet-button"
              @click=${() => openLabelDialog(this.app, ids)}>Label…</button>
            <button class="quiet-button danger-text"
              @click=${() => openDeleteDialog(this.app, ids)}>Delete…</button>`
              : nothing
          }
        </span>
      </div>`;
  }

  // Onboarding

  #noRobots() {
    const { can } = this.app;
    return html`
      <section class="empty onboarding">
        <h2>Waiting for the first robot…</h2>
        ${
          can('administer')
            ? html`
          <p class="quiet">Run this once on each robot.
            By default, the token is valid for one day and 100 robots.</p>
          ${
            this.enrollment
              ? command(enrollCommand(this.enrollment))
              : html`<p><button class="primary"
                  @click=${() => this.#createToken()}>Show command</button></p>`
          }
          <p class="quiet">Then start the agent. The robot appears here automatically.</p>
          ${command('task-agent run')}`
            : html`<p class="quiet">An administrator creates an enrollment token for robots:
                <code>taskd enroll-token create</code></p>`
        }
      </section>`;
  }

  async #createToken() {
    this.enrollment = await this.app.attempt(() => createEnrollmentToken());
    change();
  }

  onKey(event) {
    const { key, shiftKey, target } = event;
    const { fleet, selection } = this.app;
    const { current } = this.#cursor;
    if (key === 'Escape') {
      if (fleet.search.text || fleet.search.status) this.#setSearch({ text: '', status: '' });
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
    return this.#cursor.onKey(event, fleet.shown);
  }
}

function heightOf(robot) {
  if (!robot) return 0;
  const { length } = robot.tasks;
  return PADDING + LINE_HEIGHT * (isNarrow ? 3 + length : Math.max(1, length));
}

/** The address without its port, if it has one. */
const hostOf = (address) => address.replace(/^(?:\[(.*)\]|([^:]*)):\d+$/, '$1$2');

/**
 * The tasks, one per line. Failures and conditions share these lines: extra lines would move the
 * rows below.
 */
function taskCell({ conditions, tasks }) {
  const shown = isNarrow ? [] : conditions;
  if (tasks.length) return tasks.map((task, index) => taskLine(task, index ? [] : shown));
  return shown.length
    ? html`<div class="line details"><span class="note">${shown.map(conditionBadge)}</span></div>`
    : nothing;
}

const taskLine = (task, conditions) => html`
  <div class="line task" data-task=${task.task}>
    <span class="package" title=${task.deployment}
      >${task.task}<span class="quiet">@${task.version}</span></span>
    ${phaseBadge(task.phase)}
    <span class="details">${taskDetails(task, conditions)}</span>
  </div>`;

/** The details of a task, beside the conditions. */
function taskDetails(task, conditions) {
  const note = taskNote(task);
  if (!conditions.length) return note;
  const issues = html`<span class="note">${conditions.map(conditionBadge)}</span>`;
  return note ? html`${note}${issues}` : issues;
}

function taskNote(task) {
  const bar = progressBar(task);
  if (bar) return html`<span class="note">${bar}</span>`;
  if (task.failure && !isNarrow) return failureBadge(task);
  const notes = taskNotes(task);
  return notes.length ? html`<span class="note quiet">${notes.join(' · ')}</span>` : null;
}

const conditionBadge = ({ code, text }) => html`
  <span class="condition" title=${text}><span class="bad"><span
    aria-hidden="true">▲ </span>${words(code)}</span> <span class="quiet">${text}</span></span>`;

/** The failure of a task and its notes. */
function failureBadge(task) {
  const { code, text } = task.failure;
  const notes = [...taskNotes(task), text].join(' · ');
  return html`<span class="note failure" title=${`${code}: ${text}`}><span
    class="bad">${words(code)}</span><span class="quiet"> · ${notes}</span></span>`;
}

/** All failures and conditions, for narrow screens. */
const issuesOf = ({ conditions, tasks }) => [
  ...conditions.map(conditionBadge),
  ...tasks.filter(({ failure }) => failure).map(failureBadge),
];
