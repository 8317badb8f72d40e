// The files of a package as a collapsible tree, flattened to visible rows.

// Trees up to this size start expanded.
const EXPAND_UP_TO = 60;

export class Tree {
  #children = new Map([['', []]]);
  #nodes = new Map();
  #expanded = new Set();
  /** Number of files, and their total size. */
  files = 0;
  bytes = 0;

  /** `files` is the server's list, sorted by path; directories may be missing. */
  constructor(files) {
    for (const file of files) this.#add(file);
    for (const [path, { kind }] of this.#nodes)
      if (kind === 'directory' && files.length <= EXPAND_UP_TO) this.#expanded.add(path);
    for (const children of this.#children.values()) children.sort(byKindAndName);
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

  isExpanded(path) {
    return this.#expanded.has(path);
  }

  toggle(path) {
    if (this.#nodes.get(path)?.kind !== 'directory') return;
    if (!this.#expanded.delete(path)) this.#expanded.add(path);
  }

  /** Expands or collapses all directories. */
  toggleAll(isExpanded) {
    this.#expanded = new Set(
      isExpanded
        ? [...this.#nodes.values()]
            .filter(({ kind }) => kind === 'directory')
            .map(({ path }) => path)
        : [],
    );
  }

  /** The visible rows, or, with a search text, the files whose paths contain it. */
  rows(text = '') {
    if (text)
      return [...this.#nodes.values()]
        .filter(({ path, kind }) => kind !== 'directory' && path.toLowerCase().includes(text))
        .map((node) => ({ ...node, name: node.path, depth: 0 }));
    const rows = [];
    const visit = (path) => {
      for (const node of this.#children.get(path)) {
        rows.push(node);
        if (this.#expanded.has(node.path)) visit(node.path);
      }
    };
    visit('');
    return rows;
  }
}

// Directories first, as in file managers.
const byKindAndName = (one, other) =>
  (other.kind === 'directory') - (one.kind === 'directory') || (one.name < other.name ? -1 : 1);

/** `0755`. */
export const modeText = (mode) =>
  mode == null ? '' : (mode & 0o7777).toString(8).padStart(4, '0');

/** The files that differ between two versions, sorted by path, and the difference in size. */
export function packageDiff({ added, removed, changed }) {
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
