// Owns the start of the page: the session, the messages of the event stream, the choice of the view
// and the frame around it; it never draws the content of a view.
//
// A view is a class with `constructor(app)`, `onNavigate(route)` for changes of the query or of
// later path segments, and `draw(now)`, which returns a template. Optional are `afterDraw()`,
// `onEvent(event)` for each event of the stream, `refresh()` when the stream is back and fetched
// data may be stale, `onKey(event)` for otherwise unhandled keys (returns whether it handled the
// key), `isUnsaved`, and `leave()`. All views share `app`, below.

import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing, render } from './vendor/lit-html-3.3.3/lit-html.js';
import * as api from './api/api.js';
import { subscribe } from './api/events.js';
import { DeploymentView } from './deployments/deployment.js';
import { DeploymentsView } from './deployments/deployments.js';
import { preserveFocus } from './display/cursor.js';
import {
  closeDialog,
  dialogView,
  isDialogOpen,
  syncDialog,
  handleDialogKey,
} from './display/dialog.js';
import { change, setRenderer } from './display/display.js';
import { ago, plural } from './display/format.js';
import { showHelp } from './display/help.js';
import { notifyError, hide as hideNotice, noticeView } from './display/notice.js';
import { hrefTo, currentRoute } from './display/router.js';
import { statusDot } from './display/status.js';
import { Fleet, Selection } from './fleet.js';
import { PackageView } from './packages/package.js';
import { PackagesView } from './packages/packages.js';
import { Uploads } from './packages/uploads.js';
import { RobotView } from './robots/robot.js';
import { RobotsView } from './robots/robots.js';
import { ServerView } from './server/server.js';
import { SettingsView } from './server/settings.js';
import { restorePlace, takeLinkParameters, providerError, signInView } from './sign-in.js';

const REFETCH_PAUSE_MS = 2_000;
const MAX_PAUSE_MS = 30_000;
/** The storage key of the server version for which this tab was reloaded. */
const RELOADED_FOR = 'taskd.renewed';

/** The sections with their views: of the list and of one item. */
const SECTIONS = [
  { id: 'robots', title: 'Robots', List: RobotsView, Detail: RobotView },
  { id: 'packages', title: 'Packages', List: PackagesView, Detail: PackageView },
  { id: 'deployments', title: 'Deployments', List: DeploymentsView, Detail: DeploymentView },
  { id: 'server', title: 'Server', List: ServerView },
  { id: 'settings', title: 'Settings', List: SettingsView },
];

/** The state and helpers that all views share. */
const app = {
  fleet: new Fleet(),
  /** Selected robots. The selection survives changes of the view. */
  selection: new Selection(),
  /** Uploads of packages. */
  uploads: new Uploads(),
  /** The signed-in user. */
  me: null,
  /** The server's time. */
  now: () => Date.now() + page.clockAheadMs,
  /**
   * Whether the user has this permission: `read`, `operate`, `publish`, `maintain`, `administer`.
   */
  can: (permission) => Boolean(app.me?.permissions.includes(permission)),
  /**
   * Runs an action that may fail, and shows its error as a notification. Returns the result, or
   * nothing.
   */
  async attempt(action) {
    try {
      return await action();
    } catch (error) {
      if (error instanceof api.SignedOut) endSession();
      else notifyError(error.message);
      return undefined;
    }
  },
};

const page = {
  /** `starting`, `signed_out` or `in`. */
  state: 'starting',
  view: null,
  /** Identifies the view: the view is replaced when this changes. */
  viewKey: null,
  section: SECTIONS[0],
  stream: { state: 'connecting' },
  /**
   * Events that arrive while the lists are loading: newer than the lists, or followed by newer
   * events.
   */
  backlog: null,
  lastEventAt: null,
  /** The identity provider, if one is configured. */
  provider: null,
  /** The token of a link. */
  token: null,
  clockAheadMs: 0,
  /** The server version when this page was loaded, and the latest reported version. */
  version: null,
  serverVersion: null,
  problem: null,
  isSigningIn: false,
  /** Whether the lists have to be fetched again. */
  isStale: false,
  /** The number of consecutive failures of that. */
  failures: 0,
  /** Ends the pause before the next attempt. */
  skipPause: null,
};

let live = null;

// Signing in and out

async function start({ token, problem } = takeLinkParameters()) {
  try {
    const { expires_at_ms: until, provider } = await api.session();
    page.provider = provider;
    if (until) {
      restorePlace();
      showPage();
    } else showSignIn(problem ? providerError(problem) : null);
    if (token) offerToken(token);
  } catch (error) {
    change(() => (page.problem = error.message));
    setTimeout(() => start({ token, problem }), REFETCH_PAUSE_MS);
  }
}

/**
 * Fills in a link's token for a signed-out user. Anyone can make such a link, so it never signs in
 * by itself.
 */
function offerToken(token) {
  if (page.state === 'in') return;
  change(() => (page.token = token));
  // After the frame that `change` requested.
  requestAnimationFrame(() => document.querySelector('.by-token button')?.focus());
}

