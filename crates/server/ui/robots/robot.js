// The view of a robot: a header, and tabs in modules of their own.
//
// A tab is a class with `constructor(page)` and `draw(robot, now)`. Optional are `enter()` and
// `leave()` when it is shown and hidden, `onNavigate()` for changes of the query, `onEvent(robot)`
// for changes of this robot, `refresh()` and `afterDraw()`. A tab keeps unsaved input while another
// one is shown.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { words } from '../display/format.js';
import { hrefTo, currentRoute, replaceQuery } from '../display/router.js';
import { lastSeen, robotState } from '../display/status.js';
import { labelsOf } from '../fleet.js';
import { Control } from './tabs/control.js';
import { Edit } from './tabs/edit.js';
import { Logs } from './tabs/logs.js';
import { Monitor } from './tabs/monitor.js';
import { Outputs } from './tabs/outputs.js';
import { Ros } from './tabs/ros.js';
import { Tasks } from './tabs/tasks.js';

/** The tabs. `needs` lists permissions of which the user must have one. */
const TABS = [
  { id: 'monitor', title: 'Monitor', Tab: Monitor },
  { id: 'ros', title: 'ROS', Tab: Ros },
  { id: 'tasks', title: 'Tasks', Tab: Tasks },
  { id: 'logs', title: 'Logs', Tab: Logs },
  { id: 'outputs', title: 'Outputs', Tab: Outputs },
  { id: 'control', title: 'Control', Tab: Control, needs: ['operate', 'maintain'] },
  { id: 'edit', title: 'Edit', Tab: Edit, needs: ['maintain'] },
];

export class RobotView {
  /** The query of the route. */
  query = {};
  #name;
  /** Once found, the same robot stays shown even after a rename. */
  #id = null;
  #selected = TABS[0];
  /** The tabs that have been created, and the current one. */
  #tabs = new Map();
  #current = null;
  #shownTab = null;

  constructor(app) {
    this.app = app;
  }

  /** The robot, or nothing if it does not exist. */
  get robot() {
    const { fleet } = this.app;
    const robot = this.#id ? fleet.robots.get(this.#id) : fleet.robot(this.#name);
    if (robot) this.#id = robot.id;
    return robot;
  }

  get #isAllowed() {
    const { needs } = this.#selected;
    return !needs || needs.some((permission) => this.app.can(permission));
  }

  onNavigate({ path: [, name, tab], query }) {
    this.#name = name;
    this.#selected = TABS.find(({ id }) => id === tab) ?? TABS[0];
    this.query = query;
    if (this.#current?.id === this.#selected.id) this.#current.tab.onNavigate?.();
  }

  /** Changes the query in the address. */
  setQuery(query) {
    this.query = { ...this.query, ...query };
    replaceQuery(this.query);
  }

  /** A server message with the name of the robot in place of its id. */
  withRobotName(text) {
    return this.#id ? text.replaceAll(this.#id, this.robot?.name ?? this.#id) : text;
  }

  /** The address of a tab of this robot. */
  hrefTo(tab, query) {
    return hrefTo(['robots', this.robot?.name ?? this.#name, tab], query);
  }

  onEvent({ type, robot }) {
    if (type === 'robot' && robot.id === this.#id) this.#current?.tab.onEvent?.(robot);
  }

  refresh() {
    this.#current?.tab.refresh?.();
  }

  leave() {
    this.#show(null);
  }

  draw(now) {
    const { robot } = this;
    this.#show(robot && this.app.me && this.#isAllowed ? this.#selected : null);
    if (!robot) return this.#notFound();
    this.#updateAddress(robot);
    return html`
      <div class="robot-page">
        ${this.#head(robot, now)}
        ${
          this.#current
            ? this.#current.tab.draw(robot, now)
            : this.app.me
              ? html`<p class="empty quiet">You do not have permission to view this tab.</p>`
              : nothing
        }
      </div>`;
  }

  afterDraw() {
    this.#current?.tab.afterDraw?.();
    if (this.#shownTab === this.#selected) return;
    // On a narrow screen the link may be scrolled out of view.
    document
      .querySelector('.tabs [aria-current]')
      ?.scrollIntoView({ block: 'nearest', inline: 'nearest' });
    this.#shownTab = this.#current && this.#selected;
  }

  get isUnsaved() {
    return [...this.#tabs.values()].some(({ isUnsaved }) => isUnsaved);
  }

  #show(selected) {
    if (this.#current?.id === selected?.id) return;
    this.#current?.tab.leave?.();
    this.#current = null;
    if (!selected) return;
    const { id, Tab } = selected;
    if (!this.#tabs.has(id)) this.#tabs.set(id, new Tab(this));
    this.#current = { id, tab: this.#tabs.get(id) };
    this.#current.tab.enter?.();
  }

  /** Updates the address after a rename, so that it can be shared. */
  #updateAddress({ id, name }) {
    if (this.#name === name || this.#name === id) return;
    const {
      path: [section, , ...rest],
      query,
    } = currentRoute();
    if (section === 'robots')
      history.replaceState(null, '', hrefTo([section, name, ...rest], query));
    this.#name = name;
  }

  #notFound() {
    if (!this.app.fleet.isLoaded)
      return html`<div class="robot-page"><header class="robot-head">
        <h1>${this.#name}</h1></header></div>`;
    return html`
      <div class="empty">
        <h1>${this.#name}</h1>
        <p>${
          this.#id
            ? 'This robot was deleted.'
            : 'No robot with this name or ID exists, or you do not have access to it.'
        }</p>
        <p><a href=${hrefTo(['robots'])}>All robots</a></p>
      </div>`;
  }

  #head(robot, now) {
    const { app } = this;
    const tabs = TABS.filter(
      ({ needs }) => !needs || needs.some((permission) => app.can(permission)),
    );
    return html`
      <header class="robot-head">
        <h1>${robot.name}</h1>
        <p>${robotState(robot)}${
          robot.online
            ? nothing
            : html` <span class="quiet">last seen ${lastSeen(robot, now)}</span>`
        }</p>
        ${robot.address ? html`<p class="code quiet">${robot.address}</p>` : nothing}
        ${
          labelsOf(robot).length
            ? html`<ul class="labels" aria-label="Labels">${labelsOf(robot).map(
                (label) => html`<li class="code">${label}</li>`,
              )}</ul>`
            : nothing
        }
      </header>
      ${robot.conditions.map(
        ({ code, text }) =>
          html`<p class="condition"><span class="bad"><span
            aria-hidden="true">▲ </span>${words(code)}:</span> ${text}</p>`,
      )}
      <nav class="tabs" aria-label="Robot">${tabs.map(
        ({ id, title }) =>
          html`<a href=${this.hrefTo(id)}
            aria-current=${this.#selected.id === id ? 'page' : nothing}>${title}</a>`,
      )}</nav>`;
  }
}
