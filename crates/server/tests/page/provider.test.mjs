// Signing in by an OpenID Connect provider that others made, in a real browser, as a person does
// it.

import { spawn } from 'node:child_process';
import { once } from 'node:events';
import { writeFileSync } from 'node:fs';
import { createServer } from 'node:net';
import { join } from 'node:path';
import { createInterface } from 'node:readline';
import { test } from 'node:test';
import { assert, atEnd, browser, directory, live, Server } from './harness.mjs';

const PEOPLE = [
  { sub: '1', preferred_username: 'alice', groups: ['admins'] },
  { sub: '2', preferred_username: 'mallory', groups: [] },
];

/** Starts the provider; answers its address. */
async function provider(t) {
  const environment = process.env.TASKD_TEST_OIDC;
  assert.ok(
    environment,
    'TASKD_TEST_OIDC is not set: run ./scripts/test, ' +
      'or set it to the directory that scripts/need oidc prints',
  );
  const claims = PEOPLE.flatMap((person) => ['--user-claims', JSON.stringify(person)]);
  const child = spawn(
    join(environment, 'bin/python'),
    ['-m', 'oidc_provider_mock', '--port', '0', ...claims],
    { stdio: ['ignore', 'ignore', 'pipe'] },
  );
  atEnd(t, async () => {
    child.kill();
    await once(child, 'exit');
  });
  for await (const line of createInterface({ input: child.stderr })) {
    const [, address] = line.match(/running on (\S+) /) ?? [];
    if (address) {
      // The rest is discarded, because a full pipe would stop the process.
      child.stderr.resume();
      return address;
    }
  }
  throw new Error('the provider did not say where it is');
}

/** A port without a listener at this moment. */
async function freePort() {
  const listener = createServer().listen(0, '127.0.0.1');
  await once(listener, 'listening');
  const { port } = listener.address();
  listener.close();
  return port;
}

test('the page offers the identity provider and explains a failed sign-in', async (t) => {
  const [issuer, port] = [await provider(t), await freePort()];
  const secret = join(directory(t), 'oidc.secret');
  writeFileSync(secret, 'a secret\n');
  const configuration = `
    [oidc]
    issuer = "${issuer}"
    client_id = "taskd"
    client_secret_file = "${secret}"
    public_url = "http://127.0.0.1:${port}"
    title = "the lab"
    [[oidc.rules]]
    claim = "groups"
    value = "admins"
    roles = "admin"`;
  const server = await Server.start(t, { configuration, http: `127.0.0.1:${port}` });
  const context = await (await browser(t)).newContext();
  // Resources that the provider's own page would load from elsewhere.
  await context.route(
    (url) => url.hostname !== '127.0.0.1',
    (route) => route.abort(),
  );
  const page = await context.newPage();
  await page.goto(server.url);
  const signInAs = async (sub) => {
    await page.getByRole('link', { name: 'Sign in with the lab' }).click();
    await page.getByRole('button', { name: sub, exact: true }).click();
  };
  await signInAs('2');
  await page
    .getByRole('alert')
    .filter({ hasText: 'Your account has no role on this server. Ask an administrator.' })
    .waitFor();
  assert.equal(page.url(), `${server.url}/`, 'the problem has left the address bar');
  await signInAs('1');
  await live(page);
  await page.locator('.user', { hasText: 'alice' }).waitFor();
});
