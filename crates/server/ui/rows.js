// Long lists: only the rows in sight exist, so ten thousand cost what thirty do. The window
// scrolls, not the list.

// Rows drawn beyond the edges, so that the next ones are there when the wheel turns.
const SPARE_ROWS = 6;
const narrow = matchMedia('(max-width: 1219px)');
/** As in style.css: where a row has two forms. Kept, because every row of a long list asks. */
export let isNarrow = narrow.matches;
narrow.addEventListener('change', ({ matches }) => (isNarrow = matches));

/**
 * The rows of one list, which the template has as `.rows` with `.sight` in it, each row with its
 * key as `data-key`.
 */
export class Rows {
  #keys = [];
  #bottoms = [];
  #shape = null;
  #offset = 0;
  #scrolled = 0;
  #isRearranged = false;

  /**
   * A person, not the stream, has changed which rows stand where: the next drawing does not hold on
   * to any.
   */
  rearrange() {
    this.#isRearranged = true;
  }

  /**
   * Which of `keys` are in sight now, as `{ start, end }`. `heightOf` gives a row's height in
   * pixels; the same `keys` with the same `shape` have the same heights.
   */
  sight(keys, heightOf, shape = isNarrow) {
    if (keys !== this.#keys || shape !== this.#shape) this.#arrange(keys, heightOf, shape);
    const rows = document.querySelector('.rows');
    const top = (rows?.getBoundingClientRect().top ?? 0) - this.#scrolled;
    const start = Math.max(0, this.#first(-top) - SPARE_ROWS);
    const end = Math.min(keys.length, this.#first(innerHeight - top) + 1 + SPARE_ROWS);
    this.#offset = this.#top(start);
    return { start, end };
  }

  #arrange(keys, heightOf, shape) {
    let bottom = 0;
    this.#keys = keys;
    this.#shape = shape;
    this.#bottoms = keys.map((key) => (bottom += heightOf(key)));
    this.#scrolled = this.#keepInPlace();
  }

  /**
   * Puts the rows where they belong; to be called after each drawing. Through the style objects:
   * the policy of this page allows no style attributes.
   */
  place() {
    const rows = document.querySelector('.rows');
    if (!rows) return;
    rows.style.height = `${this.#bottoms.at(-1) ?? 0}px`;
    // Not by a transform: rows that stay in sight stay where they are, and need not be painted
    // again.
    rows.querySelector('.sight').style.top = `${this.#offset}px`;
    if (this.#scrolled) scrollBy(0, this.#scrolled);
    this.#scrolled = 0;
  }

  /** Scrolls so far that the row is in sight. */
  reveal(key) {
    const index = this.#keys.indexOf(key);
    const rows = document.querySelector('.rows');
    if (index < 0 || !rows) return;
    const { top } = rows.getBoundingClientRect();
    const head = document.querySelector('.row.head')?.getBoundingClientRect().height ?? 0;
    const [above, below] = [
      top + this.#top(index) - head,
      top + this.#bottoms[index] - innerHeight,
    ];
    if (above < 0) scrollBy(0, above);
    else if (below > 0) scrollBy(0, below);
  }

  #top(index) {
    return index > 0 ? this.#bottoms[index - 1] : 0;
  }

  /** The first row that ends below this distance from the list's top. */
  #first(distance) {
    let [low, high] = [0, this.#bottoms.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.#bottoms[middle] > distance) high = middle;
      else low = middle + 1;
    }
    return low;
  }

  /**
   * How far to scroll so that the row at the list's upper edge stays where it is, though rows above
   * it grow or shrink.
   */
  #keepInPlace() {
    const rows = document.querySelector('.rows');
    const wasRearranged = this.#isRearranged;
    this.#isRearranged = false;
    if (!rows || wasRearranged) return 0;
    const edge = document.querySelector('.row.head')?.getBoundingClientRect().bottom ?? 0;
    const { left, top } = rows.getBoundingClientRect();
    if (top >= edge) return 0;
    const row = document.elementFromPoint(left + 1, edge + 1)?.closest('[data-key]');
    const index = row ? this.#keys.indexOf(row.dataset.key) : -1;
    return index < 0 ? 0 : Math.round(top + this.#top(index) - row.getBoundingClientRect().top);
  }
}
