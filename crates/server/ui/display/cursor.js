// Keyboard navigation in a long list: arrow keys move between rows, Enter opens the row. The focus
// stays on a row that moves.

import { change } from './display.js';

const CONTROLS = 'a, button, input, summary';
const rowOf = (key) => document.querySelector(`[data-key="${CSS.escape(key)}"]`);

/**
 * Call this before each drawing. It returns a function that restores the focus after the drawing,
 * because a moved row loses it.
 */
export function preserveFocus() {
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
  /** The key of the current row. */
  current = null;
  #list;
  #open;
  #isFocusDue = false;

  /** `list` is the virtual list; Enter calls `open(key)`. */
  constructor(list, open) {
    this.#list = list;
    this.#open = open;
  }

  /** Tab reaches one row of the list, arrow keys the others. */
  tabindex(key, index) {
    const isFirst = this.current ? this.current === key : index === 0;
    return isFirst ? 0 : -1;
  }

  /** Returns whether it handled the key. `keys` are the row keys in their order. */
  onKey({ key, target }, keys) {
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
      this.#list.reveal(this.current);
      this.#isFocusDue = true;
    });
    return true;
  }

  /** Call this after each drawing. */
  afterDraw() {
    if (!this.#isFocusDue) return;
    this.#isFocusDue = false;
    rowOf(this.current)?.focus({ preventScroll: true });
  }
}
