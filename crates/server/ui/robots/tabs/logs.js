// The Logs tab: live lines of a robot's tasks, nodes and agent. Earlier lines and gaps are fetched
// from the robot, which stores its lines, or from the server's memory if the robot cannot be
// reached.

import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { get, SignedOut } from '../../api/api.js';
import { openStream } from '../../api/stream.js';
import { change } from '../../display/display.js';
import { duration, number, plural } from '../../display/format.js';
import { statusDot } from '../../display/status.js';
import { LogView, textOf } from './log-view.js';

const MAX_LINES = 5_000;
const FETCH_LINES = 1_000;
// A browser allows six connections per server, so a hidden tab disconnects and fetches missed lines
// later.
const HIDDEN_MS = 20_000;

const LEVELS = [
  ['', 'All levels'],
  ['info', 'Info and above'],
  ['warn', 'Warnings and above'],
  ['error', 'Errors and above'],
  ['fatal', 'Fatal only'],
];

export class Logs {
  #page;
  /** All known lines, oldest first. */
  #lines = [];
  #view = new LogView(MAX_LINES, (act) => change(act));
  /** How many lines with this key a fetch brought, which the stream may bring as well. */
  #fetched = new Map();
  /** Lines to append to the view; `null` to replace all its lines. */
  #pending = null;
  /** Number of new lines since the view was paused; `null` if it is not paused. */
  #paused = null;
  /** The state of the connection. */
  #state = { text: 'Connecting…' };
  #fallback = null;
  #end = null;
  #hidden = null;
  #isFetching = false;
  #filter = null;

  constructor(page) {
    this.#page = page;
  }

  enter() {
    this.#filter = null;
    this.#follow();
    document.addEventListener('visibilitychange', this.#onVisibilityChange);
  }

  leave() {
    this.#disconnect();
    clearTimeout(this.#hidden);
    document.removeEventListener('visibilitychange', this.#onVisibilityChange);
  }

  onNavigate() {
    this.#follow();
  }

  // Connection

  #onVisibilityChange = () => {
    clearTimeout(this.#hidden);
    if (document.hidden) this.#hidden = setTimeout(() => this.#disconnect(), HIDDEN_MS);
    else if (!this.#end) this.#listen();
  };

  /** Follows the lines that the route's query selects. */
  #follow() {
    const { level = '', task = '', q = '' } = this.#page.query;
    this.#view.search(q);
    const filter = { level, task };
    if (this.#filter?.level === level && this.#filter?.task === task) return;
    this.#disconnect();
    this.#filter = filter;
    this.#lines = [];
    this.#fetched.clear();
    this.#pending = null;
    this.#paused = null;
    this.#fallback = null;
    this.#view.isAtEnd = true;
    this.#listen();
  }

  #listen() {
    const given = Object.entries({ ...this.#filter, follow: true }).filter(([, value]) => value);
    const url = `/api/v1/robots/${this.#page.robot.id}/logs?${new URLSearchParams(given)}`;
    this.#state = { text: 'Connecting…' };
    const end = openStream((message) => this.#end === end && this.#onMessage(message), url);
    this.#end = end;
    this.#fetch();
  }

  #disconnect() {
    this.#end?.();
    this.#end = null;
  }

  #onMessage({ state, events = [] }) {
    change(() => {
      if (state === 'waiting') this.#state = { text: 'Disconnected; retrying', isBad: true };
      for (const event of events) this.#applyEvent(event);
    });
  }

  #applyEvent({ type, reason, lines, suppressed }) {
    if (type === 'away')
      this.#state = { text: `No live lines: ${this.#page.withRobotName(reason)}`, isBad: true };
    if (type === 'following') {
      this.#state = { text: 'Following', isOn: true };
      // Fetches missed lines, also after a gap.
      this.#fetch();
    }
    if (type !== 'lines') return;
    if (suppressed)
      this.#append([
        {
          at_ms: lines[0]?.at_ms ?? this.#page.app.now(),
          note: `${plural(suppressed, 'line')} skipped by the rate limit. The robot keeps them.`,
        },
      ]);
    this.#append(lines.filter((line) => !this.#takeFetched(line)));
  }

  /** Whether a fetch has brought this line already. */
  #takeFetched(line) {
    const count = this.#fetched.get(keyOf(line)) ?? 0;
    if (count) this.#fetched.set(keyOf(line), count - 1);
    return count > 0;
  }

  #append(lines) {
    this.#lines.push(...lines);
    this.#trim();
    if (this.#paused !== null) this.#paused += lines.length;
    else this.#pending?.push(...lines);
  }

  #trim() {
    if (this.#lines.length > MAX_LINES) this.#lines = this.#lines.slice(-MAX_LINES);
  }