async function signIn(credentials) {
  change(() => Object.assign(page, { isSigningIn: true, problem: null }));
  try {
    await api.signIn(credentials);
    showPage({ isNew: true });
  } catch (error) {
    showSignIn(error.message);
  }
}

/**
 * Shows the page for the current session; `isNew` says that the session has just begun in this tab.
 */
function showPage({ isNew = false } = {}) {
  live?.stop();
  change(() => {
    Object.assign(page, {
      state: 'in',
      problem: null,
      token: null,
      isSigningIn: false,
      stream: { state: 'connecting' },
    });
    reset();
    openView();
  });
  live = subscribe(onStreamMessage, { isNew });
}

function showSignIn(problem = null) {
  live?.stop();
  live = null;
  change(() => {
    closeDialog();
    Object.assign(page, { state: 'signed_out', problem, isSigningIn: false });
    reset();
  });
}

/**
 * Handles a session that ended without a sign-out in this tab. The server may have been restarted
 * with another provider since.
 */
async function endSession() {
  showSignIn();
  const { provider } = await api.session().catch(() => page);
  if (page.state === 'signed_out') change(() => (page.provider = provider));
}

/** Clears all data of the user, so that the next user sees none of it. */
function reset() {
  page.view?.leave?.();
  page.skipPause?.();
  hideNotice();
  app.uploads.stop();
  Object.assign(page, { view: null, viewKey: null, backlog: null, lastEventAt: null, failures: 0 });
  Object.assign(app, {
    fleet: new Fleet(),
    selection: new Selection(),
    uploads: new Uploads(),
    me: null,
  });
}

async function signOut() {
  try {
    await api.signOut();
  } catch (error) {
    // The session would still be valid, and scripts cannot remove the cookie.
    if (!(error instanceof api.SignedOut))
      return notifyError(`Could not sign out: ${error.message}`);
  }
  live?.signOut();
  showSignIn();
}

// Navigation

function openView() {
  const route = currentRoute();
  const [name, item] = route.path;
  const section = SECTIONS.find(({ id }) => id === name) ?? SECTIONS[0];
  const View = item && section.Detail ? section.Detail : section.List;
  const key = `${section.id} ${section.Detail ? (item ?? '') : ''}`;
  if (page.viewKey !== key) {
    page.view?.leave?.();
    Object.assign(page, { section, viewKey: key, view: new View(app) });
    scrollTo(0, 0);
  }
  page.view.onNavigate(route);
}

addEventListener('hashchange', ({ oldURL }) => {
  const { token } = takeLinkParameters(oldURL);
  if (token) offerToken(token);
  else if (page.state === 'in') change(openView);
});

// Events

function onStreamMessage({ state, events, retry_at, problem }) {
  if (!live) return;
  if (state === 'signed_out') return endSession();
  if (state) change(() => (page.stream = { state, retry_at, problem }));
  if (state === 'open') page.skipPause ? page.skipPause() : refetch();
  // Without a stream the page still shows the lists.
  if (state === 'waiting' && !app.fleet.isLoaded && !page.backlog) refetch();
  if (!events) return;
  page.lastEventAt = app.now();
  if (page.backlog) page.backlog.push(...events);
  else change(() => applyEvents(events));
}

function applyEvents(events) {
  const stale = events.map((event) => {
    page.view?.onEvent?.(event);
    return app.fleet.apply(event);
  });
  if (stale.includes(true)) refetch();
}

let refetchedAt = -Infinity;

/** Fetches the lists. Calls during a fetch cause one more fetch, after a pause. */
async function refetch() {
  page.isStale = Boolean(page.backlog);
  if (page.backlog) return;
  page.backlog = [];
  const listener = live;
  const isCurrent = () => live === listener && listener;
  await pause(refetchedAt + pauseAfter(page.failures) - performance.now());
  if (!isCurrent()) return;
  try {
    await fetchLists(isCurrent);
    if (!isCurrent()) return;
    page.failures = 0;
    page.view?.refresh?.();
  } catch (error) {
    if (!isCurrent()) return;
    if (error instanceof api.SignedOut) return endSession();
    Object.assign(page, { problem: error.message, isStale: true, failures: page.failures + 1 });
  }
  refetchedAt = performance.now();
  const events = page.backlog;
  page.backlog = null;
  change(() => applyEvents(events));
  if (page.isStale) refetch();
}

/** With jitter, so that pages do not all return to a recovering server at once. */
const pauseAfter = (failures) =>
  failures
    ? Math.min(REFETCH_PAUSE_MS * 2 ** failures, MAX_PAUSE_MS) * (0.5 + Math.random() / 2)
    : REFETCH_PAUSE_MS;

/** Waits this long, or until the stream is back. */
async function pause(ms) {
  if (ms <= 0) return;
  await new Promise((resume) => {
    page.skipPause = resume;
    setTimeout(resume, ms);
  });
  page.skipPause = null;
}

