// Owns requests to the server, and its stream of events; it holds no state of the fleet and draws
// nothing.
//
// This module is the client of the JSON API.

const BASE = '/api/v1';
const TIMEOUT_MS = 30_000;

/** The session has ended or the token is invalid: the user has to sign in. */
export class SignedOut extends Error {}

/** The server refused the request: `code` is for programs, the message for users. */
class ApiError extends Error {
  constructor(status, error) {
    super(error?.message ?? `the server responded with status ${status}`);
    this.status = status;
    this.code = error?.code;
  }
}

/**
 * The number of attempts for a request that the server is too busy for, and the longest
 * `Retry-After` that is followed.
 */
const MAX_ATTEMPTS = 4;
const MAX_WAIT_S = 15;

/**
 * Sends a request, and repeats it after 429 with a short `Retry-After`: the server has not
 * processed it then. Longer waits, as after failed sign-ins, are reported at once.
 */
async function send(url, options) {
  for (let attempt = 1; ; attempt += 1) {
    const response = await fetch(url, { ...options, signal: AbortSignal.timeout(TIMEOUT_MS) });
    const wait = Number(response.headers.get('retry-after') ?? Infinity);
    if (response.status !== 429 || attempt >= MAX_ATTEMPTS || !(wait <= MAX_WAIT_S))
      return response;
    // With jitter, since many pages may wait.
    await new Promise((resume) => setTimeout(resume, (wait + Math.random()) * 1000));
  }
}

/**
 * Sends a request and returns the parsed body. Throws `SignedOut` on 401 and `ApiError` on other
 * refusals.
 */
async function request(method, path, { body, query = {}, headers = {}, reviver } = {}) {
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
    return response.status === 204 ? null : JSON.parse(await response.text(), reviver);
  const answer = await response.json().catch(() => null);
  if (response.status === 401) throw new SignedOut(answer?.error?.message);
  throw new ApiError(response.status, answer?.error);
}

export const get = (path, query) => request('GET', path, { query });
export const post = (path, body, headers) => request('POST', path, { body, headers });
export const patch = (path, body) => request('PATCH', path, { body });
export const remove = (path) => request('DELETE', path);

/**
 * Uploads a file without a time limit and returns the parsed body. `onProgress` gets the number of
 * bytes sent, which is why this uses XMLHttpRequest and not `fetch`. `signal` cancels the upload.
 */
export function upload(path, blob, type, { onProgress, signal }) {
  return new Promise((resolve, reject) => {
    signal.throwIfAborted();
    const xhr = new XMLHttpRequest();
    xhr.open('POST', BASE + path);
    xhr.setRequestHeader('content-type', type);
    xhr.upload.onprogress = ({ loaded }) => onProgress(loaded);
    xhr.onerror = () => reject(new Error('Connection lost.'));
    xhr.onabort = () => reject(new Error('Upload cancelled.'));
    xhr.onload = () => {
      const answer = parseJson(xhr.responseText);
      if (xhr.status < 300) resolve(answer);
      else if (xhr.status === 401) reject(new SignedOut(answer?.error?.message));
      else reject(new ApiError(xhr.status, answer?.error));
    };
    signal.addEventListener('abort', () => xhr.abort());
    xhr.send(blob);
  });
}

function parseJson(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

/** A POST that may be repeated without a second effect, as long as the key stays the same. */
export const postIdempotent = (path, body, key) => post(path, body, { 'idempotency-key': key });

/** An idempotency key. The browser's own UUIDs need https. */
export const newIdempotencyKey = () =>
  Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) =>
    byte.toString(16).padStart(2, '0'),
  ).join('');

export const session = () => get('/session');
/** With `{ user, password }` or `{ token }`. */
export const signIn = (credentials) => post('/session', credentials);
export const signOut = () => remove('/session');

/** One page of deployments: the newest, or those older than `before`. */
export const deployments = (before) => get('/deployments', { limit: 200, before });

const PAGE = 1_000;

/** All robots in pages, so that the first are drawn while the rest is loading. */
export async function* robots() {
  // The first page is short, so that it fills the screen quickly.
  for (let after, limit = 100; ; limit = PAGE) {
    const page = await get('/robots', { limit, after });
    yield page.robots;
    if (!page.next) return;
    after = page.next;
  }
}

/**
 * Sends a query to a robot and returns the answer, parsed with `reviver` as by `JSON.parse`. Throws
 * if the robot or the server refuses.
 */
export const askRobot = (robot, query, reviver) =>
  request('POST', `/robots/${robot}/ask`, { body: query, reviver });
