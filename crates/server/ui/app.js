// The page: signs in, listens, and draws once per frame whatever has changed. All views are functions of `page`.

import { html, nothing, render } from './vendor/lit-html-3.3.3/lit-html.js';
import * as api from './api.js';
import { command } from './copy.js';
import { deploymentList } from './deployments.js';
import { Fleet } from './fleet.js';
import { ago, number, plural } from './format.js';
import { listen } from './live.js';
import { drawMaps, Outputs } from './outputs.js';
import { robotDialog } from './robot.js';
import { Layout, robotTable, sign } from './robots.js';

const REFETCH_PAUSE_MS = 2_000;

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

const page = {
  view: 'starting',
  fleet: new Fleet(),
  stream: { state: 'connecting' },
  /** Heard while the lists are on their way: newer than the lists, or followed by something newer. */
  backlog: null,
  heardAt: null,
  /** Who is signed in. */
  me: null,
  /** Another way to sign in, if there is one. */
  provider: null,
  clockAheadMs: 0,
  problem: null,
  isSigningIn: false,
  robot: null,
  isAllShown: false,
  /** The person, not the stream, has changed which rows stand where. */
  isRearranged: false,
  /** The lists have to be fetched once more. */
  isStale: false,
};

let live = null;
const outputs = new Outputs(() => change(() => {}));

const actions = {
  sortBy: (column) => rearrange(() => page.fleet.sortBy(column)),
  filterBy: (text) => rearrange(() => page.fleet.filterBy(text)),
  showAll: (yes) => change(() => (page.isAllShown = yes)),
  show: (robot) => change(() => (page.robot = robot)),
};

function rearrange(act) {
  page.isRearranged = true;
  change(act);
}

// Signing in and out

async function start({ token, problem } = ofLink()) {
  try {
    const { expires_at_ms: until, provider } = await api.session();
    page.provider = provider;
    if (token) signIn({ token });
    else if (until) enter();
    else leave(problem && (PROVIDER_PROBLEMS[problem] ?? PROVIDER_PROBLEMS.failed));
  } catch (error) {
    change(() => (page.problem = error.message));
    setTimeout(() => start({ token, problem }), REFETCH_PAUSE_MS);
  }
}

/** What a link says, `/#token=…` or `/#problem=…`, which then leaves the address bar and the history. */
function ofLink() {
  const said = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  if (said.token || said.problem) history.replaceState(null, '', location.pathname);
  return said;
}

async function signIn(who) {
  change(() => Object.assign(page, { isSigningIn: true, problem: null }));
  try {
    await api.signIn(who);
    enter();
  } catch (error) {
    leave(error.message);
  }
}

function enter() {
  live?.stop();
  change(() => Object.assign(page, { view: 'fleet', fleet: new Fleet(), problem: null, isSigningIn: false, stream: { state: 'connecting' } }));
  live = listen(hear);
}

/** What a form holds, without the spaces that come with pasting; they belong to a password. */
function signInWith(event) {
  event.preventDefault();
  const fields = Object.fromEntries(new FormData(event.currentTarget));
  signIn(fields.token ? { token: fields.token.trim() } : { user: fields.user.trim(), password: fields.password });
}

function leave(problem = null) {
  live?.stop();
  live = null;
  change(() => Object.assign(page, { view: 'signed_out', fleet: new Fleet(), problem, isSigningIn: false, robot: null }));
}

async function signOut() {
  await api.signOut().catch(() => null);
  live?.signOut();
  leave();
}

// Listening

function hear({ state, events, retry_at }) {
  if (!live) return;
  if (state === 'signed_out') return leave();
  if (state) change(() => (page.stream = { state, retry_at }));
  if (state === 'open') refetch();
  if (!events) return;
  page.heardAt = serverNow();
  if (page.backlog) page.backlog.push(...events);
  else change(() => take(events));
}

function take(events) {
  const stale = events.map((event) => page.fleet.apply(event));
  if (stale.includes(true)) refetch();
}

let refetchedAt = -Infinity;

