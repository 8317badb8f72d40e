// Thousands of log lines in the page. They are put there once and not drawn again with each frame,
// and the browser lays out only those in sight. What a robot has said becomes text and nothing
// else.

import { instant, iso, moment } from '../format.js';

const CHUNK = 100;
// So near the end counts as being there.
const NEAR_END = 32;

export class Sheet {
  /** The newest lines are in sight, and go on being so. */
  isAtEnd = true;
  /** How many lines there are to see. */
  shown = 0;
  #most;
  #changed;
  #needle = '';
  #lines = [];
  #body = document.createElement('div');
  #place = null;
  #observer = new ResizeObserver(() => this.isAtEnd && this.toEnd());

  /**
   * At `most` so many lines; `changed` is called when a person scrolls to the end or away from it.
   */
  constructor(most, changed) {
    this.#most = most;
    this.#changed = changed;
    this.#body.className = 'sheet';
  }

  /** Goes to its place in the page, where that is a new one. */
  settle(place) {
    if (!place || this.#place === place) return;
    this.#place = place;
    place.append(this.#body);
    place.addEventListener('scroll', () => this.#look(), { passive: true });
    this.#observer.disconnect();
    this.#observer.observe(this.#body);
    this.#observer.observe(place);
    if (this.isAtEnd) this.toEnd();
  }

  /** Shows these lines and no others. */
  show(lines) {
    this.#lines = lines;
    this.#rebuild();
  }

  /** Shows these lines as well, below. */
  add(lines) {
    this.#lines = [...this.#lines, ...lines].slice(-this.#most);
    this.#append(lines);
    while (this.shown > this.#most) this.#drop();
    if (this.isAtEnd) this.toEnd();
  }

  /** Shows only lines in which this occurs. */
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
    if (!this.isAtEnd) this.#changed(() => (this.isAtEnd = true));
  }

  #look() {
    const { scrollTop, scrollHeight, clientHeight } = this.#place;
    const isAtEnd = scrollHeight - scrollTop - clientHeight < NEAR_END;
    if (isAtEnd !== this.isAtEnd) this.#changed(() => (this.isAtEnd = isAtEnd));
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
        chunk = part('div', 'chunk');
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
    const element = part('p', `log-line ${line.level ?? 'note'}`);
    if (line.note) {
      element.append(part('span', 'text', line.note));
      return element;
    }
    const text = part('span', 'text');
    text.append(...this.#marked(line.text));
    element.append(
      part('time', 'at', instant(line.at_ms)),
      ' ',
      part('span', 'level', line.level),
      ' ',
      part('span', 'where', whereOf(line)),
      ' ',
      text,
    );
    element.title = moment(line.at_ms);
    return element;
  }

  /** The text with what is searched for marked in it. */
  #marked(text) {
    if (!this.#needle) return [text];
    const [parts, lower] = [[], text.toLowerCase()];
    let from = 0;
    for (let at = lower.indexOf(this.#needle); at >= 0; at = lower.indexOf(this.#needle, from)) {
      parts.push(text.slice(from, at), part('mark', '', text.slice(at, at + this.#needle.length)));
      from = at + this.#needle.length;
    }
    return [...parts, text.slice(from)];
  }
}

function part(name, className, text) {
  const element = document.createElement(name);
  if (className) element.className = className;
  if (text) element.textContent = text;
  return element;
}

/** Who said it: the node where one did, else the task, else where it was read. */
const whereOf = ({ task, node, source }) =>
  [task, node ?? (source === 'stdout' ? null : source)].filter(Boolean).join(' ');

/** A line as it is kept in a file. */
export const textOf = (line) =>
  line.note
    ? `# ${line.note}`
    : `${iso(line.at_ms)} ${line.level.toUpperCase().padEnd(5)} [${whereOf(line)}] ${line.text}`;
