// The shared worker: one event stream for all tabs, since a browser allows six connections per
// server. It forwards messages without reading them.

import { openStream } from './stream.js';

const tabs = new Set();
let close = null;
let state = null;

function broadcast(message) {
  if (message.state) state = message;
  if (message.state === 'signed_out') close = null;
  for (const tab of tabs) tab.postMessage(message);
}

function join(tab) {
  tabs.add(tab);
  if (!close) {
    state = null;
    close = openStream(broadcast);
  } else if (state) tab.postMessage(state);
}

function disconnect() {
  close?.();
  close = null;
}

addEventListener('connect', ({ ports: [tab] }) => {
  tab.onmessage = ({ data }) => {
    if (data === 'join') join(tab);
    if (data === 'leave') tabs.delete(tab);
    if (data === 'sign_out') {
      disconnect();
      broadcast({ state: 'signed_out' });
    }
    if (!tabs.size) disconnect();
  };
});
