// What is said of a deployment beside its robots: why some failed, how the bytes travel, and what
// was ordered.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { number, plural, words } from '../format.js';
import { at } from '../router.js';
import { isNarrow } from '../rows.js';
import { canRetry } from './parts.js';

const SHOWN_NAMES = 4;

// Where the page is narrow both are folded, so that the robots below stay where they are when a
// failure comes.

/**
 * The failures, the most frequent first. `act` has `show(reason)` and `retry(reason, parts)`, if
 * this person may.
 */
export function failures(reasons, chosen, act) {
  const groups = [...reasons].sort(([, one], [, other]) => other.length - one.length);
  return html`
    <details class="reasons" ?open=${!isNarrow}>
      <summary><h2>Failures <span class="count">${number(groups.reduce((sum, [, parts]) => sum + parts.length, 0))}</span></h2></summary>
      ${groups.length ? nothing : html`<p class="quiet">None.</p>`}
      <ul>${groups.map(([reason, parts]) => group(reason, parts, chosen === reason, act))}</ul>
    </details>`;
}

function group(reason, parts, isChosen, { show, retry }) {
  const text = parts.find(({ failure }) => failure)?.failure.text;
  const isRetried = retry && parts.some(canRetry);
  return html`
    <li class="reason">
      <p class="bad"><strong>✕ ${words(reason)}</strong> <span class="quiet">on ${plural(parts.length, 'robot')}</span></p>
      ${text ? html`<p class="example" title=${text}>${text}</p>` : nothing}
      <p class="quiet">${names(parts)}</p>
      <p class="acts">
        <button class="plain link" aria-pressed=${isChosen} @click=${() => show(isChosen ? '' : reason)}>${isChosen ? 'Show all robots' : 'Show these'}</button>
        ${isRetried ? html`<button class="plain link" @click=${() => retry(reason, parts)}>Retry these…</button>` : nothing}
      </p>
    </li>`;
}

function names(parts) {
  const rest = parts.length - SHOWN_NAMES;
  return html`${parts.slice(0, SHOWN_NAMES).map(({ name }, index) => html`${index ? ', ' : ''}<a href=${at(['robots', name])}>${name}</a>`)}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
}

/** How the bytes travel, by mechanism and the rule that chose it. */
export function deliveries(ways, ordered) {
  const groups = [...ways.values()].sort((one, other) => other.length - one.length);
  return html`
    <details ?open=${!isNarrow}>
      <summary><h2>Delivery <span class="count">${groups.map(([{ delivery }]) => words(delivery.mechanism)).join(', ')}</span></h2></summary>
      <ul>${groups.map((parts) => {
        const { mechanism, rule, because } = parts[0].delivery;
        const isSame = parts.slice(0, 100).every(({ delivery }) => delivery.because === because);
        return html`<li class="way"><p><strong>${words(mechanism)}</strong> <span class="quiet">for ${plural(parts.length, 'robot')}</span></p>
          <p class="quiet">${rule === 'ordered' ? 'as it was ordered' : html`rule “${rule}”: ${because}${isSame ? '' : ', and the like'}`}</p></li>`;
      })}</ul>
      ${groups.length ? nothing : html`<p class="quiet">${ordered === 'adaptive' ? 'Decided when the bytes begin to travel.' : words(ordered)}</p>`}
    </details>`;
}
