// The phases that a robot went through, as a strip whose parts are as long as they took, and as a
// list.

import { html, nothing, svg } from './vendor/lit-html-3.3.3/lit-html.js';
import { clock, duration, moment, tone, words } from './format.js';
import { phaseSign } from './signs.js';

/**
 * Each phase with how long it took; the last one lasts until now. One that nobody waits to see the
 * end of, unlike a job that runs, is a rest, and of those only running lasts.
 */
export function steps(timeline, kind, now) {
  return timeline.map(({ phase, at_ms, attempt }, index) => {
    const next = timeline[index + 1];
    const isRest =
      ['done', 'bad', 'gone'].includes(tone(phase)) && !(kind === 'job' && phase === 'running');
    const isOver = Boolean(next) || (isRest && phase !== 'running');
    const took = next ? next.at_ms - at_ms : isOver ? 0 : now - at_ms;
    return { phase, at_ms, attempt, isRest, isOver, took: Math.max(0, took) };
  });
}

/** All of it but the rests. */
export const tookInAll = (all) =>
  all.reduce((sum, { took, isRest }) => sum + (isRest ? 0 : took), 0);

/** The strip. Waiting to begin is left out: an hour of it would make all the rest invisible. */
export function strip(all) {
  const counted = all.filter(({ phase, isRest }) => !isRest && phase !== 'assigned');
  const total = counted.reduce((sum, { took }) => sum + took, 0);
  if (!total) return nothing;
  let x = 0;
  const parts = counted.map(({ phase, took }) => {
    const width = (100 * took) / total;
    x += width;
    return svg`<rect class=${phase} x=${x - width} width=${width} height="1"></rect>`;
  });
  const said = counted.map(({ phase, took }) => `${words(phase)} ${duration(took)}`).join(', ');
  return html`<svg class="strip-of-time" viewBox="0 0 100 1" preserveAspectRatio="none" role="img" aria-label=${said}><title>${said}</title>${parts}</svg>`;
}

/** The list. */
export const list = (all) => html`
  <ol class="steps">${all.map(
    ({ phase, at_ms, took, isOver, attempt }) => html`
    <li><time class="quiet" title=${moment(at_ms)}>${clock(at_ms)}</time> ${phaseSign(phase)} <span class="quiet">${took || !isOver ? `${isOver ? '' : 'for '}${duration(took)}` : ''}${attempt > 1 ? html`, try ${attempt}` : nothing}</span></li>`,
  )}</ol>`;
