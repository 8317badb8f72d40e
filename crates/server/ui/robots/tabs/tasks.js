// The Tasks tab: all assignments of a robot, newest first, with phases and failures.

import { repeat } from '../../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { get, SignedOut } from '../../api/api.js';
import { change } from '../../display/display.js';
import { plural } from '../../display/format.js';
import { hrefTo } from '../../display/router.js';
import { phaseBadge, progressBar, timeAgo } from '../../display/status.js';
import { timelineList, timelineSteps, timelineBar } from '../../display/timeline.js';
import { failureText } from './monitor.js';

const SHOWN = 25;
// A busy robot changes more often than users can read.
const REFETCH_PAUSE_MS = 2_000;

export class Tasks {
  #page;
  #assignments = null;
  /** The `before` parameter of the next older page. */
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

  onEvent() {
    this.#timer ??= setTimeout(() => {
      this.#timer = null;
      this.refresh();
    }, REFETCH_PAUSE_MS);
  }

  /** Fetches the newest assignments; older pages stay. */
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
          ? 'This server keeps no task history. The Monitor tab lists the current tasks.'
          : this.#problem.message;
      return html`<p class="empty quiet">${text}</p>`;
    }
    if (!this.#assignments) return html`<p class="empty quiet">Loading…</p>`;
    if (!this.#assignments.length) return html`<p class="empty quiet">No tasks yet.</p>`;
    const current = this.#assignments.filter(({ wanted }) => wanted);
    const past = this.#assignments.filter(({ wanted }) => !wanted);
    return html`
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem.message}</p>` : nothing}
      ${this.#list('Current', current, now)}
      ${this.#list('Previous', past, now)}
      ${
        this.#next
          ? html`<p><button class="quiet-button"
              @click=${() => this.#fetch(this.#next)}>Show older</button></p>`
          : nothing
      }`;
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
    const course = timelineSteps(assignment.timeline ?? [], assignment.kind, now);
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
    const notes = [
      attempts > 1 && plural(attempts, 'attempt'),
      !assignment.released && 'waiting for its batch',
    ].filter(Boolean);
    return html`
      <article class="assignment" data-deployment=${deployment}>
        <h3>${name}<span class="quiet">@${version}</span> ${phaseBadge(phase)}${
          wanted === 'stopped' && phase !== 'stopped'
            ? html`<span class="quiet"> stop requested</span>`
            : nothing
        }</h3>
        <p class="quiet time">${timeAgo(then, now)}</p>
        ${timelineBar(course)}
        ${timelineList(course)}
        ${progressBar({ ...assignment, task: name })}
        ${failure ? failureText(failure) : nothing}
        <p class="quiet">${notes.map((said) => `${said} · `)}${
          delivery
            ? html`${delivery.mechanism}: ${delivery.because}
                <span class="rule">(rule: ${delivery.rule})</span>`
            : 'delivery not decided yet'
        }</p>
        <p><a href=${hrefTo(['deployments', deployment])}>Deployment</a>
          · <a href=${this.#page.hrefTo('logs', { task: name })}>Log</a>${
            newer
              ? html` · superseded by a
                  <a href=${hrefTo(['deployments', newer])}>newer deployment</a>`
              : nothing
          }</p>
      </article>`;
  }
}
