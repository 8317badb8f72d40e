// The keyboard shortcuts, shown by `?`.

import { html } from '../vendor/lit-html-3.3.3/lit-html.js';
import { openDialog } from './dialog.js';

const KEYS = [
  [['/'], 'Search'],
  [['↑', '↓'], 'Move between rows'],
  [['Enter'], 'Open the row'],
  [['←', '→'], 'Collapse or expand a directory'],
  [['x'], 'Select the row; with Shift, select a range'],
  [['Esc'], 'Clear the search, then the selection; close a dialog'],
  [['?'], 'Show this help'],
];

export const showHelp = () =>
  openDialog({
    title: 'Keyboard shortcuts',
    body: () => html`<dl class="keys">${KEYS.map(
      ([keys, does]) =>
        html`<dt>${keys.map((key) => html`<kbd>${key}</kbd> `)}</dt><dd>${does}</dd>`,
    )}</dl>
    <p class="quiet">Everything on this page is also available on the command line and in the
      <a href="/api/docs">API</a>.</p>`,
  });
