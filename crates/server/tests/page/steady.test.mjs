// The page's elements keep their positions while robots send one report after the other.

import { test } from 'node:test';
import { assert, assertQuiet, eventually, open, Puppet, Server, settled } from './harness.mjs';

const MB = 2 ** 20;
const HELD = { code: 'held', text: 'a wheel is being changed' };
const FULL = { code: 'disk_low', text: '1 GB is left' };
const UNWELL = { code: 'unhealthy', text: 'its health check fails' };
const FAILURE = {
  code: 'build_failed',
  text: 'colcon build ended with status 1: fatal error: no such file or directory',
};

const progress = (megabytes) => ({
  each: () => ({ progress: { done: Math.round(megabytes * MB), total: 400 * MB } }),
});
const failure = { each: () => ({ failure: FAILURE }) };
const fails = (index) => index % 3 === 0;
const held = (index) => ({ conditions: index % 4 === 3 ? [HELD] : [] });

/**
 * Successive reports of twenty robots, and the text then shown for one of them: on all pages, or on
 * the robots' page alone.
 */
const STORY = [
  { says: () => ['fetching', progress(9.9)], seen: ['robot19', '9.9 of 400.0 MB'] },
  {
    says: (index) => ['fetching', { ...progress(100.1), ...held(index) }],
    seen: ['robot19', '100.1 of 400.0 MB'],
  },
  { says: (index) => ['building', held(index)], seen: ['robot19', 'building'] },
  {
    says: (index) =>
      fails(index) ? ['failed', { ...failure, ...held(index) }] : ['starting', held(index)],
    seen: ['robot18', FAILURE.text],
  },
  {
    says: (index) =>
      fails(index)
        ? ['failed', { ...failure, conditions: [HELD, FULL] }]
        : ['running', { each: () => ({ restarts: 2 }) }],
    seen: ['robot18', FULL.text],
    isOfRobots: true,
  },
  {
    says: (index) =>
      fails(index)
        ? ['failed', failure]
        : ['running', { each: () => ({ restarts: 3, degraded: UNWELL }) }],
    seen: ['robot19', 'unhealthy'],
  },
];

/** From now on measures the page's layout shifts without user input. */
const watchShifts = (page) =>
  page.evaluate(() => {
    const begun = performance.now();
    const all = [];
    const textOf = (node) =>
      `${node?.parentElement?.className}: ` +
      node?.textContent.trim().replace(/\s+/g, ' ').slice(0, 40);
    // A duration that is longer by a digit begins further to the left, and pushes nothing.
    const isPushed = ({ node, previousRect, currentRect }) =>
      node?.parentElement?.closest('.rows') && previousRect.top !== currentRect.top;
    const take = (entries) => {
      for (const { value, hadRecentInput, startTime, sources } of entries) {
        if (hadRecentInput || startTime < begun) continue;
        all.push({
          value,
          what: sources.map(({ node }) => textOf(node)),
          rows: sources.filter((source) => isPushed(source)).length,
        });
      }
    };
    const observer = new PerformanceObserver((list) => take(list.getEntries()));
    observer.observe({ type: 'layout-shift', buffered: true });
    window.shifts = () => {
      take(observer.takeRecords());
      return {
        sum: all.reduce((sum, { value }) => sum + value, 0),
        rows: all.reduce((sum, { rows }) => sum + rows, 0),
        all,
      };
    };
  });
const shifts = async (page) => {
  await settled(page);
  return page.evaluate(() => window.shifts());
};

test('rows keep their positions while reports arrive', async (t) => {
  const server = await Server.start(t);
  const robots = [];
  for (let index = 0; index < 20; index += 1)
    robots.push(await Puppet.enroll(server, `robot${index}`));
  const { id } = server.push('talker', '1.0.0', { to: '*' });
  for (const robot of robots) await robot.report('assigned');
  // A window each, with room for all of them: hidden windows are not drawn.
  const wide = await open(t, server, { viewport: { width: 1280, height: 1200 } });
  const narrow = await open(t, server, { viewport: { width: 375, height: 2700 } });
  const deployment = await open(t, server, {
    hash: `#/deployments/${id}`,
    viewport: { width: 1280, height: 1200 },
  });
  const pages = [wide, narrow, deployment];
  for (const page of pages) {
    await page
      .locator('[data-key]', { hasText: 'robot19' })
      .locator('.phase', { hasText: 'assigned' })
      .waitFor();
    await settled(page);
    await watchShifts(page);
  }
  for (const { says, seen, isOfRobots } of STORY) {
    for (const [index, robot] of robots.entries()) await robot.report(...says(index));
    const [name, text] = seen;
    for (const page of isOfRobots ? [wide, narrow] : pages)
      await page.locator('[data-key]', { hasText: name }).filter({ hasText: text }).waitFor();
  }
  for (const list of [wide, narrow]) {
    const { sum, all } = await shifts(list);
    assert.equal(sum, 0, JSON.stringify(all));
  }
  // Beside the robots the reasons of failures make themselves room, and above them a button to
  // retry. The robots stay where they are.
  const ofDeployment = await shifts(deployment);
  assert.ok(ofDeployment.sum < 0.01 && ofDeployment.rows === 0, JSON.stringify(ofDeployment.all));
  // A shift would have been seen:
  for (const page of pages)
    await page.evaluate(() => document.getElementById('main').prepend('This pushes all the rest.'));
  for (const page of pages)
    await eventually('the shift', async () => (await shifts(page)).sum > 0.001);
  for (const page of pages) assertQuiet(page);
});

test('on a narrow screen robots without tasks have the calculated height', async (t) => {
  const server = await Server.start(t);
  const robots = [];
  for (let index = 0; index < 12; index += 1)
    robots.push(await Puppet.enroll(server, `robot${index}`));
  await robots[11].report('running', { conditions: [HELD] });
  const page = await open(t, server, { viewport: { width: 375, height: 700 } });
  await page.locator('[data-robot]').first().waitFor();
  await page
    .locator('.rows')
    .evaluate((rows) => rows.ownerDocument.scrollingElement.scrollTo(0, 1e6));
  await page.locator('[data-robot]', { hasText: 'robot11' }).locator('.condition').waitFor();
  const { end, last } = await page.evaluate(() => ({
    end: document.querySelector('.rows').getBoundingClientRect().bottom,
    last: [...document.querySelectorAll('[data-robot]')].at(-1).getBoundingClientRect().bottom,
  }));
  assert.ok(Math.abs(end - last) < 2, `the last row ends at ${last}, the rows at ${end}`);
  assertQuiet(page);
});
