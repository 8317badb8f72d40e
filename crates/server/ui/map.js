// Pictures of occupancy grids: browsers show PNG by themselves, but not the PGM of ROS's map_server.

const MAX_PIXELS = 64e6;

export const isMap = (path) => /\.(pgm|png)$/i.test(path);

/** Fetches a picture and draws it, pixel by pixel, onto `canvas`. What can't be read is said in its place. */
export async function drawMap(canvas, source) {
  try {
    const response = await fetch(source);
    if (!response.ok) throw new Error(`the server answered ${response.status}`);
    const bytes = new Uint8Array(await response.arrayBuffer());
    const picture = bytes[0] === 0x50 ? gray(bytes) : await createImageBitmap(new Blob([bytes]));
    Object.assign(canvas, { width: picture.width, height: picture.height });
    const context = canvas.getContext('2d');
    if (picture instanceof ImageData) context.putImageData(picture, 0, 0);
    else context.drawImage(picture, 0, 0);
  } catch (error) {
    canvas.closest('figure')?.replaceChildren(`The picture can't be shown: ${error.message}`);
  }
}

/** A PGM, text (P2) or bytes (P5), as Netpbm describes it. */
export function gray(bytes) {
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
  const isSane = (kind === 'P5' || kind === 'P2') && width > 0 && height > 0 && width * height <= MAX_PIXELS && most > 0 && most < 65536;
  if (!isSane) throw new Error('it is no PGM picture');
  at += 1;
  const wide = most > 255 ? 2 : 1;
  if (kind === 'P5' && bytes.length - at < width * height * wide) throw new Error('it ends before its last row');
  const picture = new ImageData(width, height);
  for (let pixel = 0; pixel < width * height; pixel += 1) {
    let value;
    if (kind === 'P2') value = Number(word());
    else value = wide === 2 ? bytes[at + 2 * pixel] * 256 + bytes[at + 2 * pixel + 1] : bytes[at + pixel];
    picture.data.fill((value * 255) / most, 4 * pixel, 4 * pixel + 3);
    picture.data[4 * pixel + 3] = 255;
  }
  return picture;
}
