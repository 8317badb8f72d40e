// Owns the views of the server: its status, and its settings, tokens and users; it never changes the
// server's configuration.
//
// This module is the status: sites, MQTT sessions and recent events.

import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing, svg } from '../vendor/lit-html-3.3.3/lit-html.js';
import { get } from '../api/api.js';
import { change } from '../display/display.js';
import { duration, number, plural, size, words } from '../display/format.js';
import { hrefTo } from '../display/router.js';
import { statusDot, timeAgo } from '../display/status.js';

const POLL_PAUSE_MS = 2_000;
/** Samples of the sparklines: five minutes. */
const MAX_STATUSES = 150;
const SESSIONS_PER_PAGE = 100;
const MAX_ENTRIES = 200;

export class ServerView {
  #isGone = false;
  /** Newest last, each with the rates since the previous one. */
  #statuses = [];
  #sessions = [];
  #more = null;
  #total = 0;
  #entries = [];
  #problem = null;

  constructor(app) {
    this.app = app;
    this.#poll();
    this.refresh();
  }

  onNavigate() {}

  leave() {
    this.#isGone = true;
  }

  refresh() {
    this.#fetchSessions();
    this.#fetchFeed();
  }

  onEvent({ type, entry }) {
    if (type === 'feed') this.#addEntries([entry]);
  }

