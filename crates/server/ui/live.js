// What the server tells this tab: through the worker that all tabs share, or directly where a browser has none.

import { openStream } from './stream.js';

/** Starts listening; `hear` gets the stream's messages. Returns `stop` (this tab) and `signOut` (all tabs). */
export function listen(hear) {
  if (typeof SharedWorker === 'undefined') return direct(hear);
  const worker = new SharedWorker('/ui/worker.js', { type: 'module', name: 'taskd' });
  const { port } = worker;
  const join = () => port.postMessage('join');
  const leave = () => port.postMessage('leave');
  const end = new AbortController();
  const stop = () => {
    end.abort();
    leave();
  };
  const shared = { stop, signOut: () => port.postMessage('sign_out') };
  // A browser that knows shared workers, but not modules in them.
  worker.onerror = () => end.signal.aborted || Object.assign(shared, direct(hear));
  port.onmessage = ({ data }) => hear(data);
  // A port does not tell when its tab is gone, and a tab may come back from the browser's cache.
  addEventListener('pagehide', leave, { signal: end.signal });
  addEventListener('pageshow', ({ persisted }) => persisted && join(), { signal: end.signal });
  join();
  return shared;
}

function direct(hear) {
  const stop = openStream(hear);
  return { stop, signOut: stop };
}
