// Starts the real programs with their own directories and ports, and a real browser that shows
// the page. Nothing is left behind.

import assert from 'node:assert/strict';
import { spawn, spawnSync } from 'node:child_process';
import { createHash, randomBytes } from 'node:crypto';
import { createSocket } from 'node:dgram';
import {
  chmodSync,
  existsSync,
  mkdirSync,
  mkdtempSync,
  openSync,
  readFileSync,
  readdirSync,
  rmSync,
  rmdirSync,
  writeFileSync,
} from 'node:fs';
import { createRequire } from 'node:module';
import { tmpdir } from 'node:os';
import { dirname, join } from 'node:path';
import { fileURLToPath } from 'node:url';

/** Time limit for any expected event on a busy machine. */
export const PATIENCE_MS = 60_000;
/** User id of the robots' tasks where the tests run as root: a user that owns nothing. */
const TASK_USER = '65534';

const packages = process.env.TASKD_TEST_PAGE;
assert.ok(
  packages,
  'TASKD_TEST_PAGE is not set: run ./scripts/test, ' +
    'or set it to the directory that scripts/need page prints',
);
const require = createRequire(join(packages, 'node_modules/'));
const { chromium } = require('playwright-core');
const AXE = readFileSync(require.resolve('axe-core/axe.min.js'), 'utf8');

export const root = join(dirname(fileURLToPath(import.meta.url)), '../../../..');

/** The path of one of the workspace's programs. */
export function program(name) {
  const path = join(process.env.CARGO_TARGET_DIR ?? join(root, 'target'), 'debug', name);
  assert.ok(existsSync(path), `${path} is missing: run cargo build --bins, or ./scripts/test`);
  return path;
}

/** Polls until there is an answer; fails with `what` after the time limit. */
export async function eventually(what, ask) {
  const end = Date.now() + PATIENCE_MS;
  let last;
  while (Date.now() < end) {
    try {
      const answer = await ask();
      if (answer) return answer;
    } catch (error) {
      last = error;
    }
    await new Promise((resume) => setTimeout(resume, 50));
  }
  throw new Error(`still waiting for ${what}${last ? `: ${last.message}` : ''}`);
}

const endings = new WeakMap();

/** Registers a clean-up for the end of the test. Clean-ups run in reverse order. */
export function atEnd(t, end) {
  if (!endings.has(t)) {
    endings.set(t, []);
    t.after(async () => {
      for (const one of endings.get(t).reverse()) await one();
    });
  }
  endings.get(t).push(end);
}

/** A directory of the test's own, removed with the test. */
export function directory(t) {
  const path = mkdtempSync(join(tmpdir(), 'taskd-page-'));
  // For the user that tasks run as.
  chmodSync(path, 0o711);
  atEnd(t, () => rmSync(path, { recursive: true, force: true }));
  return path;
}

function start(t, log, path, args, environment = {}) {
  const file = openSync(log, 'a');
  const child = spawn(path, args, {
    stdio: ['ignore', file, file],
    env: { ...process.env, ...environment },
  });
  const ended = new Promise((resume) => child.once('exit', resume));
  const stop = async (signal = 'SIGTERM') => {
    child.kill(signal);
    await ended;
  };
  atEnd(t, () => stop('SIGKILL'));
  return { child, stop };
}

/**
 * A disk of `bytes` bytes, for a server to be started with. The disk is mounted in the namespace of
 * an idle process only, and vanishes with that process: the server joins the namespace, and others
 * look at the disk through the process.
 */
export async function smallDisk(t, bytes) {
  const path = directory(t);
  const isRoot = process.getuid() === 0;
  const mount = `mount -t tmpfs -o size=${bytes} none "$0"`;
  const order = `${mount} && mkdir "$0/there" && exec sleep 1000000`;
  const { child } = start(t, join(directory(t), 'disk.log'), 'unshare', [
    ...(isRoot ? [] : ['--map-root-user']),
    '--mount',
    'sh',
    '-c',
    order,
    path,
  ]);
  const root = `/proc/${child.pid}/root`;
  await eventually('the small disk', () => existsSync(join(root, path, 'there')));
  return {
    path,
    root,
    join: [
      'nsenter',
      '--target',
      String(child.pid),
      '--mount',
      ...(isRoot ? [] : ['--user', '--preserve-credentials']),
    ],
  };
}

