// The page: signs in, listens, finds the view of the place somebody is at, and draws it once per
// frame.
//
// A view is a class: `constructor(app)`, `arrive(place)` when its place's query or later parts
// change, `draw(now)`, which answers a template, and, where it needs them, `drawn()` after the
// drawing, `hear(event)` for each event of the stream, `refresh()` when the stream has come back
// and what was fetched may be old, `key(event)` for a key that nothing else takes (answers whether
// it took it), and `leave()`. What every view may use is `app`, below.

import { html, nothing, render } from './vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from './vendor/lit-html-3.3.3/directives/repeat.js';
import * as api from './api.js';
import { holdFocus } from './cursor.js';
import {
  close as closeDialog,
  dialogView,
  isAsking,
  settleDialog,
  takesKey as dialogTakes,
} from './dialog.js';
import { Fleet, Selection } from './fleet.js';
import { ago, plural } from './format.js';
import { change, drawWith } from './frame.js';
import { showHelp } from './help.js';
import { listen } from './live.js';
import { complain, hide as hideNotice, noticeView } from './notice.js';
import { at, place } from './router.js';
import { comeBack, ofLink, problemOfProvider, RESTARTED, signInView } from './signin.js';
import { sign } from './signs.js';
import { DeploymentView } from './deployment.js';
import { DeploymentsView } from './deployments.js';
import { PackageView } from './package.js';
import { PackagesView } from './packages.js';
import { Uploads } from './packages/uploads.js';
import { RobotView } from './robot.js';
import { RobotsView } from './robots.js';
import { ServerView } from './server.js';
import { SettingsView } from './settings.js';

const REFETCH_PAUSE_MS = 2_000;
const LONGEST_PAUSE_MS = 30_000;
/** For which server the page was loaded anew, in this tab. */
const RENEWED = 'taskd.renewed';

/** The sections, and the views of what is in them. */
const SECTIONS = [
  { id: 'robots', title: 'Robots', list: RobotsView, one: RobotView },
  { id: 'packages', title: 'Packages', list: PackagesView, one: PackageView },
  { id: 'deployments', title: 'Deployments', list: DeploymentsView, one: DeploymentView },
  { id: 'server', title: 'Server', list: ServerView },
  { id: 'settings', title: 'Settings', list: SettingsView },
];

/** What every view may use. */
const app = {
  fleet: new Fleet(),
  /** Robots that were chosen, which stay so on the way to other views and back. */
  selection: new Selection(),
  /** Packages on their way to the server. */
  uploads: new Uploads(),
  /** Who is signed in. */
  me: null,
  /** The server's time. */
  now: () => Date.now() + page.clockAheadMs,
  /** Whether this person may do it: `read`, `operate`, `publish`, `maintain`, `administer`. */
  can: (permission) => Boolean(app.me?.permissions.includes(permission)),
  /** Does what may fail, and says so where everybody looks. Answers what `act` did, or nothing. */
  async attempt(act) {
    try {
      return await act();
    } catch (error) {
      if (error instanceof api.SignedOut) lose();
      else complain(error.message);
      return undefined;
    }
  },
};

const page = {
  /** `starting`, `signed_out` or `in`. */
  state: 'starting',
  view: null,
  /** Which view that is: views change when this does. */
  viewKey: null,
  section: SECTIONS[0],
  stream: { state: 'connecting' },
  /**
   * Heard while the lists are on their way: newer than the lists, or followed by something newer.
   */
  backlog: null,
  heardAt: null,
  /** Another way to sign in, if there is one. */
  provider: null,
  /** What a link brought to sign in with. */
  token: null,
  clockAheadMs: 0,
  /** The server's version when this page was loaded, and that of its last answer. */
  version: null,
  serverVersion: null,
  problem: null,
  isSigningIn: false,
  /** The lists have to be fetched once more. */
  isStale: false,
  /** How often in a row that failed. */
  failures: 0,
  /** Ends the pause before that. */
  hurry: null,
};

let live = null;

// Signing in and out

async function start({ token, problem } = ofLink()) {
  try {
    const { expires_at_ms: until, provider, ended_by_restart: isRestarted } = await api.session();
    page.provider = provider;
    if (until) {
      comeBack();
      enter();
    } else leave(problem ? problemOfProvider(problem) : isRestarted ? RESTARTED : null);
    if (token) offer(token);
  } catch (error) {
    change(() => (page.problem = error.message));
    setTimeout(() => start({ token, problem }), REFETCH_PAUSE_MS);
  }
}

/**
 * Leaves a link's token to who is not in: anybody can make such a link, so it signs nobody in by
 * itself.
 */
