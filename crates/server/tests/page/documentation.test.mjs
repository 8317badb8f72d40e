// The API documentation page: its calls are made as the signed-in user.

import { test } from 'node:test';
import { assertQuiet, open, Server } from './harness.mjs';

test('the API documentation calls as the signed-in user and violates no policy', async (t) => {
  const server = await Server.start(t);
  const page = await open(t, server);
  await page.goto(`${server.url}/api/docs`);
  for (const [tag, operation, status] of [
    ['people', 'people_me', '200'],
    ['session', 'session_sign_out', '204'],
  ]) {
    await page.locator(`#operations-tag-${tag}`).click();
    const block = page.locator(`#operations-${tag}-${operation}`);
    for (const button of ['.opblock-summary-control', '.try-out__btn', '.execute'])
      await block.locator(button).click();
    await block
      .locator('.live-responses-table .response .response-col_status', { hasText: status })
      .waitFor();
  }
  assertQuiet(page);
});