/** A `taskd serve` with a data directory of its own. */
export class Server {
  /**
   * `configuration` is the content of its file, `environment` further settings, `disk` the disk of
   * its data, if not the usual one.
   */
  static async start(
    t,
    {
      environment = {},
      configuration = '',
      disk = null,
      data = join(disk?.path ?? directory(t), 'server'),
      http = '127.0.0.1:0',
      mqtt = '127.0.0.1:0',
    } = {},
  ) {
    const server = new Server();
    const seen = join(disk?.root ?? '/', data);
    Object.assign(server, { t, data: seen });
    rmSync(join(seen, 'addresses.json'), { force: true });
    writeFileSync(`${seen}.toml`, configuration);
    const [path, ...order] = [
      ...(disk?.join ?? []),
      program('taskd'),
      'serve',
      '--data',
      data,
      '--config',
      `${data}.toml`,
      '--http',
      http,
      '--mqtt',
      mqtt,
    ];
    server.process = start(t, `${seen}.log`, path, order, environment);
    const addresses = await eventually('the server to say where it is', () =>
      JSON.parse(readFileSync(join(seen, 'addresses.json'), 'utf8')),
    );
    server.http = addresses.http;
    server.url = `http://${addresses.http}`;
    server.token = readFileSync(join(seen, 'operator.token'), 'utf8').trim();
    await eventually(
      'the server to be ready',
      async () => (await fetch(`${server.url}/readyz`)).ok,
    );
    return server;
  }

  /** Calls the API as the operator, or with another token; returns the body. */
  async ask(method, path, body, { token = this.token, headers = {} } = {}) {
    const response = await fetch(`${this.url}/api/v1${path}`, {
      method,
      headers: {
        authorization: `Bearer ${token}`,
        ...(body ? { 'content-type': 'application/json' } : {}),
        ...headers,
      },
      body: body && JSON.stringify(body),
    });
    const text = await response.text();
    assert.ok(response.ok, `${method} ${path}: ${response.status} ${text}`);
    return text ? JSON.parse(text) : null;
  }

  /** Runs an operator's command that must succeed; returns its output. */
  operate(...args) {
    const environment = { ...process.env, TASKD_SERVER: this.url, TASKD_TOKEN: this.token };
    const { status, stdout, stderr } = spawnSync(program('taskd'), args, {
      env: environment,
      encoding: 'utf8',
    });
    assert.equal(status, 0, `taskd ${args.join(' ')}: ${stderr}${stdout}`);
    return stdout;
  }

  /**
   * Pushes a package; `files` are its files by name, `more` further lines of its manifest, `to` the
   * robots of its deployment, `force` whether its version may be another's. Returns the output.
   */
  push(
    name,
    version,
    { files = { 'run.sh': '#!/bin/sh\nexec sleep 1000\n' }, more = '', to, force = false } = {},
  ) {
    const path = join(directory(this.t), name);
    mkdirSync(path);
    for (const [file, content] of Object.entries(files)) {
      mkdirSync(dirname(join(path, file)), { recursive: true });
      writeFileSync(join(path, file), content);
      if (String(content).startsWith('#!')) chmodSync(join(path, file), 0o755);
    }
    writeFileSync(
      join(path, 'task.toml'),
      `name = "${name}"\nversion = "${version}"\n\n[run]\nexec = ["./run.sh"]\n${more}`,
    );
    return JSON.parse(
      this.operate(
        'push',
        path,
        '-o',
        'json',
        ...(force ? ['--force'] : []),
        ...(to ? ['--to', to, '--yes'] : []),
      ),
    );
  }

  createEnrollmentToken(wanted = {}) {
    return this.ask('POST', '/enrollment-tokens', wanted);
  }
}

