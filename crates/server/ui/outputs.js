// What one robot's tasks brought back: files to download, maps as pictures. Fetched when its dialog opens.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { robotOutputs } from './api.js';
import { ago, size, words } from './format.js';
import { drawMap, isMap } from './map.js';

const SHOWN_RUNS = 3;
// A larger picture would only make the browser slow; it can be downloaded.
const MAX_PICTURE_BYTES = 16e6;

/** What is known of one robot's outputs; `changed` is called when that becomes more. */
export class Outputs {
  #changed;
  robot = null;
  list = [];
  problem = null;

  constructor(changed) {
    this.#changed = changed;
  }

  /** Fetches what `robot` brought back; asked again for the same moment of the same robot it does nothing. */
  async show(robot, moment) {
    const key = robot && `${robot} ${moment}`;
    if (this.robot === key) return;
    if (!robot || !this.robot?.startsWith(robot)) Object.assign(this, { list: [], problem: null });
    this.robot = key;
    if (!robot) return;
    try {
      const { outputs } = await robotOutputs(robot);
      if (this.robot === key) this.list = outputs;
    } catch (error) {
      this.problem = error.message;
    }
    this.#changed();
  }
}

export function outputList({ list, problem }, now) {
  if (problem) return html`<section><h3>Outputs</h3><p class="bad">${problem}</p></section>`;
  if (!list.length) return nothing;
  return html`
    <section class="outputs">
      <h3>Outputs</h3>
      ${list.slice(0, SHOWN_RUNS).map((output) => run(output, now))}
      ${list.length > SHOWN_RUNS ? html`<p class="quiet">${list.length - SHOWN_RUNS} older: <code>taskd output list</code></p>` : nothing}
    </section>`;
}

const run = (output, now) => html`
  <p>${output.task}<span class="quiet">@${output.version} · run ${output.run} · ${ago(output.pushed_at_ms, now)}</span></p>
  ${output.files.filter(({ path, size: bytes }) => isMap(path) && bytes <= MAX_PICTURE_BYTES).map((file) => picture(output, file))}
  <ul>${output.files.map((file) => html`<li><a href=${url(output, file)} download=${file.path.split('/').at(-1)}>${file.path}</a> <span class="quiet">${size(file.size)}</span></li>`)}</ul>`;

const picture = (output, file) => html`
  <figure>
    <canvas role="img" aria-label=${`${file.path}, ${words(output.task)}`} data-source=${url(output, file)}></canvas>
    <figcaption class="quiet">${file.path}</figcaption>
  </figure>`;

const url = ({ robot_id, task }, { digest }) => `/v2/outputs/${robot_id}/${task}/blobs/${digest}`;

/** Draws the maps that have come into the page since the last time. */
export function drawMaps() {
  for (const canvas of document.querySelectorAll('canvas[data-source]')) {
    if (canvas.dataset.drawn === canvas.dataset.source) continue;
    canvas.dataset.drawn = canvas.dataset.source;
    drawMap(canvas, canvas.dataset.source);
  }
}
