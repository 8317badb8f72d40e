// Features that do not depend on agents: many tabs, signing in, robots' reports, keys, and
// accessibility.

import { test } from 'node:test';
import {
  assert,
  assertAccessible,
  assertQuiet,
  browser,
  eventually,
  followLink,
  live,
  open,
  Puppet,
  Server,
  settled,
  takeComplaints,
  until,
} from './harness.mjs';

const GB = 2 ** 30;
const PASSWORD = 'correct horse battery';
const HOSTILE =
  "<img src=x onerror=\"document.title='owned'\"><script>document.title='owned'</script>";

test('nine tabs are live at once', async (t) => {
  const server = await Server.start(t);
  const first = await open(t, server);
  const tabs = [first];
  for (let tab = 1; tab < 9; tab += 1) {
    const page = await first.context().newPage();
    await page.goto(server.url);
    tabs.push(page);
  }
  await Promise.all(tabs.map(live));
  await Puppet.enroll(server, 'atlas');
  await Promise.all(
    tabs.map((page) => page.locator('[data-robot]', { hasText: 'atlas' }).waitFor()),
  );
  assertQuiet(first);
});

test('robot messages are shown as text', async (t) => {
  const server = await Server.start(t);
  const atlas = await Puppet.enroll(server, 'atlas');
  server.push('talker', '1.0.0', { to: 'atlas' });
  const page = await open(t, server);
  await atlas.report('failed', {
    each: () => ({ failure: { code: 'build_failed', text: HOSTILE } }),
    conditions: [{ code: 'held', text: HOSTILE }],
    host: { hostname: HOSTILE },
  });
  await page.locator('.failure', { hasText: '<img src=x' }).waitFor();
  await page.locator('.condition', { hasText: '<img src=x' }).waitFor();
  for (const tab of ['', '/tasks', '/control', '/edit']) {
    await page.goto(`${server.url}/#/robots/atlas${tab}`);
    await page.getByRole('heading', { name: 'atlas' }).waitFor();
    await settled(page);
    assert.equal(await page.locator('body img, body script').count(), 0);
  }
  await page.goto(`${server.url}/#/robots/atlas`);
  await page.locator('dd', { hasText: '<img src=x' }).waitFor();
  assert.match(await page.title(), /taskd/);
  assertQuiet(page);
  // A change would have been seen:
  await page.evaluate(() => document.body.setAttribute('style', 'color: red'));
  assert.equal(takeComplaints(page).length, 1);
});

test('a wrong token shows an error, and the page reconnects to a restarted server', async (t) => {
  const server = await Server.start(t);
  const it = await browser(t);
  const page = await it.newPage();
  await page.goto(`${server.url}/#token=tsko_wrong`);
  await until(page, () => document.activeElement.matches('.by-token button'));
  assert.equal(page.url(), `${server.url}/`, 'the token has left the address bar');
  await page.keyboard.press('Enter');
  await page.getByRole('alert').filter({ hasText: 'token: ' }).waitFor();
  await page.locator('form.by-token input').fill(server.token);
  await page.getByRole('button', { name: 'Sign in with token' }).click();
  await live(page);
  await server.process.stop();
  await page.locator('.stream', { hasText: 'Disconnected' }).waitFor();
  await Server.start(t, { data: server.data, http: server.http });
  await live(page);
  await page.getByRole('button', { name: 'Sign out' }).click();
  await page.getByLabel('Username').waitFor();
  assert.equal(
    await page.evaluate(() => fetch('/api/v1/robots').then(({ status }) => status)),
    401,
  );
});

test('a page that reloads after a server restart is still signed in', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  const place = '#/robots/atlas/logs?level=warn';
  const page = await open(t, server, { hash: place });
  await live(page);
  await server.process.stop();
  await Server.start(t, { data: server.data, http: server.http });
  await page.reload();
  await live(page);
  await page.getByRole('heading', { name: 'atlas' }).waitFor();
  assert.equal(page.url(), `${server.url}/${place}`);
});

