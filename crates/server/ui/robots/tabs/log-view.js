// Thousands of log lines in the page. Lines are added once and not redrawn each frame, and the
// browser lays out only the visible ones. They are added as text nodes only.

import { instant, iso, moment } from '../../display/format.js';

const CHUNK = 100;
// Closer to the end counts as at the end.
const NEAR_END = 32;

export class LogView {
  /** Whether the view is scrolled to the newest lines and follows them. */
  isAtEnd = true;
  /** Number of visible lines. */
  shown = 0;
  #maxLines;
  #onScroll;
  #needle = '';
  #lines = [];
  #body = document.createElement('div');
  #place = null;
  #observer = new ResizeObserver(() => this.isAtEnd && this.toEnd());

  /**
   * Keeps at most `maxLines` lines; `onScroll` is called when the user scrolls to the end or away
   * from it.
   */
  constructor(maxLines, onScroll) {
    this.#maxLines = maxLines;
    this.#onScroll = onScroll;
    this.#body.className = 'log-lines';
  }

  /** Moves to a new container. */
  attach(place) {
    if (!place || this.#place === place) return;
    this.#place = place;
    place.append(this.#body);
    place.addEventListener('scroll', () => this.#updateIsAtEnd(), { passive: true });
    this.#observer.disconnect();
    this.#observer.observe(this.#body);
    this.#observer.observe(place);
    if (this.isAtEnd) this.toEnd();
  }

  /** Replaces the lines. */
  show(lines) {
    this.#lines = lines;
    this.#rebuild();
  }

  /** Appends lines. */
  add(lines) {
    this.#lines = [...this.#lines, ...lines].slice(-this.#maxLines);
    this.#append(lines);
    while (this.shown > this.#maxLines) this.#drop();
    if (this.isAtEnd) this.toEnd();
  }

  /** Shows only lines that contain this text. */
  search(needle) {
    if (needle.toLowerCase() === this.#needle) return;
    this.#needle = needle.toLowerCase();
    this.#rebuild();
  }

  get lines() {
    return this.#lines.filter((line) => this.#matches(line));
  }

  toEnd() {
    if (this.#place) this.#place.scrollTop = this.#place.scrollHeight;
    if (!this.isAtEnd) this.#onScroll(() => (this.isAtEnd = true));
  }

  #updateIsAtEnd() {
    const { scrollTop, scrollHeight, clientHeight } = this.#place;
    const isAtEnd = scrollHeight - scrollTop - clientHeight < NEAR_END;
    if (isAtEnd !== this.isAtEnd) this.#onScroll(() => (this.isAtEnd = isAtEnd));
  }

  #matches(line) {
    return !this.#needle || textOf(line).toLowerCase().includes(this.#needle);
  }

  #rebuild() {
    this.#body.replaceChildren();
    this.shown = 0;
    this.#append(this.#lines);
    if (this.isAtEnd) this.toEnd();
  }

  #append(lines) {
    for (const line of lines) {
      if (!this.#matches(line)) continue;
      let chunk = this.#body.lastElementChild;
      if (!chunk || chunk.childElementCount >= CHUNK) {
        chunk = createElement('div', 'chunk');
        this.#body.append(chunk);
      }
      chunk.append(this.#element(line));
      this.shown += 1;
    }
  }

  #drop() {
    const chunk = this.#body.firstElementChild;
    chunk.firstElementChild.remove();
    if (!chunk.childElementCount) chunk.remove();
    this.shown -= 1;
  }

  #element(line) {
    const element = createElement('p', `log-line ${line.level ?? 'note'}`);
    if (line.note) {
      element.append(createElement('span', 'text', line.note));
      return element;
    }
    const text = createElement('span', 'text');
    text.append(...this.#marked(line.text));
    element.append(
      createElement('time', 'at', instant(line.at_ms)),
      ' ',
      createElement('span', 'level', line.level),
      ' ',
      createElement('span', 'source', sourceOf(line)),
      ' ',
      text,
    );
    element.title = moment(line.at_ms);
    return element;
  }

  /** The text with matches marked. */
  #marked(text) {
    if (!this.#needle) return [text];
    const [parts, lower] = [[], text.toLowerCase()];
    let from = 0;
    for (let at = lower.indexOf(this.#needle); at >= 0; at = lower.indexOf(this.#needle, from)) {
      parts.push(
        text.slice(from, at),
        createElement('mark', '', text.slice(at, at + this.#needle.length)),
      );
      from = at + this.#needle.length;
    }
    return [...parts, text.slice(from)];
  }
}

function createElement(name, className, text) {
  const element = document.createElement(name);
  if (className) element.className = className;
  if (text) element.textContent = text;
  return element;
}

/** The source of a line: the node, or the task, or the stream. */
const sourceOf = ({ task, node, source }) =>
  [task, node ?? (source === 'stdout' ? null : source)].filter(Boolean).join(' ');

/** A line as in a downloaded file. */
export const textOf = (line) =>
  line.note
    ? `# ${line.note}`
    : `${iso(line.at_ms)} ${line.level.toUpperCase().padEnd(5)} [${sourceOf(line)}] ${line.text}`;
