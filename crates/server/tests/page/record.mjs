// Makes docs/page/demo.gif, the recording of a push: scripts/record calls it in a network where
// each robot has an address and a slow link. Programs, shell, ROS and browser are real.

import { spawn, spawnSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { cpSync, mkdirSync, readFileSync, statSync, writeFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { dirname, join } from 'node:path';
import { setTimeout as pause } from 'node:timers/promises';
import {
  agent,
  assert,
  atEnd,
  browser,
  directory,
  eventually,
  open,
  program,
  root,
  ros,
  Server,
  settled,
} from './harness.mjs';

const target = process.argv[2];
const networks = process.env.TASKD_TEST_NETWORKS.split(' ');
const require = createRequire(join(process.env.TASKD_TEST_XTERM, 'node_modules/'));

/** The talker's voice, for a transfer that takes its time. */
const VOICE_BYTES = 12e6;
/** The sizes in pixels of terminal and page, side by side. */
const [LEFT, RIGHT] = [
  { width: 636, height: 680 },
  { width: 644, height: 680 },
];
const [COLUMNS, ROWS] = [80, 30];
const FRAMES_PER_S = 10;
/** A longer recording, as on a busy machine, is played faster. */
const MAX_DURATION_S = 20;
const COLOURS = 128;
const KEY_MS = 35;
const THEME = {
  background: '#131517',
  foreground: '#e4e6e9',
  cursor: '#4fc3b5',
  black: '#131517',
  red: '#ff8a80',
  green: '#4fc3b5',
  yellow: '#e8c468',
  blue: '#8ab4f8',
  magenta: '#d7aefb',
  cyan: '#4fc3b5',
  white: '#e4e6e9',
  brightBlack: '#9aa1ab',
  brightCyan: '#4fc3b5',
};

async function story() {
  const place = directory(t);
  const server = await Server.start(t, {
    http: '10.0.0.1:8080',
    mqtt: '10.0.0.1:1883',
    environment: { TASKD_ALLOW_PLAINTEXT: 'true' },
  });
  for (const [index, pid] of networks.entries()) {
    const within = ['nsenter', `--net=/proc/${pid}/ns/net`];
    await agent(t, server, `robot-${index + 1}`, await ros(t), within);
  }
  await eventually('the robots to be connected', async () => {
    const { robots } = await server.ask('GET', '/robots');
    return robots.length === networks.length && robots.every(({ online }) => online);
  });
  talker(place);

  const it = await browser(t);
  const page = await open(t, server, { on: it, colorScheme: 'light', viewport: RIGHT });
  const go = async (address) => {
    await page.goto(`${server.url}/#/${address}`);
    await page.locator('main h1').first().waitFor();
  };
  await go('robots');
  await settled(page);
  const terminal = await Terminal.open(it, place, server);
  const films = [await Film.start(terminal.page), await Film.start(page)];
  await pause(500);

  await terminal.type('taskd robot list\r');
  await terminal.prompt();
  await pause(1_200);
  await terminal.type("taskd push ./talker --to '*' --wait\r");
  await page.locator('main', { hasText: 'building' }).first().waitFor();
  await pause(800);
  const { deployments } = await server.ask('GET', '/deployments');
  await go(`deployments/${deployments[0].id}`);
  await terminal.prompt();
  await pause(1_800);
  await go('robots/robot-1/logs');
  // Ctrl-L clears the terminal.
  await terminal.type('\ftaskd logs -f -n 4 robot-1 talker\r');
  await pause(4_000);

  for (const film of films) await film.end();
  develop(films, place);
}

/** The example package, with a log of its messages. */
function talker(place) {
  const path = join(place, 'talker');
  cpSync(join(root, 'examples/talker'), path, { recursive: true });
  const node = join(path, 'talker/node.py');
  const source = readFileSync(node, 'utf8');
  const said = source.replace(
    /^( +)self\.publisher\.publish.*$/m,
    '$&\n$1self.get_logger().info(text)',
  );
  assert.notEqual(said, source, 'the example has changed');
  writeFileSync(node, said);
  mkdirSync(join(path, 'voice'));
  writeFileSync(join(path, 'voice/en.onnx'), randomBytes(VOICE_BYTES));
}

/** A shell on a terminal of its own, shown in a page. */
class Terminal {
  #output = '';
  #read = 0;

  static async open(on, place, server) {
    const terminal = new Terminal();
    const context = await on.newContext({ viewport: LEFT });
    terminal.page = await context.newPage();
    await terminal.page.setContent(`<style>
      html { background: ${THEME.background}; overflow: hidden; }
      body { margin: 0; padding: 18px 17px; }
      .xterm .xterm-viewport { overflow: hidden !important; }
      </style><div></div>`);
    const library = dirname(require.resolve('@xterm/xterm'));
    await terminal.page.addStyleTag({ path: join(library, '../css/xterm.css') });
    await terminal.page.addScriptTag({ path: join(library, 'xterm.js') });
    await terminal.page.evaluate(
      ([theme, cols, rows]) => {
        const it = new globalThis.Terminal({
          theme,
          cols,
          rows,
          fontFamily: 'DejaVu Sans Mono, monospace',
          fontSize: 12.5,
          lineHeight: 1.4,
          scrollback: 0,
          cursorInactiveStyle: 'block',
        });
        it.open(document.querySelector('div'));
        globalThis.show = (text) => it.write(text);
      },
      [THEME, COLUMNS, ROWS],
    );
    terminal.shell = spawn(
      'script',
      ['-qfc', `stty cols ${COLUMNS} rows ${ROWS}; exec bash --norc --noprofile`, '/dev/null'],
      {
        cwd: place,
        env: {
          HOME: place,
          LANG: 'C.UTF-8',
          PATH: `${dirname(program('taskd'))}:${process.env.PATH}`,
          PS1: String.raw`\[\e[1;36m\]$\[\e[0m\] `,
          TASKD_SERVER: server.url,
          TASKD_TOKEN: server.token,
          TERM: 'xterm-256color',
        },
      },
    );
    atEnd(t, () => terminal.shell.kill());
    terminal.shell.stdout.setEncoding('utf8').on('data', (text) => {
      terminal.#output += text;
      terminal.page.evaluate((it) => globalThis.show(it), text).catch(() => {});
    });
    await terminal.prompt();
    return terminal;
  }

  async type(text) {
    for (const key of text) {
      this.shell.stdin.write(key);
      await pause(key === '\r' ? 0 : KEY_MS);
    }
  }

  /** Waits until the shell asks for the next command. */
  async prompt() {
    await eventually('the prompt', () => this.#output.indexOf('$\x1b[0m ', this.#read) >= 0);
    this.#read = this.#output.length;
  }
}

/** The pictures of a page from its start to its end. */
class Film {
  frames = [];

  static async start(page) {
    const film = new Film();
    film.session = await page.context().newCDPSession(page);
    film.session.on('Page.screencastFrame', ({ data, metadata, sessionId }) => {
      film.frames.push({ at: metadata.timestamp, image: Buffer.from(data, 'base64') });
      film.session.send('Page.screencastFrameAck', { sessionId }).catch(() => {});
    });
    await film.session.send('Page.startScreencast', { format: 'png' });
    await eventually('the first frame', () => film.frames.length);
    return film;
  }

  async end() {
    await this.session.send('Page.stopScreencast');
    this.endAt = Date.now() / 1_000;
  }
}

/** Puts the films side by side into one GIF. */
function develop(films, place) {
  const begin = Math.max(...films.map(({ frames }) => frames[0].at));
  const end = Math.min(...films.map(({ endAt }) => endAt));
  const inputs = films.flatMap(({ frames }, number) => {
    const lines = ['ffconcat version 1.0'];
    for (const [index, { at, image }] of frames.entries()) {
      const until = Math.min(frames[index + 1]?.at ?? end, end);
      const duration_s = until - Math.max(at, begin);
      if (duration_s <= 0) continue;
      const file = `${number}-${index}.png`;
      writeFileSync(join(place, file), image);
      lines.push(`file ${file}`, `duration ${duration_s.toFixed(3)}`);
    }
    // The last duration counts only with a file behind it.
    lines.push(lines.at(-2));
    writeFileSync(join(place, `${number}.ffconcat`), lines.join('\n'));
    return ['-i', join(place, `${number}.ffconcat`)];
  });
  const pace = `setpts=PTS/${Math.max(1, (end - begin) / MAX_DURATION_S)},fps=${FRAMES_PER_S}`;
  const filter =
    `[0]${pace}[left];[1]${pace}[right];[left][right]hstack=shortest=1,split[all][again];` +
    `[all]palettegen=max_colors=${COLOURS}[palette];` +
    '[again][palette]paletteuse=dither=none:diff_mode=rectangle';
  const { status, stderr } = spawnSync(
    'ffmpeg',
    ['-v', 'error', '-y', ...inputs, '-filter_complex', filter, '-loop', '0', target],
    { encoding: 'utf8' },
  );
  assert.equal(status, 0, stderr);
  console.log(`${target}: ${(end - begin).toFixed(1)} s, ${statSync(target).size} bytes`);
}

const endings = [];
const t = { after: (end) => endings.unshift(end) };
try {
  await story();
} finally {
  for (const end of endings) await end();
}
