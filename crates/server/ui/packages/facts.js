// A task manifest as a person reads it.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { number, plural, size } from '../format.js';

const LAUNCHERS = { catkin: 'roslaunch' };
const BUILDS = {
  colcon: 'built on the robot by colcon',
  catkin: 'built on the robot by catkin',
  none: 'nothing to build',
};
const BOOT = {
  start: 'started after a reboot',
  hold: 'stays down after a reboot until it is started',
};
const RESTART = {
  'on-failure': 'started again when it fails',
  always: 'started again whenever it ends',
  never: 'never started again by itself',
};

export function facts({
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
    ['Runs', html`<code>${commandOf(build, run)}</code>`],
    ['As', `${conduct(run).join(', ')}`],
    [
      'Stops',
      `by SIGINT, after ${run.stop_timeout_s} s by SIGTERM, after ${run.stop_timeout_s} s more by SIGKILL`,
    ],
    ['Build', BUILDS[build.tool] ?? build.tool],
    ['Needs', needs(requires)],
    [
      'Depends on',
      depends.length ? html`<span class="code">${depends.join(', ')}</span>` : 'no other package',
    ],
    ['Ready when', readiness(ready)],
    ['Parameters', parametersOf(parameters)],
    [
      'Brings back',
      outputs.paths?.length
        ? html`<span class="code">${outputs.paths.join(', ')}</span>`
        : 'nothing',
    ],
    ['Limits', limitsOf(limits)],
    [
      'Unpacked',
      `${size(content.tar_size)} in ${plural(content.entries, 'entry').replace('entrys', 'entries')}`,
    ],
  ];
  return html`<dl class="manifest">${rows.map(([title, text]) => html`<dt>${title}</dt><dd>${text}</dd>`)}</dl>`;
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

function conduct({ kind, on_boot: boot, restart, idempotent, deadline_s: deadline }) {
  if (kind !== 'job') return ['a service', BOOT[boot], RESTART[restart]];
  return [
    'a job that runs to its end, once per start',
    deadline && `for ${number(deadline)} s at most`,
    idempotent && 'started again if it was interrupted',
  ].filter(Boolean);
}

function needs({ labels = {}, ros_distro: distros = [], arch = [] }) {
  const all = [
    ...Object.entries(labels).map(([label, value]) => `${label}=${value}`),
    distros.length && `ROS ${distros.join(' or ')}`,
    arch.length && arch.join(' or '),
  ].filter(Boolean);
  return all.length ? all.join(', ') : 'nothing in particular';
}

function readiness({
  nodes = [],
  lifecycle = [],
  services = [],
  topics = {},
  hold_s: hold,
  timeout_s: timeout,
}) {
  const told = [
    ...nodes.map((node) => ['node', node, '']),
    ...lifecycle.map((node) => ['lifecycle node', node, ' is active']),
    ...services.map((service) => ['service', service, ' answers']),
    ...Object.entries(topics).map(([topic, { min_hz: rate }]) => [
      'topic',
      topic,
      rate ? ` with at least ${rate} Hz` : ' is published',
    ]),
  ];
  const times = `for ${hold} s, within ${timeout} s`;
  if (!told.length) return `its process lives ${times}`;
  return html`${told.map(([what, name, holds]) => html`<div>${what} <span class="code">${name}</span>${holds}</div>`)}<div class="quiet">${times}</div>`;
}

function parametersOf(parameters) {
  const all = Object.entries(parameters).flatMap(([node, values]) =>
    Object.entries(values).map(([name, value]) => [node, name, value]),
  );
  if (!all.length) return 'none';
  return html`${all.map(([node, name, value]) => html`<div class="code">${node} <span class="quiet">${name} =</span> ${JSON.stringify(value)}</div>`)}`;
}

function limitsOf({ memory_mb: memory, cpu_weight: weight, pids }) {
  const all = [
    memory != null && `${number(memory)} MiB of memory`,
    weight != null && `processor weight ${number(weight)}, others having 100`,
    pids != null && plural(pids, 'process').replace('processs', 'processes'),
  ].filter(Boolean);
  return all.length ? all.join('; ') : 'those of the robot';
}

/**
 * What differs between two manifests, key by key, but for the version and what describes the files.
 */
export function manifestDifference(from, to) {
  const [before, after] = [flat(from), flat(to)];
  const keys = [...new Set([...Object.keys(before), ...Object.keys(after)])].filter(
    (key) => key !== 'version' && !key.startsWith('content.'),
  );
  const changed = keys.filter((key) => before[key] !== after[key]);
  if (!changed.length) return nothing;
  return html`<dl class="manifest">${changed.sort().map((key) => html`<dt class="code">${key}</dt><dd class="code">${before[key] === undefined ? html`<span class="quiet">not set</span>` : before[key]} <span class="quiet">→</span> ${after[key] === undefined ? html`<span class="quiet">not set</span>` : after[key]}</dd>`)}</dl>`;
}

function flat(value, key = '', all = {}) {
  if (value && typeof value === 'object' && !Array.isArray(value))
    for (const [name, part] of Object.entries(value))
      flat(part, key ? `${key}.${name}` : name, all);
  else all[key] = JSON.stringify(value);
  return all;
}
