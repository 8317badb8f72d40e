// What a robot's tasks brought back: files to download, maps as pictures; the newest first.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { get, SignedOut } from '../api.js';
import { plural, size, words } from '../format.js';
import { change } from '../frame.js';
import { at } from '../router.js';
import { since } from '../signs.js';
import { drawMap, isMap } from './map.js';

// At first, and with each asking for more.
const SHOWN_RUNS = 5;
// Of one run; a robot may bring back hundreds.
const SHOWN_PICTURES = 4;
const SHOWN_FILES = 20;
// A larger picture would only make the browser slow; it can be downloaded.
const MAX_PICTURE_BYTES = 16e6;
// What a run brings back comes after the news that it has ended.
const AFTERWARDS_MS = 3_000;

export class Outputs {
  #page;
  #list = null;
  #problem = null;
  #shown = SHOWN_RUNS;
  #moment = null;
  #timer = null;

  constructor(page) {
    this.#page = page;
  }

  enter() {
    this.#moment = momentOf(this.#page.robot);
    this.refresh();
  }

  leave() {
    clearTimeout(this.#timer);
  }

  /**
   * Looks again whenever it may have brought something back: each time one of its tasks stands
   * elsewhere.
   */
  hear(robot) {
    if (this.#moment === momentOf(robot)) return;
    this.#moment = momentOf(robot);
    this.refresh();
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.refresh(), AFTERWARDS_MS);
  }

  async refresh() {
    try {
      const { outputs } = await get('/outputs', { robot: this.#page.robot?.id });
      change(() => {
        this.#list = outputs;
        this.#problem = null;
      });
    } catch (error) {
      if (!(error instanceof SignedOut)) change(() => (this.#problem = error.message));
    }
  }

  draw(robot, now) {
    const list = this.#list;
    return html`
      ${this.#problem ? html`<p class="bad" role="alert">▲ ${this.#problem}</p>` : nothing}
      ${
        list?.length
          ? html`
          <div class="outputs">${repeat(
            list.slice(0, this.#shown),
            ({ manifest }) => manifest,
            (output) => run(output, now),
          )}</div>
          ${list.length > this.#shown ? html`<p><button class="quiet-button" @click=${() => change(() => (this.#shown += SHOWN_RUNS))}>Show older</button> <span class="quiet">${plural(list.length - this.#shown, 'run')} more</span></p>` : nothing}`
          : html`<p class="empty quiet">${list ? html`Its tasks have brought nothing back. What they should is said in a package’s <code>[outputs]</code>.` : 'Fetching…'}</p>`
      }`;
  }

  drawn() {
    drawMaps();
  }
}

const momentOf = (robot) =>
  robot?.tasks.map(({ task, run: count, phase }) => `${task} ${count} ${phase}`).join();

const run = (output, now) => html`
  <section class="run" aria-label=${`${output.task}, run ${output.run}`}>
    <header><h2>${output.task}<span class="quiet">@${output.version}</span></h2><p class="quiet">run ${output.run} · ${since(output.pushed_at_ms, now)}</p><a href=${at(['deployments', output.deployment])}>Deployment</a></header>
    <div class="pictures">${output.files
      .filter(({ path, size: bytes }) => isMap(path) && bytes <= MAX_PICTURE_BYTES)
      .slice(0, SHOWN_PICTURES)
      .map((file) => picture(output, file))}</div>
    <ul>${output.files.slice(0, SHOWN_FILES).map((file) => html`<li><a class="code" href=${url(output, file)} download=${file.path.split('/').at(-1)}>${file.path}</a> <span class="quiet">${size(file.size)}</span></li>`)}</ul>
    ${output.files.length > SHOWN_FILES ? html`<p class="quiet">${output.files.length - SHOWN_FILES} more: <code>taskd output get</code></p>` : nothing}
  </section>`;

const picture = (output, file) => html`
  <figure>
    <canvas role="img" aria-label=${`${file.path}, ${words(output.task)}`} data-source=${url(output, file)}></canvas>
    <p class="bad"></p>
    <figcaption class="quiet">${file.path}</figcaption>
  </figure>`;

const url = ({ robot_id, task }, { digest }) => `/v2/outputs/${robot_id}/${task}/blobs/${digest}`;

/**
 * Draws the maps that have come into the page since the last time. What can't be drawn is said in
 * its place.
 */
function drawMaps() {
  for (const canvas of document.querySelectorAll('canvas[data-source]')) {
    const { source, drawn } = canvas.dataset;
    if (drawn === source) continue;
    canvas.dataset.drawn = source;
    const say = (problem) => {
      if (canvas.dataset.source !== source) return;
      canvas.hidden = Boolean(problem);
      canvas.nextElementSibling.textContent = problem;
    };
    drawMap(canvas).then(
      () => say(''),
      ({ message }) => say(`The picture can't be shown: ${message}`),
    );
  }
}
