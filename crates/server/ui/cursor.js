// Going from row to row of a long list by keys: up, down, and Enter, which opens. And staying there
// while the rows change places.

import { change } from './frame.js';

const CONTROLS = 'a, button, input, summary';
const rowOf = (key) => document.querySelector(`[data-key="${CSS.escape(key)}"]`);

/**
 * To be called before each drawing. Answers what gives the focus back after it: a row that is put
 * elsewhere has lost it.
 */
export function holdFocus() {
  const held = document.activeElement;
  const key = held?.closest('[data-key]')?.dataset.key;
  if (key === undefined) return () => {};
  const control = [...rowOf(key).querySelectorAll(CONTROLS)].indexOf(held);
  return () => {
    if (document.activeElement !== document.body) return;
    const row = rowOf(key);
    (control < 0 ? row : row?.querySelectorAll(CONTROLS)[control])?.focus({ preventScroll: true });
  };
}

export class Cursor {
  /** The row that keys go to. */
  current = null;
  #rows;
  #open;
  #isFocusDue = false;

  /** `rows` are the list's, `open(key)` is what Enter does. */
  constructor(rows, open) {
    this.#rows = rows;
    this.#open = open;
  }

  /** The tab key reaches one row of the list, and the arrows the others. */
  tabindex(key, index) {
    const isFirst = this.current ? this.current === key : index === 0;
    return isFirst ? 0 : -1;
  }

  /** Whether it took the key. `keys` are the rows', in their order. */
  key({ key, target }, keys) {
    const isSearch = target.matches('input[type=search]');
    if (key === 'ArrowDown' || key === 'ArrowUp')
      return this.#move(isSearch ? 0 : key === 'ArrowDown' ? 1 : -1, keys);
    if (
      key !== 'Enter' ||
      isSearch ||
      target.matches('button, a, summary') ||
      !keys.includes(this.current)
    )
      return false;
    this.#open(this.current);
    return true;
  }

  #move(by, keys) {
    if (!keys.length) return false;
    const from = keys.indexOf(this.current);
    change(() => {
      this.current = by === 0 ? keys[0] : keys[Math.min(keys.length - 1, Math.max(0, from + by))];
      this.#rows.reveal(this.current);
      this.#isFocusDue = true;
    });
    return true;
  }

  /** To be called after each drawing. */
  drawn() {
    if (!this.#isFocusDue) return;
    this.#isFocusDue = false;
    rowOf(this.current)?.focus({ preventScroll: true });
  }
}
