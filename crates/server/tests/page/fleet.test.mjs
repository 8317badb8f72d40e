// An operator's work with a fleet of real agents: from the first robot to a task that runs, fails,
// is followed and is reverted.

import { randomBytes } from 'node:crypto';
import { test } from 'node:test';
import {
  agent,
  assert,
  assertQuiet,
  eventually,
  open,
  PATIENCE_MS,
  Puppet,
  Server,
  until,
} from './harness.mjs';

const row = (page, name) => page.locator('.row[data-robot]', { hasText: name });
const phase = (page, name, text) => row(page, name).locator('.phase', { hasText: text });

test('a robot enrolled with the shown command appears without a reload', async (t) => {
  const server = await Server.start(t);
  const page = await open(t, server);
  await page.getByText('Waiting for the first robot…').waitFor();
  await page.evaluate(() => (window.isSameDocument = true));
  await page.getByRole('button', { name: 'Show command' }).click();
  const line = await page.locator('.command code', { hasText: '--token' }).innerText();
  const [, url, token] = line.match(/^task-agent enroll --server (\S+) --token (\S+)$/);
  assert.equal(url, server.url);
  await server.ask('POST', '/enroll', { mac: '02:00:00:00:00:77', name: 'first' }, { token });
  await row(page, 'first').locator('.state', { hasText: 'Offline' }).waitFor();
  await agent(t, server, 'atlas');
  await row(page, 'atlas').locator('.state', { hasText: 'Online' }).waitFor();
  assert.equal(await page.evaluate(() => window.isSameDocument), true, 'the page was not reloaded');
  assertQuiet(page);
});

