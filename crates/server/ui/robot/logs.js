// What a robot's tasks, their nodes and its agent say, as they say it. What was said before, and in
// gaps, is asked of the robot, which keeps its lines; where it can't be asked, the server's memory
// has the last of them.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { get, SignedOut } from '../api.js';
import { duration, number, plural } from '../format.js';
import { change } from '../frame.js';
import { sign } from '../signs.js';
import { openStream } from '../stream.js';
import { Sheet, textOf } from './sheet.js';

const KEPT = 5_000;
const FETCHED = 1_000;
// A browser allows six connections to a server. A tab nobody looks at lets go of its own, and
// fetches what it missed later.
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
  /** All that is known, the oldest first. */
  #lines = [];
  #sheet = new Sheet(KEPT, (act) => change(act));
  /** What the sheet does not have yet; `null`: it has to be filled anew. */
  #fresh = null;
  /** While it is set, the sheet stays as it is; so many lines have come since. */
  #paused = null;
  /** Where the lines come from now, in words, and whether that is what one would want. */
  #state = { text: 'Connecting…' };
  #memory = null;
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
    document.addEventListener('visibilitychange', this.#look);
  }

  leave() {
    this.#hangUp();
    clearTimeout(this.#hidden);
    document.removeEventListener('visibilitychange', this.#look);
  }

  arrive() {
    this.#follow();
  }

  // Listening

  #look = () => {
    clearTimeout(this.#hidden);
    if (document.hidden) this.#hidden = setTimeout(() => this.#hangUp(), HIDDEN_MS);
    else if (!this.#end) this.#listen();
  };

  /** Follows the lines that the place's query wants. */
  #follow() {
    const { level = '', task = '', q = '' } = this.#page.query;
    this.#sheet.search(q);
    const filter = { level, task };
    if (this.#filter?.level === level && this.#filter?.task === task) return;
    this.#hangUp();
    this.#filter = filter;
    this.#lines = [];
    this.#fresh = null;
    this.#paused = null;
    this.#memory = null;
    this.#sheet.isAtEnd = true;
    this.#listen();
  }

  #listen() {
    const given = Object.entries({ ...this.#filter, follow: true }).filter(([, value]) => value);
    const url = `/api/v1/robots/${this.#page.robot.id}/logs?${new URLSearchParams(given)}`;
    this.#state = { text: 'Connecting…' };
    const end = openStream((message) => this.#end === end && this.#hear(message), url);
    this.#end = end;
    this.#fetch();
  }

  #hangUp() {
    this.#end?.();
    this.#end = null;
  }

  #hear({ state, events = [] }) {
    change(() => {
      if (state === 'waiting') this.#state = { text: 'Not connected; trying again', isBad: true };
      for (const event of events) this.#take(event);
    });
  }

  #take({ type, reason, lines, suppressed }) {
    if (type === 'away')
      this.#state = { text: `Nothing comes: ${this.#page.inWords(reason)}`, isBad: true };
    if (type === 'following') {
      this.#state = { text: 'Following', isOn: true };
      // Also after a gap: what was said in it is to be had by asking.
      this.#fetch();
    }
    if (type !== 'lines') return;
    if (suppressed)
      this.#add([
        {
          at_ms: lines[0]?.at_ms ?? this.#page.app.now(),
          note: `${plural(suppressed, 'line')} left out here because they were too many. The robot keeps them.`,
        },
      ]);
    this.#add(lines);
  }

  #add(lines) {
    this.#lines.push(...lines);
    this.#bound();
    if (this.#paused !== null) this.#paused += lines.length;
    else this.#fresh?.push(...lines);
  }

  #bound() {
    if (this.#lines.length > KEPT) this.#lines = this.#lines.slice(-KEPT);
  }

  /**
   * Asks for the newest lines there are, and puts those that are not known yet where they belong.
   */
  async #fetch() {
    if (this.#isFetching) return;
    this.#isFetching = true;
    const filter = this.#filter;
    const said = await get(`/robots/${this.#page.robot.id}/logs`, {
      ...filter,
      max_lines: FETCHED,
    }).catch((error) => (error instanceof SignedOut ? null : { error }));
    this.#isFetching = false;
    if (filter !== this.#filter) return this.#end && this.#fetch();
    if (!said) return;
    change(() => {
      if (said.error) this.#memory = { text: '', whole: this.#page.inWords(said.error.message) };
      else this.#merge(said);
    });
  }

  #merge({ from, age_ms: age, reason, lines }) {
    this.#memory =
      from === 'server' ? remembered(lines, age, reason && this.#page.inWords(reason)) : null;
    const known = new Map();
    for (const line of this.#lines) known.set(keyOf(line), (known.get(keyOf(line)) ?? 0) + 1);
    const unknown = lines.filter((line) => {
      const count = known.get(keyOf(line)) ?? 0;
      if (count) known.set(keyOf(line), count - 1);
      return !count;
    });
    if (!unknown.length && this.#fresh) return;
    this.#lines = [...unknown, ...this.#lines].sort((one, other) => one.at_ms - other.at_ms);
    this.#bound();
    if (this.#paused === null) this.#fresh = null;
    else this.#paused += unknown.length;
  }

  // Drawing

  draw(robot) {
    const { level = '', task = '', q = '' } = this.#page.query;
    const tasks = [
      ...new Set([...robot.tasks.map((one) => one.task), task].filter(Boolean)),
    ].sort();
    const isPaused = this.#paused !== null;
    const said = this.#state.isBad ? this.#memory?.text : this.#memory?.whole;
    return html`
      <section class="logs" aria-label="Logs">
        <div class="tools">
          <label><span>Level</span> <select @change=${({ currentTarget }) => this.#say({ level: currentTarget.value })}>${LEVELS.map(([id, title]) => html`<option value=${id} .selected=${id === level}>${title}</option>`)}</select></label>
          <label><span>Task</span> <select @change=${({ currentTarget }) => this.#say({ task: currentTarget.value })}><option value="" .selected=${!task}>All tasks</option>${tasks.map((name) => html`<option value=${name} .selected=${name === task}>${name}</option>`)}</select></label>
          <input type="search" placeholder="Search within" aria-label="Search within the lines" aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${q} @input=${({ currentTarget }) => this.#say({ q: currentTarget.value })}>
          <span class="acts">
            <button class="quiet-button pause" aria-pressed=${isPaused} @click=${() => this.#pause()}>${isPaused ? `Go on (${number(this.#paused)} wait)` : 'Pause'}</button>
            <button class="quiet-button" ?disabled=${!this.#sheet.shown} @click=${() => this.#download(robot)}>Download</button>
          </span>
        </div>
        <p class="log-state"><span role="status">${this.#state.isBad ? html`<span class="bad"><span aria-hidden="true">▲ </span>${this.#state.text}</span>` : sign(Boolean(this.#state.isOn), this.#state.text)}</span>${said ? html`<span class="quiet"> · ${said}</span>` : nothing}</p>
        <div class="log-place" role="log" aria-live="off" aria-label="Lines" tabindex="0"></div>
        <p class="log-foot quiet"><span>${this.#count(q)}</span>${this.#sheet.isAtEnd ? nothing : html`<button class="plain link" @click=${() => this.#sheet.toEnd()}>To the newest ↓</button>`}</p>
      </section>`;
  }

  drawn() {
    this.#sheet.settle(document.querySelector('.log-place'));
    if (this.#paused !== null) return;
    if (this.#fresh?.length === 0) return;
    if (this.#fresh) this.#sheet.add(this.#fresh);
    else this.#sheet.show(this.#lines);
    this.#fresh = [];
    // How many there are is said above.
    change();
  }

  #count(q) {
    const { shown } = this.#sheet;
    if (q) return `${plural(shown, 'line')} with “${q}”`;
    if (!shown)
      return this.#isFetching
        ? 'Asking for what was said before…'
        : this.#memory
          ? ''
          : 'Nothing has been said yet.';
    return `${plural(shown, 'line')}${shown >= KEPT ? '; older ones are no longer shown' : ''}`;
  }

  #say(query) {
    change(() => {
      this.#page.say(query);
      this.#follow();
    });
  }

  #pause() {
    change(() => {
      const isPaused = this.#paused !== null;
      this.#paused = isPaused ? null : 0;
      if (isPaused) this.#fresh = null;
    });
  }

  #download({ name }) {
    const lines = this.#sheet.lines.map(textOf);
    const link = document.createElement('a');
    link.href = URL.createObjectURL(new Blob([`${lines.join('\n')}\n`], { type: 'text/plain' }));
    link.download = `${name}-${new Date(this.#page.app.now()).toISOString().slice(0, 19).replaceAll(':', '')}.log`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  }
}

/** That the robot could not be asked: shortly, where why is said already, and as a whole. */
function remembered(lines, age, reason) {
  const text = lines.length
    ? `What is here is from the server’s memory, last heard ${duration(age)} ago`
    : 'The server remembers no line of it';
  return { text, whole: reason ? `${text}: ${reason}` : text };
}

const keyOf = ({ at_ms: then, level, source, task, node, text, note }) =>
  [then, level, source, task, node, text, note].join('\u0000');