  /** Fetches the newest lines and merges unknown ones by time. */
  async #fetch() {
    if (this.#isFetching) return;
    this.#isFetching = true;
    const filter = this.#filter;
    const answer = await get(`/robots/${this.#page.robot.id}/logs`, {
      ...filter,
      max_lines: FETCH_LINES,
    }).catch((error) => (error instanceof SignedOut ? null : { error }));
    this.#isFetching = false;
    if (filter !== this.#filter) return this.#end && this.#fetch();
    if (!answer) return;
    change(() => {
      if (answer.error)
        this.#fallback = { text: '', full: this.#page.withRobotName(answer.error.message) };
      else this.#merge(answer);
    });
  }

  #merge({ from, age_ms: age, reason, lines }) {
    this.#fallback =
      from === 'server'
        ? fallbackNote(lines, age, reason && this.#page.withRobotName(reason))
        : null;
    const known = new Map();
    for (const line of this.#lines) known.set(keyOf(line), (known.get(keyOf(line)) ?? 0) + 1);
    const unknown = lines.filter((line) => {
      const count = known.get(keyOf(line)) ?? 0;
      if (count) known.set(keyOf(line), count - 1);
      return !count;
    });
    if (this.#fetched.size > MAX_LINES) this.#fetched.clear();
    for (const line of unknown)
      this.#fetched.set(keyOf(line), (this.#fetched.get(keyOf(line)) ?? 0) + 1);
    if (!unknown.length && this.#pending) return;
    this.#lines = [...unknown, ...this.#lines].sort((one, other) => one.at_ms - other.at_ms);
    this.#trim();
    if (this.#paused === null) this.#pending = null;
    else this.#paused += unknown.length;
  }

  // Drawing

  draw(robot) {
    const { level = '', task = '', q = '' } = this.#page.query;
    const tasks = [
      ...new Set([...robot.tasks.map((one) => one.task), task].filter(Boolean)),
    ].sort();
    const isPaused = this.#paused !== null;
    const note = this.#state.isBad ? this.#fallback?.text : this.#fallback?.full;
    return html`
      <section class="logs" aria-label="Logs">
        <div class="tools">
          <label><span>Level</span> <select
            @change=${({ currentTarget }) => this.#setQuery({ level: currentTarget.value })}>
            ${LEVELS.map(
              ([id, title]) =>
                html`<option value=${id} .selected=${id === level}>${title}</option>`,
            )}</select></label>
          <label><span>Task</span> <select
            @change=${({ currentTarget }) => this.#setQuery({ task: currentTarget.value })}>
            <option value="" .selected=${!task}>All tasks</option>
            ${tasks.map(
              (name) => html`<option value=${name} .selected=${name === task}>${name}</option>`,
            )}</select></label>
          <input type="search" placeholder="Search" aria-label="Search log lines"
            aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${q}
            @input=${({ currentTarget }) => this.#setQuery({ q: currentTarget.value })}>
          <span class="actions">
            <button class="quiet-button pause" aria-pressed=${isPaused}
              @click=${() => this.#pause()}
              >${isPaused ? `Resume (${number(this.#paused)} new)` : 'Pause'}</button>
            <button class="quiet-button" ?disabled=${!this.#view.shown}
              @click=${() => this.#download(robot)}>Download</button>
          </span>
        </div>
        <p class="log-state"><span role="status">${
          this.#state.isBad
            ? html`<span class="bad"><span aria-hidden="true">▲ </span>${this.#state.text}</span>`
            : statusDot(Boolean(this.#state.isOn), this.#state.text)
        }</span>${note ? html`<span class="quiet"> · ${note}</span>` : nothing}</p>
        <div class="log-view" role="log" aria-live="off" aria-label="Log lines" tabindex="0"></div>
        <p class="log-footer quiet"><span>${this.#count(q)}</span>${
          this.#view.isAtEnd
            ? nothing
            : html`<button class="plain link"
                @click=${() => this.#view.toEnd()}>Jump to newest ↓</button>`
        }</p>
      </section>`;
  }

  afterDraw() {
    this.#view.attach(document.querySelector('.log-view'));
    if (this.#paused !== null) return;
    if (this.#pending?.length === 0) return;
    if (this.#pending) this.#view.add(this.#pending);
    else this.#view.show(this.#lines);
    this.#pending = [];
    // The line count is drawn above the view.
    change();
  }

  #count(q) {
    const { shown } = this.#view;
    if (q) return `${plural(shown, 'line')} matching “${q}”`;
    if (!shown)
      return this.#isFetching
        ? 'Loading earlier lines…'
        : this.#fallback
          ? ''
          : 'No log lines yet.';
    return `${plural(shown, 'line')}${shown >= MAX_LINES ? '; older lines are not shown' : ''}`;
  }

  #setQuery(query) {
    change(() => {
      this.#page.setQuery(query);
      this.#follow();
    });
  }

  #pause() {
    change(() => {
      const isPaused = this.#paused !== null;
      this.#paused = isPaused ? null : 0;
      if (isPaused) this.#pending = null;
    });
  }

  #download({ name }) {
    const lines = this.#view.lines.map(textOf);
    const link = document.createElement('a');
    link.href = URL.createObjectURL(new Blob([`${lines.join('\n')}\n`], { type: 'text/plain' }));
    const time = new Date(this.#page.app.now()).toISOString().slice(0, 19).replaceAll(':', '');
    link.download = `${name}-${time}.log`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  }
}

/** Explains lines from the server's memory: as `text`, and with the reason as `full`. */
function fallbackNote(lines, age, reason) {
  const text = lines.length
    ? `Showing lines from the server’s memory, last received ${duration(age)} ago`
    : 'The server has no lines of this robot in memory';
  return { text, full: reason ? `${text}: ${reason}` : text };
}

const keyOf = ({ at_ms: then, level, source, task, node, text, note }) =>
  [then, level, source, task, node, text, note].join('\u0000');
