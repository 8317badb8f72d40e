// The view of a deployment: overall progress, reasons of failures, and the phases of each robot.

import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { get, newIdempotencyKey, postIdempotent, post } from '../api/api.js';
import { Cursor } from '../display/cursor.js';
import { openDialog } from '../display/dialog.js';
import { change } from '../display/display.js';
import {
  bytes,
  duration,
  moment,
  number,
  plural,
  shortDigest,
  size,
  tone,
  words,
} from '../display/format.js';
import { notify } from '../display/notice.js';
import { hrefTo, navigate, replaceQuery } from '../display/router.js';
import {
  phaseBar,
  deploymentState,
  phaseBadge,
  progressBar,
  robotState,
  timeAgo,
} from '../display/status.js';
import { timelineList, timelineSteps, timelineBar, totalDuration } from '../display/timeline.js';
import { VirtualList, isNarrow } from '../display/virtual-list.js';
import { selectorOf } from '../fleet.js';
import { robotNames } from '../orders/orders.js';
import { optionsText } from '../orders/push.js';
import { Assignments, canRetry, reasonOf } from './assignments.js';
import { targetText } from './deployments.js';
import { deliveryGroups, failureGroups } from './sidebar.js';

// As in deployments.css.
const ROW = 41;
const NARROW_ROW = 65;
// Minimum interval between updates of the filtered rows.
const FILTER_PAUSE_MS = 1_000;
// Minimum interval between fetches of the whole deployment, which is some megabytes for ten
// thousand robots. The interval grows with the duration of a fetch.
const REFETCH_PAUSE_MS = 5_000;
const REFETCH_SHARE = 10;
// Number of robots that are named as waiting.
const AWAITED_NAMES = 5;

/** Phases that are always shown, so that the layout is stable when the first robot reaches one. */
const SHOWN_PHASES = [
  'assigned',
  'fetching',
  'unpacking',
  'building',
  'starting',
  'running',
  'failed',
];
const JOB_PHASES = [...SHOWN_PHASES.slice(0, -1), 'succeeded', 'failed'];
const HEADS = [
  'Robot',
  'State',
  'Phase',
  html`<span class="visually-hidden">Details</span>`,
  'Phases',
  'Duration',
];
const ALL_PHASES = [
  'assigned',
  'deferred',
  'fetching',
  'unpacking',
  'building',
  'staged',
  'starting',
  'running',
  'succeeded',
  'failed',
  'unmet',
  'expired',
  'rolled_back',
  'stopped',
  'superseded',
  'cancelled',
];

