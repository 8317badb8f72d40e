// The list of a cluster's servers in the view of the server: two real servers on one Postgres.

import assert from 'node:assert/strict';
import { spawnSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { copyFileSync, mkdirSync } from 'node:fs';
import { createServer } from 'node:net';
import { join } from 'node:path';
import { test } from 'node:test';

import { agent, directory, eventually, open, Server } from './harness.mjs';

/** An address that was free a moment ago: a server of a cluster has to know its own URL. */
async function freeAddress() {
  const listener = createServer();
  await new Promise((resume) => listener.listen(0, '127.0.0.1', resume));
  const { port } = listener.address();
  await new Promise((resume) => listener.close(resume));
  return `127.0.0.1:${port}`;
}

function newDatabase() {
  const postgres = process.env.TASKD_TEST_POSTGRES;
  assert.ok(postgres, 'TASKD_TEST_POSTGRES is not set: run ./scripts/test');
  const name = `taskd_test_${randomBytes(8).toString('hex')}`;
  const made = spawnSync('psql', [`${postgres}/postgres`, '-qc', `CREATE DATABASE ${name}`]);
  assert.equal(made.status, 0, String(made.stderr));
  return `${postgres}/${name}`;
}

async function startNode(t, name, { database, packages }, first) {
  const data = join(directory(t), name);
  mkdirSync(data);
  for (const key of first ? ['signing.key', 'operator.token'] : []) {
    copyFileSync(join(first.data, key), join(data, key));
  }
  const http = await freeAddress();
  return Server.start(t, {
    data,
    http,
    environment: {
      TASKD_DATABASE: database,
      TASKD_BLOBS_STORE: `file://${packages}`,
      TASKD_CLUSTER_NAME: name,
      TASKD_CLUSTER_URL: `http://${http}`,
    },
  });
}

test('server view lists the servers of the cluster', async (t) => {
  const shared = { database: newDatabase(), packages: directory(t) };
  const one = await startNode(t, 'one', shared);
  const two = await startNode(t, 'two', shared, one);
  await agent(t, one, 'atlas');
  await eventually('both servers to know each other', async () => {
    const { nodes } = await two.ask('GET', '/cluster/nodes');
    return nodes.length === 2 && nodes[0].figures?.mqtt.robots_connected === 1;
  });
  const page = await open(t, two, { hash: '#/server' });
  const row = (name) => page.locator(`[data-node="${name}"]`);
  await row('one').waitFor();
  assert.match(await row('one').innerText(), /serving\s+1\s+/);
  assert.match(await row('two').innerText(), /two this page[^]*serving\s+0\s+/);
  assert.match(await page.locator('.figures').innerText(), /1 of 1[^]*1 over MQTT/);
  if (process.env.TASKD_TEST_PICTURE) {
    await page.screenshot({ path: process.env.TASKD_TEST_PICTURE, fullPage: true });
  }
  await one.process.stop('SIGKILL');
  await eventually('the page to show that a server is gone', async () =>
    /does not answer|lost/.test(await row('one').innerText()),
  );
});