  /** Polls the status while the view is shown. */
  async #poll() {
    while (!this.#isGone) {
      if (!document.hidden) await this.#fetchStatus();
      await new Promise((resume) => setTimeout(resume, POLL_PAUSE_MS));
    }
  }

  async #fetchStatus() {
    try {
      const status = await get('/server/status');
      change(() => {
        this.#problem = null;
        this.#statuses = [
          ...this.#statuses.slice(1 - MAX_STATUSES),
          withRates(status, this.#statuses.at(-1)),
        ];
      });
    } catch (error) {
      change(() => (this.#problem = error.message));
    }
  }

  async #fetchSessions(after) {
    const page = await this.app.attempt(() =>
      get('/server/sessions', { limit: SESSIONS_PER_PAGE, after }),
    );
    if (!page) return;
    change(() => {
      this.#sessions = after ? [...this.#sessions, ...page.sessions] : page.sessions;
      this.#more = page.next ?? null;
      this.#total = page.total;
    });
  }

  async #fetchFeed() {
    const page = await this.app.attempt(() => get('/feed', { limit: MAX_ENTRIES }));
    if (page) change(() => this.#addEntries(page.entries));
  }

  /** Adds entries from any source, without duplicates, newest first. */
  #addEntries(entries) {
    const known = new Set(this.#entries.map(({ number: one }) => one));
    const newEntries = entries.filter(({ number: one }) => !known.has(one));
    this.#entries = [...newEntries, ...this.#entries]
      .sort((one, other) => other.number - one.number)
      .slice(0, MAX_ENTRIES);
  }

  draw(now) {
    const status = this.#statuses.at(-1);
    return html`
      <header class="toolbar"><h1>Server and network</h1>${
        status ? html`<p class="quiet">${summary(status)}</p>` : nothing
      }</header>
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}
      ${
        status
          ? html`<div class="figures">${figures(status).map((one) => this.#figure(one))}</div>`
          : html`<div class="figures waiting"></div>`
      }
      <div class="server-body">
        <div>
          ${status?.nodes ? servers(status) : nothing}
          ${status ? sites(status) : nothing}
          ${this.#sessionTable(now)}
        </div>
        ${this.#feed(now)}
      </div>`;
  }

  #figure({ title, value, note, of, isBad }) {
    return html`
      <section class="figure">
        <h2>${title}</h2>
        <p class="value ${isBad ? 'bad' : ''}">${
          isBad ? html`<span aria-hidden="true">▲ </span>` : nothing
        }${value}</p>
        <p class="quiet">${note}</p>
        ${of ? sparkline(this.#statuses.map(of)) : nothing}
      </section>`;
  }

  #sessionTable(now) {
    const row = ({ robot, name, since_ms: then, address, subscriptions, traffic }) => html`
      <tr data-session=${robot}>
        <td><a href=${hrefTo(['robots', name])}>${name}</a><br>
          <span class="code quiet">${address ?? '–'}</span></td>
        <td class="code">${subscriptions.map(
          ({ topic_filter: filter, qos }) =>
            html`<div>${filter} <span class="quiet">QoS ${qos}</span></div>`,
        )}</td>
        <td class="number">${number(traffic.messages_in)} in<br>
          ${number(traffic.messages_out)} out</td>
        <td class="number">${size(traffic.bytes_in)} in<br>${size(traffic.bytes_out)} out</td>
        <td>${timeAgo(then, now)}</td>
      </tr>`;
    return html`
      <section aria-labelledby="sessions">
        <header><h2 id="sessions">Subscriptions
            <span class="count">${plural(this.#total, 'session')}</span></h2>
          <button class="plain link" @click=${() => this.#fetchSessions()}>Refresh</button></header>
        ${
          this.#sessions.length
            ? html`<div class="scroll" tabindex="0" role="group" aria-labelledby="sessions"><table>
              <thead><tr><th>Robot</th><th>Topic filters</th><th class="number">Messages</th>
                <th class="number">Bytes</th><th>Connected</th></tr></thead>
              <tbody>${repeat(this.#sessions, ({ robot }) => robot, row)}</tbody>
            </table></div>
            ${
              this.#more
                ? html`<p><button class="quiet-button"
                    @click=${() => this.#fetchSessions(this.#more)}>Show more</button></p>`
                : nothing
            }`
            : html`<p class="quiet">No robots are connected over MQTT.</p>`
        }
      </section>`;
  }

  #feed(now) {
    return html`
      <section class="feed" aria-labelledby="feed">
        <header><h2 id="feed">Events</h2></header>
        ${
          this.#entries.length
            ? html`<ol>${repeat(
                this.#entries,
                ({ number: one }) => one,
                (entry) => feedLine(entry, now),
              )}</ol>`
            : html`<p class="quiet">No events since the server started.</p>`
        }
      </section>`;
  }
}

const LEVELS = { warn: '▲ ', error: '✕ ', fatal: '✕ ' };

const feedLine = ({ at_ms: then, level, kind, text, robot_name: robot, deployment }, now) => html`
  <li class="entry ${LEVELS[level] ? 'bad' : ''}">
    <span class="kind"><span aria-hidden="true">${LEVELS[level] ?? ''}</span>${words(kind)}</span>
    ${robot ? html`<a href=${hrefTo(['robots', robot])}>${robot}</a>` : nothing}
    ${
      deployment
        ? html`<a class="code" href=${hrefTo(['deployments', deployment])}>${deployment}</a>`
        : nothing
    }
    <span class="time">${timeAgo(then, now)}</span>
    <span class="text">${text}</span>
  </li>`;

/** A status with the rates since the previous one. */
function withRates(status, before) {
  const seconds = before ? (status.now_ms - before.now_ms) / 1000 : 0;
  const rate = (of) => (seconds > 0 ? Math.max(0, of(status) - of(before)) / seconds : null);
  const rates = {
    messages: rate(({ mqtt }) => mqtt.all.messages_in + mqtt.all.messages_out),
    requests: rate(({ http }) => http.requests),
    out: rate(({ http, mqtt }) => http.bytes_out + mqtt.all.bytes_out),
    in: rate(({ http, mqtt }) => http.bytes_in + mqtt.all.bytes_in),
  };
  return { ...status, rates };
}

const summary = ({ version, uptime_s: uptime, listeners }) =>
  [
    `taskd ${version}`,
    `up ${duration(uptime * 1000)}`,
    ...listeners.map(
      ({ kind, address, tls }) => `${kind.toUpperCase()} ${tls ? 'over TLS ' : ''}on ${address}`,
    ),
  ].join(' · ');

/** The figures with their sparklines. */
function figures({ robots, rates, transfers, reports, database, disk, broker, mqtt }) {
  const each = (value, unit) =>
    value === null ? '–' : `${value < 10 ? value.toFixed(1) : number(Math.round(value))} ${unit}`;
  const ms = (value) =>
    value == null ? '–' : `${value < 10 ? value.toFixed(1) : Math.round(value)} ms`;
  const bytes = (value) => (value === null ? '–' : `${size(value)}/s`);
  const free = disk.total_bytes ? disk.free_bytes / disk.total_bytes : 1;
  return [
    {
      title: 'Robots connected',
      value: `${number(robots.online)} of ${number(robots.known)}`,
      note: `${number(mqtt.robots_connected)} over MQTT`,
      of: (one) => one.robots.online,
    },
    {
      title: 'MQTT messages',
      value: each(rates.messages, '/s'),
      note: `${number(mqtt.messages_refused)} refused, ${number(mqtt.messages_dropped)} dropped`,
      of: (one) => one.rates.messages,
    },
    {
      title: 'Bandwidth',
      value: bytes(rates.out),
      note: `out; ${bytes(rates.in)} in, ${each(rates.requests, 'requests/s')}`,
      of: (one) => one.rates.out,
    },
    {
      title: 'Transfers',
      value: number(transfers.active),
      note: `${number(transfers.waiting)} waiting, ${size(transfers.bytes_per_s)}/s`,
      of: (one) => one.transfers.active,
    },
    {
      title: 'Report latency',
      value: ms(reports.latency_ms_p99),
      note: `p99; median ${ms(reports.latency_ms_p50)}, ${each(reports.per_s, '/s')}`,
      of: (one) => one.reports.latency_ms_p99,
    },
    {
      title: 'Database',
      value: ms(database.latency_ms),
      note: [database.kind, database.size_bytes != null && size(database.size_bytes)]
        .filter(Boolean)
        .join(', '),
      of: (one) => one.database.latency_ms,
    },
    {
      title: 'Free disk',
      value: size(disk.free_bytes),
      note: `of ${size(disk.total_bytes)}; packages and outputs ${size(disk.packages_bytes)}`,
      isBad: free < 0.05,
    },
    {
      title: 'Broker',
      value: broker.healthy ? 'Healthy' : 'Unhealthy',
      note: `${broker.kind}: ${broker.detail}`,
      isBad: !broker.healthy,
    },
  ];
}

/**
 * A sparkline from zero to the maximum. It is hidden from screen readers, since the figure has the
 * value.
 */
function sparkline(values) {
  const most = Math.max(...values.map((value) => value ?? 0), 1e-9);
  const step = 100 / (MAX_STATUSES - 1);
  const first = MAX_STATUSES - values.length;
  const points = values
    .map((value, index) =>
      value == null
        ? null
        : `${((first + index) * step).toFixed(2)},${(19 - (18 * value) / most).toFixed(2)}`,
    )
    .filter(Boolean);
  return html`<svg class="curve" viewBox="0 0 100 20" preserveAspectRatio="none"
    aria-hidden="true">${svg`<polyline points=${points.join(' ')}></polyline>`}</svg>`;
}

const NODE_STATES = {
  serving: 'serving',
  draining: 'draining',
  silent: 'does not answer',
  lost: 'lost',
};

/** The servers of the cluster. The figures above are those of all that answer. */
const servers = ({ nodes: list }) => html`
  <section aria-labelledby="servers">
    <header><h2 id="servers">Servers</h2></header>
    <div class="scroll" tabindex="0" role="group" aria-labelledby="servers"><table>
      <thead><tr><th>Server</th><th>State</th><th class="number">Sessions</th>
        <th class="number">Reports</th><th class="number">Transfers</th><th>Version</th>
        <th class="number">Last heartbeat</th></tr></thead>
      <tbody>${list.map(
        ({ name, url, version, state, answers, heartbeat_age_ms: age, figures: own }) => html`
        <tr data-node=${name}>
          <td>${name}${answers ? html` <span class="quiet">this page</span>` : nothing}<br>
            <span class="code quiet">${url ?? '–'}</span></td>
          <td>${statusDot(state === 'serving', NODE_STATES[state] ?? words(state))}</td>
          <td class="number">${own ? number(own.mqtt.robots_connected) : '–'}</td>
          <td class="number">${own ? `${own.reports.per_s.toFixed(1)} /s` : '–'}</td>
          <td class="number">${own ? number(own.transfers.active) : '–'}</td>
          <td>${version}</td>
          <td class="number">${age == null ? '–' : `${(age / 1000).toFixed(1)} s ago`}</td>
        </tr>`,
      )}</tbody>
    </table></div>
  </section>`;

const sites = ({ sites: list }) => html`
  <section aria-labelledby="sites">
    <header><h2 id="sites">Sites</h2></header>
    <div class="scroll" tabindex="0" role="group" aria-labelledby="sites"><table>
      <thead><tr><th>Site</th><th class="number">Robots</th><th>State</th>
        <th class="number">Throughput</th><th class="number">RTT</th></tr></thead>
      <tbody>${list.map(
        ({ site, robots, online, throughput_bytes_per_s: throughput, rtt_ms: rtt }) => html`
        <tr>
          <td>${
            site
              ? html`<a href=${hrefTo(['robots'], { q: `site=${site}` })}>${site}</a>`
              : html`<span class="quiet">no site label</span>`
          }</td>
          <td class="number">${number(robots)}</td>
          <td>${statusDot(online > 0, `${number(online)} online`)}</td>
          <td class="number">${throughput == null ? '–' : `${size(throughput)}/s`}</td>
          <td class="number">${rtt == null ? '–' : `${number(rtt)} ms`}</td>
        </tr>`,
      )}</tbody>
    </table></div>
    <p class="quiet">Throughput and RTT are medians of recent transfers to the robots of a site.</p>
  </section>`;
