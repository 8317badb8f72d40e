// The page of one robot: what it is and how it stands above, and below the part somebody has
// chosen, each in a module of its own.
//
// A part is a class: `constructor(page)`, `draw(robot, now)`, and, where it needs them, `enter()`
// when it comes into sight, `leave()` when it goes, `arrive()` when the place's query has changed,
// `hear(robot)` when this robot has changed, `refresh()` and `drawn()`. What somebody has typed in
// a part stays in it while they look at another.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { labelsOf } from './fleet.js';
import { words } from './format.js';
import { at, place, restate } from './router.js';
import { lastSeen, robotState } from './signs.js';
import { Control } from './robot/control.js';
import { Edit } from './robot/edit.js';
import { Logs } from './robot/logs.js';
import { Monitor } from './robot/monitor.js';
import { Outputs } from './robot/outputs.js';
import { Ros } from './robot/ros.js';
import { Tasks } from './robot/tasks.js';

/** The parts. Those with `needs` are for people who may do one of these. */
const PARTS = [
  { id: 'monitor', title: 'Monitor', Part: Monitor },
  { id: 'ros', title: 'ROS', Part: Ros },
  { id: 'tasks', title: 'Tasks', Part: Tasks },
  { id: 'logs', title: 'Logs', Part: Logs },
  { id: 'outputs', title: 'Outputs', Part: Outputs },
  { id: 'control', title: 'Control', Part: Control, needs: ['operate', 'maintain'] },
  { id: 'edit', title: 'Edit', Part: Edit, needs: ['maintain'] },
];

export class RobotView {
  /** The place's query. */
  query = {};
  #name;
  /** Once found, the robot stays the one that is shown, also by a new name. */
  #id = null;
  #chosen = PARTS[0];
  /** The parts that were looked at, and which of them is in sight. */
  #parts = new Map();
  #current = null;
  #shownPart = null;

  constructor(app) {
    this.app = app;
  }

  /** The robot as it is now; nothing if there is none. */
  get robot() {
    const { fleet } = this.app;
    const robot = this.#id ? fleet.robots.get(this.#id) : fleet.robot(this.#name);
    if (robot) this.#id = robot.id;
    return robot;
  }

  get #isAllowed() {
    const { needs } = this.#chosen;
    return !needs || needs.some((permission) => this.app.can(permission));
  }

  arrive({ path: [, name, part], query }) {
    this.#name = name;
    this.#chosen = PARTS.find(({ id }) => id === part) ?? PARTS[0];
    this.query = query;
    if (this.#current?.id === this.#chosen.id) this.#current.part.arrive?.();
  }

  /** Says in the address what is looked at now. */
  say(query) {
    this.query = { ...this.query, ...query };
    restate(this.query);
  }

  /** What the server said of this robot, with the name that people know it by. */
  inWords(text) {
    return this.#id ? text.replaceAll(this.#id, this.robot?.name ?? this.#id) : text;
  }

  /** The address of a part of this robot's page. */
  at(part, query) {
    return at(['robots', this.robot?.name ?? this.#name, part], query);
  }

  hear({ type, robot }) {
    if (type === 'robot' && robot.id === this.#id) this.#current?.part.hear?.(robot);
  }

  refresh() {
    this.#current?.part.refresh?.();
  }

  leave() {
    this.#show(null);
  }

  draw(now) {
    const { robot } = this;
    this.#show(robot && this.app.me && this.#isAllowed ? this.#chosen : null);
    if (!robot) return this.#noRobot();
    this.#keepAddress(robot);
    return html`
      <div class="robot-page">
        ${this.#head(robot, now)}
        ${this.#current ? this.#current.part.draw(robot, now) : this.app.me ? html`<p class="empty quiet">Your roles do not allow that.</p>` : nothing}
      </div>`;
  }

  drawn() {
    this.#current?.part.drawn?.();
    if (this.#shownPart === this.#chosen) return;
    // On a narrow screen its link may be out of sight.
    document
      .querySelector('.parts [aria-current]')
      ?.scrollIntoView({ block: 'nearest', inline: 'nearest' });
    this.#shownPart = this.#current && this.#chosen;
  }

  get isUnsaved() {
    return [...this.#parts.values()].some(({ isUnsaved }) => isUnsaved);
  }

  #show(chosen) {
    if (this.#current?.id === chosen?.id) return;
    this.#current?.part.leave?.();
    this.#current = null;
    if (!chosen) return;
    const { id, Part } = chosen;
    if (!this.#parts.has(id)) this.#parts.set(id, new Part(this));
    this.#current = { id, part: this.#parts.get(id) };
    this.#current.part.enter?.();
  }

  /** A robot that gets another name keeps a page that can be shared. */
  #keepAddress({ id, name }) {
    if (this.#name === name || this.#name === id) return;
    const {
      path: [section, , ...rest],
      query,
    } = place();
    if (section === 'robots') history.replaceState(null, '', at([section, name, ...rest], query));
    this.#name = name;
  }

  #noRobot() {
    if (!this.app.fleet.isLoaded)
      return html`<div class="robot-page"><header class="robot-head"><h1>${this.#name}</h1></header></div>`;
    return html`
      <div class="empty">
        <h1>${this.#name}</h1>
        <p>${this.#id ? 'This robot has been removed.' : 'There is no robot of this name or id, or none that you may see.'}</p>
        <p><a href=${at(['robots'])}>All robots</a></p>
      </div>`;
  }

  #head(robot, now) {
    const { app } = this;
    const parts = PARTS.filter(
      ({ needs }) => !needs || needs.some((permission) => app.can(permission)),
    );
    return html`
      <header class="robot-head">
        <h1>${robot.name}</h1>
        <p>${robotState(robot)}${robot.online ? nothing : html` <span class="quiet">last seen ${lastSeen(robot, now)}</span>`}</p>
        ${robot.address ? html`<p class="code quiet">${robot.address}</p>` : nothing}
        ${labelsOf(robot).length ? html`<ul class="labels" aria-label="Labels">${labelsOf(robot).map((label) => html`<li class="code">${label}</li>`)}</ul>` : nothing}
      </header>
      ${robot.conditions.map(({ code, text }) => html`<p class="condition"><span class="bad"><span aria-hidden="true">▲ </span>${words(code)}:</span> ${text}</p>`)}
      <nav class="parts" aria-label="Parts of this page">${parts.map(({ id, title }) => html`<a href=${this.at(id)} aria-current=${this.#chosen.id === id ? 'page' : nothing}>${title}</a>`)}</nav>`;
  }
}