test('a push to two selected robots shows its progress until they run the package', async (t) => {
  // Slow enough to observe the progress.
  const server = await Server.start(t, { environment: { TASKD_TRANSFERS_BYTES_PER_S: '250 KB' } });
  for (const name of ['atlas', 'borea', 'corvus']) await agent(t, server, name);
  server.push('talker', '1.0.0', {
    files: { 'run.sh': '#!/bin/sh\nexec sleep 1000\n', model: randomBytes(3_000_000) },
  });
  const page = await open(t, server);
  for (const name of ['atlas', 'borea']) await row(page, name).getByRole('checkbox').click();
  await page.getByRole('button', { name: 'Push…' }).click();
  await page.getByRole('dialog').getByText('Push to 2 robots').waitFor();
  await page.getByRole('dialog').getByLabel('Package').selectOption('talker');
  await page.getByRole('dialog').getByRole('button', { name: 'Deploy' }).click();
  await page.waitForURL(/#\/deployments\/d/);
  await page.getByRole('link', { name: 'Robots' }).click();
  // Two values of one robot's bar, one after the other.
  await page.getByRole('searchbox').fill('atlas');
  const values = await page.evaluate(
    (patience) =>
      new Promise((resume, reject) => {
        const seen = new Set();
        const end = performance.now() + patience;
        const look = () => {
          const bar = document.querySelector('[data-task=talker] progress');
          if (bar?.value > 0) seen.add(bar.value);
          if (seen.size > 1) resume([...seen]);
          else if (performance.now() > end)
            reject(new Error(`the bar showed no two values, but ${[...seen]}`));
          else requestAnimationFrame(look);
        };
        look();
      }),
    PATIENCE_MS,
  );
  assert.ok(values[0] < values[1], `the bar grows: ${values}`);
  await page.getByRole('searchbox').fill('');
  for (const name of ['atlas', 'borea']) await phase(page, name, 'running').waitFor();
  assert.equal(
    await row(page, 'corvus').locator('[data-task]').count(),
    0,
    'the robot that is not selected gets nothing',
  );
  assertQuiet(page);
});

test('the counter of failures filters the robots; a failed robot shows its reason', async (t) => {
  const server = await Server.start(t);
  for (const name of ['atlas', 'borea']) await agent(t, server, name);
  server.push('sensor', '0.1.0', {
    files: { 'run.sh': '#!/bin/sh\necho no such sensor >&2\nexit 3\n' },
    more: 'restart = "never"\n',
    to: 'atlas',
  });
  const page = await open(t, server);
  await phase(page, 'atlas', 'failed').waitFor();
  await row(page, 'atlas').locator('.failure').waitFor();
  await page.getByRole('button', { name: 'Failed' }).click();
  await until(page, () => document.querySelectorAll('.row[data-robot]').length === 1);
  assert.match(page.url(), /state=failed/);
  await row(page, 'atlas').getByRole('link', { name: 'atlas' }).click();
  await page.getByText('exited with code 3').first().waitFor();
  assertQuiet(page);
});

test('a cancelled deployment leaves the previous version running', async (t) => {
  const server = await Server.start(t);
  await agent(t, server, 'atlas');
  server.push('talker', '1.0.0', { to: 'atlas' });
  const page = await open(t, server);
  await phase(page, 'atlas', 'running').waitFor();
  // Not settled before it is cancelled.
  const newest = server.push('talker', '2.0.0', {
    more: '\n[ready]\nhold_s = 30\ntimeout_s = 60\n',
    to: 'atlas',
  });
  await page.goto(`${server.url}/#/deployments/${newest.id}`);
  await page.getByRole('button', { name: 'Cancel…' }).click();
  await page.getByRole('dialog').getByRole('button', { name: 'Cancel deployment' }).click();
  await page.locator('.deployment-state', { hasText: 'Cancelled' }).waitFor();
  await eventually(
    'the previous version to be desired',
    async () => (await server.ask('GET', '/robots/atlas')).tasks[0]?.version === '1.0.0',
  );
  assertQuiet(page);
});

test('a log can be followed, paused and filtered', async (t) => {
  const server = await Server.start(t);
  await agent(t, server, 'atlas');
  server.push('talker', '1.0.0', {
    to: 'atlas',
    files: {
      'run.sh': '#!/bin/sh\ni=0\nwhile :; do i=$((i+1)); echo "line $i"; sleep 0.2; done\n',
    },
  });
  const page = await open(t, server, { hash: '#/robots/atlas/logs' });
  const lines = () => page.getByRole('log').innerText();
  await eventually('lines to come', async () => /line 3\b/.test(await lines()));
  await page.getByRole('button', { name: 'Pause' }).click();
  const before = await lines();
  // The button shows the number of waiting lines.
  const resume = page.getByRole('button', { name: /Resume \([2-9]\d* new\)/ });
  await resume.waitFor();
  assert.equal(await lines(), before, 'nothing moves while it is paused');
  await resume.click();
  await eventually('lines to go on', async () => (await lines()) !== before);
  await page.getByLabel('Level').selectOption('error');
  await eventually('only errors to be left', async () => !/line \d/.test(await lines()));
  assert.match(page.url(), /level=error/);
  assertQuiet(page);
});

test('a live line that was fetched before appears once', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  const page = await open(t, server);
  const [fetched, later] = ['fetched', 'later'].map((text, at_ms) => ({
    at_ms,
    level: 'info',
    source: 'task',
    task: 'talker',
    text,
  }));
  const line = (text) => page.getByRole('log').getByText(text, { exact: true });
  let streams = 0;
  await page.route('**/robots/*/logs?**', async (route) => {
    if (!route.request().url().includes('follow')) {
      await route.fulfill({ json: { from: 'robot', age_ms: 0, lines: [fetched] } });
      return;
    }
    streams += 1;
    // The next connection stays open and silent.
    if (streams > 1) return;
    await line('fetched').waitFor();
    const event = { type: 'lines', lines: [fetched, later], suppressed: 0 };
    await route.fulfill({
      contentType: 'text/event-stream',
      body: `data: ${JSON.stringify(event)}\n\n`,
    });
  });
  await page.goto(`${server.url}/#/robots/atlas/logs`);
  await line('later').waitFor();
  assert.equal(await line('fetched').count(), 1);
  assertQuiet(page);
});

test('the log of another robot shows no lines of the previous robot', async (t) => {
  const server = await Server.start(t);
  for (const [robot, task] of [
    ['atlas', 'talker'],
    ['borea', 'singer'],
  ]) {
    await agent(t, server, robot);
    server.push(task, '1.0.0', {
      to: robot,
      files: { 'run.sh': `#!/bin/sh\nwhile :; do echo "${task} of ${robot}"; sleep 0.2; done\n` },
    });
  }
  const page = await open(t, server, { hash: '#/robots/atlas/logs' });
  const said = async (text) => (await page.getByRole('log').innerText()).includes(text);
  await eventually('lines of the first robot', () => said('talker of atlas'));
  await page.goto(`${server.url}/#/robots/borea/logs`);
  await eventually('lines of the second robot', () => said('singer of borea'));
  assert.equal(await said('atlas'), false);
  // The same robot by its id has a page of its own as well.
  const { id } = await server.ask('GET', '/robots/borea');
  await page.goto(`${server.url}/#/robots/${id}/logs`);
  await until(page, () => document.querySelector('.log-line'));
  assert.equal(await page.locator('.log-view > *').count(), 1);
  assertQuiet(page);
});

