// The sidebar of a deployment: reasons of failures, and delivery mechanisms.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { number, plural, words } from '../display/format.js';
import { hrefTo } from '../display/router.js';
import { isNarrow } from '../display/virtual-list.js';
import { canRetry } from './assignments.js';

const SHOWN_NAMES = 4;

// On a narrow screen both are collapsed, so that the robots below stay in place when a failure
// arrives.

/**
 * The failures, most frequent first. `actions` has `show(reason)` and, if the user may retry,
 * `retry(reason, assignments)`.
 */
export function failureGroups(reasons, selected, actions) {
  const groups = [...reasons].sort(([, one], [, other]) => other.length - one.length);
  const count = groups.reduce((sum, [, assignments]) => sum + assignments.length, 0);
  return html`
    <details class="reasons" ?open=${!isNarrow}>
      <summary><h2>Failures <span class="count">${number(count)}</span></h2></summary>
      ${groups.length ? nothing : html`<p class="quiet">No failures.</p>`}
      <ul>${groups.map(([reason, assignments]) =>
        group(reason, assignments, selected === reason, actions),
      )}</ul>
    </details>`;
}

function group(reason, assignments, isSelected, { show, retry }) {
  const text = assignments.find(({ failure }) => failure)?.failure.text;
  const canRetryAny = retry && assignments.some(canRetry);
  return html`
    <li class="reason">
      <p class="bad"><strong>✕ ${words(reason)}</strong>
        <span class="quiet">on ${plural(assignments.length, 'robot')}</span></p>
      ${text ? html`<p class="example" title=${text}>${text}</p>` : nothing}
      <p class="quiet">${robotLinks(assignments)}</p>
      <p class="actions">
        <button class="plain link" aria-pressed=${isSelected}
          @click=${() => show(isSelected ? '' : reason)}
          >${isSelected ? 'Show all robots' : 'Show these robots'}</button>
        ${
          canRetryAny
            ? html`<button class="plain link"
                @click=${() => retry(reason, assignments)}>Retry these…</button>`
            : nothing
        }
      </p>
    </li>`;
}

function robotLinks(assignments) {
  const rest = assignments.length - SHOWN_NAMES;
  const links = assignments
    .slice(0, SHOWN_NAMES)
    .map(
      ({ name }, index) =>
        html`${index ? ', ' : ''}<a href=${hrefTo(['robots', name])}>${name}</a>`,
    );
  return html`${links}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
}

/** The delivery mechanisms with the rules that chose them. */
export function deliveryGroups(mechanisms, ordered) {
  const groups = [...mechanisms.values()].sort((one, other) => other.length - one.length);
  return html`
    <details ?open=${!isNarrow}>
      <summary><h2>Delivery <span class="count">${groups
        .map(([{ delivery }]) => words(delivery.mechanism))
        .join(', ')}</span></h2></summary>
      <ul>${groups.map((assignments) => {
        const { mechanism, rule, because } = assignments[0].delivery;
        const isSame = assignments
          .slice(0, 100)
          .every(({ delivery }) => delivery.because === because);
        return html`<li class="mechanism"><p><strong>${words(mechanism)}</strong>
            <span class="quiet">for ${plural(assignments.length, 'robot')}</span></p>
          <p class="quiet">${
            rule === 'ordered'
              ? 'as ordered'
              : html`rule “${rule}”: ${because}${isSame ? '' : ', and similar reasons'}`
          }</p></li>`;
      })}</ul>
      ${
        groups.length
          ? nothing
          : html`<p class="quiet">${
              ordered === 'adaptive' ? 'Decided when the transfer starts.' : words(ordered)
            }</p>`
      }
    </details>`;
}