let macs = 0;
const nextMac = () => {
  macs += 1;
  const [high, low] = [macs >> 8, macs & 255].map((byte) => byte.toString(16).padStart(2, '0'));
  return `02:00:00:01:${high}:${low}`;
};

/**
 * A real `task-agent`, enrolled and running. Its tasks end with the test. `within` is the command
 * that starts it in another namespace.
 */
export async function agent(t, server, name, environment = {}, within = []) {
  const [path, ...order] = [...within, program('task-agent')];
  const data = join(directory(t), name);
  const { token } = await server.createEnrollmentToken({ uses: 1 });
  const asRoot = process.getuid() === 0 ? { TASK_AGENT_TASK_USER: TASK_USER } : {};
  const enrolled = spawnSync(
    path,
    [
      ...order,
      'enroll',
      '--data',
      data,
      '--server',
      server.url,
      '--token',
      token,
      '--name',
      name,
      '--mac',
      nextMac(),
    ],
    { encoding: 'utf8' },
  );
  assert.equal(enrolled.status, 0, enrolled.stderr);
  // After the agent's end: tasks outlive it on purpose.
  atEnd(t, () => endProcessesOf(data));
  const { stop } = start(t, `${data}.log`, path, [...order, 'run', '--data', data], {
    ...asRoot,
    ...environment,
  });
  return { name, stop };
}

/**
 * The settings of an agent whose tasks find ROS, in a domain reserved on this machine.
 */
export async function ros(t) {
  const home = process.env.TASKD_TEST_ROS;
  assert.ok(
    home,
    'TASKD_TEST_ROS is not set: run ./scripts/test, ' +
      'or set it to the path that `scripts/need ros` prints, without /bin/activate',
  );
  // A port that no participant of the domain uses is the lock: 7400 + 250 n + 249 would be the
  // 120th participant's.
  for (let domain = 70; domain > 0; domain -= 1) {
    const lock = createSocket('udp4');
    const isFree = await new Promise((resume) =>
      lock
        .once('error', () => resume(false))
        .bind(7400 + 250 * domain + 249, '127.0.0.1', () => resume(true)),
    );
    if (!isFree) continue;
    atEnd(t, () => new Promise((resume) => lock.close(resume)));
    const asRoot = process.getuid() === 0 ? { TASK_AGENT_TASK_USER: 'root' } : {};
    return {
      ...asRoot,
      TASK_AGENT_UNDERLAYS: join(home, 'bin/activate'),
      TASK_AGENT_ROS_DOMAIN_ID: String(domain),
      ROS_AUTOMATIC_DISCOVERY_RANGE: 'LOCALHOST',
    };
  }
  throw new Error('there is no free ROS domain');
}

/** The node of the end-to-end tests, which follows its arguments. */
export const probe = readFileSync(
  join(root, 'crates/bench/tests/it/graph_probe/graph_probe/probe.py'),
  'utf8',
);

/** The control groups of an agent's runs. They outlive the agent, as its tasks do. */
function groupsOf(data) {
  const tasks = join(data, 'tasks');
  const entries = existsSync(tasks) ? readdirSync(tasks, { recursive: true }) : [];
  const specs = entries.filter((entry) => /^[^/]+\/run\/[^/]+\/spec\.json$/.test(entry));
  return specs
    .map((spec) => JSON.parse(readFileSync(join(tasks, spec), 'utf8')).cgroup)
    .filter(Boolean);
}

/** Whether a control group is no longer there, or could be removed: nothing is left in it. */
function isGone(group) {
  try {
    rmdirSync(group);
  } catch ({ code }) {
    return code === 'ENOENT';
  }
  return true;
}

/**
 * Ends every process whose command line or environment names this directory: shims, then their
 * tasks.
 */
