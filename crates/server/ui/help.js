// The keys there are, shown by `?`.

import { html } from './vendor/lit-html-3.3.3/lit-html.js';
import { open } from './dialog.js';

const KEYS = [
  [['/'], 'search'],
  [['↑', '↓'], 'go from row to row'],
  [['Enter'], 'open the row'],
  [['←', '→'], 'fold and unfold a directory'],
  [['x'], 'select the row; with Shift all rows up to it'],
  [['Esc'], 'clear the search, then the selection; close a dialog'],
  [['?'], 'this help'],
];

export const showHelp = () =>
  open({
    title: 'Keys',
    body: () => html`<dl class="keys">${KEYS.map(([keys, does]) => html`<dt>${keys.map((key) => html`<kbd>${key}</kbd> `)}</dt><dd>${does}</dd>`)}</dl>
    <p class="quiet">Everything here can be done at the command line and <a href="/api/docs">over the API</a> as well.</p>`,
  });
