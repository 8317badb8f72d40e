// What the server tells this tab: through the worker that all tabs share, or directly where a browser has none.

import { openStream } from './stream.js';

/** Starts listening; `hear` gets the stream's messages. Returns `stop` (this tab) and `signOut` (all tabs). */
export function listen(hear) {
  if (typeof SharedWorker === 'undefined') {
    const stop = openStream(hear);
    return { stop, signOut: stop };
  }
  const { port } = new SharedWorker('/ui/worker.js', { type: 'module', name: 'taskd' });
  const join = () => port.postMessage('join');
  const leave = () => port.postMessage('leave');
  port.onmessage = ({ data }) => hear(data);
  // A port does not tell when its tab is gone, and a tab may come back from the browser's cache.
  addEventListener('pagehide', leave);
  addEventListener('pageshow', ({ persisted }) => persisted && join());
  join();
  return { stop: leave, signOut: () => port.postMessage('sign_out') };
}
