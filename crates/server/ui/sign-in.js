// Owns the sign-in view; it never stores a password or a token.
//
// A user signs in by username and password, with a token, or with the identity provider.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';

/** Errors of a sign-in with the identity provider. */
const PROVIDER_PROBLEMS = {
  expired: 'The sign-in expired or was started in another browser. Try again.',
  refused: 'The identity provider denied the sign-in.',
  no_role: 'Your account has no role on this server. Ask an administrator.',
  no_name: 'The identity provider sent no valid username. Ask an administrator.',
  name_taken: 'Another account already has your username. Ask an administrator.',
  blocked: 'Too many failed sign-ins from your address. Try again in 15 minutes.',
  failed: 'The sign-in failed. See the server log for the reason.',
};

export const providerError = (code) => PROVIDER_PROBLEMS[code] ?? PROVIDER_PROBLEMS.failed;

/**
 * The storage key of the route to restore after a sign-in with the provider, which returns to the
 * start of the page.
 */
const RETURN_TO = 'taskd.left-at';

/** Restores that route. */
export function restorePlace() {
  const place = sessionStorage.getItem(RETURN_TO);
  sessionStorage.removeItem(RETURN_TO);
  if (place && !location.hash) history.replaceState(null, '', place);
}

/**
 * Reads the parameters of a link, `/#token=…` or `/#problem=…`, and removes them from the address
 * bar and the history, where `before` replaces them.
 */
export function takeLinkParameters(before = location.pathname) {
  const parameters = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  if (parameters.token || parameters.problem) history.replaceState(null, '', before);
  return parameters;
}

/** The credentials of a form, trimmed except for the password. */
function credentialsOf(event) {
  event.preventDefault();
  const fields = Object.fromEntries(new FormData(event.currentTarget));
  return fields.token
    ? { token: fields.token.trim() }
    : { user: fields.user.trim(), password: fields.password };
}

/** The view. `token` comes from a link; `signIn` gets `{ user, password }` or `{ token }`. */
export const signInView = ({ provider, problem, token, isSigningIn }, signIn) => html`
  <main class="sign-in">
    <h1>taskd</h1>
    ${
      provider
        ? html`<p><a class="button by-provider" href=${provider.url}
            @click=${() => sessionStorage.setItem(RETURN_TO, location.hash)}
            >Sign in with ${provider.title}</a></p>`
        : nothing
    }
    <form class="by-password" @submit=${(event) => signIn(credentialsOf(event))}>
      <label for="user">Username</label>
      <input id="user" name="user" required ?autofocus=${!token}
        autocomplete="username" autocapitalize="none" spellcheck="false">
      <label for="password">Password</label>
      <input id="password" name="password" type="password" required
        autocomplete="current-password" aria-describedby="problem">
      <button class="primary" ?disabled=${isSigningIn}>Sign in</button>
      <p id="problem" class="bad" role="alert">${problem ?? ''}</p>
    </form>
    <details ?open=${Boolean(token)}>
      <summary>Sign in with a token</summary>
      <form class="by-token" @submit=${(event) => signIn(credentialsOf(event))}>
        <label for="token">Token</label>
        <input id="token" name="token" type="password" required autocomplete="off"
          spellcheck="false" aria-describedby="hint problem" .value=${token ?? ''}>
        ${
          token
            ? html`<p id="of-link">This token comes from a link. Use it only if you trust the
                sender.</p>`
            : nothing
        }
        <button class="primary" aria-describedby=${token ? 'of-link' : nothing}
          ?disabled=${isSigningIn}>Sign in with token</button>
      </form>
      <p id="hint" class="quiet">Tokens start with <code>tsko_</code>. The server writes the first
        one to <code>operator.token</code> in its data directory.</p>
    </details>
  </main>`;
