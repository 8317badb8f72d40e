// What the server tells this tab: through the worker that all tabs share, or directly where a
// browser has none.

import { openStream } from './stream.js';

/**
 * Starts listening; `hear` gets the stream's messages. Returns `stop` (this tab) and `signOut` (all
 * tabs). With `isNew`, a session has just begun: the stream of whoever was in before ends, and the
 * other tabs are signed out.
 */
export function listen(hear, { isNew }) {
  if (typeof SharedWorker === 'undefined') return direct(hear);
  const worker = new SharedWorker('/ui/worker.js', { type: 'module', name: 'taskd' });
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
  // A browser that knows shared workers, but not modules in them.
  worker.onerror = () => end.signal.aborted || Object.assign(shared, direct(hear));
  port.onmessage = ({ data }) => end.signal.aborted || hear(data);
  // A port does not tell when its tab is gone, and a tab may come back from the browser's cache.
  addEventListener('pagehide', leave, { signal: end.signal });
  addEventListener('pageshow', ({ persisted }) => persisted && join(), { signal: end.signal });
  // This tab is none of the worker's yet.
  if (isNew) signOut();
  join();
  return shared;
}

function direct(hear) {
  const stop = openStream(hear);
  return { stop, signOut: stop };
}
