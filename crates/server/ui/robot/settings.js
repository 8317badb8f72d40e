// The settings that a robot may be given here: how each is written, read, and what holds of it on
// the robot.

const UNITS = [
  ['GiB', 2 ** 30],
  ['GB', 1e9],
  ['MiB', 2 ** 20],
  ['MB', 1e6],
  ['KiB', 2 ** 10],
  ['kB', 1e3],
  ['B', 1],
];

/** A number of bytes as people write it, exactly. */
const bytesText = (bytes) => {
  const [unit, length] = UNITS.find(([, length]) => bytes && bytes % length === 0) ?? UNITS.at(-1);
  return `${bytes / length} ${unit}`;
};

function bytesOf(text) {
  const [, value, unit = 'B'] = /^([\d.]+)\s*([a-z]*)$/i.exec(text) ?? [];
  const length = UNITS.find(([name]) => name.toLowerCase() === (unit || 'B').toLowerCase())?.[1];
  const bytes = Math.round(Number(value) * length);
  if (!Number.isSafeInteger(bytes)) throw new Error('Write a size as 512 MB, 2 GiB or 4096.');
  return bytes;
}

function countOf(text) {
  if (!/^\d+$/.test(text)) throw new Error('Write a whole number.');
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
  if (!text.startsWith('/')) throw new Error(`${text}: write a path that begins with /`);
  return text;
}

const count = { write: String, read: countOf };
const bytes = { write: bytesText, read: bytesOf, isBytes: true };

/** Each by its key, as the robot's own file and the server's refusals name it. */
export const SETTINGS = [
  {
    key: 'underlays',
    title: 'ROS underlays',
    hint: 'Setup files, one a line, sourced in this order before a task is built or run.',
    write: (paths) => paths.join('\n'),
    read: pathsOf,
    isLong: true,
    fallback: 'what is found in /opt/ros',
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
    title: 'Log lines sent while nobody follows',
    write: String,
    read: String,
    choices: ['debug', 'info', 'warn', 'error', 'fatal'],
  },
  { key: 'limits.archive_bytes', title: 'Unpacked package', ...bytes },
  { key: 'limits.archive_entries', title: 'Files of a package', ...count },
  { key: 'limits.disk_reserve_bytes', title: 'Disk that stays free', ...bytes },
  { key: 'limits.log_bytes', title: 'Log file of a task', ...bytes },
  { key: 'limits.output_bytes', title: 'Files a run brings back', ...bytes },
  { key: 'limits.build_memory_bytes', title: 'Memory of a build', ...bytes },
  { key: 'limits.build_timeout_s', title: 'Seconds a build may take', ...count },
  { key: 'limits.parallel_tasks', title: 'Tasks prepared at once', ...count },
  { key: 'limits.task_memory_mb', title: 'Memory of a task, in MiB', ...count },
  { key: 'limits.task_pids', title: 'Processes of a task', ...count },
];

export const valueAt = (settings, key) =>
  key.split('.').reduce((value, part) => value?.[part], settings);

/**
 * The settings with these texts instead; what is empty is no longer set. Throws `{ key, message }`.
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

/** What holds on the robot, and where that is from: `{ text, isBad }`. */
export function holding(
  { key, write, fallback = 'the agent’s default' },
  { settings, effective_settings: effective, online },
) {
  const set = valueAt(settings, key);
  const held = valueAt(effective, key);
  const isSet = set !== undefined;
  if (effective?.refused?.includes(key))
    return {
      text: 'The robot does not take this: its own settings do not allow it, or it can not use the value.',
      isBad: true,
    };
  if (effective?.own?.includes(key))
    return {
      text: `Holds: ${shown(held, write)}, from the robot’s own file${isSet ? ', which wins' : ''}.`,
      isBad: isSet && !isSame(set, held),
    };
  if (isSet && isSame(set, held)) return { text: 'Holds on the robot, from here.' };
  if (isSet)
    return {
      text: online
        ? 'Set here; the robot has not said yet that it holds.'
        : 'Set here; the robot takes it when it is back.',
    };
  if (held !== undefined) return { text: `Holds: ${shown(held, write)}.` };
  return { text: `Holds: ${fallback}.` };
}

const shown = (value, write) =>
  value === undefined ? 'nothing' : write(value).replaceAll('\n', ', ');
