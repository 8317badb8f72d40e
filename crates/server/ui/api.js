// The JSON API as this page uses it. It knows no state and draws nothing.

const BASE = '/api/v1';
const PATIENCE_MS = 30_000;

/** The server does not know who is asking: time to sign in. */
export class SignedOut extends Error {}

/** Asks the server; answers the parsed body. Throws `SignedOut` on 401 and an `Error` a person can read on the rest. */
async function ask(method, path, body) {
  const response = await fetch(BASE + path, {
    method,
    headers: body ? { 'content-type': 'application/json' } : {},
    body: body && JSON.stringify(body),
    signal: AbortSignal.timeout(PATIENCE_MS),
  });
  if (response.ok) return response.status === 204 ? null : response.json();
  const said = await response.json().catch(() => null);
  const message = said?.error?.message ?? `the server answered ${response.status}`;
  throw response.status === 401 ? new SignedOut(message) : new Error(message);
}

export const session = () => ask('GET', '/session');
/** With `{ user, password }` or `{ token }`. */
export const signIn = (who) => ask('POST', '/session', who);
export const me = () => ask('GET', '/me');
export const signOut = () => ask('DELETE', '/session');
export const server = () => ask('GET', '/server');

export const robotOutputs = async (robot) => ask('GET', `/outputs?robot=${robot}`);

/** Everything the page shows, as it is now. */
export async function lists() {
  const [robots, deployments] = await Promise.all(['/robots', '/deployments'].map((path) => ask('GET', path)));
  return { robots: robots.robots, deployments: deployments.deployments };
}