test('a sign-in after the end of a session returns to the place', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  const place = '#/robots/atlas/logs?level=warn';
  const page = await open(t, server, { hash: place });
  await live(page);
  // Another tab signs out in this way.
  await page.evaluate(() => fetch('/api/v1/session', { method: 'DELETE' }));
  await page.getByLabel('Username').waitFor();
  await page.getByText('Sign in with a token').click();
  await page.locator('form.by-token input').fill(server.token);
  await page.getByRole('button', { name: 'Sign in with token' }).click();
  await live(page);
  assert.equal(page.url(), `${server.url}/${place}`);
  await page.getByRole('heading', { name: 'atlas' }).waitFor();
  await page.getByRole('button', { name: 'Sign out' }).click();
  await page.getByLabel('Username').waitFor();
  assert.equal(await page.getByRole('alert').innerText(), '');
});

test('a page without its event stream shows the reason and the listed robots', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  const page = await open(t, server);
  // The tabs' shared worker sends its requests where a test can't answer for the server.
  await page.addInitScript(() => delete window.SharedWorker);
  const refusal = { error: { code: 'too_many_requests', message: 'too many event streams' } };
  await page.route(/\/events$/, (route) => route.fulfill({ status: 429, json: refusal }));
  await page.reload();
  await page
    .locator('.stream', { hasText: 'Disconnected (429: too many event streams)' })
    .waitFor();
  await page.locator('[data-robot]', { hasText: 'atlas' }).waitFor();
  await page.unrouteAll();
  await live(page);
  assert.ok(takeComplaints(page).every((said) => said.includes('status of 429')));
});

test('a page reloads after an upgrade, but not while a dialog is open', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  const page = await open(t, server);
  await page.addInitScript(() => delete window.SharedWorker);
  await page.route(/\/events$/, (route) => route.fulfill({ status: 503 }));
  await page.reload();
  await page.locator('[data-robot]', { hasText: 'atlas' }).waitFor();
  await page.evaluate(() => (window.isSameDocument = true));
  await page.keyboard.press('?');
  await page.getByRole('heading', { name: 'Keyboard shortcuts' }).waitFor();
  await page.route(/\/api\/v1\/server$/, async (route) => {
    const response = await route.fetch();
    await route.fulfill({ response, json: { ...(await response.json()), version: '9.9.9' } });
  });
  await page.unroute(/\/events$/);
  await live(page);
  await settled(page);
  assert.equal(await page.evaluate(() => window.isSameDocument), true);
  await page.keyboard.press('Escape');
  await until(page, () => !window.isSameDocument);
  // Once.
  await live(page);
  await page.evaluate(() => (window.isSameDocument = true));
  await settled(page);
  assert.equal(await page.evaluate(() => window.isSameDocument), true);
  assert.ok(takeComplaints(page).every((said) => said.includes('status of 503')));
});

