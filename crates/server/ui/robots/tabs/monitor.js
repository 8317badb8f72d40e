// The Monitor tab: vitals of the last hour and live, tasks, and facts.

import { repeat } from '../../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { askRobot, get, SignedOut } from '../../api/api.js';
import { change } from '../../display/display.js';
import { ago, clock, duration, moment, number, plural, size, words } from '../../display/format.js';
import { hrefTo } from '../../display/router.js';
import { phaseBadge, progressBar, taskNotes, robotState, statusDot } from '../../display/status.js';
import { Charts } from './charts.js';

const HOUR_MS = 3_600_000;
const RANGES = [
  { id: '', title: 'Hour', ms: HOUR_MS },
  { id: '5min', title: '5 minutes', ms: 300_000 },
];
const POLL_MS = 2_000;
const RETRY_MS = 15_000;
const OFFLINE_RETRY_MS = 60_000;
// One hour, one sample every two seconds.
const MAX_SAMPLES = 1_900;

// The accounts that tasks run under, as reported by the robot.
const ACCOUNTS = {
  per_task: 'one per task',
  shared: 'shared by all tasks',
  agent: 'the agent’s own account',
};
const percent = (value) => `${Math.round(value)} %`;
/** No fraction from three digits on, so that the width is stable. */
const rate = (value) => `${size(value).replace(/^(\d{3,})\.\d/, '$1')}/s`;
const short = (text) => text.replace('.0 ', ' ');

/** The charts. `text` formats a value, `tick` formats it for an axis of a number or of bytes. */
const FIGURES = [
  {
    id: 'cpu',
    title: 'CPU',
    text: percent,
    tick: percent,
    most: () => 100,
    lines: [{ of: (vitals) => vitals.cpu_percent }],
  },
  usageFigure('memory', 'Memory', 'memory_used_bytes', 'memory_total_bytes'),
  usageFigure('disk', 'Disk', 'disk_used_bytes', 'disk_total_bytes'),
  {
    id: 'network',
    title: 'Network',
    text: rate,
    tick: (value) => short(rate(value)),
    isBytes: true,
    most: (_, highest) => Math.max(1_024, (highest ?? 0) * 1.1),
    lines: [
      { title: 'in', of: (vitals) => vitals.network_in_bytes_per_s },
      { title: 'out', of: (vitals) => vitals.network_out_bytes_per_s },
    ],
  },
  {
    id: 'battery',
    title: 'Battery',
    isOptional: true,
    text: percent,
    tick: percent,
    most: () => 100,
    lines: [{ of: (vitals) => vitals.battery_percent }],
  },
];

function usageFigure(id, title, used, total) {
  const most = (samples, highest) =>
    samples.findLast((vitals) => vitals[total])?.[total] ?? Math.max(1, highest ?? 1);
  return {
    id,
    title,
    text: size,
    tick: (value) => short(size(value)),
    isBytes: true,
    most,
    lines: [{ of: (vitals) => vitals[used] }],
    whole: (vitals) => vitals[total],
  };
}

export class Monitor {
  #page;
  #samples = [];
  #charts = null;
  #timer;
  /** Whether the charts need an update. */
  #isDue = false;
  #isFetched = false;
  /** Why there are no live vitals. */
  #problem = null;
  #mqtt = null;
  #isOnline = false;

  constructor(page) {
    this.#page = page;
  }

  enter() {
    this.#charts = new Charts(FIGURES);
    this.#isDue = true;
    this.refresh();
    this.#timer = setTimeout(() => this.#poll());
  }

