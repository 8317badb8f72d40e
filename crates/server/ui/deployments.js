// The deployments, newest first: how far each has come, as a bar and in words.

import { html, nothing, svg } from './vendor/lit-html-3.3.3/lit-html.js';
import { command } from './copy.js';
import { ago, moment, number, tone, words } from './format.js';

/** Shown at once; as many lines are kept free, so that a new deployment moves nothing. */
const NEWEST = 3;
const MOST = 200;

/** The section. `actions` has `filterBy(text)` and `showAll(yes)`. */
export function deploymentList(fleet, isAllShown, now, actions) {
  const { deployments } = fleet;
  const shown = deployments.slice(0, isAllShown ? MOST : NEWEST);
  return html`
    <section aria-labelledby="deployments">
      <header>
        <h2 id="deployments">Deployments <span class="count">${number(deployments.length)}</span></h2>
        ${deployments.length > NEWEST
          ? html`<button class="plain link" aria-expanded=${isAllShown} @click=${() => actions.showAll(!isAllShown)}>${isAllShown ? 'Show the newest' : 'Show all'}</button>`
          : nothing}
      </header>
      <ol class="deployments">
        ${shown.map((deployment) => deploymentRow(deployment, fleet, now, actions))}
      </ol>
      ${deployments.length || !fleet.isLoaded ? nothing : noDeployments()}
      ${isAllShown && deployments.length > MOST ? html`<p class="quiet">Older ones: <code>taskd deploy list</code></p>` : nothing}
    </section>`;
}

const noDeployments = () => html`
  <div class="empty">
    <p class="quiet">Nothing is deployed yet. Push a directory to every robot with</p>
    ${command("taskd push ./my_pkg --to '*'")}
  </div>`;

function deploymentRow(deployment, fleet, now, actions) {
  const { id, package: { name, version }, selector, state, counts, created_at_ms: created } = deployment;
  return html`
    <li data-deployment=${id}>
      <span class="package"><button class="plain" title=${`${id}: show its robots`} @click=${() => actions.filterBy(id)}>${name}<span class="quiet">@${version}</span></button></span>
      <span class="selector code" title=${selector}>${selector}</span>
      <span class="standing ${state}">${STATES[state] ?? words(state)}</span>
      ${countBar(counts)}
      <span class="counts">${counts.map(({ phase, count }) => html`<span class="phase ${tone(phase)}">${number(count)} ${words(phase)}</span> `)}</span>
      <span class="since"><time title=${moment(created)}>${ago(created, now)}</time>${replaced(deployment, fleet)}</span>
    </li>`;
}

const STATES = { active: '▸ Active', paused: '‖ Paused', settled: '✓ Settled', cancelled: '✕ Cancelled' };

/** Only versions: what a deployment takes the place of is always the same package. */
function replaced({ supersedes }, fleet) {
  if (!supersedes.length) return nothing;
  const versions = new Set(supersedes.map((id) => fleet.deployment(id)?.package.version ?? id));
  return html`<span class="quiet" title=${supersedes.join(', ')}>, supersedes ${[...versions].join(', ')}</span>`;
}

const ORDER = ['done', 'busy', 'waiting', 'bad', 'gone'];

/** One bar of all robots, in parts: what is done, under way, waiting, failed and out of date. */
function countBar(counts) {
  const total = counts.reduce((sum, { count }) => sum + count, 0);
  let x = 0;
  const parts = ORDER.map((kind) => {
    const count = counts.filter(({ phase }) => tone(phase) === kind).reduce((sum, part) => sum + part.count, 0);
    const part = svg`<rect class=${kind} x=${x} width=${total ? (100 * count) / total : 0} height="1"></rect>`;
    x += total ? (100 * count) / total : 0;
    return part;
  });
  const said = counts.map(({ phase, count }) => `${count} ${words(phase)}`).join(', ');
  return html`<svg class="bar" viewBox="0 0 100 1" preserveAspectRatio="none" role="img" aria-label=${said}>${parts}</svg>`;
}
