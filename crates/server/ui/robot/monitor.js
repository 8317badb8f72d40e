// How a robot does: its machine over the last hour and from now on, what it works on, and what is
// known of it.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { askRobot, get, SignedOut } from '../api.js';
import { ago, clock, duration, moment, number, plural, size, words } from '../format.js';
import { change } from '../frame.js';
import { at } from '../router.js';
import { phaseSign, progressBar, remarks, robotState, sign } from '../signs.js';
import { Charts } from './charts.js';

const HOUR_MS = 3_600_000;
const RANGES = [
  { id: '', title: 'Hour', ms: HOUR_MS },
  { id: '5min', title: '5 minutes', ms: 300_000 },
];
const ASK_EVERY_MS = 2_000;
const ASK_AGAIN_MS = 15_000;
const ASK_LATER_MS = 60_000;
// An hour of them, one every two seconds.
const KEPT_SAMPLES = 1_900;

// Under which accounts tasks run, as the robot says.
const accounts = {
  per_task: 'one for each task',
  shared: 'one for all tasks',
  agent: 'none: tasks run as the agent',
};
const percent = (value) => `${Math.round(value)} %`;
/** Three digits, so that a text that changes every two seconds keeps its width. */
const rate = (value) => `${size(value).replace(/^(\d{3})\.\d/, '$1')}/s`;
const short = (text) => text.replace('.0 ', ' ');

/** What has a curve. `say` puts one value in words, `tick` as short as an axis wants it. */
const FIGURES = [
  {
    id: 'cpu',
    title: 'CPU',
    say: percent,
    tick: percent,
    most: () => 100,
    lines: [{ of: (vitals) => vitals.cpu_percent }],
  },
  ofWhole('memory', 'Memory', 'memory_used_bytes', 'memory_total_bytes'),
  ofWhole('disk', 'Disk', 'disk_used_bytes', 'disk_total_bytes'),
  {
    id: 'network',
    title: 'Network',
    say: rate,
    tick: (value) => short(rate(value)),
    most: (_, highest) => Math.max(1_000, (highest ?? 0) * 1.1),
    lines: [
      { title: 'in', of: (vitals) => vitals.network_in_bytes_per_s },
      { title: 'out', of: (vitals) => vitals.network_out_bytes_per_s },
    ],
  },
  {
    id: 'battery',
    title: 'Battery',
    isOptional: true,
    say: percent,
    tick: percent,
    most: () => 100,
    lines: [{ of: (vitals) => vitals.battery_percent }],
  },
];

