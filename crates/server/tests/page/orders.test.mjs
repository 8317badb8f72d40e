// Orders are for the robots that the page has named, and for no others, despite changes before
// they are sent.

import { test } from 'node:test';
import {
  assert,
  assertAccessible,
  assertQuiet,
  browser,
  live,
  open,
  Puppet,
  Server,
  until,
} from './harness.mjs';

const FAILED = {
  each: () => ({ failure: { code: 'build_failed', text: 'colcon build ended with status 1' } }),
};

const enrollAll = (server, labels) =>
  Promise.all(Object.entries(labels).map(([name, its]) => Puppet.enroll(server, name, its)));
/** The names of the robots that a deployment is for. */
const receivers = async (server, id) =>
  (await server.ask('GET', `/deployments/${id}`)).assignments.map(({ name }) => name).sort();
const newest = async (server) => (await server.ask('GET', '/deployments')).deployments[0].id;

test('a robot that fails while the retry dialog is open is not retried', async (t) => {
  const server = await Server.start(t);
  const [atlas, borea] = await enrollAll(server, { atlas: {}, borea: {} });
  const page = await open(t, server);
  const dialog = page.getByRole('dialog');
  // All that failed, and all that failed for one reason.
  for (const [name, button] of [
    ['talker', 'Retry 1 robot…'],
    ['singer', 'Retry these…'],
  ]) {
    const { id } = server.push(name, '1.0.0', { to: '*' });
    await atlas.report('failed', FAILED);
    await page.goto(`${server.url}/#/deployments/${id}`);
    await page.getByRole('button', { name: button }).click();
    await dialog.getByRole('heading', { name: 'Retry on 1 robot' }).waitFor();
    await borea.report('failed', FAILED);
    await page.locator('.reason', { hasText: 'on 2 robots' }).waitFor();
    await dialog.getByRole('button', { name: 'Retry' }).click();
    await page.waitForURL((url) => /#\/deployments\/d/.test(url.hash) && !url.hash.includes(id));
    assert.deepEqual(await receivers(server, await newest(server)), ['atlas'], button);
  }
  assertQuiet(page);
});

test('an operator with a scope retries only the robots in it', async (t) => {
  const server = await Server.start(t);
  const robots = await enrollAll(server, { atlas: { site: 'lab' }, borea: { site: 'yard' } });
  const { id } = server.push('talker', '1.0.0', { to: '*' });
  for (const robot of robots) await robot.report('failed', FAILED);
  await server.ask('POST', '/users', { name: 'alice', roles: ['operator'], scope: 'site=lab' });
  const { token } = await server.ask('POST', '/tokens', { user: 'alice', title: 'the page' });
  const page = await open(t, server, { token, hash: `#/deployments/${id}` });
  await page.getByRole('button', { name: 'Retry 1 robot…' }).click();
  await page.getByRole('dialog').getByRole('button', { name: 'Retry' }).click();
  await page.waitForURL((url) => /#\/deployments\/d/.test(url.hash) && !url.hash.includes(id));
  assert.deepEqual(await receivers(server, await newest(server)), ['atlas']);
  assertQuiet(page);
});

test('a superseded deployment cannot be retried', async (t) => {
  const server = await Server.start(t);
  const robots = await enrollAll(server, { atlas: {}, borea: {} });
  const { id } = server.push('talker', '1.0.0', { to: '*' });
  for (const robot of robots) await robot.report('failed', FAILED);
  const page = await open(t, server, { hash: `#/deployments/${id}` });
  await page.getByRole('button', { name: 'Retry 2 robots…' }).waitFor();
  server.push('talker', '1.1.0', { to: 'atlas' });
  await page.getByRole('button', { name: 'Retry 1 robot…' }).waitFor();
  server.push('talker', '1.1.0', { to: 'borea' });
  await page.getByRole('button', { name: 'Retry 1 robot…' }).waitFor({ state: 'detached' });
  await page.getByText('superseded by').waitFor();
  assertQuiet(page);
});

test('labels changed by another user during an edit are kept', async (t) => {
  const server = await Server.start(t);
  const [{ id }] = await enrollAll(server, { atlas: { site: 'lab', floor: '2', zone: 'a' } });
  const page = await open(t, server);
  await page.getByText('Columns').click();
  await page.getByLabel('Labels').check();
  const dialog = page.getByRole('dialog');
  const edit = async ({ meanwhile, field, text }) => {
    await page.getByRole('button', { name: /^Edit / }).click();
    await server.ask('PATCH', `/robots/${id}`, { labels: meanwhile });
    await page
      .locator('.cell.labels', {
        hasText: Object.entries(meanwhile)
          .sort()
          .map((pair) => pair.join('='))
          .join(', '),
      })
      .waitFor();
    await dialog.getByLabel(field).fill(text);
    await dialog.getByRole('button', { name: 'Save' }).click();
    await page.getByText('updated.').waitFor();
    await page.getByRole('button', { name: 'Close notification' }).click();
    return (await server.ask('GET', `/robots/${id}`)).labels;
  };
  const first = { cart: 'one', floor: '3', site: 'lab' };
  assert.deepEqual(await edit({ meanwhile: first, field: 'Name', text: 'atlas-2' }), first);
  // And those that were edited are changed.
  const labels = await edit({
    meanwhile: { cart: 'one', floor: '4', site: 'lab', spare: 'yes' },
    field: 'Labels',
    text: 'floor=3, site=yard',
  });
  assert.deepEqual(labels, { floor: '4', site: 'yard', spare: 'yes' });
  assertQuiet(page);
});

test('labels changed by another user during an edit in the robot view are kept', async (t) => {
  const server = await Server.start(t);
  const [{ id }] = await enrollAll(server, { atlas: { site: 'lab' } });
  const page = await open(t, server, { hash: '#/robots/atlas/edit' });
  await page.getByRole('textbox', { name: 'Labels' }).fill('site=lab, floor=3');
  await server.ask('PATCH', `/robots/${id}`, { labels: { site: 'lab', quarantine: 'yes' } });
  await page.getByRole('list', { name: 'Labels' }).getByText('quarantine=yes').waitFor();
  await page.getByRole('button', { name: 'Save' }).click();
  await page.getByText('updated.').waitFor();
  assert.deepEqual((await server.ask('GET', `/robots/${id}`)).labels, {
    floor: '3',
    quarantine: 'yes',
    site: 'lab',
  });
  assertQuiet(page);
});

/** A stream that can be broken, as by a server restart. */
function breakableStream() {
  delete window.SharedWorker;
  const { fetch } = window;
  window.fetch = async (url, options) => {
    const response = await fetch(url, options);
    if (url !== '/api/v1/events') return response;
    const [{ readable, writable }, end] = [new TransformStream(), new AbortController()];
    response.body.pipeTo(writable, { signal: end.signal }).catch(() => {});
    window.breakStream = () => end.abort();
    return new Response(readable, response);
  };
}

test('unsaved input outlives a server upgrade; discarding it reloads the page', async (t) => {
  const server = await Server.start(t);
  await enrollAll(server, { atlas: { site: 'lab' } });
  const page = await open(t, server, { hash: '#/robots/atlas/edit' });
  await page.addInitScript(breakableStream);
  await page.reload();
  await live(page);
  const labels = page.getByRole('textbox', { name: 'Labels' });
  await labels.fill('site=yard');
  await page.getByRole('heading', { name: 'ROS', exact: true }).click();
  await page.evaluate(() => (window.isSameDocument = true));
  await page.route('**/api/v1/server', async (route) => {
    const response = await route.fetch();
    await route.fulfill({ response, json: { ...(await response.json()), version: '99.0.0' } });
  });
  const asked = page.waitForResponse('**/api/v1/server');
  await page.evaluate(() => window.breakStream());
  await asked;
  await live(page);
  assert.equal(await labels.inputValue(), 'site=yard');
  assert.equal(await page.evaluate(() => window.isSameDocument), true);
  const loaded = page.waitForEvent('load');
  await page.getByRole('button', { name: 'Discard changes' }).click();
  await loaded;
  assert.equal(await page.evaluate(() => window.isSameDocument), undefined);
});

/** An open stream without events, as behind a proxy that buffers its input. */
function stallStream() {
  delete window.SharedWorker;
  const { fetch } = window;
  window.fetch = (url, options) =>
    url === '/api/v1/events'
      ? Promise.resolve(new Response(new ReadableStream()))
      : fetch(url, options);
}

test('a robot that enrolls unseen is not part of an action on all shown robots', async (t) => {
  const server = await Server.start(t);
  await enrollAll(server, { atlas: {}, borea: {} });
  server.push('talker', '1.0.0', { to: '*' });
  const page = await open(t, server);
  await page.addInitScript(stallStream);
  await page.reload();
  await live(page);
  await page.getByRole('checkbox', { name: 'Select all shown robots' }).click();
  await page.getByText('2 selected').waitFor();
  await Puppet.enroll(server, 'corvus');
  server.push('talker', '1.0.0', { to: 'corvus' });
  const dialog = page.getByRole('dialog');
  await page.getByRole('button', { name: 'Label…' }).click();
  await page.getByLabel('Labels to set').fill('floor=2');
  await dialog.getByRole('button', { name: 'Label' }).click();
  await page.getByText('Labels of 2 robots updated.').waitFor();
  await page.getByRole('button', { name: 'Stop…' }).click();
  await dialog.getByLabel('talker').check();
  await dialog.getByRole('button', { name: 'Stop' }).click();
  await page.getByText('Stop requested: talker on 2 robots.').waitFor();
  const corvus = await server.ask('GET', '/robots/corvus');
  assert.deepEqual([corvus.labels, corvus.tasks[0].wanted], [{}, 'running']);
  await page.getByRole('button', { name: 'Push…' }).click();
  await dialog.getByLabel('Package').selectOption('talker');
  await dialog.getByRole('button', { name: 'Deploy' }).click();
  await page.waitForURL(/#\/deployments\/d/);
  assert.deepEqual(await receivers(server, await newest(server)), ['atlas', 'borea']);
  assertQuiet(page);
});

test('a deployment needs a package, existing robots and, for many, a confirmation', async (t) => {
  const server = await Server.start(t);
  await enrollAll(
    server,
    Object.fromEntries(
      Array.from({ length: 12 }, (_, number) => [
        `r${number}`,
        { half: number % 2 ? 'odd' : 'even' },
      ]),
    ),
  );
  server.push('talker', '1.0.0');
  const page = await open(t, server, { hash: '#/deployments' });
  const dialog = page.getByRole('dialog');
  const [robots, deploy] = [
    dialog.getByLabel('Robots', { exact: true }),
    dialog.getByRole('button', { name: 'Deploy' }),
  ];
  const ordered = async () => (await server.ask('GET', '/deployments')).deployments.length;
  const isRefusedAt = async (id) => {
    await until(page, (field) => document.activeElement.id === field, id);
    assert.equal(await ordered(), 0, id);
  };
  await page.getByRole('button', { name: 'New deployment…' }).click();
  await deploy.waitFor();
  await page.keyboard.press('Enter');
  await isRefusedAt('order-selector');
  await robots.fill('*');
  await page.keyboard.press('Enter');
  await isRefusedAt('order-name');
  await dialog.getByLabel('Package').selectOption('talker');
  await dialog.getByText('Yes, deploy to all 12 robots').waitFor();
  await deploy.click();
  await isRefusedAt('order-confirmation');
  await assertAccessible(page, 'a deployment to many robots');
  // An unknown name is no order for the other robots, and without a name no robot is meant.
  for (const [selector, said] of [
    ['r1,r77', 'No robot has the name or ID r77.'],
    ['!r77', 'No robot has the name or ID r77.'],
    ['site=mars', 'No robots match.'],
  ]) {
    await robots.fill(selector);
    await dialog.locator('#match', { hasText: said }).waitFor();
    await robots.press('Enter');
    await isRefusedAt('order-selector');
  }
  // A confirmation for twelve robots does not hold for others; few robots need no confirmation.
  await robots.fill('*');
  await dialog.getByText('Yes, deploy to all 12 robots').click();
  await robots.fill('half=odd');
  await dialog.getByText('6 robots match').waitFor();
  assert.equal(await dialog.getByText('Yes, deploy to').count(), 0);
  await robots.fill('!r1');
  await dialog.getByText('Yes, deploy to 11 robots').waitFor();
  await deploy.click();
  await isRefusedAt('order-confirmation');
  await dialog.getByText('Yes, deploy to 11 robots').click();
  await deploy.click();
  await page.waitForURL(/#\/deployments\/d/);
  assert.equal((await receivers(server, await newest(server))).length, 11);
  // None of these choices is preset the next time.
  await page.goto(`${server.url}/#/deployments`);
  await page.getByRole('button', { name: 'New deployment…' }).click();
  await deploy.waitFor();
  assert.deepEqual(
    [await robots.inputValue(), await dialog.getByLabel('Package').inputValue()],
    ['', ''],
  );
  assertQuiet(page);
});

test('a robot that awaits approval gets no orders but can be deleted', async (t) => {
  const server = await Server.start(t);
  await enrollAll(server, { atlas: {} });
  server.push('talker', '1.0.0');
  const { token } = await server.createEnrollmentToken({ approval: true });
  const wait = (name, mac) => server.ask('POST', '/enroll', { mac, name }, { token });
  await wait('stranger', '02:00:00:00:00:81');
  const page = await open(t, server);
  const dialog = page.getByRole('dialog');
  const note = dialog.getByText('1 selected robot awaits approval and is skipped.');
  await page.locator('[data-robot]').nth(1).waitFor();
  await page.getByRole('checkbox', { name: 'Select all shown robots' }).click();
  for (const [button, title] of [
    ['Label…', 'Label atlas'],
    ['Stop…', 'Stop tasks on atlas'],
    ['Push…', 'Push to atlas'],
  ]) {
    await page.getByRole('button', { name: button }).click();
    await dialog.getByRole('heading', { name: title }).waitFor();
    await note.waitFor();
    await page.keyboard.press('Escape');
  }
  // Also of robots matched by a selector.
  await page.goto(`${server.url}/#/packages`);
  await page.getByRole('button', { name: 'Push talker 1.0.0' }).click();
  await dialog.getByLabel('Robots', { exact: true }).fill('*');
  await dialog.getByText('1 robot matches: atlas').waitFor();
  await page.keyboard.press('Escape');
  await page.goto(`${server.url}/#/settings`);
  const waiting = page.locator('section', { hasText: 'Robots awaiting approval' });
  await waiting.getByRole('cell', { name: 'stranger' }).waitFor();
  await wait('second', '02:00:00:00:00:82');
  await waiting.getByRole('cell', { name: 'second' }).waitFor();
  await page.goto(`${server.url}/#/robots`);
  await page.getByRole('button', { name: 'Delete second' }).click();
  await dialog.getByRole('button', { name: 'Delete' }).click();
  await page.getByText('1 robot deleted.').waitFor();
  await page.getByText('2 selected').waitFor();
  await page.getByRole('button', { name: 'Delete…' }).click();
  await dialog.getByRole('button', { name: 'Delete' }).click();
  await page.getByText('2 robots deleted.').waitFor();
  assert.deepEqual((await server.ask('GET', '/robots')).robots, []);
  assertQuiet(page);
});

test('an invalid value in the collapsed options of a deployment is revealed', async (t) => {
  const server = await Server.start(t);
  await enrollAll(server, { atlas: {} });
  server.push('talker', '1.0.0');
  const page = await open(t, server, { hash: '#/packages' });
  const dialog = page.getByRole('dialog');
  await page.getByRole('button', { name: 'Push talker 1.0.0' }).click();
  await dialog.getByLabel('Robots', { exact: true }).fill('atlas');
  await dialog.getByText('Batches, priority, expiry').click();
  await dialog.getByLabel('Priority').fill('1000');
  await dialog.getByText('Batches, priority, expiry').click();
  await dialog.getByLabel('Priority').waitFor({ state: 'hidden' });
  await dialog.getByRole('button', { name: 'Deploy' }).click();
  await until(page, () => document.activeElement.id === 'order-priority');
  assert.ok(await dialog.getByLabel('Priority').isVisible());
  assertQuiet(page);
});

test('every task action works on all selected robots, wide and narrow', async (t) => {
  const server = await Server.start(t);
  const robots = await enrollAll(server, { atlas: {}, borea: {} });
  const it = await browser(t);
  const orders = [
    ['Stop', 'Stop'],
    ['Start', 'Start'],
    ['Restart', 'Restart'],
    ['Roll back', 'Rollback'],
    ['Remove task', 'Removal'],
  ];
  for (const width of [1280, 375]) {
    for (const version of ['1.0.0', '1.1.0']) {
      server.push('talker', `${version}-at${width}`, { to: '*' });
      for (const robot of robots) await robot.report('running');
    }
    const page = await open(t, server, { on: it, viewport: { width, height: 900 } });
    const dialog = page.getByRole('dialog');
    for (const name of ['atlas', 'borea'])
      await page.getByRole('checkbox', { name: `Select ${name}` }).click();
    await page.getByText('2 selected').waitFor();
    await assertAccessible(page, `the actions for selected robots at ${width}`);
    const [inner, outer] = await page.evaluate(() => [
      document.documentElement.scrollWidth,
      document.documentElement.clientWidth,
    ]);
    assert.ok(inner <= outer, `not wider than the window at ${width}: ${inner} > ${outer}`);
    const bar = page.getByRole('toolbar', { name: 'Actions for selected robots' });
    assert.ok(
      (await bar.boundingBox()).height < 120,
      `at ${width} the robots can be seen above the bar`,
    );
    for (const [button, noun] of orders) {
      await bar.getByRole('button', { name: `${button}…`, exact: true }).click();
      await dialog.getByLabel('talker').check();
      await dialog.getByRole('button', { name: button.split(' task')[0], exact: true }).click();
      await page.getByText(`${noun} requested: talker on 2 robots.`).waitFor();
      await page.getByRole('button', { name: 'Close notification' }).click();
    }
    assertQuiet(page);
  }
});
