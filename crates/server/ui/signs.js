// Small parts that say how something stands, by shape and word as well as by colour.

import { html, nothing, svg } from './vendor/lit-html-3.3.3/lit-html.js';
import { ago, bytes, moment, number, tone, words } from './format.js';

/** A full or an empty dot before a text. */
export const sign = (isOn, text) => html`
  <span class=${isOn ? 'online' : 'offline'}><svg class="dot" viewBox="0 0 10 10" aria-hidden="true"><circle cx="5" cy="5" r="3.75"></circle></svg>${text}</span>`;

/** Whether a robot is there. */
export const robotState = ({ online }) => sign(online, online ? 'Online' : 'Offline');

export const lastSeen = ({ online, last_seen_ms: then }, now) =>
  then || online
    ? html`<time title=${then ? moment(then) : nothing}>${online ? 'now' : ago(then, now)}</time>`
    : 'never';

/** A moment as `12 s ago`, with the whole of it on pointing at it. */
export const since = (then, now) => html`<time title=${moment(then)}>${ago(then, now)}</time>`;

export const phaseSign = (phase) =>
  tone(phase) === 'bad'
    ? html`<span class="phase bad"><span aria-hidden="true">✕ </span>${words(phase)}</span>`
    : html`<span class="phase ${tone(phase)}">${words(phase)}</span>`;

/** How far a phase that is under way has come; null where there is nothing to measure it by. */
export const progressBar = ({ task, phase, progress }) =>
  progress?.total && tone(phase) === 'busy'
    ? html`<span class="moving"><progress max=${progress.total} .value=${Math.min(progress.done, progress.total)} aria-label=${`${task} ${words(phase)}`}></progress><span class="quiet bytes">${bytes(progress)}</span></span>`
    : null;

/** What else is worth knowing of a task that has not failed. */
export function remarks({
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
  if (outdated) said.push(`▲ outdated: ${version} is another package now`);
  if (degraded) said.push(`▲ degraded: ${words(degraded.code)}`);
  if (active && active.deployment !== deployment)
    said.push(
      active.version === version
        ? 'what was there before still runs'
        : `${active.version} still runs`,
    );
  if (restarts) said.push(`restarted ${restarts}×`);
  if (wanted === 'stopped' && phase === 'running') said.push('stop ordered');
  return said;
}

const STATES = {
  active: '▸ Active',
  paused: '‖ Paused',
  settled: '✓ Settled',
  cancelled: '✕ Cancelled',
};

/** Where a deployment stands as a whole. */
export const deploymentState = ({ state }) =>
  html`<span class="standing ${state}">${STATES[state] ?? words(state)}</span>`;

const ORDER = ['done', 'busy', 'waiting', 'bad', 'gone'];

/** One bar of all robots, in parts: what is done, under way, waiting, failed and out of date. */
export function countBar(counts) {
  const total = counts.reduce((sum, { count }) => sum + count, 0);
  let x = 0;
  const parts = ORDER.map((kind) => {
    const count = counts
      .filter(({ phase }) => tone(phase) === kind)
      .reduce((sum, part) => sum + part.count, 0);
    const part = svg`<rect class=${kind} x=${x} width=${total ? (100 * count) / total : 0} height="1"></rect>`;
    x += total ? (100 * count) / total : 0;
    return part;
  });
  const said = counts.map(({ phase, count }) => `${count} ${words(phase)}`).join(', ');
  return html`<svg class="bar" viewBox="0 0 100 1" preserveAspectRatio="none" role="img" aria-label=${said || 'none'}>${parts}</svg>`;
}

export const countWords = (counts) =>
  counts.map(
    ({ phase, count }) =>
      html`<span class="phase ${tone(phase)}">${number(count)} ${words(phase)}</span> `,
  );
