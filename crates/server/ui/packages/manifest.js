// A task manifest in readable form, and the differences between two manifests.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { number, plural, size } from '../display/format.js';

const LAUNCHERS = { catkin: 'roslaunch' };
const BUILDS = {
  colcon: 'on the robot with colcon',
  catkin: 'on the robot with catkin',
  none: 'none',
};
const ON_BOOT = {
  start: 'starts after a reboot',
  hold: 'stays stopped after a reboot',
};
const RESTART = {
  'on-failure': 'restarts on failure',
  always: 'always restarts',
  never: 'never restarts',
};

export function manifestView({
  build,
  run,
  ready,
  parameters = {},
  outputs = {},
  requires = {},
  limits = {},
  exec_depends: depends = [],
  content,
}) {
  const rows = [
    ['Command', html`<code>${commandOf(build, run)}</code>`],
    ['Kind', behaviour(run).join(', ')],
    [
      'Stop',
      `SIGINT, after ${run.stop_timeout_s} s SIGTERM, ` +
        `after another ${run.stop_timeout_s} s SIGKILL`,
    ],
    ['Build', BUILDS[build.tool] ?? build.tool],
    ['Requires', requirements(requires)],
    ['Depends on', depends.length ? html`<span class="code">${depends.join(', ')}</span>` : 'none'],
    ['Ready when', readiness(ready)],
    ['Parameters', parametersOf(parameters)],
    [
      'Outputs',
      outputs.paths?.length ? html`<span class="code">${outputs.paths.join(', ')}</span>` : 'none',
    ],
    ['Limits', limitsOf(limits)],
    [
      'Unpacked',
      `${size(content.tar_size)} in ` +
        plural(content.entries, 'entry').replace('entrys', 'entries'),
    ],
  ];
  return html`<dl class="manifest">${rows.map(
    ([title, text]) => html`<dt>${title}</dt><dd>${text}</dd>`,
  )}</dl>`;
}

function commandOf({ tool }, { launch, exec, args = {} }) {
  const words = launch
    ? [
        LAUNCHERS[tool] ?? 'ros2 launch',
        ...launch,
        ...Object.entries(args).map(([name, value]) => `${name}:=${value}`),
      ]
    : (exec ?? []);
  return words
    .map((word, index) =>
      index && /[\s"'\\$]|^$/.test(word) ? `'${word.replaceAll("'", "'\\''")}'` : word,
    )
    .join(' ');
}

function behaviour({ kind, on_boot: boot, restart, idempotent, deadline_s: deadline }) {
  if (kind !== 'job') return ['service', ON_BOOT[boot], RESTART[restart]];
  return [
    'job, runs once per start',
    deadline && `at most ${number(deadline)} s`,
    idempotent && 'restarts if interrupted',
  ].filter(Boolean);
}

function requirements({ labels = {}, ros_distro: distros = [], arch = [] }) {
  const all = [
    ...Object.entries(labels).map(([label, value]) => `${label}=${value}`),
    distros.length && `ROS ${distros.join(' or ')}`,
    arch.length && arch.join(' or '),
  ].filter(Boolean);
  return all.length ? all.join(', ') : 'none';
}

function readiness({
  nodes = [],
  lifecycle = [],
  services = [],
  topics = {},
  hold_s: hold,
  timeout_s: timeout,
}) {
  const checks = [
    ...nodes.map((node) => ['node', node, '']),
    ...lifecycle.map((node) => ['lifecycle node', node, ' is active']),
    ...services.map((service) => ['service', service, ' is available']),
    ...Object.entries(topics).map(([topic, { min_hz: rate }]) => [
      'topic',
      topic,
      rate ? ` at ${rate} Hz or more` : ' is published',
    ]),
  ];
  const times = `for ${hold} s, within ${timeout} s`;
  if (!checks.length) return `the process stays up ${times}`;
  return html`${checks.map(
    ([what, name, holds]) => html`<div>${what} <span class="code">${name}</span>${holds}</div>`,
  )}<div class="quiet">${times}</div>`;
}

function parametersOf(parameters) {
  const all = Object.entries(parameters).flatMap(([node, values]) =>
    Object.entries(values).map(([name, value]) => [node, name, value]),
  );
  if (!all.length) return 'none';
  return html`${all.map(
    ([node, name, value]) =>
      html`<div class="code">${node}
        <span class="quiet">${name} =</span> ${JSON.stringify(value)}</div>`,
  )}`;
}

function limitsOf({ memory_mb: memory, cpu_weight: weight, pids }) {
  const all = [
    memory != null && `${number(memory)} MB of memory`,
    weight != null && `CPU weight ${number(weight)} (default: 100)`,
    pids != null && plural(pids, 'process').replace('processs', 'processes'),
  ].filter(Boolean);
  return all.length ? all.join('; ') : 'limits of the robot';
}

/**
 * The keys that differ between two manifests, except the version and the description of the files.
 */
export function manifestDiff(from, to) {
  const [before, after] = [flat(from), flat(to)];
  const keys = [...new Set([...Object.keys(before), ...Object.keys(after)])].filter(
    (key) => key !== 'version' && !key.startsWith('content.'),
  );
  const changed = keys.filter((key) => before[key] !== after[key]);
  if (!changed.length) return nothing;
  const shown = (value) => value ?? html`<span class="quiet">not set</span>`;
  return html`<dl class="manifest">${changed.sort().map(
    (key) =>
      html`<dt class="code">${key}</dt><dd class="code">${shown(before[key])}
        <span class="quiet">→</span> ${shown(after[key])}</dd>`,
  )}</dl>`;
}

function flat(value, key = '', all = {}) {
  if (value && typeof value === 'object' && !Array.isArray(value))
    for (const [name, part] of Object.entries(value))
      flat(part, key ? `${key}.${name}` : name, all);
  else all[key] = JSON.stringify(value);
  return all;
}