async function endProcessesOf(data) {
  const groups = groupsOf(data);
  for (let round = 0; round < 3; round += 1) {
    for (const pid of readdirSync('/proc').filter(
      (entry) => /^\d+$/.test(entry) && Number(entry) !== process.pid,
    )) {
      try {
        const said =
          readFileSync(`/proc/${pid}/cmdline`, 'latin1') +
          readFileSync(`/proc/${pid}/environ`, 'latin1');
        if (said.includes(data)) process.kill(Number(pid), 'SIGKILL');
      } catch {
        // The process ended meanwhile, or is none of ours.
      }
    }
  }
  for (const group of groups) await eventually(`the end of ${group}`, () => isGone(group));
}

/**
 * A simulated robot that reports over HTTP on the test's command: reports that no real robot sends,
 * or not at the moment of the test.
 */
export class Puppet {
  #seq = 0;
  #instance = `i${randomBytes(8).toString('hex')}`;

  static async enroll(server, name, labels = {}) {
    const { token } = await server.createEnrollmentToken({ uses: 1 });
    const enrolled = await server.ask(
      'POST',
      '/enroll',
      { mac: nextMac(), name, labels },
      { token },
    );
    return Object.assign(new Puppet(), {
      server,
      name,
      id: enrolled.robot_id,
      token: enrolled.token,
    });
  }

  /** The robot's desired state. */
  async desired() {
    const { payload } = await this.server.ask('GET', `/robots/${this.id}/desired`, undefined, {
      token: this.token,
    });
    return JSON.parse(Buffer.from(payload, 'base64'));
  }

  /**
   * Reports each of its tasks in `phase`, with the additions of `each`, a function of the task's
   * desired state.
   */
  async report(phase, { each = () => ({}), conditions = [], host = {}, link = null } = {}) {
    const state = await this.desired();
    this.#seq += 1;
    const body = {
      robot_id: this.id,
      start: 1,
      instance: this.#instance,
      boot_id: 'boot',
      seq: this.#seq,
      observed_generation: state.generation,
      uptime_ms: 1_000,
      conditions,
      link,
      host: { agent_version: '0.1.0', hostname: `${this.name}.local`, arch: 'x86_64', ...host },
      tasks: state.tasks.map((one) => ({
        task: one.task,
        deployment: one.deployment,
        package: one.package,
        wanted: one.wanted,
        run: one.run,
        kind: 'service',
        phase,
        phase_ms: 0,
        attempts: 1,
        restarts: 0,
        ...each(one),
      })),
    };
    await this.server.ask('POST', `/robots/${this.id}/report`, body, { token: this.token });
  }

  /** Reports the vitals of its machine. */
  async vitals(sample) {
    await this.server.ask(
      'POST',
      `/robots/${this.id}/telemetry`,
      { robot_id: this.id, vitals: sample },
      { token: this.token },
    );
  }

  /** Uploads output files of a task, by their paths. */
  async bringBack(task, files) {
    const blobs = [];
    for (const [path, bytes] of files)
      blobs.push({ path, ...(await this.#putBlob(task, Buffer.from(bytes))) });
    const output = {
      robot_id: this.id,
      task,
      version: '1.0.0',
      deployment: 'd00000000000000b2',
      run: 1,
      files: blobs,
    };
    const manifest = {
      schemaVersion: 2,
      mediaType: 'application/vnd.oci.image.manifest.v1+json',
      artifactType: 'application/vnd.taskd.output.v1',
      config: {
        mediaType: 'application/vnd.taskd.output.config.v1+json',
        ...(await this.#putBlob(task, Buffer.from(JSON.stringify(output)))),
      },
      layers: blobs.map(({ path, digest, size }) => ({
        mediaType: 'application/octet-stream',
        digest,
        size,
        annotations: { 'org.opencontainers.image.title': path },
      })),
    };
    await this.#put(
      'PUT',
      `${task}/manifests/${output.deployment}-1`,
      JSON.stringify(manifest),
      manifest.mediaType,
    );
  }

  async #putBlob(task, bytes) {
    const digest = `sha256:${createHash('sha256').update(bytes).digest('hex')}`;
    await this.#put(
      'POST',
      `${task}/blobs/uploads/?digest=${digest}`,
      bytes,
      'application/octet-stream',
    );
    return { digest, size: bytes.length };
  }

  async #put(method, path, body, type) {
    const response = await fetch(`${this.server.url}/v2/outputs/${this.id}/${path}`, {
      method,
      headers: { authorization: `Bearer ${this.token}`, 'content-type': type },
      body,
    });
    assert.equal(response.status, 201, `${method} ${path}`);
  }
}