async function fetchLists(isCurrent) {
  const [server, me, deployments] = await Promise.all([
    api.get('/server'),
    api.get('/me'),
    api.deployments(),
  ]);
  if (!isCurrent()) return;
  const { fleet } = app;
  app.me = me;
  page.version ??= server.version;
  page.serverVersion = server.version;
  page.clockAheadMs = server.now_ms - Date.now();
  page.lastEventAt = app.now();
  page.problem = null;
  fleet.setDeployments(deployments);
  const ids = new Set();
  for await (const robots of api.robots()) {
    if (!isCurrent()) return;
    robots.forEach(({ id }) => ids.add(id));
    change(() => {
      fleet.add(robots);
      if (!fleet.isLoaded) fleet.sort();
    });
  }
  change(() => {
    fleet.retain(ids);
    fleet.isLoaded = true;
    fleet.sort();
  });
}

// Drawing

setRenderer((frame) => {
  if (page.state === 'starting')
    return render(page.problem ? html`<p class="bad">${page.problem}</p>` : nothing, document.body);
  if (page.state === 'signed_out') return render(signInView(page, signIn), document.body);
  app.fleet.sortIfDue(frame);
  app.selection.retain(app.fleet.robots);
  const giveFocusBack = preserveFocus();
  render(frameView(app.now()), document.body);
  giveFocusBack();
  page.view.afterDraw?.();
  syncDialog();
  if (page.serverVersion !== page.version && !isDialogOpen() && !hasUnsavedWork()) reloadOnce();
});

/** Whether a reload would lose typed text or uploads. */
function hasUnsavedWork() {
  const isTyping = document.activeElement?.matches(
    'input:not([type=checkbox], [type=radio]), textarea',
  );
  return isTyping || page.view.isUnsaved || !app.uploads.isEmpty;
}

/**
 * Reloads the page after a server upgrade. It does so once per version: two versions behind one
 * address would cause endless reloads.
 */
function reloadOnce() {
  if (sessionStorage.getItem(RELOADED_FOR) === page.serverVersion) return;
  sessionStorage.setItem(RELOADED_FOR, page.serverVersion);
  location.reload();
}

/**
 * Gives each view its own elements, so that no content, listeners or expanded state of the previous
 * view remain.
 */
const keyedByView = (view, drawn) =>
  repeat(
    [view],
    (one) => one,
    () => drawn,
  );

const frameView = (now) => html`
  <header class="top">
    <a class="skip" href="#main" @click=${skip}>Skip to content</a>
    <p class="brand"><a href=${hrefTo(['robots'])}>taskd</a></p>
    <nav aria-label="Main">${SECTIONS.map(
      ({ id, title }) =>
        html`<a href=${hrefTo([id])}
          aria-current=${page.section.id === id ? 'page' : nothing}>${title}</a>`,
    )}</nav>
    <p class="stream" role="status">${streamStatus(now)}</p>
    <p class="user">${app.me ? userText(app.me) : ''}</p>
    <button class="plain link" @click=${signOut}>Sign out</button>
  </header>
  <main id="main" tabindex="-1">
    ${page.problem ? html`<p class="bad" role="alert">▲ ${page.problem}</p>` : nothing}
    ${keyedByView(page.view, page.view.draw(now))}
  </main>
  ${dialogView()}
  ${noticeView()}`;

/** Moves the focus by script, because the hash of the address holds the route. */
function skip(event) {
  event.preventDefault();
  document.getElementById('main').focus();
}

/** The user and their scope. */
const userText = ({ name, scope }) => (scope.length ? `${name}, ${scope.join(' and ')}` : name);

/**
 * Times that change every second are hidden from screen readers, which would announce each change.
 */
function streamStatus(now) {
  const { state, retry_at, problem } = page.stream;
  if (state === 'open' && app.fleet.isLoaded) return statusDot(true, 'Live');
  const since = page.lastEventAt ? `; last update ${ago(page.lastEventAt, now)}` : '';
  if (state !== 'waiting')
    return statusDot(false, html`Connecting<span aria-hidden="true">${since}</span>`);
  const seconds = Math.max(0, Math.ceil((retry_at - Date.now()) / 1000));
  return statusDot(
    false,
    html`<span class="bad">Disconnected${problem ? ` (${problem})` : ''}<span
      aria-hidden="true">${since}; retrying in ${plural(seconds, 'second')}</span></span>`,
  );
}

// Keys

addEventListener('keydown', (event) => {
  if (
    page.state !== 'in' ||
    event.ctrlKey ||
    event.metaKey ||
    event.altKey ||
    handleDialogKey(event)
  )
    return;
  const isTyping = event.target.matches(
    'input:not([type=checkbox]), textarea, select, [contenteditable]',
  );
  const search = document.querySelector('input[type=search]');
  if (event.key === '/' && !isTyping && search) {
    event.preventDefault();
    search.focus();
    search.select();
  } else if (event.key === '?' && !isTyping) {
    event.preventDefault();
    showHelp();
  } else if ((!isTyping || event.target === search) && page.view?.onKey?.(event))
    event.preventDefault();
});

addEventListener('scroll', () => change(), { passive: true });
addEventListener('resize', () => change());
// Relative times and row positions need frames even without events.
setInterval(() => change(), 1_000);
start();