/** Fetches the lists; asked again meanwhile, it does so once more, but never without a pause. */
async function refetch() {
  page.isStale = Boolean(page.backlog);
  if (page.backlog) return;
  page.backlog = [];
  const wait = refetchedAt + REFETCH_PAUSE_MS - performance.now();
  if (wait > 0) await new Promise((resume) => setTimeout(resume, wait));
  refetchedAt = performance.now();
  const listener = live;
  try {
    const [server, me, lists] = await Promise.all([api.server(), api.me(), api.lists()]);
    if (live !== listener) return;
    page.me = me;
    page.clockAheadMs = server.now_ms - Date.now();
    page.heardAt = serverNow();
    page.problem = null;
    page.fleet.load(lists);
  } catch (error) {
    if (error instanceof api.SignedOut) leave();
    else page.problem = error.message;
    page.isStale = true;
  } finally {
    const heard = page.backlog;
    page.backlog = null;
    if (live === listener) change(() => take(heard));
    if (live && page.isStale) refetch();
  }
}

// Drawing

let isDirty = false;

function change(act) {
  act();
  if (!isDirty) requestAnimationFrame(paint);
  isDirty = true;
}

const serverNow = () => Date.now() + page.clockAheadMs;

function paint(frame) {
  isDirty = false;
  if (page.view === 'starting') return render(page.problem ? html`<p class="bad">${page.problem}</p>` : nothing, document.body);
  if (page.view === 'signed_out') return render(signInView(), document.body);
  page.fleet.settle(frame);
  const layout = new Layout(page.fleet);
  const scrolled = keepInPlace(layout);
  const rows = document.querySelector('.rows');
  const top = (rows?.getBoundingClientRect().top ?? 0) - scrolled;
  const sight = layout.sight(-top, innerHeight - top);
  render(fleetView(sight), document.body);
  // Through the style objects: the policy of this page allows no style attributes.
  document.querySelector('.rows').style.height = `${layout.height}px`;
  document.querySelector('.sight').style.transform = `translateY(${sight.offset}px)`;
  if (scrolled) scrollBy(0, scrolled);
  const dialog = document.querySelector('dialog');
  if (page.robot && !dialog.open) dialog.showModal();
  outputs.show(page.robot, momentOf(page.fleet.robots.get(page.robot)));
  drawMaps();
}

/** Changes whenever a robot may have brought something back: each time one of its tasks stands elsewhere. */
const momentOf = (robot) => robot?.tasks.map(({ task, run, phase }) => `${task} ${run} ${phase}`).join();

/** How far to scroll so that the row at the table's upper edge stays where it is, though rows above it grow or shrink. */
function keepInPlace(layout) {
  const rows = document.querySelector('.rows');
  const head = document.querySelector('.row.head');
  const wasRearranged = page.isRearranged;
  page.isRearranged = false;
  if (!rows || wasRearranged) return 0;
  const edge = head.getBoundingClientRect().bottom;
  const { left, top } = rows.getBoundingClientRect();
  if (top >= edge) return 0;
  const row = document.elementFromPoint(left + 1, edge + 1)?.closest('[data-robot]');
  const index = row ? layout.ids.indexOf(row.dataset.robot) : -1;
  return index < 0 ? 0 : Math.round(top + layout.top(index) - row.getBoundingClientRect().top);
}

const signInView = () => html`
  <main class="sign-in">
    <h1>taskd</h1>
    ${page.provider ? html`<p><a class="button by-provider" href=${page.provider.url}>Sign in with ${page.provider.title}</a></p>` : nothing}
    <form class="by-password" @submit=${signInWith}>
      <label for="user">Name</label>
      <input id="user" name="user" required autofocus autocomplete="username" autocapitalize="none" spellcheck="false">
      <label for="password">Password</label>
      <input id="password" name="password" type="password" required autocomplete="current-password" aria-describedby="problem">
      <button ?disabled=${page.isSigningIn}>Sign in</button>
      <p id="problem" class="bad" role="alert">${page.problem ?? ''}</p>
    </form>
    <details>
      <summary>With a token</summary>
      <form class="by-token" @submit=${signInWith}>
        <label for="token">Token</label>
        <input id="token" name="token" type="password" required autocomplete="off" spellcheck="false" aria-describedby="hint problem">
        <button ?disabled=${page.isSigningIn}>Sign in with it</button>
      </form>
      <p id="hint" class="quiet">It starts with <code>tsko_</code>. The first one lies in the server's data directory, in <code>operator.token</code>.</p>
    </details>
  </main>`;

