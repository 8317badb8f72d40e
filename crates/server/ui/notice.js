// What was done, said for a moment at the page's lower edge, and read aloud.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { change } from './frame.js';

const SHOWN_MS = 6_000;
// What went wrong stays until somebody has read it.
let current = null;
let timer;

/** Says that something was done. `link`, if given, is `[address, text]`. */
export const tell = (text, link) => show({ text, link }, SHOWN_MS);

/** Says that something failed, until it is closed. */
export const complain = (text) => show({ text, isBad: true });

function show(notice, duration) {
  clearTimeout(timer);
  change(() => (current = notice));
  if (duration) timer = setTimeout(hide, duration);
}

/** Shows nothing any more. */
export const hide = () => change(() => (current = null));

export const noticeView = () => html`
  <div class="notice" role="status">${
    current
      ? html`<p class=${current.isBad ? 'bad' : ''}>${current.isBad ? '▲ ' : ''}${current.text}
        ${current.link ? html`<a href=${current.link[0]} @click=${hide}>${current.link[1]}</a>` : nothing}
        <button class="plain" aria-label="Close the notice" @click=${hide}>✕</button></p>`
      : nothing
  }</div>`;
