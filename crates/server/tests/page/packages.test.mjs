// Packages and deployments in the page: uploading a folder, browsing and comparing versions,
// deploying, and retrying failures.

import { chmodSync, mkdirSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { test } from 'node:test';
import {
  agent,
  assert,
  assertAccessible,
  assertQuiet,
  directory,
  eventually,
  open,
  Puppet,
  Server,
  takeComplaints,
} from './harness.mjs';

const LONG = `${'d'.repeat(80)}/${'e'.repeat(60)}`;

/** A package's directory. */
function folder(t, name, files) {
  const top = join(directory(t), name);
  for (const [path, content] of Object.entries(files)) {
    mkdirSync(join(top, path, '..'), { recursive: true });
    writeFileSync(join(top, path), content);
    if (content.startsWith('#!')) chmodSync(join(top, path), 0o755);
  }
  return top;
}

const manifest = (name, version, more = 'exec = ["./run.sh"]') =>
  `name = "${name}"\nversion = "${version}"\n\n[run]\n${more}\n`;
const SCRIPT = '#!/bin/sh\nexec sleep 1000\n';

const uploadFolder = (page, path) => page.getByLabel('Folder to upload').setInputFiles(path);

test('an uploaded folder equals the package of the pack command, and runs', async (t) => {
  const server = await Server.start(t);
  await agent(t, server, 'atlas');
  const files = {
    'task.toml': manifest('talker', '1.0.0'),
    'run.sh': SCRIPT,
    [`${LONG}/größe.txt`]: 'x'.repeat(513),
    'empty/none': '',
    '.git/HEAD': 'no',
  };
  const path = folder(t, 'talker', files);
  const page = await open(t, server, { hash: '#/packages' });
  await page.getByText('No packages yet').waitFor();
  await uploadFolder(page, path);
  await page.locator('[data-package="talker@1.0.0"]').waitFor();
  const [uploaded] = (await server.ask('GET', '/packages')).packages;
  const packed = JSON.parse(server.operate('pack', path, '-o', 'json'));
  assert.ok(JSON.stringify(packed).includes(uploaded.package.manifest.digest), 'the same digest');
  await assertAccessible(page, 'the packages');
  await page.locator('[data-package="talker@1.0.0"]').getByRole('button', { name: 'Push' }).click();
  await page.getByRole('dialog').getByLabel('Robots', { exact: true }).fill('*');
  await page.getByRole('dialog').getByText('1 robot matches: atlas').waitFor();
  await assertAccessible(page, 'the order');
  await page.getByRole('dialog').getByRole('button', { name: 'Deploy' }).click();
  await page.locator('[data-assignment=atlas] .phase', { hasText: 'running' }).waitFor();
  await page
    .locator('[data-assignment=atlas]')
    .getByRole('button', { name: /^Phases of atlas/ })
    .click();
  await page.locator('.steps', { hasText: 'running' }).waitFor();
  await assertAccessible(page, 'the deployment');
  assertQuiet(page);
});

test('an error in an uploaded folder names the file and the key', async (t) => {
  const server = await Server.start(t);
  const page = await open(t, server, { hash: '#/packages' });
  await uploadFolder(page, folder(t, 'notes', { 'readme.md': 'nothing' }));
  await page.getByText('notes: contains neither task.toml nor package.xml').waitFor();
  await uploadFolder(
    page,
    folder(t, 'talker', { 'task.toml': manifest('talker', '1.0.0', 'exec = ["./absent.sh"]') }),
  );
  await page
    .locator('.upload', { hasText: 'talker' })
    .locator('.problem', { hasText: 'run.exec' })
    .waitFor();
  assert.match(takeComplaints(page).join(), /422/);
  await page
    .locator('.upload', { hasText: 'talker' })
    .getByRole('button', { name: 'Dismiss' })
    .click();
  await page.locator('.upload', { hasText: 'talker' }).waitFor({ state: 'detached' });
});

test('versions can be browsed, compared and deleted', async (t) => {
  const server = await Server.start(t);
  server.push('talker', '1.0.0', { files: { 'run.sh': SCRIPT, old: 'gone' } });
  server.push('talker', '2.0.0', {
    files: { 'run.sh': `${SCRIPT}# longer\n`, new: 'here' },
    more: 'stop_timeout_s = 20\n',
  });
  const page = await open(t, server, { hash: '#/packages/talker' });
  await page
    .getByRole('row', { name: /run\.sh/ })
    .getByText('0755')
    .waitFor();
  await page.getByLabel('Compare with').selectOption('1.0.0');
  await page.getByRole('row', { name: /added new/ }).waitFor();
  await page.getByRole('row', { name: /removed old/ }).waitFor();
  await page
    .getByRole('row', { name: /changed run\.sh/ })
    .getByText('+9 B')
    .waitFor();
  await page.getByText('run.stop_timeout_s').waitFor();
  assert.match(page.url(), /with=1\.0\.0/);
  await assertAccessible(page, 'the package');
  await page.getByRole('link', { name: /^1\.0\.0/ }).click();
  await page.getByRole('button', { name: 'Delete…' }).click();
  await page.getByRole('dialog').getByRole('button', { name: 'Delete' }).click();
  await eventually(
    'the version to be gone',
    async () => (await server.ask('GET', '/packages')).packages.length === 1,
  );
  await page.getByRole('link', { name: /^1\.0\.0/ }).waitFor({ state: 'detached' });
  assertQuiet(page);
});

test('two packages with the same version are distinguished', async (t) => {
  const server = await Server.start(t);
  const running = (more) => ({
    each: ({ deployment, package: { version, manifest } }) => ({
      active: { deployment, version, pid: 1, ...more(manifest.digest) },
    }),
  });
  const atlas = await Puppet.enroll(server, 'atlas');
  server.push('talker', '1.0.0', { files: { 'run.sh': SCRIPT, 'x86_64.so': 'one' }, to: 'atlas' });
  await atlas.report(
    'running',
    running((manifest) => ({ manifest })),
  );
  const borea = await Puppet.enroll(server, 'borea');
  server.push('talker', '1.0.0', {
    files: { 'run.sh': SCRIPT, 'aarch64.so': 'another' },
    to: 'borea',
    force: true,
  });
  await borea.report(
    'running',
    running((manifest) => ({ manifest })),
  );
  const page = await open(t, server, { hash: '#/packages/talker' });
  const runsOn = (robot) =>
    page
      .locator('section', { has: page.getByRole('heading', { name: 'Runs on 1' }) })
      .getByRole('link', { name: robot });
  await page.getByRole('row', { name: /aarch64\.so/ }).waitFor();
  await runsOn('borea').waitFor();
  await page.getByRole('link', { name: /^1\.0\.0 \(/ }).click();
  await page.getByRole('row', { name: /x86_64\.so/ }).waitFor();
  await runsOn('atlas').waitFor();
  // An older agent reports the version, and not which of the two packages.
  await page.getByRole('link', { name: '1.0.0', exact: false }).first().click();
  await runsOn('borea').waitFor();
  await atlas.report(
    'running',
    running(() => ({})),
  );
  await page.getByRole('heading', { name: 'Runs on 2' }).waitFor();
  await page.goto(`${server.url}/#/packages`);
  await page.locator('[data-key]').getByRole('button', { name: /older/ }).click();
  for (const [index, count] of ['2 robots', '1 robot'].entries())
    await page
      .locator('[data-key]')
      .nth(index)
      .getByRole('link', { name: count, exact: true })
      .waitFor();
  await page.locator('[data-key]').nth(1).getByRole('link', { name: '1.0.0' }).last().click();
  await page.getByRole('row', { name: /x86_64\.so/ }).waitFor();
  assertQuiet(page);
});

test('a package that is assigned to robots cannot be deleted', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  server.push('talker', '1.0.0', { files: { 'run.sh': SCRIPT, 'x86_64.so': 'one' } });
  server.push('talker', '1.0.0', {
    files: { 'run.sh': SCRIPT, 'aarch64.so': 'another' },
    to: 'atlas',
    force: true,
  });
  const page = await open(t, server, { hash: '#/packages/talker' });
  const dialog = page.getByRole('dialog');
  const remove = dialog.getByRole('button', { name: 'Delete' });
  const ask = () => page.getByRole('button', { name: 'Delete…' }).click();
  await ask();
  await dialog.getByText('It is assigned to 1 robot.').waitFor();
  await dialog.getByText('atlas').waitFor();
  assert.equal(await remove.count(), 0);
  await assertAccessible(page, 'the refusal to delete');
  await page.keyboard.press('Escape');
  // No robot should have the other package of the same version.
  await page.getByRole('link', { name: /^1\.0\.0 \(/ }).click();
  await page.getByRole('row', { name: /x86_64\.so/ }).waitFor();
  await ask();
  await remove.click();
  await eventually(
    'the version to be gone',
    async () => (await server.ask('GET', '/packages')).packages.length === 1,
  );
  assertQuiet(page);
});

test('failures are grouped by reason and can be retried', async (t) => {
  const server = await Server.start(t);
  await agent(t, server, 'atlas');
  const { id } = server.push('sensor', '0.1.0', {
    files: { 'run.sh': '#!/bin/sh\nexit 3\n' },
    more: 'restart = "never"\n',
    to: 'atlas',
  });
  const page = await open(t, server, { hash: `#/deployments/${id}` });
  const reason = page.locator('.reason', { hasText: 'on 1 robot' });
  await reason.waitFor();
  await reason.getByRole('button', { name: 'Retry these…' }).click();
  await page.getByRole('dialog').getByRole('button', { name: 'Retry' }).click();
  await page.waitForURL((url) => /#\/deployments\/d/.test(url.hash) && !url.hash.includes(id));
  await page.getByText('supersedes').waitFor();
  await page.goto(`${server.url}/#/deployments`);
  await page.locator('[data-deployment]').nth(1).waitFor();
  await page.getByRole('button', { name: /With failures/ }).click();
  assert.match(page.url(), /state=failures/);
  assertQuiet(page);
});
