// Everything that was ordered of a robot, the newest first: how each order went, phase by phase,
// and why it failed.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { get, SignedOut } from '../api.js';
import { plural } from '../format.js';
import { change } from '../frame.js';
import { at } from '../router.js';
import { phaseSign, progressBar, since } from '../signs.js';
import { list, steps, strip } from '../timeline.js';
import { why } from './monitor.js';

const SHOWN = 25;
// A robot that works says more than a person can read.
const REFETCH_PAUSE_MS = 2_000;

export class Tasks {
  #page;
  #assignments = null;
  /** What comes before is asked for with this. */
  #next = null;
  #problem = null;
  #timer = null;

  constructor(page) {
    this.#page = page;
  }

  enter() {
    this.refresh();
  }

  leave() {
    clearTimeout(this.#timer);
    this.#timer = null;
  }

  hear() {
    this.#timer ??= setTimeout(() => {
      this.#timer = null;
      this.refresh();
    }, REFETCH_PAUSE_MS);
  }

  /** Fetches the newest again; older ones that were asked for stay. */
  refresh() {
    return this.#fetch();
  }

  async #fetch(before) {
    try {
      const { assignments, next = null } = await get(`/robots/${this.#page.robot.id}/tasks`, {
        limit: SHOWN,
        before,
      });
      change(() => {
        const old = this.#assignments ?? [];
        const fresh = new Set(assignments.map(({ deployment }) => deployment));
        const kept = old.filter(({ deployment }) => !fresh.has(deployment));
        if (before || old.length <= SHOWN) this.#next = next;
        this.#assignments = before
          ? [...kept, ...assignments]
          : [...assignments, ...(next ? kept : [])];
        this.#problem = null;
      });
    } catch (error) {
      if (!(error instanceof SignedOut)) change(() => (this.#problem = error));
    }
  }

  draw(robot, now) {
    if (!this.#assignments && this.#problem) {
      const text =
        this.#problem.status === 404
          ? 'This server keeps no history of tasks. What is ordered now is on Monitor.'
          : this.#problem.message;
      return html`<p class="empty quiet">${text}</p>`;
    }
    if (!this.#assignments) return html`<p class="empty quiet">Fetching…</p>`;
    if (!this.#assignments.length)
      return html`<p class="empty quiet">Nothing has been ordered of it.</p>`;
    const current = this.#assignments.filter(({ wanted }) => wanted);
    const past = this.#assignments.filter(({ wanted }) => !wanted);
    return html`
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem.message}</p>` : nothing}
      ${this.#list('Now', current, now)}
      ${this.#list('Before', past, now)}
      ${this.#next ? html`<p><button class="quiet-button" @click=${() => this.#fetch(this.#next)}>Show older</button></p>` : nothing}`;
  }

  #list(title, assignments, now) {
    if (!assignments.length) return nothing;
    return html`
      <section class="history" aria-label=${title}>
        <header><h2>${title}</h2></header>
        ${repeat(
          assignments,
          ({ deployment }) => deployment,
          (assignment) => this.#assignment(assignment, now),
        )}
      </section>`;
  }

  #assignment(assignment, now) {
    const course = steps(assignment.timeline ?? [], assignment.kind, now);
    const {
      deployment,
      package: { name, version },
      phase,
      wanted,
      failure,
      attempts,
      delivery,
      superseded_by: newer,
      created_at_ms: then,
    } = assignment;
    return html`
      <article class="assignment" data-deployment=${deployment}>
        <h3>${name}<span class="quiet">@${version}</span> ${phaseSign(phase)}${wanted === 'stopped' && phase !== 'stopped' ? html`<span class="quiet"> stop ordered</span>` : nothing}</h3>
        <p class="quiet when">${since(then, now)}</p>
        ${strip(course)}
        ${list(course)}
        ${progressBar({ ...assignment, task: name })}
        ${failure ? why(failure) : nothing}
        <p class="quiet">${[attempts > 1 && plural(attempts, 'attempt'), !assignment.released && 'waits for its batch'].filter(Boolean).map((said) => `${said} · `)}${delivery ? html`${delivery.mechanism}, because ${delivery.because} <span class="rule">(rule: ${delivery.rule})</span>` : 'delivery not decided yet'}</p>
        <p><a href=${at(['deployments', deployment])}>Deployment</a> · <a href=${this.#page.at('logs', { task: name })}>Log</a>${newer ? html` · <a href=${at(['deployments', newer])}>what took its place</a>` : nothing}</p>
      </article>`;
  }
}
