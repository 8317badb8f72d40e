// What one robot's tasks brought back: files to download, maps as pictures. Fetched when its dialog opens.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { robotOutputs } from './api.js';
import { ago, size, words } from './format.js';
import { drawMap, isMap } from './map.js';

const SHOWN_RUNS = 3;
// Of one run; a robot may bring back hundreds.
const SHOWN_PICTURES = 4;
const SHOWN_FILES = 20;
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
      if (this.robot === key) Object.assign(this, { list: outputs, problem: null });
    } catch (error) {
      if (this.robot === key) this.problem = error.message;
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
  ${output.files.filter(({ path, size: bytes }) => isMap(path) && bytes <= MAX_PICTURE_BYTES).slice(0, SHOWN_PICTURES).map((file) => picture(output, file))}
  <ul>${output.files.slice(0, SHOWN_FILES).map((file) => html`<li><a href=${url(output, file)} download=${file.path.split('/').at(-1)}>${file.path}</a> <span class="quiet">${size(file.size)}</span></li>`)}</ul>
  ${output.files.length > SHOWN_FILES ? html`<p class="quiet">${output.files.length - SHOWN_FILES} more: <code>taskd output get</code></p>` : nothing}`;

const picture = (output, file) => html`
  <figure>
    <canvas role="img" aria-label=${`${file.path}, ${words(output.task)}`} data-source=${url(output, file)}></canvas>
    <p class="bad"></p>
    <figcaption class="quiet">${file.path}</figcaption>
  </figure>`;

const url = ({ robot_id, task }, { digest }) => `/v2/outputs/${robot_id}/${task}/blobs/${digest}`;

/** Draws the maps that have come into the page since the last time. What can't be drawn is said in its place. */
export function drawMaps() {
  for (const canvas of document.querySelectorAll('canvas[data-source]')) {
    const { source, drawn } = canvas.dataset;
    if (drawn === source) continue;
    canvas.dataset.drawn = source;
    const say = (problem) => {
      if (canvas.dataset.source !== source) return;
      canvas.hidden = Boolean(problem);
      canvas.nextElementSibling.textContent = problem;
    };
    drawMap(canvas).then(() => say(''), ({ message }) => say(`The picture can't be shown: ${message}`));
  }
}
