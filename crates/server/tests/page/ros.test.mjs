// The ROS graph of a robot in the page: real nodes are looked at, moved through their lifecycle and
// given parameters.

import { test } from 'node:test';
import {
  agent,
  assert,
  assertAccessible,
  assertQuiet,
  open,
  probe,
  ros,
  Server,
} from './harness.mjs';

test('nodes are listed, change their lifecycle state and take parameters', async (t) => {
  const server = await Server.start(t);
  await agent(t, server, 'atlas', await ros(t));
  const run =
    '#!/bin/sh\nexec python3 probe.py ' +
    '--node mapper --lifecycle --service /say --topic /ticks --hz 5\n';
  server.push('mapper', '1.0.0', {
    files: { 'run.sh': run, 'probe.py': probe },
    more: "[ready]\nhold_s = 0\ntimeout_s = 60\nlifecycle = ['/mapper']\n",
    to: 'atlas',
  });
  const page = await open(t, server, { hash: '#/robots/atlas/tasks' });
  await page.locator('.phase', { hasText: 'running' }).first().waitFor();
  await page.getByRole('link', { name: 'ROS' }).click();
  const row = (table, name) => page.getByRole('region', { name: table }).getByRole('row', { name });
  await row('Table of nodes', '/mapper mapper active').waitFor();
  await row('Table of topics', '/ticks std_msgs/msg/String /mapper none').waitFor();
  await page.getByPlaceholder('Filter nodes and topics').fill('tick');
  await page.getByText('No nodes match this filter.').waitFor();
  await page.getByPlaceholder('Filter nodes and topics').fill('');

  await page
    .getByRole('region', { name: 'Table of nodes' })
    .getByRole('link', { name: '/mapper' })
    .click();
  const parameter = page.locator('.parameters li', { hasText: 'resolution' });
  await parameter.getByText('0.05').waitFor();
  await page.getByText('Offers').click();
  await page.getByText('/say std_srvs/srv/Trigger').waitFor();
  const set = async (value) => {
    await page.getByLabel('resolution', { exact: true }).fill(value);
    await page.getByRole('button', { name: 'Set', exact: true }).click();
  };
  await page.getByRole('button', { name: 'Change resolution' }).click();
  await set('coarse');
  await page.getByText('Not a valid JSON value.').waitFor();
  await set('-1');
  await page.getByText('/mapper does not accept resolution = -1: must be positive').waitFor();
  await set('2');
  await parameter.locator('.value', { hasText: /^2(\.0)?$/ }).waitFor();
  await assertAccessible(page, 'the graph');

  // Nothing is done to a node without a question.
  const transitions = [];
  page.on(
    'request',
    (request) =>
      request.postData()?.includes('"transition"') && transitions.push(request.postData()),
  );
  const dialog = page.getByRole('dialog');
  await page.getByRole('button', { name: 'shutdown…' }).click();
  await dialog.getByText('of the task mapper on atlas is active').waitFor();
  await dialog.getByRole('button', { name: 'Cancel' }).click();
  await dialog.waitFor({ state: 'hidden' });
  assert.deepEqual(transitions, []);
  const change = async (transition, action) => {
    await page.getByRole('button', { name: transition, exact: true }).click();
    await dialog.getByRole('button', { name: action, exact: true }).click();
  };
  await change('deactivate…', 'Deactivate');
  await row('Table of nodes', '/mapper mapper inactive').waitFor();
  await page.getByRole('link', { name: 'Monitor' }).click();
  await page.getByText('node inactive').first().waitFor();
  await page.goBack();
  await change('activate…', 'Activate');
  await row('Table of nodes', '/mapper mapper active').waitFor();
  assert.match(page.url(), /node=%2Fmapper/);
  assertQuiet(page);
});
