// The settings of a robot: how each is formatted and parsed, and which value is in effect.

import { SIZES } from '../../display/format.js';

/** A byte size in the largest unit that is exact. */
const bytesText = (bytes) => {
  const [unit, length] = SIZES.find(([, length]) => bytes && bytes % length === 0) ?? SIZES.at(-1);
  return `${bytes / length} ${unit}`;
};

function bytesOf(text) {
  // GiB is accepted for GB, and so on.
  const [, value, letter = ''] = /^([\d.]+)\s*(?:([kmg])i?)?b?$/i.exec(text) ?? [];
  const length = SIZES.find(([unit]) => unit === `${letter.toUpperCase()}B`)?.[1];
  const bytes = Math.round(Number(value) * length);
  if (!Number.isSafeInteger(bytes)) throw new Error('Enter a size such as 512 MB, 2 GB or 4096.');
  return bytes;
}

function countOf(text) {
  if (!/^\d+$/.test(text)) throw new Error('Enter a whole number.');
  return Number(text);
}

function pathsOf(text) {
  return text
    .split('\n')
    .map((line) => line.trim())
    .filter(Boolean)
    .map(pathOf);
}

function pathOf(text) {
  if (!text.startsWith('/')) throw new Error(`${text}: enter an absolute path`);
  return text;
}

const count = { write: String, read: countOf };
const bytes = { write: bytesText, read: bytesOf, isBytes: true };

/** The settings by key, as in the robot's own file and in server errors. */
export const SETTINGS = [
  {
    key: 'underlays',
    title: 'ROS underlays',
    hint: 'Setup files, one per line, sourced in this order before a task is built or run.',
    write: (paths) => paths.join('\n'),
    read: pathsOf,
    isLong: true,
    fallback: 'found in /opt/ros',
  },
  {
    key: 'workspace',
    title: 'Workspace',
    hint: 'The robot’s own ROS workspace, sourced after the underlays.',
    write: String,
    read: pathOf,
    isPath: true,
    fallback: 'none',
  },
  { key: 'ros_domain_id', title: 'ROS_DOMAIN_ID', hint: '0 to 232', ...count },
  {
    key: 'forward_level',
    title: 'Log level to forward',
    hint: 'Sent to the server even when the log is not open in a page or command.',
    write: String,
    read: String,
    choices: ['debug', 'info', 'warn', 'error', 'fatal'],
  },
  { key: 'limits.archive_bytes', title: 'Unpacked package size', ...bytes },
  { key: 'limits.archive_entries', title: 'Files per package', ...count },
  { key: 'limits.disk_reserve_bytes', title: 'Reserved disk space', ...bytes },
  { key: 'limits.log_bytes', title: 'Log size per task', ...bytes },
  { key: 'limits.output_bytes', title: 'Output size per run', ...bytes },
  { key: 'limits.build_memory_bytes', title: 'Build memory', ...bytes },
  { key: 'limits.build_timeout_s', title: 'Build timeout (seconds)', ...count },
  { key: 'limits.parallel_tasks', title: 'Tasks prepared in parallel', ...count },
  { key: 'limits.task_memory_mb', title: 'Memory per task (MB)', ...count },
  { key: 'limits.task_pids', title: 'Processes per task', ...count },
];

export const valueAt = (settings, key) =>
  key.split('.').reduce((value, part) => value?.[part], settings);

/**
 * The settings with these texts parsed; an empty text clears a setting. Throws an error with a
 * `key`.
 */
export function settingsWith(settings, texts) {
  const next = { ...settings, limits: { ...settings?.limits } };
  for (const { key, read } of SETTINGS) {
    if (!(key in texts)) continue;
    const text = texts[key].trim();
    const [place, name] = key.startsWith('limits.')
      ? [next.limits, key.slice('limits.'.length)]
      : [next, key];
    try {
      if (text) place[name] = read(text);
      else delete place[name];
    } catch ({ message }) {
      throw Object.assign(new Error(message), { key });
    }
  }
  if (!Object.keys(next.limits).length) delete next.limits;
  return Object.keys(next).length ? next : null;
}

const isSame = (one, other) => JSON.stringify(one) === JSON.stringify(other);

/** The effective value and its origin: `{ text, isBad }`. */
export function effectiveValue(
  { key, write, fallback = 'set by the agent' },
  { settings, effective_settings: effective, online },
) {
  const set = valueAt(settings, key);
  const current = valueAt(effective, key);
  const isSet = set !== undefined;
  if (effective?.refused?.includes(key))
    return {
      text: 'Rejected by the robot: its own settings do not allow it, or the value is unusable.',
      isBad: true,
    };
  if (effective?.own?.includes(key)) {
    const origin = `the robot’s own file${isSet ? ', which takes precedence' : ''}`;
    return {
      text: `In effect: ${shown(current, write)}, from ${origin}.`,
      isBad: isSet && !isSame(set, current),
    };
  }
  if (isSet && isSame(set, current)) return { text: 'In effect on the robot.' };
  if (isSet)
    return {
      text: online
        ? 'Set here; not yet confirmed by the robot.'
        : 'Set here; takes effect when the robot is back online.',
    };
  if (current !== undefined) return { text: `In effect: ${shown(current, write)}.` };
  return { text: `Default: ${fallback}.` };
}

const shown = (value, write) =>
  value === undefined ? 'not set' : write(value).replaceAll('\n', ', ');
