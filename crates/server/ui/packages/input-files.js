// Reads dropped or selected files and folders as packages to upload.

import { number } from '../display/format.js';

// As the server, which refuses more.
const MAX_FILES = 100_000;
/** Names that packages never contain. */
const IGNORED = new Set(['.git', '__pycache__']);

/**
 * The dropped items, each `{ name, file }` or `{ name, entries }` with a promise. Call this during
 * the event.
 */
export function fromDrop(dataTransfer) {
  return [...dataTransfer.items]
    .filter(({ kind }) => kind === 'file')
    .map((item) => {
      const entry = item.webkitGetAsEntry();
      if (entry?.isDirectory) return { name: entry.name, entries: walk(entry) };
      const file = item.getAsFile();
      return { name: file.name, file: Promise.resolve(file) };
    });
}

/** Selected archives. */
export const fromFiles = (files) =>
  [...files].map((file) => ({ name: file.name, file: Promise.resolve(file) }));

/** A selected folder: the paths of its files begin with its name. */
export function fromFolder(files) {
  const all = [...files].map((file) => ({
    path: file.webkitRelativePath.split('/').slice(1).join('/'),
    file,
  }));
  const entries = all.filter(({ path }) => !path.split('/').some((part) => IGNORED.has(part)));
  return { name: files[0].webkitRelativePath.split('/')[0], entries: Promise.resolve(entries) };
}

const fileOf = (entry) =>
  new Promise((resolve, reject) =>
    entry.file(resolve, () => reject(new Error(`${entry.fullPath.slice(1)}: cannot be read`))),
  );

/** All files and directories below a directory, with relative paths. */
async function walk(top) {
  const found = [];
  const waiting = [{ entry: top, path: '' }];
  while (waiting.length) {
    const { entry, path } = waiting.pop();
    for (const child of await childrenOf(entry)) {
      if (IGNORED.has(child.name)) continue;
      const below = path ? `${path}/${child.name}` : child.name;
      if (child.isDirectory) {
        found.push({ path: below });
        waiting.push({ entry: child, path: below });
      } else found.push({ path: below, file: await fileOf(child) });
      if (found.length > MAX_FILES)
        throw new Error(`${top.name}: more than ${number(MAX_FILES)} files`);
    }
  }
  return found;
}

/** A reader returns a hundred entries at a time, and none at the end. */
async function childrenOf(directory) {
  const reader = directory.createReader();
  const all = [];
  for (;;) {
    const some = await new Promise((resolve, reject) =>
      reader.readEntries(resolve, () =>
        reject(new Error(`${directory.fullPath.slice(1)}: cannot be read`)),
      ),
    );
    if (!some.length) return all;
    all.push(...some);
  }
}
