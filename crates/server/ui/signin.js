// Signing in: by name and password, with a token, or by the provider there is.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';

/** Why the provider's way in led nowhere. */
const PROVIDER_PROBLEMS = {
  expired: 'Signing in took too long or was begun in another browser. Try again.',
  refused: 'The provider did not let you in.',
  no_role: 'You have no role here. Ask an administrator.',
  no_name: 'The provider has no name for you that can be used here. Ask an administrator.',
  name_taken: 'Somebody else has your name here. Ask an administrator.',
  blocked: 'Too many sign-ins failed from your address. Try again in a quarter of an hour.',
  failed: 'Signing in by the provider failed. The server\u2019s log says why.',
};

export const problemOfProvider = (code) => PROVIDER_PROBLEMS[code] ?? PROVIDER_PROBLEMS.failed;

export const RESTARTED =
  'The server was restarted, which ended your session. Sign in again to go on where you were.';

/**
 * Where in the page somebody was who has gone to the provider, in this tab: it sends them back to
 * the page's beginning.
 */
const LEFT_AT = 'taskd.left-at';

/** Goes on there. */
export function comeBack() {
  const place = sessionStorage.getItem(LEFT_AT);
  sessionStorage.removeItem(LEFT_AT);
  if (place && !location.hash) history.replaceState(null, '', place);
}

/**
 * What a link says, `/#token=…` or `/#problem=…`, which then leaves the address bar and the
 * history: `before` takes its place.
 */
export function ofLink(before = location.pathname) {
  const said = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  if (said.token || said.problem) history.replaceState(null, '', before);
  return said;
}

/** What a form holds, without the spaces that come with pasting; they belong to a password. */
function whoOf(event) {
  event.preventDefault();
  const fields = Object.fromEntries(new FormData(event.currentTarget));
  return fields.token
    ? { token: fields.token.trim() }
    : { user: fields.user.trim(), password: fields.password };
}

/** The view. `token` is what a link brought; `signIn` gets `{ user, password }` or `{ token }`. */
export const signInView = ({ provider, problem, token, isSigningIn }, signIn) => html`
  <main class="sign-in">
    <h1>taskd</h1>
    ${provider ? html`<p><a class="button by-provider" href=${provider.url} @click=${() => sessionStorage.setItem(LEFT_AT, location.hash)}>Sign in with ${provider.title}</a></p>` : nothing}
    <form class="by-password" @submit=${(event) => signIn(whoOf(event))}>
      <label for="user">Name</label>
      <input id="user" name="user" required ?autofocus=${!token} autocomplete="username" autocapitalize="none" spellcheck="false">
      <label for="password">Password</label>
      <input id="password" name="password" type="password" required autocomplete="current-password" aria-describedby="problem">
      <button class="primary" ?disabled=${isSigningIn}>Sign in</button>
      <p id="problem" class="bad" role="alert">${problem ?? ''}</p>
    </form>
    <details ?open=${Boolean(token)}>
      <summary>With a token</summary>
      <form class="by-token" @submit=${(event) => signIn(whoOf(event))}>
        <label for="token">Token</label>
        <input id="token" name="token" type="password" required autocomplete="off" spellcheck="false" aria-describedby="hint problem" .value=${token ?? ''}>
        ${token ? html`<p id="of-link">A link brought this token. Use it only if you know from whom it comes.</p>` : nothing}
        <button class="primary" aria-describedby=${token ? 'of-link' : nothing} ?disabled=${isSigningIn}>Sign in with it</button>
      </form>
      <p id="hint" class="quiet">It starts with <code>tsko_</code>. The first one lies in the server's data directory, in <code>operator.token</code>.</p>
    </details>
  </main>`;
