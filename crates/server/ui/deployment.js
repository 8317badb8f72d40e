// One deployment: how far it has come as a whole, why some robots failed, and each robot with the
// phases it went through.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import { names } from './acts.js';
import { get, newKey, order, post } from './api.js';
import { Cursor } from './cursor.js';
import { wordsOf } from './deployments.js';
import { deliveries, failures } from './deployments/aside.js';
import { Parts, canRetry, reasonOf } from './deployments/parts.js';
import { list, steps, strip, tookInAll } from './timeline.js';
import { open } from './dialog.js';
import { idsOf } from './fleet.js';
import { bytes, duration, moment, number, plural, short, size, tone, words } from './format.js';
import { change } from './frame.js';
import { tell } from './notice.js';
import { optionsOf } from './push.js';
import { at, go, restate } from './router.js';
import { Rows, isNarrow } from './rows.js';
import { countBar, deploymentState, phaseSign, progressBar, robotState, since } from './signs.js';

// As in deployments.css.
const ROW = 41;
const NARROW_ROW = 65;
// While data streams, rows come and go at most this often.
const ORDER_PAUSE_MS = 1_000;
// The whole is fetched anew at most this often, and more seldom where that takes long: ten thousand
// robots are some megabytes.
const REFETCH_PAUSE_MS = 5_000;
const REFETCH_SHARE = 10;
// Robots that are named where it is said which are waited for.
const AWAITED_NAMES = 5;

