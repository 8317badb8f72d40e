// The phases of an assignment, as a bar with proportional parts and as a list.

import { html, nothing, svg } from '../vendor/lit-html-3.3.3/lit-html.js';
import { clock, duration, moment, tone, words } from './format.js';
import { phaseBadge } from './status.js';

/**
 * The phases with their durations. The last phase lasts until now. Final phases count as rest, as
 * does `running` for services; only `running` has a growing duration.
 */
export function timelineSteps(timeline, kind, now) {
  return timeline.map(({ phase, at_ms, attempt }, index) => {
    const next = timeline[index + 1];
    const isRest =
      ['done', 'bad', 'gone'].includes(tone(phase)) && !(kind === 'job' && phase === 'running');
    const isOver = Boolean(next) || (isRest && phase !== 'running');
    const took = next ? next.at_ms - at_ms : isOver ? 0 : now - at_ms;
    return { phase, at_ms, attempt, isRest, isOver, took: Math.max(0, took) };
  });
}

/** The total duration without rest. */
export const totalDuration = (all) =>
  all.reduce((sum, { took, isRest }) => sum + (isRest ? 0 : took), 0);

/** The bar. It leaves out `assigned`: an hour of waiting would hide all other phases. */
export function timelineBar(all) {
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
  return html`<svg class="timeline-bar" viewBox="0 0 100 1" preserveAspectRatio="none" role="img"
    aria-label=${said}><title>${said}</title>${parts}</svg>`;
}

export const timelineList = (all) => html`
  <ol class="steps">${all.map(
    ({ phase, at_ms, took, isOver, attempt }) => html`
    <li><time class="quiet" title=${moment(at_ms)}>${clock(at_ms)}</time>
      ${phaseBadge(phase)} <span class="quiet">${
        took || !isOver ? `${isOver ? '' : 'for '}${duration(took)}` : ''
      }${attempt > 1 ? html`, attempt ${attempt}` : nothing}</span></li>`,
  )}</ol>`;