  leave() {
    clearTimeout(this.#timer);
    this.#timer = null;
    this.#charts.leave();
    this.#charts = null;
  }

  onNavigate() {
    this.#isDue = true;
  }

  onEvent({ vitals, online }) {
    if (vitals) this.#addSamples([vitals]);
    if (online && !this.#isOnline) this.refresh();
    this.#isOnline = online;
  }

  async refresh() {
    const { id, online } = this.#page.robot;
    this.#isOnline = online;
    const [past, robot] = await Promise.all(
      [`/robots/${id}/vitals`, `/robots/${id}`].map((path) => get(path).catch(() => null)),
    );
    change(() => {
      this.#isFetched = true;
      this.#mqtt = robot?.mqtt ?? null;
      this.#addSamples(past?.samples ?? []);
    });
  }

  /** Polls the vitals while the tab is visible. */
  async #poll() {
    const timer = this.#timer;
    const { robot } = this.#page;
    // Robots in poll mode cannot be queried.
    const isLive = robot?.online && (this.#mqtt || robot.vitals) && !document.hidden;
    const pause = isLive ? await this.#fetchVitals(robot) : POLL_MS;
    if (this.#timer === timer && pause) this.#timer = setTimeout(() => this.#poll(), pause);
  }

  /** Returns the pause before the next poll; nothing if polling is pointless. */
  async #fetchVitals({ id }) {
    try {
      const vitals = await askRobot(id, { type: 'vitals' });
      change(() => {
        this.#problem = null;
        // The event stream carries the same sample.
        this.#addSamples([vitals]);
      });
      return POLL_MS;
    } catch (error) {
      if (error instanceof SignedOut) return null;
      const isUnsupported = error.status === 400 || error.code === 'unsupported';
      change(
        () =>
          (this.#problem = isUnsupported
            ? 'This robot does not report live vitals.'
            : this.#page.withRobotName(error.message)),
      );
      if (isUnsupported) return null;
      return error.code === 'robot_offline' ? OFFLINE_RETRY_MS : RETRY_MS;
    }
  }

  /** Adds samples from any source, without duplicates, oldest first. */
  #addSamples(samples) {
    const since = this.#page.app.now() - HOUR_MS;
    const all = new Map([...this.#samples, ...samples].map((sample) => [sample.at_ms, sample]));
    this.#samples = [...all.values()]
      .filter(({ at_ms: then }) => then >= since)
      .sort((one, other) => one.at_ms - other.at_ms)
      .slice(-MAX_SAMPLES);
    this.#isDue = true;
  }

  get #range() {
    return RANGES.find(({ id }) => id === this.#page.query.range) ?? RANGES[0];
  }

  draw(robot, now) {
    const { ms } = this.#range;
    const shown = this.#samples.filter(({ at_ms: then }) => then >= now - ms);
    const figures = FIGURES.filter(
      ({ isOptional, lines }) => !isOptional || this.#samples.some(lines[0].of),
    );
    if (this.#isDue) this.#charts.show(shown, now - ms, now);
    this.#isDue = false;
    return html`
      <section class="vitals" aria-labelledby="vitals">
        <header>
          <h2 id="vitals">Machine</h2>
          <p class="quiet state">${this.#state(robot, now)}</p>
          <p class="range" role="group" aria-label="Time range">${RANGES.map(
            ({ id, title }) =>
              html`<button class="plain" aria-pressed=${id === this.#range.id}
                @click=${() => this.#setRange(id)}>${title}</button>`,
          )}</p>
        </header>
        <div class="charts">${repeat(
          figures,
          ({ id }) => id,
          (figure) => this.#figure(figure, shown),
        )}</div>
      </section>
      <div class="two-columns">
        <section aria-labelledby="work"><header><h2 id="work">Tasks</h2></header>${
          robot.tasks.length
            ? robot.tasks.map((task) => this.#task(task))
            : html`<p class="quiet">No tasks.</p>`
        }</section>
        <section aria-labelledby="facts"><header><h2 id="facts">Facts</h2></header>
          <dl class="facts">${this.#facts(robot, now).map(
            ([term, fact]) => html`<dt>${term}</dt><dd>${fact}</dd>`,
          )}</dl></section>
      </div>`;
  }

  afterDraw() {
    this.#charts?.attach();
  }

  #setRange(id) {
    change(() => {
      this.#isDue = true;
      this.#page.setQuery({ range: id });
    });
  }

  /** The time of the shown values: under the pointer, live, or the last known. */
  #state({ online }, now) {
    const { pointed } = this.#charts;
    if (pointed) return `at ${clock(pointed.at_ms)}`;
    const last = this.#samples.at(-1);
    if (online && last && now - last.at_ms < 3 * POLL_MS) return statusDot(true, 'Live');
    if (!last) return this.#isFetched ? 'No vitals since the server started.' : '';
    const age = `as of ${ago(last.at_ms, now)}`;
    return online
      ? [age, this.#problem].filter(Boolean).join('. ')
      : `${age}; the robot is offline`;
  }

  #figure(figure, samples) {
    const { title, lines, text, whole } = figure;
    const sample = this.#charts.pointed ?? this.#samples.at(-1) ?? {};
    const total = whole?.(sample);
    return html`
      <figure>
        <figcaption>
          <h3>${title}</h3>
          ${lines.map(
            ({ title: line, of }, index) =>
              html`<p class="value">${line ? lineKey(line, index) : nothing}${
                of(sample) == null ? '–' : text(of(sample))
              }${total ? html`<span class="quiet"> of ${text(total)}</span>` : nothing}</p>`,
          )}
          <p class="quiet span">${rangeText(samples, lines, text)}</p>
        </figcaption>
        ${this.#charts.place(figure)}
      </figure>`;
  }

  #task(task) {
    const { delivery } = task;
    const notes = [
      `run ${task.run}`,
      task.active && `process ${task.active.pid}`,
      ...taskNotes(task),
    ].filter(Boolean);
    return html`
      <article class="current-task" data-task=${task.task}>
        <h3>${task.task}<span class="quiet">@${task.version}</span> ${phaseBadge(task.phase)}</h3>
        ${progressBar(task)}
        ${task.failure ? failureText(task.failure) : nothing}
        ${task.degraded ? failureText(task.degraded, 'degraded: ') : nothing}
        <p class="quiet">${notes.join(' · ')}${
          delivery
            ? html` · <span class="delivery">${delivery.mechanism}: ${delivery.because}</span>`
            : nothing
        }</p>
        <p><a href=${hrefTo(['deployments', task.deployment])}>Deployment</a>
          · <a href=${this.#page.hrefTo('logs', { task: task.task })}>Log</a></p>
      </article>`;
  }

  #facts(robot, now) {
    const { host, link, vitals } = robot;
    const code = (text) => html`<span class="code">${text}</span>`;
    const given = [
      ['State', robotState(robot)],
      [
        'Last seen',
        robot.last_seen_ms && `${moment(robot.last_seen_ms)} (${ago(robot.last_seen_ms, now)})`,
      ],
      ['ID', code(robot.id)],
      ['MAC', code(robot.mac)],
      ['Address', robot.address && code(robot.address)],
      [
        'Labels',
        Object.entries(robot.labels)
          .map(([label, value]) => `${label}=${value}`)
          .join(', '),
      ],
      ['Enrolled', moment(robot.enrolled_at_ms)],
      [
        'Generation',
        robot.generation === robot.observed_generation
          ? robot.generation
          : `${robot.generation} (on the robot: ${robot.observed_generation})`,
      ],
      ['Host', host && `${host.hostname}, ${host.arch}, agent ${host.agent_version}`],
      ['ROS', host && ros(host)],
      ['Isolation', host?.isolation && words(host.isolation)],
      ['Accounts', host?.accounts && (ACCOUNTS[host.accounts] ?? words(host.accounts))],
      ['Free disk', host?.disk_free_bytes && size(host.disk_free_bytes)],
      ['Load', vitals?.load_1m != null && `${vitals.load_1m.toFixed(2)} (1 min)`],
      ['Temperature', vitals?.temperature_c != null && `${Math.round(vitals.temperature_c)} °C`],
      ['Battery', host?.battery_percent != null && percent(host.battery_percent)],
      [
        'Publishers',
        host?.publishers != null &&
          (host.publishers
            ? `signatures required, list ${host.publishers}`
            : 'signatures required, own list'),
      ],
      ['Network', link && network(link)],
      ['MQTT', this.#mqtt && connectionText(this.#mqtt, now)],
    ];
    return given.filter(([, fact]) => fact || fact === 0);
  }
}

/** A failure with its code and its full text. */
export const failureText = ({ code, text }, before = '') => html`
  <p class="bad"><span aria-hidden="true">▲ </span>${before}${words(code)}</p>
  ${text ? html`<pre class="why" tabindex="0">${text}</pre>` : nothing}`;

/** The name of a line, beside a piece of it. */
const lineKey = (title, index) =>
  html`<svg class="key" viewBox="0 0 16 2" aria-hidden="true"><line
    class=${index ? 'second' : 'first'} x1="0" x2="16" y1="1" y2="1"></line></svg><span
    class="quiet">${title} </span>`;

/** The range of the values; of several lines the maximum of each. */
function rangeText(samples, lines, text) {
  const of = (line) => samples.map(line.of).filter((value) => value != null);
  if (lines.length > 1)
    return lines
      .filter((line) => of(line).length)
      .map((line, index) => `${index ? '' : 'up to '}${text(Math.max(...of(line)))} ${line.title}`)
      .join(', ');
  const values = of(lines[0]);
  if (!values.length) return '';
  const [least, most] = [Math.min(...values), Math.max(...values)].map(text);
  return least === most ? `constant ${least}` : `${least} to ${most}`;
}

function ros({ ros: used, ros_distros: found }) {
  if (!used) return found.join(', ') || 'none found';
  const domain =
    used.domain_id != null &&
    `domain ${used.domain_id}${used.localhost_only ? ', localhost only' : ''}`;
  return [used.distro, used.rmw, domain].filter(Boolean).join(', ');
}

const connectionText = ({ since_ms: then, traffic }, now) =>
  `connected for ${duration(now - then)}, ` +
  `${number(traffic.messages_in)} messages in, ${number(traffic.messages_out)} out`;

function network({ throughput_bytes_per_s: throughput, rtt_ms: rtt, reconnects, losses }) {
  return [
    throughput != null && `downloads at ${rate(throughput)}`,
    rtt != null && `RTT ${rtt} ms`,
    reconnects ? `${plural(reconnects, 'session')} lost in the last hour` : null,
    losses ? `${plural(losses, 'transfer')} interrupted in the last hour` : null,
  ]
    .filter(Boolean)
    .join(', ');
}