/** Phases that always have a place, so that nothing moves when the first robot gets there. */
const PLACES = ['assigned', 'fetching', 'unpacking', 'building', 'starting', 'running', 'failed'];
const JOB_PLACES = [...PLACES.slice(0, -1), 'succeeded', 'failed'];
const LIFE = [
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
  #rows = new Rows();
  #cursor = new Cursor(this.#rows, (robot) =>
    this.#look({ robot: this.#place.robot === robot ? '' : robot }),
  );
  #parts = new Parts();
  #deployment = null;
  #problem = null;
  #orderedBy = null;
  /** Of the address: which robots are shown, and whose phases. */
  #place = { phase: '', reason: '', q: '', robot: '' };
  #shown = [];
  #shownAt = -Infinity;
  #detailHeight = 0;
  #fetchedAt = -Infinity;
  #fetchMs = 0;
  /**
   * The last heard of each robot, and of the deployment, while a list is on its way: newer than the
   * list, or followed by something newer.
   */
  #heard = null;
  /** It has to be fetched once more. */
  #isStale = false;
  #timer = null;
  #isGone = false;

  constructor(app) {
    this.app = app;
  }

  arrive({ path: [, id], query }) {
    const isFirst = !this.id;
    this.id = id;
    this.#place = {
      phase: query.phase ?? '',
      reason: query.reason ?? '',
      q: query.q ?? '',
      robot: query.robot ?? '',
    };
    this.#rows.rearrange();
    this.#shownAt = -Infinity;
    if (isFirst) this.#fetch();
  }

  leave() {
    this.#isGone = true;
    clearTimeout(this.#timer);
  }

  refresh() {
    this.#fetch();
  }

  #look(place) {
    change(() => {
      this.#place = { ...this.#place, ...place };
      this.#rows.rearrange();
      this.#shownAt = -Infinity;
      restate(this.#place);
    });
  }

  // Fetching and hearing.

  async #fetch() {
    clearTimeout(this.#timer);
    this.#timer = null;
    this.#isStale = this.#heard !== null;
    if (this.#isStale) return;
    this.#heard = new Map();
    const begun = performance.now();
    this.#fetchedAt = begun;
    try {
      const deployment = await get(`/deployments/${encodeURIComponent(this.id)}`, {
        timeline: true,
      });
      if (this.#isGone) return;
      this.#fetchMs = performance.now() - begun;
      change(() => {
        this.#parts.renew(deployment);
        this.#deployment = deployment;
        this.#problem = null;
        this.#shownAt = -Infinity;
      });
      if (this.#orderedBy === null) this.#askWho();
    } catch ({ status, message }) {
      this.#isStale ||= status !== 404;
      change(() => (this.#problem = message));
    }
    const heard = this.#heard;
    this.#heard = null;
    change(() => heard.forEach((event) => this.#take(event)));
    if (this.#isStale) this.#fetchSoon();
  }

  /** Fetches once more, some time soon: one fetch for all that is heard meanwhile. */
  #fetchSoon() {
    if (this.#timer || this.#isGone) return;
    const wait = Math.max(
      ORDER_PAUSE_MS,
      this.#fetchedAt +
        Math.max(REFETCH_PAUSE_MS, REFETCH_SHARE * this.#fetchMs) -
        performance.now(),
    );
    this.#timer = setTimeout(() => this.#fetch(), wait);
  }

  /** Who ordered it is written in the audit, which administrators may read. */
  async #askWho() {
    if (!this.app.can('administer')) return;
    const { records } = await get('/audit', {
      target: this.id,
      act: 'deployment.create',
      limit: 1,
    }).catch(() => ({ records: [] }));
    change(() => (this.#orderedBy = records[0]?.entry.who ?? ''));
  }

  hear(event) {
    this.#heard?.set(event.robot?.id ?? event.deployment?.id ?? event.id, event);
    this.#take(event);
  }

  #take(event) {
    const deployment = this.#deployment;
    if (!deployment) return;
    if (event.type === 'robot' && this.#parts.hear(event.robot, this.id, this.app.now()))
      this.#fetchSoon();
    if (event.type === 'robot_removed') {
      this.#parts.remove(event.id);
      this.#shownAt = -Infinity;
    }
    if (event.type !== 'deployment' || event.deployment.id !== this.id) return;
    this.#deployment = { ...deployment, ...event.deployment, assignments: deployment.assignments };
    if (this.#parts.isBehind(event.deployment.counts, performance.now())) this.#fetchSoon();
  }

  // Drawing.

  draw(now) {
    if (!this.#deployment)
      return html`<p class="path"><a href=${at(['deployments'])}>Deployments</a></p><h1>${this.id}</h1><p class=${this.#problem ? 'bad' : 'quiet'}>${this.#problem ?? 'Fetching…'}</p>`;
    const sum = this.#parts.summary(performance.now());
    this.#choose();
    return html`
      ${this.#head(now, sum)}
      ${this.#figures(now, sum)}
      <div class="deployment-body">
        <div class="aside">
          ${failures(sum.reasons, this.#place.reason, { show: (reason) => this.#look({ reason, phase: '' }), retry: this.app.can('operate') ? (reason, parts) => this.#askRetry(parts, reason) : null })}
          ${deliveries(sum.ways, this.#deployment.delivery)}
        </div>
        <section class="receivers" aria-labelledby="parts">${this.#table(now, sum)}</section>
      </div>`;
  }

  #head(now, { retried, newer }) {
    const deployment = this.#deployment;
    const {
      package: { name, version, manifest },
      selector,
      created_at_ms: created,
      expires_at_ms: expires,
      state,
      outdated,
    } = deployment;
    const isUnsettled = this.#isUnsettled;
    return html`
      <p class="path"><a href=${at(['deployments'])}>Deployments</a> <span class="quiet">/ <span class="code">${this.id}</span></span></p>
      <header class="bar-of-tools deployment-head">
        <h1><a href=${at(['packages', name], { version: manifest.digest })}>${name}<span class="quiet">@${version}</span></a></h1>
        <p class="state">${deploymentState(deployment)}</p>
        ${outdated ? html`<p class="bad">▲ outdated: ${version} is another package now, this is <span class="code">${short(manifest.digest)}</span></p>` : nothing}
        ${
          this.app.can('operate')
            ? html`<span class="acts">
          ${state === 'paused' ? html`<button class="primary" @click=${() => this.#askResume()}>Resume…</button>` : nothing}
          ${retried.size ? html`<button class="quiet-button" @click=${() => this.#askRetry([...this.#parts.all.values()])}>Retry ${plural(retried.size, 'robot')}…</button>` : nothing}
          ${isUnsettled ? html`<button class="quiet-button danger-text" @click=${() => this.#askCancel()}>Cancel…</button>` : nothing}
        </span>`
            : nothing
        }
      </header>
      <p class="quiet ordered">
        <span title=${selector ?? nothing}>To ${wordsOf(deployment, this.app.fleet)}</span> · ${optionsOf(deployment)}
        · ordered ${since(created, now)}${this.#orderedBy ? ` by ${this.#orderedBy}` : ''}${isUnsettled && expires > now ? html` · <span title=${moment(expires)}>expires in ${duration(expires - now)}</span>` : nothing}${this.#relations(newer)}
      </p>
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}`;
  }

  get #isUnsettled() {
    return ['active', 'paused'].includes(this.#deployment.state);
  }

  /** The deployments before and after it. */
  #relations(newer) {
    const { supersedes } = this.#deployment;
    const links = (ids) =>
      [...ids]
        .slice(0, 3)
        .map(
          (id, index) =>
            html`${index ? ', ' : ''}<a href=${at(['deployments', id])} title=${id}>${this.#versionOf(id)}</a>`,
        );
    return html`${supersedes.length ? html` · supersedes ${links(supersedes)}` : nothing}${newer.size ? html` · superseded by ${links(newer)}` : nothing}`;
  }

  #versionOf(id) {
    const { name, version } = this.app.fleet.deployment(id)?.package ?? {};
    return name ? `${name}@${version}` : id;
  }

  /** The counters, which are the filter as well, and how the bytes come along. */
  #figures(now, { phases, done, total, awaited, busy, offline }) {
    const places = this.#deployment.kind === 'job' ? JOB_PLACES : PLACES;
    const shown = [
      ...places,
      ...LIFE.filter((phase) => !places.includes(phase) && phases.get(phase)),
    ];
    const all = this.#parts.all.size;
    const rate = this.#parts.throughput(now);
    const counts = LIFE.filter((phase) => phases.get(phase)).map((phase) => ({
      phase,
      count: phases.get(phase),
    }));
    return html`
      <div class="whole">${countBar(counts)}</div>
      <div class="strip phases" role="group" aria-label="Show robots that are">
        ${[
          { id: '', count: all, title: 'All' },
          ...shown.map((id) => ({ id, count: phases.get(id) ?? 0, title: capital(words(id)) })),
        ].map(
          ({ id, count, title }) => html`
          <button class="counter ${tone(id)}" aria-pressed=${this.#place.phase === id && !this.#place.reason} @click=${() => this.#look({ phase: this.#place.phase === id ? '' : id, reason: '' })}>
            <span class="figure">${number(count)}</span><span>${title}</span>
            <svg class="share" viewBox="0 0 100 1" preserveAspectRatio="none" aria-hidden="true"><rect class=${id ? tone(id) : 'done'} width=${id && all ? (100 * count) / all : 0} height="1"></rect></svg>
          </button>`,
        )}
      </div>
      <dl class="travel">
        <div><dt>Transferred</dt><dd>${total ? bytes({ done, total }) : '–'}</dd></div>
        <div><dt>Throughput</dt><dd>${rate ? `${size(rate)}/s` : '–'}</dd></div>
        <div><dt>Time left</dt><dd>${timeLeft(this.#deployment.state, done, total, awaited, rate)}</dd></div>
        <div class="awaited"><dt>Waits for</dt><dd>${this.#isUnsettled && busy.length ? someNames(busy) : '–'}</dd></div>
        <div class="awaited"><dt>Offline</dt><dd>${this.#isUnsettled && offline.length ? html`${someNames(offline)}: ${offline.length === 1 ? 'goes' : 'go'} on when back` : '–'}</dd></div>
      </dl>`;
  }

  /** Chooses the robots to show, unless that was done a moment ago. */
  #choose() {
    if (performance.now() - this.#shownAt < ORDER_PAUSE_MS) return;
    this.#shownAt = performance.now();
    const { phase, reason, q } = this.#place;
    const text = q.toLowerCase();
    this.#shown = [...this.#parts.all.values()]
      .filter(
        (part) =>
          (!phase || part.phase === phase) &&
          (!reason || reasonOf(part) === reason) &&
          (!text || part.name.toLowerCase().includes(text)),
      )
      .map(({ robot }) => robot);
  }

  #table(now) {
    const { all } = this.#parts;
    const keys = this.#shown;
    const height = isNarrow ? NARROW_ROW : ROW;
    const { start, end } = this.#rows.sight(
      keys,
      (robot) => height + (robot === this.#place.robot ? this.#detailHeight : 0),
      `${height} ${this.#place.robot} ${this.#detailHeight}`,
    );
    const isAll = keys.length === all.size;
    return html`
      <header>
        <h2 id="parts">Robots <span class="count">${isAll ? number(all.size) : `${number(keys.length)} of ${number(all.size)}`}</span></h2>
        <input type="search" placeholder="Search" aria-label="Search its robots" aria-keyshortcuts="/" autocomplete="off" spellcheck="false" .value=${this.#place.q} @input=${({ currentTarget }) => this.#look({ q: currentTarget.value })}>
      </header>
      <div class="table parts-table" role="grid" aria-label="Robots of this deployment" aria-rowcount=${keys.length + 1}>
        <div class="row head" role="row" aria-rowindex="1">${['Robot', 'State', 'Phase', '', 'Phases', 'Took'].map((title, index) => html`<span role="columnheader">${title || html`<span class="unseen">${index === 3 ? 'What is known' : ''}</span>`}</span>`)}</div>
        <div class="rows" role="rowgroup"><div class="sight" role="presentation">${repeat(
          keys.slice(start, end),
          (robot) => robot,
          (robot, index) => this.#row(all.get(robot), start + index, now),
        )}</div></div>
      </div>
      ${keys.length ? nothing : html`<p class="empty quiet">No robot is like that. <button class="plain link" @click=${() => this.#look({ phase: '', reason: '', q: '' })}>Show all</button></p>`}`;
  }

  #row(part, index, now) {
    const { robot, name, timeline } = part;
    const all = steps(timeline, this.#deployment.kind, now);
    const took = tookInAll(all);
    const isOpen = robot === this.#place.robot;
    const toggle = () => this.#look({ robot: isOpen ? '' : robot });
    return html`
      <div class="row ${isOpen ? 'is-open' : ''}" role="row" tabindex=${this.#cursor.tabindex(robot, index)} aria-rowindex=${index + 2} data-key=${robot} data-part=${name} @focusin=${() => (this.#cursor.current = robot)}>
        <span class="cell name" role="gridcell"><a href=${at(['robots', name])}>${name}</a></span>
        <span class="cell state" role="gridcell">${robotState(part)}</span>
        <span class="cell phase-cell" role="gridcell">${phaseSign(part.phase)}</span>
        <span class="cell note" role="gridcell">${note(part, this.#deployment)}</span>
        <span class="cell times" role="gridcell">${strip(all)}</span>
        <span class="cell took quiet" role="gridcell"><button class="plain" aria-expanded=${isOpen} @click=${toggle}><span class="unseen">Phases of ${name}: </span>${took ? duration(took) : '–'} <span aria-hidden="true">${isOpen ? '▾' : '▸'}</span></button></span>
        ${isOpen ? html`<div class="detail" role="gridcell">${this.#detail(part, all)}</div>` : nothing}
      </div>`;
  }

  #detail({ failure, delivery, attempts, superseded_by: newer, name }, all) {
    const {
      package: { name: task },
    } = this.#deployment;
    return html`
      ${failure ? html`<p class="bad whole-text">${words(failure.code)}: ${failure.text}</p>` : nothing}
      ${list(all)}
      <p class="quiet">
        ${delivery ? html`${words(delivery.mechanism)}${delivery.rule === 'ordered' ? ', as it was ordered' : ` by rule “${delivery.rule}”: ${delivery.because}`}` : 'Nothing has travelled yet'}${attempts > 1 ? ` · ${number(attempts)} tries` : ''}${newer ? html` · superseded by <a href=${at(['deployments', newer])}>${this.#versionOf(newer)}</a>` : nothing}
        · <a href=${at(['robots', name, 'logs'], { task })}>Its log</a>
      </p>`;
  }

  drawn() {
    this.#rows.place();
    this.#cursor.drawn();
    // How high an open row is depends on its texts: it is looked up, and the rows below make room.
    const height = document.querySelector('.parts-table .detail')?.offsetHeight ?? 0;
    if (height === this.#detailHeight) return;
    change(() => (this.#detailHeight = height));
  }

  key(event) {
    const { phase, reason, q, robot } = this.#place;
    if (event.key === 'Escape' && (phase || reason || q || robot)) {
      this.#look(robot ? { robot: '' } : { phase: '', reason: '', q: '' });
      return true;
    }
    return this.#cursor.key(event, this.#shown);
  }

  // Acting.

  #askRetry(parts, reason = null) {
    const { name, version } = this.#deployment.package;
    const ids = new Set(parts.filter(canRetry).map(({ robot }) => robot));
    // A reason without a code is how they ended, which the server does not choose by.
    const code = reason && parts[0].failure?.code;
    // Named one by one: whoever fails while the question is open was not in it.
    const selector = idsOf(ids);
    const key = newKey();
    open({
      title: `Retry on ${plural(ids.size, 'robot')}`,
      action: 'Retry',
      body: () =>
        html`${names(ids, this.app.fleet)}<p>${name}@${version} is ordered once more in the same way, for those that ended badly${code ? html` with “${words(code)}”` : nothing} and have had no newer order since.</p>`,
      act: async () => {
        const { id } = await order(
          `/deployments/${this.id}/retry`,
          { code: code || undefined, selector },
          key,
        );
        go(['deployments', id]);
      },
    });
  }

  #askCancel() {
    const { name, version } = this.#deployment.package;
    open({
      title: `Cancel ${name}@${version}?`,
      action: 'Cancel the deployment',
      dismissal: 'Let it go on',
      isDangerous: true,
      body: () =>
        html`<p>Robots that are not done yet go back to what they had before. A service that runs already goes on.</p>`,
      act: async () => {
        await post(`/deployments/${this.id}/cancel`);
        tell(`${name}@${version} is cancelled.`);
        this.#fetch();
      },
    });
  }

  #askResume() {
    const { name, version } = this.#deployment.package;
    open({
      title: `Resume ${name}@${version}?`,
      action: 'Resume',
      dismissal: 'Leave it paused',
      body: () =>
        html`<p>More robots failed than it was told to bear. The failures so far are forgiven, and the next batch begins.</p>`,
      act: async () => {
        await post(`/deployments/${this.id}/resume`);
        tell(`${name}@${version} goes on.`);
        this.#fetch();
      },
    });
  }
}

/** Only of robots that are there: of the others nobody knows. */
function timeLeft(state, done, total, awaited, rate) {
  if (state === 'paused') return 'paused: too many failed';
  if (state === 'cancelled') return '–';
  if (awaited) return rate ? `about ${duration((1000 * awaited) / rate)}` : 'not known yet';
  return done < total ? 'the rest is offline or waits' : '–';
}

/** The names of the first robots, each a link, and how many more there are. */
function someNames(parts) {
  const rest = parts.length - AWAITED_NAMES;
  return html`${parts.slice(0, AWAITED_NAMES).map(({ name }, index) => html`${index ? ', ' : ''}<a href=${at(['robots', name])}>${name}</a>`)}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/** What else is known of a robot's part: how far, why not, or what it waits for. */
function note(part, { package: { name } }) {
  const { failure, degraded, progress, phase, released } = part;
  if (failure && tone(phase) !== 'done')
    return html`<span class=${tone(phase) === 'bad' ? 'bad' : 'quiet'} title=${failure.text}>${words(failure.code)}<span class="quiet">: ${failure.text}</span></span>`;
  const bar = progressBar({ task: name, phase, progress });
  if (bar) return bar;
  if (degraded)
    return html`<span class="bad" title=${degraded.text}>▲ degraded: ${words(degraded.code)}</span>`;
  if (['assigned', 'deferred'].includes(phase) && !part.online)
    return html`<span class="quiet">begins when the robot is back</span>`;
  if (!released && phase === 'assigned')
    return html`<span class="quiet">waits for its batch</span>`;
  return nothing;
}