test('a link with a token does not sign in by itself', async (t) => {
  const server = await Server.start(t);
  await server.ask('POST', '/users', { name: 'mallory', roles: ['viewer'] });
  const { token } = await server.ask('POST', '/tokens', { user: 'mallory' });
  const link = `${server.url}/#token=${token}`;
  const it = await browser(t);
  const page = await open(t, server, { on: it, hash: '#/settings' });
  const sent = [];
  page
    .context()
    .on('request', (request) => request.method() === 'POST' && sent.push(request.url()));
  const isStillIn = async (one) => {
    await live(one);
    await settled(one);
    assert.equal(await one.locator('.user').innerText(), 'operator.token');
    assert.equal(
      await one.evaluate(() =>
        fetch('/api/v1/me')
          .then((answer) => answer.json())
          .then(({ name }) => name),
      ),
      'operator.token',
    );
  };
  // A signed-in user stays signed in: in the open page, and in one that the link opens.
  await page.goto(link);
  await page.waitForURL(/#\/settings$/);
  await isStillIn(page);
  await page.getByRole('heading', { name: 'Settings', exact: true }).waitFor();
  const another = await page.context().newPage();
  await another.goto(link);
  await isStillIn(another);
  assert.equal(another.url(), `${server.url}/`, 'the token has left the address bar');
  assert.deepEqual(sent, [], 'nothing was sent to sign in');
  assertQuiet(page);
  // A signed-out user is asked to sign in: by the page that the link opens, and by one that shows
  // the sign-in already.
  const stranger = await it.newPage();
  const isAsked = async () => {
    await stranger.getByText('Use it only if you trust the sender.').waitFor();
    await until(stranger, () => document.activeElement.matches('.by-token button'));
    assert.equal(
      await stranger.evaluate(() => fetch('/api/v1/me').then(({ status }) => status)),
      401,
    );
  };
  await stranger.goto(link);
  await isAsked();
  await stranger.reload();
  await stranger.getByLabel('Username').waitFor();
  await stranger.goto(link);
  await isAsked();
  await stranger.keyboard.press('Enter');
  await stranger.locator('.user', { hasText: 'mallory' }).waitFor();
});

test('a new user receives no events of the previous user', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas', { site: 'lab' });
  await server.ask('POST', '/users', {
    name: 'alice',
    roles: ['viewer'],
    scope: 'site=lab',
    password: PASSWORD,
  });
  const context = await (await browser(t)).newContext();
  const [mine, theirs] = [await context.newPage(), await context.newPage()];
  await mine.goto(server.url);
  await mine.getByLabel('Username').fill('alice');
  await mine.getByLabel('Password').fill(PASSWORD);
  await followLink(theirs, server, server.token);
  await live(theirs);
  await mine.getByRole('button', { name: 'Sign in', exact: true }).click();
  await live(mine);
  await theirs.getByLabel('Username').waitFor();
  await Puppet.enroll(server, 'borea', { site: 'yard' });
  await Puppet.enroll(server, 'corvus', { site: 'lab' });
  await mine.locator('[data-robot]', { hasText: 'corvus' }).waitFor();
  assert.deepEqual(await mine.locator('[data-robot] .name').allInnerTexts(), ['atlas', 'corvus']);
  assert.match(await mine.locator('.user').innerText(), /^alice/);
});

test('a failed sign-out shows an error and keeps the session', async (t) => {
  const server = await Server.start(t);
  const page = await open(t, server);
  const signOut = page.getByRole('button', { name: 'Sign out' });
  await page.route(/\/session$/, (route) =>
    route.request().method() === 'DELETE' ? route.fulfill({ status: 504 }) : route.continue(),
  );
  await signOut.click();
  await page.getByText('Could not sign out: the server responded with status 504').waitFor();
  assert.ok(await signOut.isVisible(), 'the user is still signed in');
  await page.unrouteAll();
  await signOut.click();
  await page.getByLabel('Username').waitFor();
  // A session that has ended already needs no ending.
  await followLink(page, server, server.token);
  await live(page);
  assert.equal(
    await page.getByText('Could not sign out').count(),
    0,
    'the next user does not see the error',
  );
  await page.route(/\/session$/, (route) =>
    route.request().method() === 'DELETE' ? route.fulfill({ status: 401 }) : route.continue(),
  );
  await signOut.click();
  await page.getByLabel('Username').waitFor();
});

test('a user sees the robots of their scope and the permitted actions', async (t) => {
  const server = await Server.start(t);
  for (const name of ['atlas', 'borea']) await Puppet.enroll(server, name);
  await server.ask('POST', '/users', {
    name: 'alice',
    roles: ['viewer'],
    scope: 'atlas',
    password: PASSWORD,
  });
  const page = await (await browser(t)).newPage();
  await page.goto(server.url);
  const signIn = async (password) => {
    await page.getByLabel('Username').fill('alice');
    await page.getByLabel('Password').fill(password);
    await page.getByRole('button', { name: 'Sign in', exact: true }).click();
  };
  await signIn('wrong');
  await page.getByRole('alert').filter({ hasText: 'or the password is wrong' }).waitFor();
  await signIn(PASSWORD);
  await live(page);
  await page.locator('.user', { hasText: 'alice' }).waitFor();
  assert.deepEqual(await page.locator('[data-robot] .name').allInnerTexts(), ['atlas']);
  assert.deepEqual(
    await page.locator('[data-robot] .operations button').allInnerTexts(),
    ['Monitor'],
    'the actions of a viewer',
  );
});

