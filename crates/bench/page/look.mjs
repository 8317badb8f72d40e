// Looks at the page in headless Chromium and prints its measurements as one JSON object: node look.mjs
// DIRECTORY URL ROBOTS SECONDS, with the operator's token in TASKD_TOKEN. DIRECTORY has
// playwright-core.

import { createRequire } from 'node:module';
import { resolve } from 'node:path';

const [directory, url, robots, seconds] = process.argv.slice(2);
const { chromium } = createRequire(resolve(directory, 'node_modules/_'))('playwright-core');

const LOADS = 5;
const SCROLL_S = 20;
/** A notch of a wheel, and how often: a screen of rows in a quarter of a second. */
const NOTCH_PX = 120;
const NOTCH_MS = 33;
const NOTCHES_PER_TURN = 150;
const HEAP_EVERY_MS = 15_000;
const PATIENCE_MS = 120_000;

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
  args: [
    ...(process.getuid() === 0 ? ['--no-sandbox'] : []),
    '--disable-gpu',
    '--disable-dev-shm-usage',
  ],
});
const context = await browser.newContext({ viewport: { width: 1440, height: 900 } });
context.setDefaultTimeout(PATIENCE_MS);
const page = await context.newPage();
const devtools = await context.newCDPSession(page);

await page.goto(`${url}/#token=${process.env.TASKD_TOKEN}`);
await page.getByRole('button', { name: 'Sign in with token' }).click();
await allRows();

const seen = {
  browser: browser.version(),
  first_rows_ms: [],
  all_rows_ms: [],
  frame_ms: [],
  frame_cpu_ms: [],
  task_ms: [],
  heap_bytes: [],
};

for (let load = 0; load < LOADS; load += 1) {
  await page.goto('about:blank');
  await page.goto(url);
  await page.waitForFunction(() => document.querySelector('[data-robot]'), null, {
    polling: 'raf',
  });
  seen.first_rows_ms.push(await page.evaluate(() => performance.now()));
  await allRows();
  seen.all_rows_ms.push(await page.evaluate(() => performance.now()));
}

await countEvents();
const begun = Date.now();
await scroll();
while (Date.now() - begun < seconds * 1000) {
  await devtools.send('HeapProfiler.collectGarbage');
  seen.heap_bytes.push((await devtools.send('Runtime.getHeapUsage')).usedSize);
  await page.waitForTimeout(
    Math.min(HEAP_EVERY_MS, Math.max(0, begun + seconds * 1000 - Date.now())),
  );
}
Object.assign(seen, {
  events: await page.evaluate(() => window.eventsTakenIn),
  events_s: (Date.now() - begun) / 1000,
});
await browser.close();
process.stdout.write(JSON.stringify(seen));

/** Waits until the page knows all robots. */
async function allRows() {
  const all = Number(robots).toLocaleString('en');
  await page.waitForFunction(
    (count) =>
      document.querySelector('.counter .figure')?.innerText === count &&
      document.querySelector('.stream')?.innerText.includes('Live'),
    all,
    { polling: 'raf' },
  );
}

/** Counts the messages of the stream from now on, through the worker that all tabs share. */
async function countEvents() {
  await page.evaluate(() => {
    window.eventsTakenIn = 0;
    const { port } = new SharedWorker('/ui/api/worker.js', { type: 'module', name: 'taskd' });
    port.onmessage = ({ data }) => (window.eventsTakenIn += data.events?.length ?? 0);
    port.postMessage('join');
  });
}

/**
 * Scrolls down and up like a hand on a wheel, while the browser traces its main thread.
 */
async function scroll() {
  const events = [];
  devtools.on('Tracing.dataCollected', ({ value }) => events.push(...value));
  const complete = new Promise((resume) => devtools.once('Tracing.tracingComplete', resume));
  await devtools.send('Tracing.start', {
    transferMode: 'ReportEvents',
    traceConfig: {
      includedCategories: [
        'toplevel',
        'disabled-by-default-devtools.timeline',
        'devtools.timeline',
        '__metadata',
      ],
    },
  });
  await page.mouse.move(600, 500);
  const end = Date.now() + SCROLL_S * 1000;
  for (let turn = 0; Date.now() < end; turn += 1) {
    await page.mouse.wheel(0, Math.floor(turn / NOTCHES_PER_TURN) % 2 ? -NOTCH_PX : NOTCH_PX);
    await page.waitForTimeout(NOTCH_MS);
  }
  await devtools.send('Tracing.end');
  await complete;
  const main = mainThread(events);
  const tasks = events.filter(
    ({ name, ph, pid, tid }) =>
      ph === 'X' && pid === main.pid && tid === main.tid && name === 'RunTask',
  );
  seen.task_ms = tasks.map(({ dur }) => dur / 1000);
  // A frame's work is the task that its scripts ran in.
  const begins = events
    .filter(
      ({ name, pid, tid }) => name === 'FireAnimationFrame' && pid === main.pid && tid === main.tid,
    )
    .map(({ ts }) => ts);
  const frames = tasks.filter(({ ts, dur }) => begins.some((at) => at >= ts && at <= ts + dur));
  seen.frame_ms = frames.map(({ dur }) => dur / 1000);
  seen.frame_cpu_ms = frames.map(({ tdur }) => tdur / 1000);
}

/** The main thread of the process that ran the most scripts: the page's. */
function mainThread(events) {
  const mains = events.filter(
    ({ name, args }) => name === 'thread_name' && args.name === 'CrRendererMain',
  );
  const frames = ({ pid, tid }) =>
    events.filter(
      (event) => event.name === 'FireAnimationFrame' && event.pid === pid && event.tid === tid,
    ).length;
  return mains.sort((one, other) => frames(other) - frames(one))[0];
}
