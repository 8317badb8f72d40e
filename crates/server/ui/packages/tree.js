// The files of a package as a tree whose directories fold: what is in sight of it, as rows.

// A small package is shown whole.
const WHOLE = 60;

export class Tree {
  #children = new Map([['', []]]);
  #nodes = new Map();
  #unfolded = new Set();
  /** How many files there are, and their bytes. */
  files = 0;
  bytes = 0;

  /** `files` as the server lists them, sorted by path; it need not list directories. */
  constructor(files) {
    for (const file of files) this.#add(file);
    for (const [path, { kind }] of this.#nodes)
      if (kind === 'directory' && files.length <= WHOLE) this.#unfolded.add(path);
    for (const children of this.#children.values()) children.sort(inOrder);
  }

  #add({ path, kind, mode, size, target }) {
    const parent = this.#parentOf(path);
    const isNew = !this.#nodes.has(path);
    const node = {
      path,
      name: path.slice(parent ? parent.length + 1 : 0),
      kind,
      mode,
      target,
      size,
      depth: parent ? parent.split('/').length : 0,
    };
    this.#nodes.set(path, node);
    if (kind === 'directory' && !this.#children.has(path)) this.#children.set(path, []);
    if (isNew) this.#children.get(parent).push(node);
    if (kind === 'directory') return;
    this.files += 1;
    this.bytes += size;
    for (let above = parent; above; above = above.slice(0, Math.max(0, above.lastIndexOf('/'))))
      this.#nodes.get(above).size += size;
  }

  #parentOf(path) {
    const parent = path.slice(0, Math.max(0, path.lastIndexOf('/')));
    if (parent && !this.#nodes.has(parent)) this.#add({ path: parent, kind: 'directory', size: 0 });
    return parent;
  }

  isUnfolded(path) {
    return this.#unfolded.has(path);
  }

  toggle(path) {
    if (this.#nodes.get(path)?.kind !== 'directory') return;
    if (!this.#unfolded.delete(path)) this.#unfolded.add(path);
  }

  /** Unfolds all directories, or folds them. */
  toggleAll(isUnfolded) {
    this.#unfolded = new Set(
      isUnfolded
        ? [...this.#nodes.values()]
            .filter(({ kind }) => kind === 'directory')
            .map(({ path }) => path)
        : [],
    );
  }

  /**
   * The rows: those that are unfolded, or, with a text to find, the files in whose path it occurs.
   */
  rows(text = '') {
    if (text)
      return [...this.#nodes.values()]
        .filter(({ path, kind }) => kind !== 'directory' && path.toLowerCase().includes(text))
        .map((node) => ({ ...node, name: node.path, depth: 0 }));
    const rows = [];
    const visit = (path) => {
      for (const node of this.#children.get(path)) {
        rows.push(node);
        if (this.#unfolded.has(node.path)) visit(node.path);
      }
    };
    visit('');
    return rows;
  }
}

// Directories come first, as file managers show them.
const inOrder = (one, other) =>
  (other.kind === 'directory') - (one.kind === 'directory') || (one.name < other.name ? -1 : 1);

/** `0755`. */
export const modeWords = (mode) =>
  mode == null ? '' : (mode & 0o7777).toString(8).padStart(4, '0');

/** What differs between two versions, as rows sorted by path, and in all. */
export function differences({ added, removed, changed }) {
  const rows = [
    ...added.map((to) => ({ path: to.path, kind: 'added', sign: '+', to, by: to.size })),
    ...removed.map((from) => ({
      path: from.path,
      kind: 'removed',
      sign: '−',
      from,
      by: -from.size,
    })),
    ...changed.map(({ path, from, to }) => ({
      path,
      kind: 'changed',
      sign: '±',
      from,
      to,
      by: to.size - from.size,
    })),
  ];
  return {
    rows: rows.sort((one, other) => (one.path < other.path ? -1 : 1)),
    by: rows.reduce((sum, row) => sum + row.by, 0),
  };
}
