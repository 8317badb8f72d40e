// Numbers, times and names of states as people read them.

const UNITS = [['d', 86_400], ['h', 3_600], ['min', 60], ['s', 1]];

/** `12 s ago`; short, because a column of it is read at a glance. */
export function ago(then, now) {
  const seconds = Math.floor((now - then) / 1000);
  const unit = UNITS.find(([, length]) => seconds >= length);
  return unit ? `${Math.floor(seconds / unit[1])} ${unit[0]} ago` : 'now';
}

export const moment = (ms) => new Date(ms).toLocaleString(undefined, { dateStyle: 'medium', timeStyle: 'medium' });

export const number = (value) => value.toLocaleString('en');

export const plural = (count, noun) => `${number(count)} ${noun}${count === 1 ? '' : 's'}`;

/** `rolled_back` as `rolled back`. */
export const words = (code) => code.replaceAll('_', ' ');

/** `12.4 MB`. */
export function size(bytes) {
  const [unit, length] = [['GB', 1e9], ['MB', 1e6], ['kB', 1e3]].find(([, length]) => bytes >= length) ?? ['B', 1];
  return `${(bytes / length).toFixed(length > 1 ? 1 : 0)} ${unit}`;
}

/** `12.4 of 48.0 MB`, both in the unit of the whole, so that the text keeps its width. */
export function bytes({ done, total }) {
  const [unit, size] = [['GB', 1e9], ['MB', 1e6], ['kB', 1e3]].find(([, size]) => total >= size) ?? ['B', 1];
  const shown = (value) => (value / size).toFixed(size > 1 ? 1 : 0);
  return `${shown(done)} of ${shown(total)} ${unit}`;
}

/** What a phase means for whoever looks: done, busy, waiting, bad or gone. */
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