function fleetView(sight) {
  const { fleet } = page;
  const now = serverNow();
  return html`
    <header class="top">
      <h1>taskd</h1>
      <p class="stream" role="status">${streamState(now)}</p>
      <p class="quiet">${page.me ? whoIsIt(page.me) : ''}</p>
      <button class="plain link" @click=${signOut}>Sign out</button>
    </header>
    <main>
      ${page.problem ? html`<p class="bad" role="alert">▲ ${page.problem}</p>` : nothing}
      ${deploymentList(fleet, page.isAllShown, now, actions)}
      <section aria-labelledby="robots">
        <header>
          <h2 id="robots">Robots <span class="count">${robotCount(fleet)}</span></h2>
          <input id="filter" type="search" placeholder="Filter" aria-label="Filter robots" aria-keyshortcuts="/" autocomplete="off" spellcheck="false"
            .value=${fleet.filter} @input=${(event) => actions.filterBy(event.currentTarget.value)}>
        </header>
        ${robotTable(fleet, sight, now, actions)}
        ${fleet.isLoaded && !fleet.robots.size ? noRobots() : nothing}
        ${fleet.robots.size && !fleet.shown.length ? html`<p class="empty quiet">No robot has “${fleet.filter}”.</p>` : nothing}
      </section>
    </main>
    ${robotDialog(fleet.robots.get(page.robot), outputs, now, () => actions.show(null))}`;
}

/** The person, and which robots they are limited to. */
const whoIsIt = ({ name, scope }) => (scope.length ? `${name}, ${scope.join(' and ')}` : name);

function robotCount({ robots, online, shown, filter, isLoaded }) {
  if (!isLoaded) return '';
  if (!robots.size) return '0';
  return filter ? `${number(shown.length)} of ${number(robots.size)}` : `${number(robots.size)}, ${number(online)} online`;
}

const noRobots = () => html`
  <div class="empty">
    <p class="quiet">No robot is enrolled yet. On this server, make a token; on each robot, enrol with it and start the agent.</p>
    ${command('taskd enroll-token create')}
    ${command(`task-agent enroll --server ${location.origin} --token TOKEN`)}
    ${command('task-agent run')}
  </div>`;

/** What moves on each second is for the eye only: read aloud, it would never stop. */
function streamState(now) {
  const { state, retry_at } = page.stream;
  if (state === 'open' && page.fleet.isLoaded) return sign(true, 'Live');
  const since = page.heardAt ? `, shown as of ${ago(page.heardAt, now)}` : '';
  if (state !== 'waiting') return sign(false, html`Connecting<span aria-hidden="true">${since}</span>`);
  const seconds = Math.max(0, Math.ceil((retry_at - Date.now()) / 1000));
  return sign(false, html`<span class="bad">Not live<span aria-hidden="true">${since}; trying again in ${plural(seconds, 'second')}</span></span>`);
}

addEventListener('hashchange', () => {
  const { token } = ofLink();
  if (token) signIn({ token });
});
addEventListener('scroll', () => change(() => {}), { passive: true });
addEventListener('resize', () => change(() => {}));
addEventListener('keydown', (event) => {
  const filter = document.getElementById('filter');
  if (!filter || event.ctrlKey || event.metaKey || event.altKey || document.querySelector('dialog[open]')) return;
  if (event.key === '/' && document.activeElement !== filter) {
    event.preventDefault();
    filter.focus();
    filter.select();
  } else if (event.key === 'Escape' && document.activeElement === filter) actions.filterBy('');
});
// Times move on, and rows find their places, also while nothing is heard.
setInterval(() => change(() => {}), 1_000);
start();