test('robots can be found, selected and opened by keyboard', async (t) => {
  const server = await Server.start(t);
  for (const name of ['atlas', 'borea', 'corvus']) await Puppet.enroll(server, name);
  const page = await open(t, server);
  await until(page, () => document.querySelectorAll('[data-robot]').length === 3);
  await page.keyboard.press('/');
  await page.keyboard.type('bore');
  await until(page, () => document.querySelectorAll('[data-robot]').length === 1);
  assert.match(page.url(), /q=bore/);
  await page.keyboard.press('Escape');
  await until(page, () => document.querySelectorAll('[data-robot]').length === 3);
  await page.keyboard.press('ArrowDown');
  const current = () =>
    page.evaluate(() => document.activeElement.querySelector('.name')?.innerText);
  await eventually('the first row', async () => (await current()) === 'atlas');
  await page.keyboard.press('ArrowDown');
  await eventually('the second row', async () => (await current()) === 'borea');
  await page.keyboard.press('x');
  await page.getByText('1 selected').waitFor();
  await page.keyboard.press('Escape');
  await page.getByText('1 selected').waitFor({ state: 'detached' });
  await page.keyboard.press('?');
  await page.getByRole('heading', { name: 'Keyboard shortcuts' }).waitFor();
  await page.keyboard.press('Escape');
  await page.getByRole('heading', { name: 'Keyboard shortcuts' }).waitFor({ state: 'hidden' });
  await page.keyboard.press('Enter');
  await page.waitForURL(/#\/robots\/borea/);
  // Hidden rows are not selected.
  await page.getByRole('link', { name: 'Robots' }).click();
  await page.locator('[data-robot]', { hasText: 'borea' }).focus();
  await page.getByRole('searchbox').fill('atlas');
  await until(page, () => document.querySelectorAll('[data-robot]').length === 1);
  await page.locator('#main').focus();
  await page.keyboard.press('x');
  await page.keyboard.press('ArrowDown');
  await until(page, () => document.activeElement.matches('[data-robot]'));
  assert.equal(await page.locator('.bulk').count(), 0);
  assertQuiet(page);
});

test('a key press right after a dialog closes is not lost', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  const page = await open(t, server);
  await until(page, () => document.querySelectorAll('[data-robot]').length === 1);
  await page.keyboard.press('ArrowDown');
  await until(page, () => document.activeElement.matches('[data-robot]'));
  await page.keyboard.press('?');
  await until(page, () => document.getElementById('dialog').open);
  await Promise.all(['Escape', 'Enter'].map((key) => page.keyboard.press(key)));
  await page.waitForURL(/#\/robots\/atlas/);
  assertQuiet(page);
});

test('robots can be selected one by one, as a range, or all that match', async (t) => {
  const server = await Server.start(t);
  for (const name of ['atlas', 'borea', 'corvus', 'delphin', 'echo'])
    await Puppet.enroll(server, name);
  const page = await open(t, server);
  await until(page, () => document.querySelectorAll('[data-robot]').length === 5);
  const selected = async (...names) => {
    await page.getByText(`${names.length} selected`).waitFor();
    assert.deepEqual(
      await page.locator('[data-robot][aria-selected=true] .name').allInnerTexts(),
      names,
    );
  };
  const box = (name) => page.getByRole('checkbox', { name: `Select ${name}`, exact: true });
  await box('borea').click();
  await box('delphin').click({ modifiers: ['Shift'] });
  await selected('borea', 'corvus', 'delphin');
  await box('corvus').click();
  await selected('borea', 'delphin');
  await page.keyboard.press('Escape');
  await page.getByText('2 selected').waitFor({ state: 'detached' });
  for (const key of ['ArrowUp', 'x', 'ArrowDown', 'ArrowDown', 'Shift+X'])
    await page.keyboard.press(key);
  await selected('borea', 'corvus', 'delphin');
  await page.getByRole('button', { name: 'Select all 5 matching robots' }).click();
  await selected('atlas', 'borea', 'corvus', 'delphin', 'echo');
  await page.keyboard.press('Escape');
  await page.keyboard.press('/');
  await page.keyboard.type('or');
  await until(page, () => document.querySelectorAll('[data-robot]').length === 2);
  await box('corvus').click();
  await page.getByRole('button', { name: 'Select all 2 matching robots' }).click();
  await selected('borea', 'corvus');
  // A range back to a selected row leaves the row selected, and its box shows that.
  await box('corvus').click();
  await selected('borea');
  await box('corvus').click();
  await box('borea').click({ modifiers: ['Shift'] });
  await selected('borea', 'corvus');
  for (const name of ['borea', 'corvus']) assert.ok(await box(name).isChecked(), name);
  // With no rows, the box stays clear.
  await page.getByRole('searchbox').fill('absent');
  await page.getByText('No robots match this filter.').waitFor();
  const all = page.getByRole('checkbox', { name: 'Select all shown robots' });
  await all.click();
  await settled(page);
  assert.equal(await all.isChecked(), false);
  assertQuiet(page);
});

test('a search for a label or a version matches exactly', async (t) => {
  const server = await Server.start(t);
  const sites = { atlas: 'lab', borea: 'lab2', corvus: 'lab', delphin: 'yard' };
  for (const [name, site] of Object.entries(sites)) await Puppet.enroll(server, name, { site });
  server.push('talker', '1.0.0', { to: 'atlas' });
  server.push('talker', '1.0.0-rc1', { to: 'borea' });
  const page = await open(t, server);
  const shown = (...names) =>
    until(
      page,
      (all) =>
        [...document.querySelectorAll('[data-robot] .name')].map((one) => one.innerText).join() ===
        all,
      names.join(),
    );
  const search = (text) => page.getByRole('searchbox').fill(text);
  for (const [text, ...names] of [
    ['site=lab', 'atlas', 'corvus'],
    ['Site=Lab2', 'borea'],
    ['site=', 'atlas', 'borea', 'corvus', 'delphin'],
    ['e=lab', 'atlas', 'borea', 'corvus'],
    ['talker@1.0.0', 'atlas'],
    ['talker@1.0.0-rc1', 'borea'],
    ['ker@1.0.0', 'atlas', 'borea'],
    ['site=lab talker@1.0.0', 'atlas'],
  ]) {
    await search(text);
    await shown(...names);
  }
  assertQuiet(page);
});

test('a search finds robots by agent version, architecture and ROS distribution', async (t) => {
  const server = await Server.start(t);
  const hosts = {
    atlas: { agent_version: '0.9.7', arch: 'x86_64', ros_distros: ['jazzy', 'kilted'] },
    borea: { agent_version: '0.9.8', arch: 'aarch64' },
  };
  for (const [name, host] of Object.entries(hosts))
    await (await Puppet.enroll(server, name)).report('running', { host });
  const page = await open(t, server);
  for (const [text, name] of [
    ['0.9.7', 'atlas'],
    ['aarch64', 'borea'],
    ['kilted', 'atlas'],
    ['0.9.8 AARCH64', 'borea'],
  ]) {
    await page.getByRole('searchbox').fill(text);
    await until(
      page,
      (only) =>
        [...document.querySelectorAll('[data-robot] .name')].map((one) => one.innerText).join() ===
        only,
      name,
    );
  }
  assertQuiet(page);
});

test('the keyboard focus follows a row that moves', async (t) => {
  const server = await Server.start(t);
  const puppets = [];
  for (const name of ['atlas', 'borea', 'corvus']) puppets.push(await Puppet.enroll(server, name));
  const page = await open(t, server, { hash: '#/robots?sort=cpu' });
  const names = (all) =>
    until(
      page,
      (said) =>
        [...document.querySelectorAll('[data-robot] .name')].map((one) => one.innerText).join() ===
        said,
      all,
    );
  const loads = async (...all) => {
    for (const [index, cpu_percent] of all.entries())
      await puppets[index].vitals({
        at_ms: 1,
        cpu_percent,
        memory_used_bytes: 3 * GB,
        memory_total_bytes: 8 * GB,
      });
  };
  await loads(90, 50, 10);
  await names('atlas,borea,corvus');
  // The row itself, and a button in it.
  await page.keyboard.press('ArrowDown');
  await until(page, () => document.activeElement.matches('[data-robot]'));
  await loads(5, 50, 90);
  await names('corvus,borea,atlas');
  assert.equal(await page.evaluate(() => document.activeElement.dataset.robot), puppets[0].id);
  const button = page.getByRole('button', { name: 'Monitor corvus' });
  await button.focus();
  await loads(90, 50, 10);
  await names('atlas,borea,corvus');
  assert.ok(await button.evaluate((one) => one === document.activeElement));
  assertQuiet(page);
});

test('a dialog opened right after another closes stays open', async (t) => {
  const server = await Server.start(t);
  const page = await open(t, server);
  await page.evaluate(async () => {
    const { openDialog, closeDialog } = await import('/ui/display/dialog.js');
    const frame = () => new Promise((resume) => requestAnimationFrame(resume));
    const ask = (title) => openDialog({ title, body: () => '' });
    ask('First');
    await frame();
    const wasClosed = new Promise((resume) =>
      document.getElementById('dialog').addEventListener('close', resume),
    );
    closeDialog();
    // In the frame that closes the browser's dialog, after the closing: the browser's event comes
    // later.
    requestAnimationFrame(() => ask('Second'));
    await wasClosed;
    await frame();
  });
  await page.getByRole('dialog').getByRole('heading', { name: 'Second' }).waitFor();
  assert.ok(await page.getByRole('dialog').isVisible());
  await page.keyboard.press('Escape');
  await page.getByRole('dialog').waitFor({ state: 'hidden' });
  assertQuiet(page);
});

test('every view is accessible and fits the window, light and dark, wide and narrow', async (t) => {
  const server = await Server.start(t);
  const robots = [];
  for (const [name, site] of [
    ['atlas', 'lab'],
    ['borea', 'lab'],
    ['corvus', 'yard'],
  ])
    robots.push(await Puppet.enroll(server, name, { site }));
  server.push('talker', '1.0.0', { to: '*' });
  server.push('talker', '1.1.0');
  await robots[0].report('running', { host: { disk_free_bytes: 5e9, ros_distros: ['jazzy'] } });
  await robots[1].report('failed', {
    each: () => ({ failure: { code: 'build_failed', text: 'colcon build ended with status 1' } }),
    conditions: [{ code: 'held', text: 'a wheel is being changed' }],
  });
  await robots[2].report('fetching', { each: () => ({ progress: { done: 10, total: 40 } }) });
  const {
    deployments: [{ id }],
  } = await server.ask('GET', '/deployments');
  const places = [
    'robots',
    'robots?state=failed',
    'robots/atlas',
    'robots/atlas/ros',
    'robots/borea/tasks',
    'robots/atlas/logs',
    'robots/atlas/outputs',
    'robots/atlas/control',
    'robots/atlas/edit',
    'packages',
    'packages/talker',
    'deployments',
    `deployments/${id}`,
    'server',
    'settings',
  ];
  const it = await browser(t);
  for (const [colorScheme, width] of [
    ['light', 1280],
    ['dark', 375],
  ]) {
    const page = await open(t, server, { on: it, colorScheme, viewport: { width, height: 900 } });
    for (const place of places) {
      await page.goto(`${server.url}/#/${place}`);
      await page.locator('main h1').first().waitFor();
      await settled(page);
      await assertAccessible(page, `${place} at ${width}, ${colorScheme}`);
      const [inner, outer] = await page.evaluate(() => [
        document.documentElement.scrollWidth,
        document.documentElement.clientWidth,
      ]);
      assert.ok(
        inner <= outer,
        `${place} at ${width} is not wider than the window: ${inner} > ${outer}`,
      );
    }
    takeComplaints(page);
  }
});

test('a long version does not widen the robot view', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  server.push('talker', `1.0.0-${'SNAPSHOT'.repeat(7)}`, { to: 'atlas' });
  const page = await open(t, server, {
    hash: '#/robots/atlas/control',
    viewport: { width: 390, height: 800 },
  });
  await page.locator('.orders', { hasText: 'SNAPSHOT' }).waitFor();
  const [inner, outer] = await page.evaluate(() => [
    document.documentElement.scrollWidth,
    document.documentElement.clientWidth,
  ]);
  assert.ok(inner <= outer, `${inner} > ${outer}`);
  assertQuiet(page);
});

