// The table of robots: only the rows in sight exist, so ten thousand robots cost what thirty do.
// Robots' texts reach the document only as text.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import { COLUMNS } from './fleet.js';
import { ago, bytes, moment, tone, words } from './format.js';

// As in style.css: a row's height follows from its number of lines, so rows out of sight need not be drawn.
const LINE = 24;
const PADDING = 17;
// Rows drawn beyond the edges, so that the next ones are there when the wheel turns.
const SPARE_ROWS = 6;
const narrow = matchMedia('(max-width: 1099px)');

const linesOf = (task) => (task.failure ? 2 : 1);

function height(robot) {
  if (!robot) return 0;
  const lines = robot.tasks.reduce((sum, task) => sum + linesOf(task), robot.conditions.length);
  return PADDING + LINE * (narrow.matches ? 2 + lines : Math.max(1, lines));
}

/** Where each row ends, and which rows are in sight between two distances from the table's top. */
export class Layout {
  constructor(fleet) {
    let bottom = 0;
    this.ids = fleet.shown;
    this.bottoms = fleet.shown.map((id) => (bottom += height(fleet.robots.get(id))));
    this.height = bottom;
  }

  top(index) {
    return index > 0 ? this.bottoms[index - 1] : 0;
  }

  sight(from, to) {
    const first = this.bottoms.findIndex((bottom) => bottom > from);
    const start = Math.max(0, (first < 0 ? this.ids.length : first) - SPARE_ROWS);
    const last = this.bottoms.findIndex((bottom) => bottom >= to);
    const end = last < 0 ? this.ids.length : Math.min(this.ids.length, last + 1 + SPARE_ROWS);
    return { start, end, offset: this.top(start) };
  }
}

/** The table. `actions` has `sortBy(column)` and `show(robotId)`. */
export function robotTable(fleet, view, now, actions) {
  const ids = fleet.shown.slice(view.start, view.end).filter((id) => fleet.robots.has(id));
  const row = (id, index) => robotRow(fleet.robots.get(id), view.start + index, now, actions);
  return html`
    <div class="table" role="table" aria-label="Robots" aria-rowcount=${fleet.shown.length + 1}>
      <div class="row head" role="row" aria-rowindex="1">${COLUMNS.map((column) => header(column, fleet.sort, actions))}</div>
      <div class="rows" role="rowgroup"><div class="sight" role="presentation">${repeat(ids, (id) => id, row)}</div></div>
    </div>`;
}

function header({ id, title }, sort, actions) {
  const isSorted = sort.column === id;
  const direction = sort.isDescending ? 'descending' : 'ascending';
  return html`
    <span role="columnheader" aria-sort=${isSorted ? direction : 'none'}>
      <button class="plain" @click=${() => actions.sortBy(id)}>${title}<span class="arrow" aria-hidden="true">${isSorted ? (sort.isDescending ? '↓' : '↑') : ''}</span></button>
    </span>`;
}

function robotRow(robot, index, now, actions) {
  return html`
    <div class="row" role="row" aria-rowindex=${index + 2} data-robot=${robot.id}>
      <span class="id code" role="cell">${robot.id}</span>
      <span class="name" role="cell"><button class="plain" title="Show everything" @click=${() => actions.show(robot.id)}>${robot.name}</button></span>
      <span class="address code" role="cell">${robot.address ?? '–'}</span>
      <span class="state" role="cell">${robotState(robot)}</span>
      <span class="seen" role="cell">${lastSeen(robot, now)}</span>
      <div class="work" role="cell">
        ${robot.conditions.map(conditionLine)}
        ${robot.tasks.map(taskLine)}
      </div>
    </div>`;
}

/** Text and shape, never colour alone. */
export const robotState = ({ online }) => sign(online, online ? 'Online' : 'Offline');

/** A full or an empty dot before a text. */
export const sign = (isOn, text) => html`
  <span class=${isOn ? 'online' : 'offline'}><svg class="dot" viewBox="0 0 10 10" aria-hidden="true"><circle cx="5" cy="5" r="3.75"></circle></svg>${text}</span>`;

const lastSeen = ({ online, last_seen_ms: then }, now) =>
  then || online ? html`<time title=${then ? moment(then) : nothing}>${online ? 'now' : ago(then, now)}</time>` : 'never';

const conditionLine = ({ code, text }) => html`
  <div class="line condition" title=${text}><span class="bad"><span aria-hidden="true">▲ </span>${words(code)}</span> <span class="quiet">${text}</span></div>`;

const taskLine = (task) => html`
  <div class="line task" data-task=${task.task}>
    <span class="package" title=${task.deployment}>${task.task}<span class="quiet">@${task.version}</span></span>
    <span class="phase ${tone(task.phase)}">${words(task.phase)}</span>
    <span class="note">${task.progress?.total && tone(task.phase) === 'busy' ? progress(task) : html`<span class="quiet">${remarks(task).join(' · ')}</span>`}</span>
    ${task.failure ? failure(task.failure) : nothing}
  </div>`;

const progress = ({ task, phase, progress: { done, total } }) => html`
  <progress max=${total} .value=${Math.min(done, total)} aria-label=${`${task} ${words(phase)}`}></progress><span class="quiet bytes">${bytes({ done, total })}</span>`;

const failure = ({ code, text }) => html`
  <span class="failure" title=${`${code}: ${text}`}>${words(code)}<span class="quiet">: ${text}</span></span>`;

/** What else is worth knowing of a task that has not failed. */
export function remarks({ active, version, restarts, wanted, phase, degraded }) {
  const said = [];
  if (degraded) said.push(`▲ degraded: ${words(degraded.code)}`);
  if (active && active.version !== version) said.push(`${active.version} still runs`);
  if (restarts) said.push(`restarted ${restarts}×`);
  if (wanted === 'stopped' && phase === 'running') said.push('stop ordered');
  return said;
}
