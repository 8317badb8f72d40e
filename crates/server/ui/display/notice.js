// Notifications at the lower edge of the page, announced to screen readers.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { change } from './display.js';

const SHOWN_MS = 6_000;
// Errors stay until they are closed.
let current = null;
let timer;

/** Shows a success message. `link`, if given, is `[address, text]`. */
export const notify = (text, link) => show({ text, link }, SHOWN_MS);

/** Shows an error until it is closed. */
export const notifyError = (text) => show({ text, isBad: true });

function show(notice, duration) {
  clearTimeout(timer);
  change(() => (current = notice));
  if (duration) timer = setTimeout(hide, duration);
}

/** Hides the notification. */
export const hide = () => change(() => (current = null));

export const noticeView = () => html`
  <div class="notice" role="status">${
    current
      ? html`<p class=${current.isBad ? 'bad' : ''}>${current.isBad ? '▲ ' : ''}${current.text}
        ${
          current.link
            ? html`<a href=${current.link[0]} @click=${hide}>${current.link[1]}</a>`
            : nothing
        }
        <button class="plain" aria-label="Close notification" @click=${hide}>✕</button></p>`
      : nothing
  }</div>`;