function ofWhole(id, title, used, total) {
  const most = (samples, highest) =>
    samples.findLast((vitals) => vitals[total])?.[total] ?? Math.max(1, highest ?? 1);
  return {
    id,
    title,
    say: size,
    tick: (value) => short(size(value)),
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
  /** The figures have changed, or the time they are shown for. */
  #isDue = false;
  #isFetched = false;
  /** Why nothing comes every two seconds. */
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
    this.#timer = setTimeout(() => this.#ask());
  }

  leave() {
    clearTimeout(this.#timer);
    this.#timer = null;
    this.#charts.leave();
    this.#charts = null;
  }

  arrive() {
    this.#isDue = true;
  }

  hear({ vitals, online }) {
    if (vitals) this.#take([vitals]);
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
      this.#take(past?.samples ?? []);
    });
  }

  /** Asks the robot how it does now, and then again, as long as somebody looks. */
  async #ask() {
    const timer = this.#timer;
    const { robot } = this.#page;
    // One that only polls can't be asked.
    const isLive = robot?.online && (this.#mqtt || robot.vitals) && !document.hidden;
    const pause = isLive ? await this.#askOnce(robot) : ASK_EVERY_MS;
    if (this.#timer === timer && pause) this.#timer = setTimeout(() => this.#ask(), pause);
  }

  /** Answers how soon to ask again; nothing if that is of no use. */
  async #askOnce({ id }) {
    try {
      const vitals = await askRobot(id, { type: 'vitals' });
      change(() => {
        this.#problem = null;
        // Whoever looks at robots hears of the same sample.
        this.#take([vitals]);
      });
      return ASK_EVERY_MS;
    } catch (error) {
      if (error instanceof SignedOut) return null;
      const isUseless = error.status === 400 || error.code === 'unsupported';
      change(
        () =>
          (this.#problem = isUseless
            ? 'This robot does not say more often how it does.'
            : this.#page.inWords(error.message)),
      );
      if (isUseless) return null;
      return error.code === 'robot_offline' ? ASK_LATER_MS : ASK_AGAIN_MS;
    }
  }

  /** Takes samples in, whichever way they come, each once and the oldest first. */
  #take(samples) {
    const since = this.#page.app.now() - HOUR_MS;
    const all = new Map([...this.#samples, ...samples].map((sample) => [sample.at_ms, sample]));
    this.#samples = [...all.values()]
      .filter(({ at_ms: then }) => then >= since)
      .sort((one, other) => one.at_ms - other.at_ms)
      .slice(-KEPT_SAMPLES);
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
          <p class="range" role="group" aria-label="Show the last">${RANGES.map(({ id, title }) => html`<button class="plain" aria-pressed=${id === this.#range.id} @click=${() => this.#choose(id)}>${title}</button>`)}</p>
        </header>
        <div class="charts">${repeat(
          figures,
          ({ id }) => id,
          (figure) => this.#figure(figure, shown),
        )}</div>
      </section>
      <div class="two-columns">
        <section aria-labelledby="work"><header><h2 id="work">Tasks</h2></header>${robot.tasks.length ? robot.tasks.map((task) => this.#task(task)) : html`<p class="quiet">Nothing has been ordered of it.</p>`}</section>
        <section aria-labelledby="facts"><header><h2 id="facts">Facts</h2></header><dl class="facts">${this.#facts(robot, now).map(([term, fact]) => html`<dt>${term}</dt><dd>${fact}</dd>`)}</dl></section>
      </div>`;
  }

  drawn() {
    this.#charts?.settle();
  }

  #choose(id) {
    change(() => {
      this.#isDue = true;
      this.#page.say({ range: id });
    });
  }

  /**
   * What the figures are: those of a moment that is pointed at, live ones, or the last there were.
   */
  #state({ online }, now) {
    const { pointed } = this.#charts;
    if (pointed) return `at ${clock(pointed.at_ms)}`;
    const last = this.#samples.at(-1);
    if (online && last && now - last.at_ms < 3 * ASK_EVERY_MS) return sign(true, 'Live');
    if (!last)
      return this.#isFetched ? 'It has not said how it does since the server started.' : '';
    const age = `as of ${ago(last.at_ms, now)}`;
    return online ? [age, this.#problem].filter(Boolean).join('. ') : `${age}; it is offline`;
  }

  #figure(figure, samples) {
    const { title, lines, say, whole } = figure;
    const looked = this.#charts.pointed ?? this.#samples.at(-1) ?? {};
    const total = whole?.(looked);
    return html`
      <figure>
        <figcaption>
          <h3>${title}</h3>
          ${lines.map(({ title: line, of }, index) => html`<p class="value">${line ? html`<svg class="key" viewBox="0 0 16 2" aria-hidden="true"><line class=${index ? 'second' : 'first'} x1="0" x2="16" y1="1" y2="1"></line></svg><span class="quiet">${line} </span>` : nothing}${of(looked) == null ? '–' : say(of(looked))}${total ? html`<span class="quiet"> of ${say(total)}</span>` : nothing}</p>`)}
          <p class="quiet span">${span(samples, lines, say)}</p>
        </figcaption>
        ${this.#charts.place(figure)}
      </figure>`;
  }

  #task(task) {
    return html`
      <article class="task-now" data-task=${task.task}>
        <h3>${task.task}<span class="quiet">@${task.version}</span> ${phaseSign(task.phase)}</h3>
        ${progressBar(task)}
        ${task.failure ? why(task.failure) : nothing}
        ${task.degraded ? why(task.degraded, 'degraded: ') : nothing}
        <p class="quiet">${[`run ${task.run}`, task.active && `process ${task.active.pid}`, ...remarks(task)].filter(Boolean).join(' · ')}${task.delivery ? html` · <span class="delivery">${task.delivery.mechanism}: ${task.delivery.because}</span>` : nothing}</p>
        <p><a href=${at(['deployments', task.deployment])}>Deployment</a> · <a href=${this.#page.at('logs', { task: task.task })}>Log</a></p>
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
      ['IP and port', robot.address && code(robot.address)],
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
          : `${robot.generation}, the robot has ${robot.observed_generation}`,
      ],
      ['Host', host && `${host.hostname}, ${host.arch}, agent ${host.agent_version}`],
      ['ROS', host && ros(host)],
      ['Isolation', host?.isolation && words(host.isolation)],
      ['Accounts', host?.accounts && (accounts[host.accounts] ?? words(host.accounts))],
      ['Free disk', host?.disk_free_bytes && size(host.disk_free_bytes)],
      ['Load', vitals?.load_1m != null && `${vitals.load_1m.toFixed(2)} over a minute`],
      ['Temperature', vitals?.temperature_c != null && `${Math.round(vitals.temperature_c)} °C`],
      ['Battery', host?.battery_percent != null && percent(host.battery_percent)],
      [
        'Publishers',
        host?.publishers != null &&
          (host.publishers
            ? `asks for signatures, list ${host.publishers}`
            : 'asks for signatures, by its own list'),
      ],
      ['Network', link && network(link)],
      [
        'MQTT',
        this.#mqtt &&
          `connected for ${duration(now - this.#mqtt.since_ms)}, ${number(this.#mqtt.traffic.messages_in)} messages in, ${number(this.#mqtt.traffic.messages_out)} out`,
      ],
    ];
    return given.filter(([, fact]) => fact || fact === 0);
  }
}

/** A failure in full: what it is called, and what the robot said. */
export const why = ({ code, text }, before = '') => html`
  <p class="bad"><span aria-hidden="true">▲ </span>${before}${words(code)}</p>
  ${text ? html`<pre class="why" tabindex="0">${text}</pre>` : nothing}`;

/** Between what the values were; of several lines the most of each. */
function span(samples, lines, say) {
  const of = (line) => samples.map(line.of).filter((value) => value != null);
  if (lines.length > 1)
    return lines
      .filter((line) => of(line).length)
      .map((line, index) => `${index ? '' : 'up to '}${say(Math.max(...of(line)))} ${line.title}`)
      .join(', ');
  const values = of(lines[0]);
  if (!values.length) return '';
  const [least, most] = [Math.min(...values), Math.max(...values)].map(say);
  return least === most ? `${least} throughout` : `${least} to ${most}`;
}

function ros({ ros: used, ros_distros: found }) {
  if (!used) return found.join(', ') || 'none found';
  const domain =
    used.domain_id != null &&
    `domain ${used.domain_id}${used.localhost_only ? ' on this host only' : ''}`;
  return [used.distro, used.rmw, domain].filter(Boolean).join(', ');
}

function network({ throughput_bytes_per_s: throughput, rtt_ms: rtt, reconnects, losses }) {
  return [
    throughput != null && `fetches at ${rate(throughput)}`,
    rtt != null && `${rtt} ms to the server`,
    reconnects ? `${plural(reconnects, 'session')} lost in the last hour` : null,
    losses ? `${plural(losses, 'transfer')} broken off in the last hour` : null,
  ]
    .filter(Boolean)
    .join(', ');
}
