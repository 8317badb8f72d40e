// Actions that close a dialog and actions that do not, so that users lose no typed text and no
// value that is shown only once.

import { test } from 'node:test';
import {
  assert,
  assertAccessible,
  assertQuiet,
  open,
  Puppet,
  Server,
  settled,
} from './harness.mjs';

/** A place beside the dialog. */
const BESIDE = [5, 450];

test('a text selection that ends outside the dialog keeps it open', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  const page = await open(t, server);
  await page.getByRole('checkbox', { name: 'Select atlas' }).click();
  await page.getByRole('button', { name: 'Label…' }).click();
  const field = page.getByLabel('Labels to set');
  await field.fill('site=lab');
  const { x, y, height } = await field.boundingBox();
  await page.mouse.move(x + 60, y + height / 2);
  await page.mouse.down();
  await page.mouse.move(...BESIDE);
  await page.mouse.up();
  await settled(page);
  assert.equal(await field.inputValue(), 'site=lab');
  // A click beside the dialog closes it, as ever.
  await page.mouse.click(...BESIDE);
  await page.getByRole('dialog').waitFor({ state: 'hidden' });
  assertQuiet(page);
});

test('a secret stays open until it is confirmed', async (t) => {
  const server = await Server.start(t);
  const page = await open(t, server, { hash: '#/settings' });
  const dialog = page.getByRole('dialog');
  await page
    .locator('section', { hasText: 'Enrollment tokens' })
    .getByRole('button', { name: 'New token…' })
    .click();
  await dialog.getByRole('button', { name: 'Create token' }).click();
  const secret = dialog.locator('code', { hasText: '--token' });
  await secret.waitFor();
  // Twice by keys: at the second request, a browser closes a dialog by itself.
  await page.keyboard.press('Escape');
  await page.keyboard.press('Escape');
  await page.mouse.click(...BESIDE);
  await settled(page);
  assert.ok(await secret.isVisible());
  await assertAccessible(page, 'the secret');
  await dialog.getByRole('button', { name: 'Done' }).click();
  await dialog.waitFor({ state: 'hidden' });
  assertQuiet(page);
});

test('a push dialog that is still loading does not replace another dialog', async (t) => {
  const server = await Server.start(t);
  await Puppet.enroll(server, 'atlas');
  server.push('talker', '1.0.0');
  const page = await open(t, server);
  const dialog = page.getByRole('dialog');
  const push = async () => {
    const asked = new Promise((resume) => page.route(/\/packages$/, resume, { times: 1 }));
    await page.getByRole('button', { name: 'Push…' }).click();
    await dialog.getByRole('heading', { name: 'Push to atlas' }).waitFor();
    await dialog.getByText('Loading…').waitFor();
    return asked;
  };
  const answer = async (route) => {
    const answered = page.waitForResponse(/\/packages$/);
    await route.continue();
    await (await answered).finished();
    await settled(page);
  };
  await page.getByRole('checkbox', { name: 'Select atlas' }).click();
  const left = await push();
  await page.keyboard.press('Escape');
  await page.getByRole('button', { name: 'Label…' }).click();
  await answer(left);
  assert.equal(await dialog.getByRole('heading').innerText(), 'Label atlas');
  await page.keyboard.press('Escape');
  await answer(await push());
  await dialog.getByRole('button', { name: 'Deploy' }).waitFor();
  assert.equal(
    await page.evaluate(() => document.activeElement.id),
    'order-name',
    'the first field has the focus',
  );
  assertQuiet(page);
});