export class DeploymentView {
  #list = new VirtualList();
  #cursor = new Cursor(this.#list, (robot) =>
    this.#setQuery({ robot: this.#query.robot === robot ? '' : robot }),
  );
  #assignments = new Assignments();
  #deployment = null;
  #problem = null;
  #author = null;
  /** The query of the address: the filter, and the expanded robot. */
  #query = { phase: '', reason: '', q: '', robot: '' };
  #filtered = [];
  #filteredAt = -Infinity;
  #detailHeight = 0;
  #fetchedAt = -Infinity;
  #fetchMs = 0;
  /**
   * The last event of each robot and of the deployment while a fetch is under way: newer than its
   * result, or followed by newer events.
   */
  #backlog = null;
  /** Whether another fetch is needed. */
  #isStale = false;
  #timer = null;
  #isGone = false;

  constructor(app) {
    this.app = app;
  }

  onNavigate({ path: [, id], query }) {
    const isFirst = !this.id;
    this.id = id;
    this.#query = {
      phase: query.phase ?? '',
      reason: query.reason ?? '',
      q: query.q ?? '',
      robot: query.robot ?? '',
    };
    this.#list.releaseAnchor();
    this.#filteredAt = -Infinity;
    if (isFirst) this.#fetch();
  }

  leave() {
    this.#isGone = true;
    clearTimeout(this.#timer);
  }

  refresh() {
    this.#fetch();
  }

  #setQuery(query) {
    change(() => {
      this.#query = { ...this.#query, ...query };
      this.#list.releaseAnchor();
      this.#filteredAt = -Infinity;
      replaceQuery(this.#query);
    });
  }

  #togglePhase(phase) {
    this.#setQuery({ phase: this.#query.phase === phase ? '' : phase, reason: '' });
  }

  // Fetching and events

  async #fetch() {
    clearTimeout(this.#timer);
    this.#timer = null;
    this.#isStale = this.#backlog !== null;
    if (this.#isStale) return;
    this.#backlog = new Map();
    const begun = performance.now();
    this.#fetchedAt = begun;
    try {
      const deployment = await get(`/deployments/${encodeURIComponent(this.id)}`, {
        timeline: true,
      });
      if (this.#isGone) return;
      this.#fetchMs = performance.now() - begun;
      change(() => {
        this.#assignments.load(deployment);
        this.#deployment = deployment;
        this.#problem = null;
        this.#filteredAt = -Infinity;
      });
      if (this.#author === null) this.#fetchAuthor();
    } catch ({ status, message }) {
      this.#isStale ||= status !== 404;
      change(() => (this.#problem = message));
    }
    const events = this.#backlog;
    this.#backlog = null;
    change(() => events.forEach((event) => this.#applyEvent(event)));
    if (this.#isStale) this.#fetchSoon();
  }

  /** Schedules a fetch: one for all events until then. */
  #fetchSoon() {
    if (this.#timer || this.#isGone) return;
    const wait = Math.max(
      FILTER_PAUSE_MS,
      this.#fetchedAt +
        Math.max(REFETCH_PAUSE_MS, REFETCH_SHARE * this.#fetchMs) -
        performance.now(),
    );
    this.#timer = setTimeout(() => this.#fetch(), wait);
  }

  /** The author is in the audit log, which administrators may read. */
  async #fetchAuthor() {
    if (!this.app.can('administer')) return;
    const { records } = await get('/audit', {
      target: this.id,
      act: 'deployment.create',
      limit: 1,
    }).catch(() => ({ records: [] }));
    change(() => (this.#author = records[0]?.entry.who ?? ''));
  }

  onEvent(event) {
    this.#backlog?.set(event.robot?.id ?? event.deployment?.id ?? event.id, event);
    this.#applyEvent(event);
  }

  #applyEvent(event) {
    const deployment = this.#deployment;
    if (!deployment) return;
    if (event.type === 'robot' && this.#assignments.update(event.robot, this.id, this.app.now()))
      this.#fetchSoon();
    if (event.type === 'robot_removed') {
      this.#assignments.remove(event.id);
      this.#filteredAt = -Infinity;
    }
    if (event.type !== 'deployment' || event.deployment.id !== this.id) return;
    const { placing } = event.deployment;
    const { assignments } = deployment;
    this.#deployment = { ...deployment, ...event.deployment, placing, assignments };
    const isBehind = this.#assignments.isBehind(event.deployment.counts, performance.now());
    if (isBehind || placing || deployment.placing) this.#fetchSoon();
  }

  // Drawing

  draw(now) {
    if (!this.#deployment)
      return html`<p class="path"><a href=${hrefTo(['deployments'])}>Deployments</a></p>
        <h1>${this.id}</h1>
        <p class=${this.#problem ? 'bad' : 'quiet'}>${this.#problem ?? 'Loading…'}</p>`;
    const sum = this.#assignments.summary(performance.now());
    this.#filter();
    return html`
      ${this.#head(now, sum)}
      ${this.#figures(now, sum)}
      <div class="deployment-body">
        <div class="sidebar">
          ${failureGroups(sum.reasons, this.#query.reason, {
            show: (reason) => this.#setQuery({ reason, phase: '' }),
            retry: this.app.can('operate')
              ? (reason, assignments) => this.#openRetryDialog(assignments, reason)
              : null,
          })}
          ${deliveryGroups(sum.mechanisms, this.#deployment.delivery)}
        </div>
        <section class="assignments" aria-labelledby="robots">${this.#table(now, sum)}</section>
      </div>`;
  }

  #head(now, { retryable, newer }) {
    const deployment = this.#deployment;
    const {
      package: { name, version, manifest },
      selector,
      created_at_ms: created,
      expires_at_ms: expires,
      state,
      outdated,
      placing,
    } = deployment;
    const isUnsettled = this.#isUnsettled;
    return html`
      <p class="path"><a href=${hrefTo(['deployments'])}>Deployments</a>
        <span class="quiet">/ <span class="code">${this.id}</span></span></p>
      <header class="toolbar deployment-head">
        <h1><a href=${hrefTo(['packages', name], { version: manifest.digest })}
          >${name}<span class="quiet">@${version}</span></a></h1>
        <p class="state">${deploymentState(deployment)}</p>
        ${
          outdated
            ? html`<p class="bad">▲ outdated: ${version} is now a different package; this one is
                <span class="code">${shortDigest(manifest.digest)}</span></p>`
            : nothing
        }
        ${
          this.app.can('operate')
            ? html`<span class="actions">
          ${
            state === 'paused'
              ? html`<button class="primary"
                  @click=${() => this.#openResumeDialog()}>Resume…</button>`
              : nothing
          }
          ${
            retryable.size
              ? html`<button class="quiet-button"
                  @click=${() => this.#openRetryDialog([...this.#assignments.all.values()])}
                  >Retry ${plural(retryable.size, 'robot')}…</button>`
              : nothing
          }
          ${
            isUnsettled
              ? html`<button class="quiet-button danger-text"
                  @click=${() => this.#openCancelDialog()}>Cancel…</button>`
              : nothing
          }
        </span>`
            : nothing
        }
      </header>
      <p class="quiet deployment-meta">
        <span title=${selector ?? nothing}>To ${targetText(deployment, this.app.fleet)}</span>
        · ${optionsText(deployment)}${
          placing && state !== 'cancelled'
            ? html` · <strong>placed for ${number(placing.placed)} of
                ${number(placing.selected)} robots</strong>`
            : nothing
        }
        · created ${timeAgo(created, now)}${this.#author ? ` by ${this.#author}` : ''}${
          isUnsettled && expires > now
            ? html` · <span title=${moment(expires)}>expires in ${duration(expires - now)}</span>`
            : nothing
        }${this.#relations(newer)}
      </p>
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}`;
  }

  get #isUnsettled() {
    return ['active', 'paused'].includes(this.#deployment.state);
  }

  /** The deployments that this one supersedes and that supersede it. */
  #relations(newer) {
    const { supersedes } = this.#deployment;
    const links = (ids) =>
      [...ids].slice(0, 3).map(
        (id, index) =>
          html`${index ? ', ' : ''}<a href=${hrefTo(['deployments', id])}
              title=${id}>${this.#versionOf(id)}</a>`,
      );
    return html`${supersedes.length ? html` · supersedes ${links(supersedes)}` : nothing}${
      newer.size ? html` · superseded by ${links(newer)}` : nothing
    }`;
  }

  #versionOf(id) {
    const { name, version } = this.app.fleet.deployment(id)?.package ?? {};
    return name ? `${name}@${version}` : id;
  }

  /** The counters, which are also the filter, and the transfer. */
  #figures(now, { phases, done, total, awaitedBytes, busy, offline }) {
    const phasesShown = this.#deployment.kind === 'job' ? JOB_PHASES : SHOWN_PHASES;
    const shown = [
      ...phasesShown,
      ...ALL_PHASES.filter((phase) => !phasesShown.includes(phase) && phases.get(phase)),
    ];
    const all = this.#assignments.all.size;
    const rate = this.#assignments.throughput(now);
    const counts = ALL_PHASES.filter((phase) => phases.get(phase)).map((phase) => ({
      phase,
      count: phases.get(phase),
    }));
    return html`
      <div class="overall">${phaseBar(counts)}</div>
      <div class="counters phases" role="group" aria-label="Filter by phase">
        ${[
          { id: '', count: all, title: 'All' },
          ...shown.map((id) => ({ id, count: phases.get(id) ?? 0, title: capital(words(id)) })),
        ].map(
          ({ id, count, title }) => html`
          <button class="counter ${tone(id)}"
            aria-pressed=${this.#query.phase === id && !this.#query.reason}
            @click=${() => this.#togglePhase(id)}>
            <span class="figure">${number(count)}</span><span>${title}</span>
            <svg class="share" viewBox="0 0 100 1" preserveAspectRatio="none"
              aria-hidden="true"><rect class=${id ? tone(id) : 'done'}
              width=${id && all ? (100 * count) / all : 0} height="1"></rect></svg>
          </button>`,
        )}
      </div>
      <dl class="transfer">
        <div><dt>Transferred</dt><dd>${total ? bytes({ done, total }) : '–'}</dd></div>
        <div><dt>Throughput</dt><dd>${rate ? `${size(rate)}/s` : '–'}</dd></div>
        <div><dt>Time left</dt><dd>${timeLeft(
          this.#deployment.state,
          done,
          total,
          awaitedBytes,
          rate,
        )}</dd></div>
        <div class="robot-list"><dt>Waiting for</dt><dd>${
          this.#isUnsettled && busy.length ? firstNames(busy) : '–'
        }</dd></div>
        <div class="robot-list"><dt>Offline</dt><dd>${
          this.#isUnsettled && offline.length
            ? html`${firstNames(offline)}:
                ${offline.length === 1 ? 'continues' : 'continue'} when back online`
            : '–'
        }</dd></div>
      </dl>`;
  }

  /** Updates the filtered rows, unless that was done a moment ago. */
  #filter() {
    if (performance.now() - this.#filteredAt < FILTER_PAUSE_MS) return;
    this.#filteredAt = performance.now();
    const { phase, reason, q } = this.#query;
    const text = q.toLowerCase();
    this.#filtered = [...this.#assignments.all.values()]
      .filter(
        (assignment) =>
          (!phase || assignment.phase === phase) &&
          (!reason || reasonOf(assignment) === reason) &&
          (!text || assignment.name.toLowerCase().includes(text)),
      )
      .map(({ robot }) => robot);
  }

  #table(now) {
    const { all } = this.#assignments;
    const keys = this.#filtered;
    const height = isNarrow ? NARROW_ROW : ROW;
    const { start, end } = this.#list.visibleRange(
      keys,
      (robot) => height + (robot === this.#query.robot ? this.#detailHeight : 0),
      `${height} ${this.#query.robot} ${this.#detailHeight}`,
    );
    const isAll = keys.length === all.size;
    return html`
      <header>
        <h2 id="robots">Robots <span class="count">${
          isAll ? number(all.size) : `${number(keys.length)} of ${number(all.size)}`
        }</span></h2>
        <input type="search" placeholder="Search" aria-label="Search robots"
          aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${this.#query.q}
          @input=${({ currentTarget }) => this.#setQuery({ q: currentTarget.value })}>
      </header>
      <div class="table assignments-table" role="grid" aria-label="Robots of this deployment"
        aria-rowcount=${keys.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">${HEADS.map(
          (title) => html`<span role="columnheader">${title}</span>`,
        )}</div>
        <div class="rows" role="rowgroup"><div class="rendered" role="presentation">${repeat(
          keys.slice(start, end),
          (robot) => robot,
          (robot, index) => this.#row(all.get(robot), start + index, now),
        )}</div></div>
      </div>
      ${
        keys.length
          ? nothing
          : html`<p class="empty quiet">No robots match this filter.
              <button class="plain link"
                @click=${() => this.#setQuery({ phase: '', reason: '', q: '' })}
                >Clear filter</button></p>`
      }`;
  }

  #row(assignment, index, now) {
    const { robot, name, timeline } = assignment;
    const all = timelineSteps(timeline, this.#deployment.kind, now);
    const took = totalDuration(all);
    const isOpen = robot === this.#query.robot;
    const toggle = () => this.#setQuery({ robot: isOpen ? '' : robot });
    return html`
      <div class="row ${isOpen ? 'is-open' : ''}" role="row"
        tabindex=${this.#cursor.tabindex(robot, index)} aria-rowindex=${index + 2}
        data-key=${robot} data-assignment=${name}
        @focusin=${() => (this.#cursor.current = robot)}>
        <span class="cell name" role="gridcell"><a
          href=${hrefTo(['robots', name])}>${name}</a></span>
        <span class="cell state" role="gridcell">${robotState(assignment)}</span>
        <span class="cell phase-cell" role="gridcell">${phaseBadge(assignment.phase)}</span>
        <span class="cell note" role="gridcell">${note(assignment, this.#deployment)}</span>
        <span class="cell timeline" role="gridcell">${timelineBar(all)}</span>
        <span class="cell duration quiet" role="gridcell"><button class="plain"
          aria-expanded=${isOpen} @click=${toggle}><span
          class="visually-hidden">Phases of ${name}: </span>${took ? duration(took) : '–'} <span
          aria-hidden="true">${isOpen ? '▾' : '▸'}</span></button></span>
        ${
          isOpen
            ? html`<div class="detail" role="gridcell">${this.#detail(assignment, all)}</div>`
            : nothing
        }
      </div>`;
  }

  #detail({ failure, delivery, attempts, superseded_by: newer, name }, all) {
    const {
      package: { name: task },
    } = this.#deployment;
    return html`
      ${
        failure
          ? html`<p class="bad full-text">${words(failure.code)}: ${failure.text}</p>`
          : nothing
      }
      ${timelineList(all)}
      <p class="quiet">
        ${delivery ? deliveryText(delivery) : 'No data transferred yet'}${
          attempts > 1 ? ` · ${number(attempts)} attempts` : ''
        }${
          newer
            ? html` · superseded by
                <a href=${hrefTo(['deployments', newer])}>${this.#versionOf(newer)}</a>`
            : nothing
        }
        · <a href=${hrefTo(['robots', name, 'logs'], { task })}>Log</a>
      </p>`;
  }

  afterDraw() {
    this.#list.applyLayout();
    this.#cursor.afterDraw();
    // The height of an expanded row depends on its texts, so it is measured and the list is laid
    // out again.
    const height = document.querySelector('.assignments-table .detail')?.offsetHeight ?? 0;
    if (height === this.#detailHeight) return;
    change(() => (this.#detailHeight = height));
  }

  onKey(event) {
    const { phase, reason, q, robot } = this.#query;
    if (event.key === 'Escape' && (phase || reason || q || robot)) {
      this.#setQuery(robot ? { robot: '' } : { phase: '', reason: '', q: '' });
      return true;
    }
    return this.#cursor.onKey(event, this.#filtered);
  }

  // Actions

  #openRetryDialog(assignments, reason = null) {
    const { name, version } = this.#deployment.package;
    const ids = new Set(assignments.filter(canRetry).map(({ robot }) => robot));
    // A reason without a code is a phase, which the server cannot select by.
    const code = reason && assignments[0].failure?.code;
    // The ids are listed: robots that fail while the dialog is open are not included.
    const selector = selectorOf(ids);
    const key = newIdempotencyKey();
    openDialog({
      title: `Retry on ${plural(ids.size, 'robot')}`,
      submitLabel: 'Retry',
      body: () =>
        html`${robotNames(ids, this.app.fleet)}<p>Deploys ${name}@${version} again, with the same
          options, to robots where it
          ${code ? `failed with “${words(code)}”` : 'failed or was cancelled'}
          and that have no newer deployment.</p>`,
      onSubmit: async () => {
        const { id } = await postIdempotent(
          `/deployments/${this.id}/retry`,
          { code: code || undefined, selector },
          key,
        );
        navigate(['deployments', id]);
      },
    });
  }

  #openCancelDialog() {
    const { name, version } = this.#deployment.package;
    openDialog({
      title: `Cancel ${name}@${version}?`,
      submitLabel: 'Cancel deployment',
      cancelLabel: 'Keep deployment',
      isDangerous: true,
      body: () =>
        html`<p>Robots that are not done return to their previous version. Services that are already
          running keep running.</p>`,
      onSubmit: async () => {
        await post(`/deployments/${this.id}/cancel`);
        notify(`${name}@${version} cancelled.`);
        this.#fetch();
      },
    });
  }

  #openResumeDialog() {
    const { name, version } = this.#deployment.package;
    openDialog({
      title: `Resume ${name}@${version}?`,
      submitLabel: 'Resume',
      cancelLabel: 'Keep paused',
      body: () =>
        html`<p>The deployment paused because too many robots failed. Resuming resets the failure
          count and starts the next batch.</p>`,
      onSubmit: async () => {
        await post(`/deployments/${this.id}/resume`);
        notify(`${name}@${version} resumed.`);
        this.#fetch();
      },
    });
  }
}

/** The time left for robots that are online; it is unknown for the others. */
function timeLeft(state, done, total, awaitedBytes, rate) {
  if (state === 'paused') return 'paused: too many failures';
  if (state === 'cancelled') return '–';
  if (awaitedBytes) return rate ? `about ${duration((1000 * awaitedBytes) / rate)}` : 'unknown';
  return done < total ? 'remaining robots are offline or waiting' : '–';
}

/** The mechanism and the rule that chose it. */
const deliveryText = ({ mechanism, rule, because }) =>
  words(mechanism) + (rule === 'ordered' ? ', as ordered' : ` by rule “${rule}”: ${because}`);

/** Links to the first robots, and the number of the others. */
function firstNames(assignments) {
  const rest = assignments.length - AWAITED_NAMES;
  const links = assignments
    .slice(0, AWAITED_NAMES)
    .map(
      ({ name }, index) =>
        html`${index ? ', ' : ''}<a href=${hrefTo(['robots', name])}>${name}</a>`,
    );
  return html`${links}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/** Details of a robot's assignment: the progress, the failure, or the reason for waiting. */
function note(assignment, { package: { name } }) {
  const { failure, degraded, progress, phase, released } = assignment;
  if (failure && tone(phase) !== 'done')
    return html`<span class=${tone(phase) === 'bad' ? 'bad' : 'quiet'} title=${failure.text}
      >${words(failure.code)}<span class="quiet">: ${failure.text}</span></span>`;
  const bar = progressBar({ task: name, phase, progress });
  if (bar) return bar;
  if (degraded)
    return html`<span class="bad" title=${degraded.text}
      >▲ degraded: ${words(degraded.code)}</span>`;
  if (['assigned', 'deferred'].includes(phase) && !assignment.online)
    return html`<span class="quiet">starts when the robot is back online</span>`;
  if (!released && phase === 'assigned')
    return html`<span class="quiet">waiting for its batch</span>`;
  return nothing;
}