/** Headless Chromium. */
export async function browser(t) {
  const sandbox = process.getuid() === 0 ? ['--no-sandbox'] : [];
  const it = await chromium.launch({
    executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
    args: [...sandbox, '--disable-gpu', '--disable-dev-shm-usage'],
  });
  atEnd(t, () => it.close());
  return it;
}

/**
 * Browser messages about answers that the page expects: an absent robot, or one that does not know
 * the requested item.
 */
const REFUSAL = /^Failed to load resource: .* status of (409|504) /;
/** Contexts whose pages were opened by `open`, each with its browser's complaints. */
const complaints = new WeakMap();

/**
 * A page at `hash`, signed in with the token of a link. Requests to other hosts and messages on the
 * console fail the test at its end.
 */
export async function open(t, server, { on, hash = '', token = server.token, ...options } = {}) {
  const context = await (on ?? (await browser(t))).newContext({
    viewport: { width: 1280, height: 900 },
    ...options,
  });
  context.setDefaultTimeout(PATIENCE_MS);
  const said = [];
  complaints.set(context, said);
  await context.route(
    (url) => !url.href.startsWith(`${server.url}/`),
    (route) => {
      said.push(`asked ${route.request().url()}`);
      return route.abort();
    },
  );
  context.on(
    'console',
    (message) =>
      ['error', 'warning'].includes(message.type()) &&
      !REFUSAL.test(message.text()) &&
      said.push(message.text()),
  );
  context.on('weberror', (error) => said.push(String(error.error().stack)));
  const page = await context.newPage();
  await followLink(page, server, token);
  await live(page);
  if (hash) await page.goto(`${server.url}/${hash}`);
  return page;
}

/** Opens a link with a token, and signs in with that token. */
export async function followLink(page, server, token) {
  await page.goto(`${server.url}/#token=${token}`);
  await page.getByRole('button', { name: 'Sign in with token' }).press('Enter');
}

/** Complaints of the page's browser since the last call. */
export const takeComplaints = (page) => complaints.get(page.context()).splice(0);

/** Asserts that the console shows no error and that no other host was contacted. */
export const assertQuiet = (page) => assert.deepEqual(takeComplaints(page), []);

/** Waits until the page is live. */
export const live = (page) => page.locator('.stream', { hasText: 'Live' }).waitFor();

/** Waits until `question` is true in the page. */
export const until = (page, question, argument) =>
  page.waitForFunction(question, argument, { timeout: PATIENCE_MS });

/**
 * Waits until the page has finished drawing: nothing changes any more, except elements that change
 * every second.
 */
export const settled = (page) =>
  page.evaluate(
    () =>
      new Promise((resume) => {
        const QUIET_MS = 300;
        let timer = setTimeout(done, QUIET_MS);
        const observer = new MutationObserver(() => {
          clearTimeout(timer);
          timer = setTimeout(done, QUIET_MS);
        });
        function done() {
          observer.disconnect();
          resume();
        }
        observer.observe(document.getElementById('main'), { childList: true, subtree: true });
      }),
  );

/** Asserts that axe finds no fault in the page. */
export async function assertAccessible(page, what) {
  // The page's own policy forbids foreign scripts; the debugger's scripts are exempt.
  await page.evaluate(`if (!window.axe) { ${AXE} }`);
  const { violations } = await page.evaluate(() =>
    globalThis.axe.run(document, { resultTypes: ['violations'] }),
  );
  const told = violations.map(
    ({ id, help, nodes }) =>
      `${id}: ${help}: ${nodes
        .slice(0, 3)
        .map(({ html }) => html)
        .join(' | ')}`,
  );
  assert.deepEqual(told, [], what);
}

export { assert };