function offer(token) {
  if (page.state === 'in') return;
  change(() => (page.token = token));
  // After the drawing that was just asked for.
  requestAnimationFrame(() => document.querySelector('.by-token button')?.focus());
}

async function signIn(who) {
  change(() => Object.assign(page, { isSigningIn: true, problem: null }));
  try {
    await api.signIn(who);
    enter({ isNew: true });
  } catch (error) {
    leave(error.message);
  }
}

/** Goes in with the session there is; `isNew` says that it has just begun here. */
function enter({ isNew = false } = {}) {
  live?.stop();
  change(() => {
    Object.assign(page, {
      state: 'in',
      problem: null,
      token: null,
      isSigningIn: false,
      stream: { state: 'connecting' },
    });
    forget();
    arrive();
  });
  live = listen(hear, { isNew });
}

function leave(problem = null) {
  live?.stop();
  live = null;
  change(() => {
    closeDialog();
    Object.assign(page, { state: 'signed_out', problem, isSigningIn: false });
    forget();
  });
}

/** The session has ended without anybody's doing here. Says why, where the server knows. */
async function lose() {
  leave();
  const { provider, ended_by_restart: isRestarted } = await api.session().catch(() => ({}));
  if (page.state !== 'signed_out' || page.isSigningIn) return;
  change(() =>
    Object.assign(page, {
      provider: provider ?? page.provider,
      problem: page.problem ?? (isRestarted ? RESTARTED : null),
    }),
  );
}

/** Nothing of one person is shown to the next. */
function forget() {
  page.view?.leave?.();
  page.hurry?.();
  hideNotice();
  app.uploads.stop();
  Object.assign(page, { view: null, viewKey: null, backlog: null, heardAt: null, failures: 0 });
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
    // Whoever loads the page next would be in: scripts can't take the cookie away.
    if (!(error instanceof api.SignedOut)) return complain(`Signing out failed: ${error.message}`);
  }
  live?.signOut();
  leave();
}

// Finding the view

function arrive() {
  const here = place();
  const [name, one] = here.path;
  const section = SECTIONS.find(({ id }) => id === name) ?? SECTIONS[0];
  const View = one && section.one ? section.one : section.list;
  const key = `${section.id} ${section.one ? (one ?? '') : ''}`;
  if (page.viewKey !== key) {
    page.view?.leave?.();
    Object.assign(page, { section, viewKey: key, view: new View(app) });
    scrollTo(0, 0);
  }
  page.view.arrive(here);
}

addEventListener('hashchange', ({ oldURL }) => {
  const { token } = ofLink(oldURL);
  if (token) offer(token);
  else if (page.state === 'in') change(arrive);
});

// Listening

function hear({ state, events, retry_at, problem }) {
  if (!live) return;
  if (state === 'signed_out') return lose();
  if (state) change(() => (page.stream = { state, retry_at, problem }));
  if (state === 'open') page.hurry ? page.hurry() : refetch();
  // Without a stream there is still what the server lists.
  if (state === 'waiting' && !app.fleet.isLoaded && !page.backlog) refetch();
  if (!events) return;
  page.heardAt = app.now();
  if (page.backlog) page.backlog.push(...events);
  else change(() => take(events));
}

function take(events) {
  const stale = events.map((event) => {
    page.view?.hear?.(event);
    return app.fleet.apply(event);
  });
  if (stale.includes(true)) refetch();
}

let refetchedAt = -Infinity;

/** Fetches the lists; asked again meanwhile, it does so once more, but never without a pause. */
async function refetch() {
  page.isStale = Boolean(page.backlog);
  if (page.backlog) return;
  page.backlog = [];
  const listener = live;
  const isMine = () => live === listener && listener;
  await rest(refetchedAt + pauseAfter(page.failures) - performance.now());
  if (!isMine()) return;
  try {
    await fetchLists(isMine);
    if (!isMine()) return;
    page.failures = 0;
    page.view?.refresh?.();
  } catch (error) {
    if (!isMine()) return;
    if (error instanceof api.SignedOut) return lose();
    Object.assign(page, { problem: error.message, isStale: true, failures: page.failures + 1 });
  }
  refetchedAt = performance.now();
  const heard = page.backlog;
  page.backlog = null;
  change(() => take(heard));
  if (page.isStale) refetch();
}

/** Spread out, so that a server in trouble is not met by every page at once. */
const pauseAfter = (failures) =>
  failures
    ? Math.min(REFETCH_PAUSE_MS * 2 ** failures, LONGEST_PAUSE_MS) * (0.5 + Math.random() / 2)
    : REFETCH_PAUSE_MS;

/** Waits until then, or until the stream has come back. */
async function rest(ms) {
  if (ms <= 0) return;
  await new Promise((resume) => {
    page.hurry = resume;
    setTimeout(resume, ms);
  });
  page.hurry = null;
}

