// The JSON API as this page uses it. It knows no state and draws nothing.

const BASE = '/api/v1';
const PATIENCE_MS = 30_000;

/** The server does not know who is asking: time to sign in. */
export class SignedOut extends Error {}

/** The server refused: `code` is for programs, the message for people. */
class Refused extends Error {
  constructor(status, error) {
    super(error?.message ?? `the server answered ${status}`);
    this.status = status;
    this.code = error?.code;
  }
}

/**
 * How often a request is sent that the server has no time for, and what it may ask to be waited in
 * between.
 */
const TRIES = 4;
const LONGEST_WAIT_S = 15;

/**
 * Sends a request, again where the server says soon when: it has done nothing of it. Nobody waits
 * for a sign-in that is refused for long.
 */
async function send(url, options) {
  for (let tried = 1; ; tried += 1) {
    const response = await fetch(url, { ...options, signal: AbortSignal.timeout(PATIENCE_MS) });
    const wait = Number(response.headers.get('retry-after') ?? Infinity);
    if (response.status !== 429 || tried >= TRIES || !(wait <= LONGEST_WAIT_S)) return response;
    // Not all at once, where many wait.
    await new Promise((resume) => setTimeout(resume, (wait + Math.random()) * 1000));
  }
}

/**
 * Asks the server; answers the parsed body. Throws `SignedOut` on 401 and `Refused` on the rest.
 */
async function ask(method, path, { body, query = {}, headers = {}, revive } = {}) {
  const given = Object.entries(query).filter(
    ([, value]) => value !== undefined && value !== null && value !== '',
  );
  const search = given.length ? `?${new URLSearchParams(given)}` : '';
  const response = await send(BASE + path + search, {
    method,
    headers: body ? { 'content-type': 'application/json', ...headers } : headers,
    body: body && JSON.stringify(body),
  });
  if (response.ok)
    return response.status === 204 ? null : JSON.parse(await response.text(), revive);
  const said = await response.json().catch(() => null);
  if (response.status === 401) throw new SignedOut(said?.error?.message);
  throw new Refused(response.status, said?.error);
}

export const get = (path, query) => ask('GET', path, { query });
export const post = (path, body, headers) => ask('POST', path, { body, headers });
export const patch = (path, body) => ask('PATCH', path, { body });
export const remove = (path) => ask('DELETE', path);

/**
 * Sends a file's bytes, for as long as it takes; answers the parsed body. `told` gets how many have
 * gone. By the older kind of request, because `fetch` does not say that. `signal` breaks it off.
 */
export function upload(path, blob, type, { told, signal }) {
  return new Promise((resolve, reject) => {
    signal.throwIfAborted();
    const request = new XMLHttpRequest();
    request.open('POST', BASE + path);
    request.setRequestHeader('content-type', type);
    request.upload.onprogress = ({ loaded }) => told(loaded);
    request.onerror = () => reject(new Error('The connection broke.'));
    request.onabort = () => reject(new Error('Broken off.'));
    request.onload = () => {
      const said = parsed(request.responseText);
      if (request.status < 300) resolve(said);
      else if (request.status === 401) reject(new SignedOut(said?.error?.message));
      else reject(new Refused(request.status, said?.error));
    };
    signal.addEventListener('abort', () => request.abort());
    request.send(blob);
  });
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

/**
 * An order that may be sent again without ordering it twice: with the same key as long as the same
 * thing is meant.
 */
export const order = (path, body, key) => post(path, body, { 'idempotency-key': key });

/** A key for one order. The browser's own UUIDs need https. */
export const newKey = () =>
  Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) =>
    byte.toString(16).padStart(2, '0'),
  ).join('');

export const session = () => get('/session');
/** With `{ user, password }` or `{ token }`. */
export const signIn = (who) => post('/session', who);
export const signOut = () => remove('/session');

/** The newest deployments, or those after `before`: a page of them. */
export const deployments = (before) => get('/deployments', { limit: 200, before });

const PAGE = 1_000;

/** All robots, page by page, so that the first are drawn while the rest is on its way. */
export async function* robots() {
  // The first page is what fits the screen, and comes at once.
  for (let after, limit = 100; ; limit = PAGE) {
    const page = await get('/robots', { limit, after });
    yield page.robots;
    if (!page.next) return;
    after = page.next;
  }
}

/**
 * Asks a robot something; answers what it answered, read with `revive` as by `JSON.parse`. Throws
 * what it refused.
 */
export const askRobot = (robot, question, revive) =>
  ask('POST', `/robots/${robot}/ask`, { body: question, revive });
