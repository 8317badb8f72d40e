// Output files of robots: maps as pictures, drawn in the browser for any content.

import { test } from 'node:test';
import { assert, assertQuiet, open, Puppet, Server, until } from './harness.mjs';

test('an uploaded map is shown as an image', async (t) => {
  const server = await Server.start(t);
  const atlas = await Puppet.enroll(server, 'atlas');
  const map = Buffer.concat([
    Buffer.from('P5\n# drawn by a test\n3 2\n255\n'),
    Buffer.from([0, 205, 254, 254, 205, 0]),
  ]);
  await atlas.bringBack('mapping', [
    ['maps/broken.pgm', 'P5 999 999 255 '],
    // Few bytes that claim to be a large picture, which would keep the browser busy or take its
    // memory.
    ['maps/endless.pgm', 'P2 3999 3999 255 0 0'],
    [
      'maps/huge.png',
      Buffer.from('\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\xff\xff\0\0\xff\xff\x08\x06', 'latin1'),
    ],
    ['maps/corridor.pgm', map],
    ...Array.from({ length: 30 }, (_, number) => [
      `more/${String(number).padStart(2, '0')}.pgm`,
      map,
    ]),
  ]);
  const page = await open(t, server, { hash: '#/robots/atlas/outputs' });
  await until(page, () => document.querySelector('.outputs canvas:not([hidden])')?.width === 3);
  const grays = await page.evaluate(() => {
    const { data } = document
      .querySelector('.outputs canvas:not([hidden])')
      .getContext('2d')
      .getImageData(0, 0, 3, 2);
    return [0, 4, 8, 12, 16, 20].map((at) => data[at]);
  });
  assert.deepEqual(grays, [0, 205, 254, 254, 205, 0]);
  const ends = 'Cannot show the image: the file ends before the last row';
  await until(
    page,
    () =>
      [...document.querySelectorAll('.outputs figure .bad')].filter((said) => said.innerText)
        .length === 3,
  );
  assert.deepEqual(
    await page.locator('.outputs figure .bad').allInnerTexts(),
    [ends, ends, 'Cannot show the image: the image is too large', ''],
    'only four images are shown',
  );
  await page.locator('.outputs', { hasText: '14 more: taskd output get' }).waitFor();
  const link = page.locator('.outputs a[download="corridor.pgm"]');
  assert.match(
    await link.getAttribute('href'),
    new RegExp(`^/v2/outputs/${atlas.id}/mapping/blobs/sha256:[0-9a-f]{64}$`),
  );
  assertQuiet(page);
});
