// Packs a folder into a POSIX tar: `ustar` headers, and a pax header for names that do not fit. The
// archive is a list of file slices, so no file is read into memory.

const BLOCK = 512;
const NAME_BYTES = 100;
// The size field of the header has this many octal digits.
const MAX_FILE_BYTES = 8 ** 11 - 1;
// A constant time, as in packages that the commands make: 2000-01-01.
const TIME_S = 946_684_800;
const READ_AT_ONCE = 16;
const text = new TextEncoder();

/**
 * The archive of `entries`, each `{ path, file }`, or a directory without a file. Throws readable
 * errors.
 */
export async function pack(entries) {
  const sorted = [...entries].sort((one, other) => (one.path < other.path ? -1 : 1));
  const modes = await modesOf(sorted);
  const pieces = [];
  sorted.forEach(({ path, file }, index) => {
    const size = file?.size ?? 0;
    if (size > MAX_FILE_BYTES)
      throw new Error(`${path}: too large for the browser; use taskd push`);
    const name = file ? path : `${path}/`;
    if (!fits(name)) pieces.push(...paxOf(name));
    pieces.push(
      header({
        name: fits(name) ? name : 'long',
        mode: modes[index],
        size,
        type: file ? '0' : '5',
      }),
    );
    if (size) pieces.push(file, new Uint8Array((BLOCK - (size % BLOCK)) % BLOCK));
  });
  pieces.push(new Uint8Array(2 * BLOCK));
  return new Blob(pieces);
}

// Only ASCII names in headers are read alike everywhere.
const fits = (name) => name.length <= NAME_BYTES && /^[\x20-\x7e]*$/.test(name);

function paxOf(name) {
  const record = text.encode(paxRecord('path', name));
  return [
    header({ name: 'pax', mode: 0o644, size: record.length, type: 'x' }),
    record,
    new Uint8Array((BLOCK - (record.length % BLOCK)) % BLOCK),
  ];
}

/**
 * `27 path=some/where\n`: the number is the length of the whole record in bytes, including itself.
 */
function paxRecord(key, value) {
  const rest = text.encode(` ${key}=${value}\n`).length;
  let length = rest;
  while (String(length).length + rest !== length) length = String(length).length + rest;
  return `${length} ${key}=${value}\n`;
}

function header({ name, mode, size, type }) {
  const block = new Uint8Array(BLOCK);
  const put = (at, value) => block.set(text.encode(value), at);
  const octal = (value, digits) => value.toString(8).padStart(digits, '0');
  put(0, name);
  put(100, octal(mode, 7));
  put(108, octal(0, 7));
  put(116, octal(0, 7));
  put(124, octal(size, 11));
  put(136, octal(TIME_S, 11));
  put(148, ' '.repeat(8));
  put(156, type);
  put(257, 'ustar\0' + '00');
  put(
    148,
    `${octal(
      block.reduce((sum, byte) => sum + byte, 0),
      6,
    )}\0 `,
  );
  return block;
}

/**
 * Browsers do not report the executable bit. Scripts with a shebang and ELF files count as
 * executable.
 */
async function modesOf(entries) {
  const modes = [];
  for (let from = 0; from < entries.length; from += READ_AT_ONCE) {
    modes.push(...(await Promise.all(entries.slice(from, from + READ_AT_ONCE).map(modeOf))));
  }
  return modes;
}

async function modeOf({ path, file }) {
  if (!file) return 0o755;
  let head;
  try {
    head = new Uint8Array(await file.slice(0, 4).arrayBuffer());
  } catch {
    throw new Error(`${path}: cannot be read`);
  }
  const begins = (bytes) => bytes.every((byte, at) => head[at] === byte);
  return begins([0x23, 0x21]) || begins([0x7f, 0x45, 0x4c, 0x46]) ? 0o755 : 0o644;
}
