// The shared worker: one stream of events for all tabs of this page, because a browser allows six
// connections to a server. It passes on what it hears and knows nothing of robots.

import { openStream } from './stream.js';

const tabs = new Set();
let close = null;
let state = null;

function tell(message) {
  if (message.state) state = message;
  if (message.state === 'signed_out') close = null;
  for (const tab of tabs) tab.postMessage(message);
}

function join(tab) {
  tabs.add(tab);
  if (!close) {
    state = null;
    close = openStream(tell);
  } else if (state) tab.postMessage(state);
}

function hangUp() {
  close?.();
  close = null;
}

addEventListener('connect', ({ ports: [tab] }) => {
  tab.onmessage = ({ data }) => {
    if (data === 'join') join(tab);
    if (data === 'leave') tabs.delete(tab);
    if (data === 'sign_out') {
      hangUp();
      tell({ state: 'signed_out' });
    }
    if (!tabs.size) hangUp();
  };
});
