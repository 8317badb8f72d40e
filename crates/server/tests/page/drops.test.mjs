// Packages that are dropped on the page, and obstacles to the upload: a server that ends meanwhile,
// and one with a full disk.

import { spawnSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { mkdirSync, readdirSync, statSync, writeFileSync } from 'node:fs';
import { dirname, join } from 'node:path';
import { test } from 'node:test';
import {
  assert,
  assertQuiet,
  directory,
  eventually,
  live,
  open,
  Server,
  smallDisk,
  takeComplaints,
  until,
} from './harness.mjs';

const MB = 1_000_000;
const SCRIPT = '#!/bin/sh\nexec sleep 1000\n';

/** A package's directory, with `files` beside its manifest and its program. */
function folder(t, name, files = {}) {
  const top = join(directory(t), name);
  const manifest = `name = "${name}"\nversion = "1.0.0"\n\n[run]\nexec = ["./run.sh"]\n`;
  for (const [path, content] of Object.entries({
    'task.toml': manifest,
    'run.sh': SCRIPT,
    ...files,
  })) {
    mkdirSync(dirname(join(top, path)), { recursive: true });
    writeFileSync(join(top, path), content, { mode: path.endsWith('.sh') ? 0o755 : 0o644 });
  }
  return top;
}

/**
 * Simulates dragging these files from a file manager: moves them over the page, and drops them.
 */
async function drop(page, ...paths) {
  const debug = await page.context().newCDPSession(page);
  const drag = (type) =>
    debug.send('Input.dispatchDragEvent', {
      type,
      x: 600,
      y: 500,
      data: { items: [], files: paths, dragOperationsMask: 1 },
    });
  await drag('dragEnter');
  await drag('dragOver');
  await page.getByText('to upload it').waitFor();
  await drag('drop');
  await page.getByText('to upload it').waitFor({ state: 'detached' });
  await debug.detach();
}

const upload = (page, name) => page.locator('.upload', { hasText: name });
const row = (page, name) => page.locator(`[data-package="${name}@1.0.0"]`);
const listed = async (server) =>
  (await server.ask('GET', '/packages')).packages.map(({ package: { name } }) => name).sort();

/** Asserts that the server's package of a directory equals the command's. */
async function assertSame(server, path, name) {
  const {
    package: { manifest },
  } = (await server.ask('GET', '/packages')).packages.find((one) => one.package.name === name);
  assert.ok(
    server.operate('pack', path, '-o', 'json').includes(manifest.digest),
    `${name}: the same digest`,
  );
}

test('dropped folders and archives become packages', async (t) => {
  const server = await Server.start(t);
  // More files than a browser lists at once.
  const many = Object.fromEntries(
    Array.from({ length: 130 }, (_, index) => [`maps/floor ${index}/größe.txt`, `${index}`]),
  );
  const talker = folder(t, 'talker', {
    ...many,
    '.git/HEAD': 'not this',
    'lib/__pycache__/one.pyc': 'nor this',
  });
  mkdirSync(join(talker, 'empty'));
  const [mapper, sensor] = [
    folder(t, 'mapper'),
    folder(t, 'sensor', { 'model.bin': randomBytes(100_000) }),
  ];
  const page = await open(t, server, { hash: '#/packages' });
  await page.getByText('No packages yet').waitFor();
  await drop(page, talker);
  await row(page, 'talker').waitFor();
  await assertSame(server, talker, 'talker');
  // Several things at once, of each kind.
  const archive = join(directory(t), 'mapper.tar');
  const tar = spawnSync('tar', ['-C', dirname(mapper), '-cf', archive, 'mapper'], {
    encoding: 'utf8',
  });
  assert.equal(tar.status, 0, tar.stderr);
  const zstd = join(directory(t), 'sensor.tar.zst');
  server.operate('pack', sensor, '--out', zstd);
  const notes = join(directory(t), 'notes.txt');
  writeFileSync(notes, 'nothing');
  await drop(page, archive, zstd, notes);
  for (const name of ['mapper', 'sensor']) await row(page, name).waitFor();
  await assertSame(server, mapper, 'mapper');
  await assertSame(server, sensor, 'sensor');
  await upload(page, 'notes.txt').getByText('not a .tar.zst, a .tar or a folder').waitFor();
  assert.deepEqual(await listed(server), ['mapper', 'sensor', 'talker']);
  assertQuiet(page);
});

test('an upload to a killed server fails, leaves nothing behind and can be repeated', async (t) => {
  const server = await Server.start(t);
  const path = folder(t, 'mapper', { 'model.bin': randomBytes(60 * MB) });
  const page = await open(t, server, { hash: '#/packages' });
  const debug = await page.context().newCDPSession(page);
  await debug.send('Network.enable');
  await debug.send('Network.emulateNetworkConditions', {
    offline: false,
    latency: 0,
    downloadThroughput: -1,
    uploadThroughput: 3 * MB,
  });
  await drop(page, path);
  await until(page, () => document.querySelector('.upload progress')?.value > 4_000_000);
  // The server has some of it, and not all.
  const incoming = join(server.data, 'incoming');
  const inThere = () =>
    readdirSync(incoming, { recursive: true })
      .map((name) => statSync(join(incoming, name)))
      .filter((one) => one.isFile())
      .reduce((sum, { size }) => sum + size, 0);
  await eventually('some of it to be there', () => inThere() > MB);
  assert.ok(inThere() < 60 * MB);
  await server.process.stop('SIGKILL');
  await upload(page, 'mapper').locator('.problem', { hasText: 'Connection lost' }).waitFor();
  await page.locator('.stream', { hasText: 'Disconnected' }).waitFor();
  assert.equal(await row(page, 'mapper').count(), 0);
  const again = await Server.start(t, { data: server.data, http: server.http });
  assert.deepEqual(await listed(again), [], 'no partial package is listed');
  assert.deepEqual(readdirSync(incoming), [], 'no partial upload takes up space');
  await live(page);
  await page.getByText('No packages yet').waitFor();
  await debug.send('Network.emulateNetworkConditions', {
    offline: false,
    latency: 0,
    downloadThroughput: -1,
    uploadThroughput: -1,
  });
  await drop(page, path);
  await row(page, 'mapper').waitFor();
  await assertSame(again, path, 'mapper');
});

test('a server with a full disk says so, and accepts smaller packages', async (t) => {
  const server = await Server.start(t, { disk: await smallDisk(t, 30 * MB) });
  const page = await open(t, server, { hash: '#/packages' });
  await drop(page, folder(t, 'mapper', { 'model.bin': randomBytes(60 * MB) }));
  await upload(page, 'mapper')
    .locator('.problem', { hasText: "the server's disk is nearly full" })
    .waitFor();
  assert.match(takeComplaints(page).join(), /507/);
  assert.deepEqual(await listed(server), []);
  assert.deepEqual(readdirSync(join(server.data, 'incoming')), [], 'the received part is removed');
  const small = folder(t, 'talker');
  await drop(page, small);
  await row(page, 'talker').waitFor();
  await assertSame(server, small, 'talker');
  await upload(page, 'mapper').getByRole('button', { name: 'Dismiss' }).click();
  await upload(page, 'mapper').waitFor({ state: 'detached' });
  assertQuiet(page);
});
