// Numbers, times and state names in readable form.

const UNITS = [
  ['d', 86_400],
  ['h', 3_600],
  ['min', 60],
  ['s', 1],
];

/** `12 s ago`: short, since it fills table columns. */
export function ago(then, now) {
  const seconds = Math.floor((now - then) / 1000);
  const unit = UNITS.find(([, length]) => seconds >= length);
  return unit ? `${Math.floor(seconds / unit[1])} ${unit[0]} ago` : 'now';
}

/** Robots may report times out of range. */
const orUnknown = (write) => (ms) => (Math.abs(ms) <= 8.64e15 ? write(ms) : '?');

/** Formatters are created once: that takes longer than drawing a row. */
const written = (locale, options) => orUnknown(new Intl.DateTimeFormat(locale, options).format);

export const moment = written(undefined, { dateStyle: 'medium', timeStyle: 'medium' });

/** The time of day. */
export const clock = written(undefined, { timeStyle: 'medium' });

/** `09:05`. */
export const minute = written(undefined, { hour: '2-digit', minute: '2-digit' });

/** `09:05:01.250`, for log lines. */
export const instant = written('en-GB', {
  hour: '2-digit',
  minute: '2-digit',
  second: '2-digit',
  fractionalSecondDigits: 3,
});

/** `2026-01-31T09:05:01.250Z`, for programs. */
export const iso = orUnknown((ms) => new Date(ms).toISOString());

const NUMBER = new Intl.NumberFormat('en');

export const number = (value) => NUMBER.format(value);

export const plural = (count, noun) => `${number(count)} ${noun}${count === 1 ? '' : 's'}`;

/** `rolled_back` as `rolled back`. */
export const words = (code) => code.replaceAll('_', ' ');

/** The units of sizes, as in the server's settings: a KB is 1,024 bytes. */
export const SIZES = [
  ['GB', 2 ** 30],
  ['MB', 2 ** 20],
  ['KB', 2 ** 10],
  ['B', 1],
];

const unitOf = (bytes) => SIZES.find(([, length]) => bytes >= length) ?? SIZES.at(-1);

/** `12.4 MB`. */
export function size(bytes) {
  const [unit, length] = unitOf(bytes);
  return `${(bytes / length).toFixed(length > 1 ? 1 : 0)} ${unit}`;
}

/** `12.4 of 48.0 MB`, both in the unit of the total, so that the width is stable. */
export function bytes({ done, total }) {
  const [unit, length] = unitOf(total);
  const shown = (value) => (value / length).toFixed(length > 1 ? 1 : 0);
  return `${shown(done)} of ${shown(total)} ${unit}`;
}

/** The tone of a phase: done, busy, waiting, bad or gone. */
export function tone(phase) {
  return TONES[phase] ?? 'busy';
}

const TONES = {
  assigned: 'waiting',
  deferred: 'waiting',
  running: 'done',
  succeeded: 'done',
  failed: 'bad',
  unmet: 'bad',
  expired: 'bad',
  rolled_back: 'bad',
  stopped: 'gone',
  superseded: 'gone',
  cancelled: 'gone',
};

/** `3 h 12 min`: the two largest units. */
export function duration(ms) {
  let rest = Math.floor(ms / 1000);
  const parts = [];
  for (const [unit, length] of UNITS) {
    const count = Math.floor(rest / length);
    rest -= count * length;
    if (count || (parts.length && parts.length < 2)) parts.push(`${count} ${unit}`);
    if (parts.length === 2) break;
  }
  return parts.length ? parts.join(' ') : `${(ms / 1000).toFixed(1)} s`;
}

/** The first characters of a digest. */
export const shortDigest = (digest) => digest.replace(/^sha256:/, '').slice(0, 12);