async function fetchLists(isMine) {
  const [server, me, deployments] = await Promise.all([
    api.get('/server'),
    api.get('/me'),
    api.deployments(),
  ]);
  if (!isMine()) return;
  const { fleet } = app;
  app.me = me;
  page.version ??= server.version;
  page.serverVersion = server.version;
  page.clockAheadMs = server.now_ms - Date.now();
  page.heardAt = app.now();
  page.problem = null;
  fleet.renew(deployments);
  const ids = new Set();
  for await (const robots of api.robots()) {
    if (!isMine()) return;
    robots.forEach(({ id }) => ids.add(id));
    change(() => {
      fleet.add(robots);
      if (!fleet.isLoaded) fleet.order();
    });
  }
  change(() => {
    fleet.keep(ids);
    fleet.isLoaded = true;
    fleet.order();
  });
}

// Drawing

drawWith((frame) => {
  if (page.state === 'starting')
    return render(page.problem ? html`<p class="bad">${page.problem}</p>` : nothing, document.body);
  if (page.state === 'signed_out') return render(signInView(page, signIn), document.body);
  app.fleet.settle(frame);
  app.selection.keep(app.fleet.robots);
  const giveFocusBack = holdFocus();
  render(frameView(app.now()), document.body);
  giveFocusBack();
  page.view.drawn?.();
  settleDialog();
  if (page.serverVersion !== page.version && !isAsking() && !isAtWork()) renew();
});

/** Whether something would be lost: what is typed, or what was chosen to be sent. */
function isAtWork() {
  const isTyping = document.activeElement?.matches(
    'input:not([type=checkbox], [type=radio]), textarea',
  );
  return isTyping || page.view.isUnsaved || !app.uploads.isEmpty;
}

/**
 * Loads the page that another server brings; once for each, lest two of them behind one address
 * make it load for ever.
 */
function renew() {
  if (sessionStorage.getItem(RENEWED) === page.serverVersion) return;
  sessionStorage.setItem(RENEWED, page.serverVersion);
  location.reload();
}

/**
 * A view gets elements of its own: what the one before has put into them, what listens to them and
 * what was unfolded is not its.
 */
const ofView = (view, drawn) =>
  repeat(
    [view],
    (one) => one,
    () => drawn,
  );

const frameView = (now) => html`
  <header class="top">
    <a class="skip" href="#main" @click=${skip}>Skip to the content</a>
    <p class="brand"><a href=${at(['robots'])}>taskd</a></p>
    <nav aria-label="Sections">${SECTIONS.map(({ id, title }) => html`<a href=${at([id])} aria-current=${page.section.id === id ? 'page' : nothing}>${title}</a>`)}</nav>
    <p class="stream" role="status">${streamState(now)}</p>
    <p class="who">${app.me ? whoIsIt(app.me) : ''}</p>
    <button class="plain link" @click=${signOut}>Sign out</button>
  </header>
  <main id="main" tabindex="-1">
    ${page.problem ? html`<p class="bad" role="alert">▲ ${page.problem}</p>` : nothing}
    ${ofView(page.view, page.view.draw(now))}
  </main>
  ${dialogView()}
  ${noticeView()}`;

/** A link of a page whose addresses all begin with `#`. */
function skip(event) {
  event.preventDefault();
  document.getElementById('main').focus();
}

/** The person, and which robots they are limited to. */
const whoIsIt = ({ name, scope }) => (scope.length ? `${name}, ${scope.join(' and ')}` : name);

/** What moves on each second is for the eye only: read aloud, it would never stop. */
function streamState(now) {
  const { state, retry_at, problem } = page.stream;
  if (state === 'open' && app.fleet.isLoaded) return sign(true, 'Live');
  const since = page.heardAt ? `, shown as of ${ago(page.heardAt, now)}` : '';
  if (state !== 'waiting')
    return sign(false, html`Connecting<span aria-hidden="true">${since}</span>`);
  const seconds = Math.max(0, Math.ceil((retry_at - Date.now()) / 1000));
  return sign(
    false,
    html`<span class="bad">Not live${problem ? ` (${problem})` : ''}<span aria-hidden="true">${since}; trying again in ${plural(seconds, 'second')}</span></span>`,
  );
}

// Keys

addEventListener('keydown', (event) => {
  if (page.state !== 'in' || event.ctrlKey || event.metaKey || event.altKey || dialogTakes(event))
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
  } else if ((!isTyping || event.target === search) && page.view?.key?.(event))
    event.preventDefault();
});

addEventListener('scroll', () => change(), { passive: true });
addEventListener('resize', () => change());
// Times move on, and rows find their places, also while nothing is heard.
setInterval(() => change(), 1_000);
start();
