// Images of occupancy grids. Browsers show PNG, but not the PGM of map_server.

const MAX_PIXELS = 16e6;

export const isMap = (path) => /\.(pgm|png)$/i.test(path);

/** Fetches the image at `canvas.dataset.source` and draws it. Throws readable errors. */
export async function drawMap(canvas) {
  const { source } = canvas.dataset;
  const response = await fetch(source);
  if (!response.ok) throw new Error(`the server responded with status ${response.status}`);
  const bytes = new Uint8Array(await response.arrayBuffer());
  const picture = bytes[0] === 0x50 ? gray(bytes) : await colours(bytes);
  // The canvas may show another image by now.
  if (canvas.dataset.source !== source) return;
  Object.assign(canvas, { width: picture.width, height: picture.height });
  const context = canvas.getContext('2d');
  if (picture instanceof ImageData) context.putImageData(picture, 0, 0);
  else context.drawImage(picture, 0, 0);
}

/** Decodes a PNG. Its size is checked in the header first: a few bytes can claim any size. */
function colours(bytes) {
  const head = [0x89, 0x50, 0x4e, 0x47];
  if (bytes.length < 24 || head.some((byte, at) => bytes[at] !== byte))
    throw new Error('not a PNG image');
  const view = new DataView(bytes.buffer);
  if (view.getUint32(16) * view.getUint32(20) > MAX_PIXELS)
    throw new Error('the image is too large');
  return createImageBitmap(new Blob([bytes], { type: 'image/png' })).catch(() => {
    throw new Error('not a PNG image');
  });
}

/** Decodes a PGM, text (P2) or binary (P5), as specified by Netpbm. */
function gray(bytes) {
  let at = 0;
  const isSpace = (byte) => byte === 0x20 || (byte >= 0x09 && byte <= 0x0d);
  function word() {
    for (;;) {
      while (at < bytes.length && isSpace(bytes[at])) at += 1;
      if (bytes[at] !== 0x23) break;
      while (at < bytes.length && bytes[at] !== 0x0a) at += 1;
    }
    const from = at;
    while (at < bytes.length && !isSpace(bytes[at])) at += 1;
    return String.fromCharCode(...bytes.subarray(from, Math.min(at, from + 16)));
  }
  const kind = word();
  const [width, height, most] = [word(), word(), word()].map(Number);
  const isSane =
    (kind === 'P5' || kind === 'P2') &&
    [width, height, most].every((count) => Number.isInteger(count) && count > 0) &&
    most < 65536;
  if (!isSane) throw new Error('not a PGM image');
  if (width * height > MAX_PIXELS) throw new Error('the image is too large');
  at += 1;
  const wide = most > 255 ? 2 : 1;
  // In P2 each pixel takes at least a digit and a separator.
  if (bytes.length - at < (kind === 'P5' ? width * height * wide : 2 * width * height - 1))
    throw new Error('the file ends before the last row');
  const picture = new ImageData(width, height);
  const { data } = picture;
  for (let pixel = 0; pixel < width * height; pixel += 1) {
    let value;
    if (kind === 'P2') value = Number(word());
    else
      value =
        wide === 2 ? bytes[at + 2 * pixel] * 256 + bytes[at + 2 * pixel + 1] : bytes[at + pixel];
    const first = 4 * pixel;
    data[first] = data[first + 1] = data[first + 2] = (value * 255) / most;
    data[first + 3] = 255;
  }
  return picture;
}
