// What somebody dropped on the page or chose in a dialog, as packages to send: archives and
// folders.

import { number } from '../format.js';

// As the server refuses more.
const MAX_ENTRIES = 100_000;
/** What never travels, so it need not be read either. */
const LEFT_OUT = new Set(['.git', '__pycache__']);

/**
 * What was dropped: for each thing `{ name, file }` or `{ name, entries }`, which is a promise. To
 * be called while the event lasts.
 */
export function ofDrop(dataTransfer) {
  return [...dataTransfer.items]
    .filter(({ kind }) => kind === 'file')
    .map((item) => {
      const entry = item.webkitGetAsEntry();
      if (entry?.isDirectory) return { name: entry.name, entries: walk(entry) };
      const file = item.getAsFile();
      return { name: file.name, file: Promise.resolve(file) };
    });
}

/** The archives that were chosen. */
export const ofFiles = (files) =>
  [...files].map((file) => ({ name: file.name, file: Promise.resolve(file) }));

/** The folder that was chosen: its files, whose paths begin with its name. */
export function ofFolder(files) {
  const all = [...files].map((file) => ({
    path: file.webkitRelativePath.split('/').slice(1).join('/'),
    file,
  }));
  const entries = all.filter(({ path }) => !path.split('/').some((part) => LEFT_OUT.has(part)));
  return { name: files[0].webkitRelativePath.split('/')[0], entries: Promise.resolve(entries) };
}

const fileOf = (entry) =>
  new Promise((resolve, reject) =>
    entry.file(resolve, () => reject(new Error(`${entry.fullPath.slice(1)}: it can't be read`))),
  );

/** All files and directories below a directory, with paths below it. */
async function walk(top) {
  const found = [];
  const waiting = [{ entry: top, path: '' }];
  while (waiting.length) {
    const { entry, path } = waiting.pop();
    for (const child of await childrenOf(entry)) {
      if (LEFT_OUT.has(child.name)) continue;
      const below = path ? `${path}/${child.name}` : child.name;
      if (child.isDirectory) {
        found.push({ path: below });
        waiting.push({ entry: child, path: below });
      } else found.push({ path: below, file: await fileOf(child) });
      if (found.length > MAX_ENTRIES)
        throw new Error(`${top.name}: more than ${number(MAX_ENTRIES)} files`);
    }
  }
  return found;
}

/** A reader gives a hundred at a time, and nothing at its end. */
async function childrenOf(directory) {
  const reader = directory.createReader();
  const all = [];
  for (;;) {
    const some = await new Promise((resolve, reject) =>
      reader.readEntries(resolve, () =>
        reject(new Error(`${directory.fullPath.slice(1)}: it can't be read`)),
      ),
    );
    if (!some.length) return all;
    all.push(...some);
  }
}
