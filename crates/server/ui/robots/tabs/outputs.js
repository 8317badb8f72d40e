// The Outputs tab: output files to download and maps as images, newest first.

import { repeat } from '../../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { get, SignedOut } from '../../api/api.js';
import { change } from '../../display/display.js';
import { plural, size, words } from '../../display/format.js';
import { hrefTo } from '../../display/router.js';
import { timeAgo } from '../../display/status.js';
import { drawMap, isMap } from './map.js';

// Runs per page.
const SHOWN_RUNS = 5;
// Per run; a robot may upload hundreds of files.
const SHOWN_PICTURES = 4;
const SHOWN_FILES = 20;
// Larger images can only be downloaded.
const MAX_PICTURE_BYTES = 16e6;
// Outputs are uploaded after the end of the run is reported.
const UPLOAD_DELAY_MS = 3_000;

export class Outputs {
  #page;
  #list = null;
  #problem = null;
  #shown = SHOWN_RUNS;
  #runs = null;
  #timer = null;

  constructor(page) {
    this.#page = page;
  }

  enter() {
    this.#runs = runsOf(this.#page.robot);
    this.refresh();
  }

  leave() {
    clearTimeout(this.#timer);
  }

  /**
   * Refreshes when a task of the robot changes its phase or run, since it may have uploaded
   * outputs.
   */
  onEvent(robot) {
    if (this.#runs === runsOf(robot)) return;
    this.#runs = runsOf(robot);
    this.refresh();
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.refresh(), UPLOAD_DELAY_MS);
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
        ${
          list.length > this.#shown
            ? html`<p><button class="quiet-button"
                @click=${() => change(() => (this.#shown += SHOWN_RUNS))}>Show older</button>
                <span class="quiet">${plural(list.length - this.#shown, 'older run')}</span></p>`
            : nothing
        }`
          : html`<p class="empty quiet">${
              list
                ? html`No outputs yet. A package declares its outputs in <code>[outputs]</code>.`
                : 'Loading…'
            }</p>`
      }`;
  }

  afterDraw() {
    drawMaps();
  }
}

const runsOf = (robot) =>
  robot?.tasks.map(({ task, run: count, phase }) => `${task} ${count} ${phase}`).join();

const run = (output, now) => html`
  <section class="run" aria-label=${`${output.task}, run ${output.run}`}>
    <header><h2>${output.task}<span class="quiet">@${output.version}</span></h2>
      <p class="quiet">run ${output.run} · ${timeAgo(output.pushed_at_ms, now)}</p>
      <a href=${hrefTo(['deployments', output.deployment])}>Deployment</a></header>
    <div class="pictures">${output.files
      .filter(({ path, size: bytes }) => isMap(path) && bytes <= MAX_PICTURE_BYTES)
      .slice(0, SHOWN_PICTURES)
      .map((file) => picture(output, file))}</div>
    <ul>${output.files.slice(0, SHOWN_FILES).map(
      (file) =>
        html`<li><a class="code" href=${url(output, file)}
          download=${file.path.split('/').at(-1)}>${file.path}</a>
          <span class="quiet">${size(file.size)}</span></li>`,
    )}</ul>
    ${
      output.files.length > SHOWN_FILES
        ? html`<p class="quiet">${output.files.length - SHOWN_FILES} more:
            <code>taskd output get</code></p>`
        : nothing
    }
  </section>`;

const picture = (output, file) => html`
  <figure>
    <canvas role="img" aria-label=${`${file.path}, ${words(output.task)}`}
      data-source=${url(output, file)}></canvas>
    <p class="bad"></p>
    <figcaption class="quiet">${file.path}</figcaption>
  </figure>`;

const url = ({ robot_id, task }, { digest }) => `/v2/outputs/${robot_id}/${task}/blobs/${digest}`;

/** Draws maps that are new in the page, and shows an error for those that cannot be drawn. */
function drawMaps() {
  for (const canvas of document.querySelectorAll('canvas[data-source]')) {
    const { source, drawn } = canvas.dataset;
    if (drawn === source) continue;
    canvas.dataset.drawn = source;
    const showProblem = (problem) => {
      if (canvas.dataset.source !== source) return;
      canvas.hidden = Boolean(problem);
      canvas.nextElementSibling.textContent = problem;
    };
    drawMap(canvas).then(
      () => showProblem(''),
      ({ message }) => showProblem(`Cannot show the image: ${message}`),
    );
  }
}