test('the robot list shows new vitals without a reload', async (t) => {
  const server = await Server.start(t);
  const atlas = await Puppet.enroll(server, 'atlas');
  const page = await open(t, server);
  await page.getByText('Columns').click();
  for (const column of ['CPU', 'Memory']) await page.getByLabel(column).check();
  const row = page.locator('[data-robot]', { hasText: 'atlas' });
  const memory = { memory_used_bytes: 3 * GB, memory_total_bytes: 8 * GB };
  for (const [cpu_percent, said] of [
    [12, '12 %'],
    [57.4, '57 %'],
  ]) {
    await atlas.vitals({ at_ms: 1, cpu_percent, ...memory });
    await row.locator('.cpu', { hasText: said }).waitFor();
  }
  await row.locator('.memory', { hasText: '3.0 GB' }).waitFor();
  // None is a figure too.
  await page.getByLabel('Free disk').check();
  await row.locator('.disk', { hasText: '–' }).waitFor();
  await atlas.report('running', { host: { disk_free_bytes: 0 } });
  await row.locator('.disk', { hasText: '0 B' }).waitFor();
  await page.getByLabel('Free disk').uncheck();
  for (const width of [1280, 1200, 1100]) {
    await page.setViewportSize({ width, height: 900 });
    // Tried without doing it: scrolled to, and not covered by anything.
    await page.getByRole('button', { name: 'Delete atlas' }).click({ trial: true });
  }
  assertQuiet(page);
});

test('the server view receives events from the stream, without polling', async (t) => {
  const server = await Server.start(t);
  const page = await open(t, server, { hash: '#/server' });
  await page.getByRole('heading', { name: 'Events' }).waitFor();
  await page.getByText('up ').waitFor();
  await settled(page);
  await page.evaluate(() => (window.isSameDocument = true));
  const asked = [];
  page.on('request', (request) => asked.push(new URL(request.url()).pathname));
  for (const name of ['atlas', 'borea']) {
    await Puppet.enroll(server, name);
    await page
      .locator('.feed .entry', { hasText: 'robot enrolled' })
      .filter({ has: page.getByRole('link', { name }) })
      .waitFor();
  }
  // The figures beside it are polled: requests would have been seen.
  await eventually('the figures to be asked for', () => asked.includes('/api/v1/server/status'));
  assert.deepEqual(
    asked.filter((path) => path !== '/api/v1/server/status'),
    [],
    'no other requests',
  );
  assert.equal(await page.evaluate(() => window.isSameDocument), true, 'the page was not reloaded');
  assert.match(
    await page.locator('.feed .entry').first().innerText(),
    /borea/,
    'the newest event is first',
  );
  assertQuiet(page);
});
