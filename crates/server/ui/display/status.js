// Small templates that show states by shape and text as well as by colour.

import { html, nothing, svg } from '../vendor/lit-html-3.3.3/lit-html.js';
import { ago, bytes, moment, number, tone, words } from './format.js';

/** A filled or an empty dot before a text. */
export const statusDot = (isOn, text) => html`
  <span class=${isOn ? 'online' : 'offline'}><svg class="dot" viewBox="0 0 10 10"
    aria-hidden="true"><circle cx="5" cy="5" r="3.75"></circle></svg>${text}</span>`;

export const robotState = ({ online }) => statusDot(online, online ? 'Online' : 'Offline');

export const lastSeen = ({ online, last_seen_ms: then }, now) =>
  then || online
    ? html`<time title=${then ? moment(then) : nothing}>${online ? 'now' : ago(then, now)}</time>`
    : 'never';

/** A time as `12 s ago`, with the full time as a tooltip. */
export const timeAgo = (then, now) => html`<time title=${moment(then)}>${ago(then, now)}</time>`;

export const phaseBadge = (phase) =>
  tone(phase) === 'bad'
    ? html`<span class="phase bad"><span aria-hidden="true">✕ </span>${words(phase)}</span>`
    : html`<span class="phase ${tone(phase)}">${words(phase)}</span>`;

/** The progress of a phase; null if it cannot be measured. */
export const progressBar = ({ task, phase, progress }) =>
  progress?.total && tone(phase) === 'busy'
    ? html`<span class="transfer-progress"><progress max=${progress.total}
        .value=${Math.min(progress.done, progress.total)}
        aria-label=${`${task} ${words(phase)}`}></progress><span
        class="quiet bytes">${bytes(progress)}</span></span>`
    : null;

/** Notes on a task that are no failures. */
export function taskNotes({
  active,
  version,
  deployment,
  outdated,
  restarts,
  wanted,
  phase,
  degraded,
}) {
  const said = [];
  if (outdated) said.push(`▲ outdated: ${version} is now a different package`);
  if (degraded) said.push(`▲ degraded: ${words(degraded.code)}`);
  if (active && active.deployment !== deployment)
    said.push(
      active.version === version
        ? 'previous package still running'
        : `${active.version} still running`,
    );
  if (restarts) said.push(`restarted ${restarts}×`);
  if (wanted === 'stopped' && phase === 'running') said.push('stop requested');
  return said;
}

const STATES = {
  active: '▸ Active',
  paused: '‖ Paused',
  settled: '✓ Settled',
  cancelled: '✕ Cancelled',
};

export const deploymentState = ({ state }) =>
  html`<span class="deployment-state ${state}">${STATES[state] ?? words(state)}</span>`;

const ORDER = ['done', 'busy', 'waiting', 'bad', 'gone'];

/** A stacked bar of all robots by tone of their phases. */
export function phaseBar(counts) {
  const total = counts.reduce((sum, { count }) => sum + count, 0);
  let x = 0;
  const parts = ORDER.map((kind) => {
    const count = counts
      .filter(({ phase }) => tone(phase) === kind)
      .reduce((sum, part) => sum + part.count, 0);
    const width = total ? (100 * count) / total : 0;
    const part = svg`<rect class=${kind} x=${x} width=${width} height="1"></rect>`;
    x += width;
    return part;
  });
  const said = counts.map(({ phase, count }) => `${count} ${words(phase)}`).join(', ');
  return html`<svg class="bar" viewBox="0 0 100 1" preserveAspectRatio="none" role="img"
    aria-label=${said || 'no robots'}>${parts}</svg>`;
}

export const phaseCounts = (counts) =>
  counts.map(
    ({ phase, count }) =>
      html`<span class="phase ${tone(phase)}">${number(count)} ${words(phase)}</span> `,
  );
