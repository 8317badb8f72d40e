// Makes the pictures of the page in docs/page, light and dark: node
// crates/server/tests/page/pictures.mjs [DIRECTORY] The server and the browser are real, most
// robots are puppets with a story, and one has ROS: TASKD_TEST_ROS says where. ffmpeg reduces the
// colours, which halves the files.

import { spawnSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { mkdirSync } from 'node:fs';
import { join } from 'node:path';
import {
  agent,
  assert,
  browser,
  eventually,
  open,
  Puppet,
  root,
  ros,
  Server,
  settled,
} from './harness.mjs';

const target = process.argv[2] ?? join(root, 'docs/page');
const SIZE = { width: 1280, height: 800 };
const NAMES = [
  'atlas',
  'borea',
  'corvus',
  'delphin',
  'echo',
  'fenn',
  'gale',
  'heron',
  'iris',
  'juno',
  'kite',
  'lynx',
  'mica',
  'nova',
];
const GB = 2 ** 30;
/** Two nodes that look like a mapping robot's in the graph and the log. */
const SLAM = `import math
import rclpy
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Trigger

class ScanFilter(Node):
    def __init__(self):
        super().__init__("scan_filter")
        self.declare_parameters("", [("range_max", 12.0), ("shadow_angle_deg", 10)])
        self.out = self.create_publisher(LaserScan, "/scan", 10)
        self.create_timer(0.1, lambda: self.out.publish(LaserScan()))

class Slam(LifecycleNode):
    def __init__(self):
        super().__init__("slam")
        self.declare_parameters("", [("resolution", 0.05), ("map_frame", "map"),
                                     ("loop_closure", True), ("min_travel_m", 0.2)])
        self.scans = self.create_subscription(LaserScan, "/scan", lambda _: None, 10)
        self.odometry = self.create_subscription(Odometry, "/odom", lambda _: None, 10)
        self.out = self.create_publisher(OccupancyGrid, "/map", 1)
        self.save = self.create_service(Trigger, "/save_map", lambda _, answer: answer)
        self.step = 0
        self.create_timer(0.5, self.tick)

    def tick(self):
        self.step += 1
        log = self.get_logger()
        x, y = math.sin(self.step / 9) * 3, self.step * 0.12
        log.info(f"pose {x:.2f} {y:.2f}, {40 + self.step} scans matched")
        if self.step % 7 == 0:
            log.warning(f"scan {40 + self.step} matched badly (0.41), odometry is used")
        if self.step % 10 == 0:
            log.info("loop closed, the map is corrected by 0.08 m")

rclpy.init()
executor = SingleThreadedExecutor()
for node in [ScanFilter(), Slam()]:
    executor.add_node(node)
executor.spin()
`;

async function story() {
  mkdirSync(target, { recursive: true });
  const server = await Server.start(t);
  const robots = new Map();
  for (const [index, name] of NAMES.entries()) {
    const site = ['lab', 'lab', 'yard'][index % 3];
    robots.set(name, await Puppet.enroll(server, name, { site, floor: String(1 + (index % 2)) }));
  }
  await agent(t, server, 'orca', await ros(t));
  await agent(t, server, 'puma');
  const machine = (name, index) => ({
    disk_free_bytes: (14 + 7 * index) * GB,
    arch: index % 3 ? 'x86_64' : 'aarch64',
    ros_distros: ['jazzy'],
    ros: { distro: 'jazzy', rmw: 'rmw_fastrtps_cpp', domain_id: 0 },
  });
  const report = async (name, phase, more = {}) =>
    robots.get(name).report(phase, {
      host: machine(name, NAMES.indexOf(name)),
      link: {
        throughput_bytes_per_s: 2_400_000 + 90_000 * NAMES.indexOf(name),
        rtt_ms: 4 + 3 * NAMES.indexOf(name),
        reconnects: 0,
        losses: 0,
      },
      ...more,
    });
  const floors = [4e6, 5e6, 6e6].map((bytes) => randomBytes(bytes));
  const lab = NAMES.filter((name, index) => index % 3 < 2);

  server.push('mapper', '0.9.4', {
    to: '*',
    files: { 'run.sh': '#!/bin/sh\nexec sleep 1000\n', 'params.yaml': 'resolution: 0.05\n' },
  });
  for (const name of NAMES) await report(name, 'running', running(1_200));
  server.push('navigation', '2.3.1', {
    to: 'site=lab',
    files: {
      'run.sh': '#!/bin/sh\nexec ./navigate\n',
      'maps/floor1.pgm': floors[0],
      'maps/floor2.pgm': floors[1],
      'params.yaml': 'speed: 0.6\n',
    },
  });
  for (const name of lab) await report(name, 'running', running(1_300));
  server.push('navigation', '2.4.0', {
    to: 'site=lab',
    files: {
      'run.sh': '#!/bin/sh\nexec ./navigate --smooth\n',
      'maps/floor1.pgm': floors[0],
      'maps/floor3.pgm': floors[2],
      'params.yaml': 'speed: 0.8\n',
    },
  });
  for (const [index, name] of lab.entries()) {
    const conditions =
      name === 'echo'
        ? [{ code: 'held', text: 'held at the robot: a wheel is being changed' }]
        : [];
    // Its other task runs on, for any outcome of this one.
    const says = (phase, more = () => ({})) =>
      report(name, 'running', {
        conditions,
        each: (one) =>
          one.package.name === 'navigation' ? { phase, ...more(one) } : running(1_200).each(one),
      });
    const fetched = (part) =>
      says('fetching', ({ package: { content } }) => ({
        progress: { done: Math.round(part * content.size), total: content.size },
      }));
    await fetched(0.02);
    if (name === 'heron') continue;
    if (index % 5 === 1) {
      await fetched(0.64);
      continue;
    }
    await says('unpacking');
    await says('building');
    if (index % 5 === 3) continue;
    if (name === 'delphin') {
      await says('failed', () => ({
        failure: {
          code: 'build_failed',
          text:
            'colcon build ended with status 1: fatal error: ' +
            'nav2_msgs/action/navigate_to_pose.hpp: No such file or directory',
        },
      }));
    } else {
      await says('starting');
      await says('running', running(2_000 + index).each);
    }
  }
  for (const [index, name] of NAMES.entries())
    await robots.get(name).vitals(sample(Date.now(), index));
  const map = corridor();
  await robots.get('atlas').bringBack('mapper', [
    ['maps/corridor.pgm', map],
    ['maps/corridor.yaml', 'image: corridor.pgm\nresolution: 0.05\n'],
  ]);

  const { deployments } = await server.ask('GET', '/deployments');
  server.push('slam', '1.3.0', {
    files: { 'run.sh': '#!/bin/sh\nexec python3 slam.py\n', 'slam.py': SLAM },
    more: "[ready]\nlifecycle = ['/slam']\n",
    to: 'orca',
  });
  const isMapping = async () =>
    (await server.ask('GET', '/robots/orca')).tasks.some(
      ({ task, phase }) => task === 'slam' && phase === 'running',
    );
  await eventually('the mapping to run', isMapping);
  const places = {
    robots: 'robots',
    robot: 'robots/atlas',
    tasks: 'robots/delphin/tasks',
    ros: 'robots/orca/ros?node=/slam',
    logs: 'robots/orca/logs',
    outputs: 'robots/atlas/outputs',
    control: 'robots/atlas/control',
    edit: 'robots/atlas/edit',
    packages: 'packages',
    package: 'packages/navigation',
    deployments: 'deployments',
    deployment: `deployments/${deployments[0].id}`,
    server: 'server',
    settings: 'settings',
  };
  await server.createEnrollmentToken({ labels: { site: 'lab' }, uses: 20 });
  // A robot that does not poll is soon shown as offline.
  const polls = setInterval(
    () => robots.forEach((robot) => robot.desired().catch(() => {})),
    10_000,
  );
  t.after(() => clearInterval(polls));
  const it = await browser(t);
  for (const colorScheme of ['light', 'dark']) {
    const page = await open(t, server, { on: it, colorScheme, viewport: SIZE });
    // The server counts an hour by its own clock, which is too long to wait for a picture.
    await page.route('**/api/v1/robots/*/vitals', (route) =>
      route.fulfill({ json: { samples: hour() } }),
    );
    for (const [name, place] of Object.entries(places)) {
      await page.goto(`${server.url}/#/${place}`);
      await page.locator('main h1').first().waitFor();
      await settled(page);
      // Rates are known after two looks at the server.
      if (name === 'server') await page.waitForTimeout(20_000);
      if (name === 'ros') await page.locator('.parameters .value').first().waitFor();
      if (name === 'logs') await page.locator('.log-line').nth(16).waitFor();
      keep(await page.screenshot(), `${name}-${colorScheme}.png`);
    }
    await page.context().close();
  }
}

/** Writes a picture with few colours: text and lines need no more. */
function keep(picture, name) {
  const filter =
    'split[all][again];[all]palettegen=reserve_transparent=0:max_colors=128[palette];' +
    '[again][palette]paletteuse=dither=none';
  const { status, stderr } = spawnSync(
    'ffmpeg',
    [
      '-v',
      'error',
      '-y',
      '-f',
      'png_pipe',
      '-i',
      '-',
      '-filter_complex',
      filter,
      join(target, name),
    ],
    { input: picture, encoding: 'utf8' },
  );
  assert.equal(status, 0, stderr);
}

const running = (pid) => ({
  each: (one) => ({
    active: {
      deployment: one.deployment,
      version: one.package.version,
      manifest: one.package.manifest.digest,
      pid,
    },
  }),
});

/** Vitals of a machine that works in bursts. */
const sample = (at_ms, turn) => ({
  at_ms,
  cpu_percent: 22 + 14 * Math.sin(turn / 5) + (turn % 7) * 3,
  memory_used_bytes: Math.round((2.1 + 0.3 * Math.sin(turn / 9)) * GB),
  memory_total_bytes: 8 * GB,
  disk_used_bytes: Math.round((31 - turn * 0.05) * GB),
  disk_total_bytes: 64 * GB,
  network_in_bytes_per_s: Math.round(120_000 + 90_000 * Math.max(0, Math.sin(turn / 4))),
  network_out_bytes_per_s: Math.round(40_000 + 20_000 * Math.cos(turn / 6)),
  load_1m: 0.7,
  battery_percent: Math.max(20, 90 - Math.floor(turn / 2)),
});

const hour = () =>
  Array.from({ length: 60 }, (_, minute) =>
    sample(Date.now() - (59 - minute) * 60_000, 59 - minute),
  );

/** A map of a corridor with two rooms, as map_saver writes it. */
function corridor() {
  const [width, height] = [240, 120];
  const pixels = Buffer.alloc(width * height, 205);
  const room = (x0, y0, x1, y1) => {
    for (let y = y0; y <= y1; y += 1)
      for (let x = x0; x <= x1; x += 1)
        pixels[y * width + x] = x === x0 || x === x1 || y === y0 || y === y1 ? 0 : 254;
  };
  room(10, 50, 230, 76);
  room(30, 10, 100, 50);
  room(140, 76, 220, 112);
  for (const [x, y] of [
    [60, 50],
    [61, 50],
    [62, 50],
    [63, 50],
    [180, 76],
    [181, 76],
    [182, 76],
  ])
    pixels[y * width + x] = 254;
  return Buffer.concat([Buffer.from(`P5\n${width} ${height}\n255\n`), pixels]);
}

const endings = [];
const t = { after: (end) => endings.unshift(end) };
try {
  await story();
} finally {
  for (const end of endings) await end();
}