test('labels can be edited for one robot and in bulk', async (t) => {
  const server = await Server.start(t);
  for (const name of ['atlas', 'borea']) await Puppet.enroll(server, name);
  const page = await open(t, server);
  await row(page, 'atlas').getByRole('button', { name: 'Edit atlas' }).click();
  await page.getByRole('textbox', { name: 'Labels' }).fill('site=lab, floor=2');
  await page.getByRole('button', { name: 'Save' }).click();
  await eventually(
    'the labels',
    async () => (await server.ask('GET', '/robots/atlas')).labels.floor === '2',
  );
  await page.getByRole('checkbox', { name: 'Select all shown robots' }).click();
  await page.getByRole('button', { name: 'Label…' }).click();
  await page.getByLabel('Labels to set').fill('site=yard');
  await page.getByRole('dialog').getByRole('checkbox', { name: 'floor' }).check();
  await page.getByRole('dialog').getByRole('button', { name: 'Label' }).click();
  for (const name of ['atlas', 'borea']) {
    await eventually(
      `the labels of ${name}`,
      async () =>
        JSON.stringify((await server.ask('GET', `/robots/${name}`)).labels) === '{"site":"yard"}',
    );
  }
  // A typing error is shown in the dialog, and nothing is lost.
  await row(page, 'atlas').getByRole('button', { name: 'Edit atlas' }).click();
  await page.getByRole('textbox', { name: 'Labels' }).fill('site');
  await page.getByRole('button', { name: 'Save' }).click();
  await page.getByRole('dialog').getByText('site: labels have the form name=value').waitFor();
  assert.equal(await page.getByRole('textbox', { name: 'Labels' }).inputValue(), 'site');
  assertQuiet(page);
});

test('bulk actions apply only to the robots loaded when they were selected', async (t) => {
  const server = await Server.start(t);
  // One more than the first page of the list holds.
  for (let arm = 1; arm <= 101; arm += 1) await Puppet.enroll(server, `arm${arm}`);
  const page = await open(t, server);
  await page.route(/\/robots\?.*after=/, () => {});
  await page.reload();
  await page.getByRole('checkbox', { name: 'Select all shown robots' }).click();
  await page.getByText('100 selected').waitFor();
  await page.getByRole('button', { name: 'Label…' }).click();
  await page.getByLabel('Labels to set').fill('floor=2');
  await page.getByRole('dialog').getByRole('button', { name: 'Label' }).click();
  await page.getByText('Labels of 100 robots updated.').waitFor();
  await page.getByRole('button', { name: 'Delete…' }).click();
  await page.getByRole('dialog').getByRole('button', { name: 'Delete' }).click();
  await page.getByText('100 robots deleted.').waitFor();
  const { robots } = await server.ask('GET', '/robots');
  assert.deepEqual(
    robots.map(({ labels }) => labels),
    [{}],
    'the robot that was not loaded is unchanged',
  );
  assertQuiet(page);
});

test('an operator with a scope can deploy to all robots in it', async (t) => {
  const server = await Server.start(t);
  for (const name of ['atlas', 'borea']) await Puppet.enroll(server, name, { site: 'lab' });
  await Puppet.enroll(server, 'corvus', { site: 'yard' });
  server.push('talker', '1.0.0');
  await server.ask('POST', '/users', { name: 'alice', roles: ['operator'], scope: 'site=lab' });
  const { token } = await server.ask('POST', '/tokens', { user: 'alice', title: 'the page' });
  const page = await open(t, server, { token });
  await page.getByRole('checkbox', { name: 'Select all shown robots' }).click();
  await page.getByRole('button', { name: 'Push…' }).click();
  await page.getByRole('dialog').getByLabel('Package').selectOption('talker');
  await page.getByRole('dialog').getByRole('button', { name: 'Deploy' }).click();
  await page.waitForURL(/#\/deployments\/d/);
  const {
    deployments: [{ counts }],
  } = await server.ask('GET', '/deployments');
  assert.equal(
    counts.reduce((sum, { count }) => sum + count, 0),
    2,
  );
  assertQuiet(page);
});
