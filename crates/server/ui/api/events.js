// Events of the server for this tab, through the worker that all tabs share, or directly in
// browsers without shared workers.

import { openStream } from './stream.js';

/**
 * Subscribes to the stream; `onMessage` gets its messages. Returns `stop` (for this tab) and
 * `signOut` (for all tabs). With `isNew`, a session has just begun: the stream of the previous user
 * ends, and the other tabs are signed out.
 */
export function subscribe(onMessage, { isNew }) {
  if (typeof SharedWorker === 'undefined') return direct(onMessage);
  const worker = new SharedWorker('/ui/api/worker.js', { type: 'module', name: 'taskd' });
  const { port } = worker;
  const join = () => port.postMessage('join');
  const leave = () => port.postMessage('leave');
  const signOut = () => port.postMessage('sign_out');
  const end = new AbortController();
  const stop = () => {
    end.abort();
    leave();
  };
  const shared = { stop, signOut };
  // Some browsers support shared workers, but no modules in them.
  worker.onerror = () => end.signal.aborted || Object.assign(shared, direct(onMessage));
  port.onmessage = ({ data }) => end.signal.aborted || onMessage(data);
  // A port does not report that its tab has closed, and a tab may return from the back-forward
  // cache.
  addEventListener('pagehide', leave, { signal: end.signal });
  addEventListener('pageshow', ({ persisted }) => persisted && join(), { signal: end.signal });
  // This tab has not joined the worker yet, so it is not signed out.
  if (isNew) signOut();
  join();
  return shared;
}

function direct(onMessage) {
  const stop = openStream(onMessage);
  return { stop, signOut: stop };
}
