// A command line with a copy button, which also works on plain http, where browsers offer no
// clipboard.

import { html } from '../vendor/lit-html-3.3.3/lit-html.js';

export const command = (text) => html`
  <div class="command">
    <code>${text}</code>
    <button class="plain" aria-label=${`Copy: ${text}`}
      @click=${(event) => copy(text, event.currentTarget)}>Copy</button>
  </div>`;

/** A small button that copies a text that is shown abbreviated beside it. */
export const copyButton = (text, what) =>
  html`<button class="plain link copy" aria-label=${`Copy ${what}`}
    @click=${(event) => copy(text, event.currentTarget)}>Copy</button>`;

async function copy(text, button) {
  const isCopied =
    (await navigator.clipboard?.writeText(text).then(
      () => true,
      () => false,
    )) || copyBySelection(text);
  button.textContent = isCopied ? 'Copied' : 'Copy failed';
  setTimeout(() => (button.textContent = 'Copy'), 2_000);
}

function copyBySelection(text) {
  const area = document.createElement('textarea');
  area.value = text;
  area.className = 'offscreen';
  document.body.append(area);
  area.select();
  const isCopied = document.execCommand('copy');
  area.remove();
  return isCopied;
}
