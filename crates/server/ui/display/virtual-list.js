// A virtual list: only visible rows exist, so ten thousand rows cost as much as thirty. The window
// scrolls, not the list.

// Rows drawn beyond the visible range, ready for scrolling.
const OVERSCAN_ROWS = 6;
const narrow = matchMedia('(max-width: 1219px)');
/** As in display.css: where rows have two layouts. Cached, because every row reads it. */
export let isNarrow = narrow.matches;
narrow.addEventListener('change', ({ matches }) => (isNarrow = matches));

/**
 * The rows of one list. The template has `.rows` with `.rendered` inside, and each row has its key
 * as `data-key`.
 */
export class VirtualList {
  #keys = [];
  #bottoms = [];
  #layoutKey = null;
  #offset = 0;
  #pendingScroll = 0;
  #isAnchorReleased = false;

  /** The user has changed the list: the next drawing does not hold the scroll position at a row. */
  releaseAnchor() {
    this.#isAnchorReleased = true;
  }

  /**
   * The visible range of `keys`, as `{ start, end }`. `heightOf` returns the height of a row in
   * pixels; heights are cached for the same `keys` and `layoutKey`.
   */
  visibleRange(keys, heightOf, layoutKey = isNarrow) {
    if (keys !== this.#keys || layoutKey !== this.#layoutKey)
      this.#measure(keys, heightOf, layoutKey);
    const rows = document.querySelector('.rows');
    const top = (rows?.getBoundingClientRect().top ?? 0) - this.#pendingScroll;
    const start = Math.max(0, this.#first(-top) - OVERSCAN_ROWS);
    const end = Math.min(keys.length, this.#first(innerHeight - top) + 1 + OVERSCAN_ROWS);
    this.#offset = this.#top(start);
    return { start, end };
  }

  #measure(keys, heightOf, layoutKey) {
    let bottom = 0;
    this.#keys = keys;
    this.#layoutKey = layoutKey;
    this.#bottoms = keys.map((key) => (bottom += heightOf(key)));
    this.#pendingScroll = this.#anchorShift();
  }

  /**
   * Positions the rows. Call this after each drawing. It sets style objects, since the content
   * security policy forbids style attributes.
   */
  applyLayout() {
    const rows = document.querySelector('.rows');
    if (!rows) return;
    rows.style.height = `${this.#bottoms.at(-1) ?? 0}px`;
    // Not a transform: visible rows stay where they are and need no repaint.
    rows.querySelector('.rendered').style.top = `${this.#offset}px`;
    if (this.#pendingScroll) scrollBy(0, this.#pendingScroll);
    this.#pendingScroll = 0;
  }

  /** Scrolls the row into view. */
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

  /** The index of the first row that ends below this offset. */
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
   * The scroll offset that keeps the top visible row in place when rows above it change their
   * heights.
   */
  #anchorShift() {
    const rows = document.querySelector('.rows');
    const wasReleased = this.#isAnchorReleased;
    this.#isAnchorReleased = false;
    if (!rows || wasReleased) return 0;
    const edge = document.querySelector('.row.head')?.getBoundingClientRect().bottom ?? 0;
    const { left, top } = rows.getBoundingClientRect();
    if (top >= edge) return 0;
    const row = document.elementFromPoint(left + 1, edge + 1)?.closest('[data-key]');
    const index = row ? this.#keys.indexOf(row.dataset.key) : -1;
    return index < 0 ? 0 : Math.round(top + this.#top(index) - row.getBoundingClientRect().top);
  }
}
