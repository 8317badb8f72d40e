// Uploads of packages. They continue while the user visits other views.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { SignedOut, upload } from '../api/api.js';
import { change } from '../display/display.js';
import { bytes } from '../display/format.js';
import { notify } from '../display/notice.js';
import { hrefTo } from '../display/router.js';
import { pack } from './pack.js';

const MEDIA_TYPES = [
  [/\.(tar\.zst|tzst|taskd)$/i, 'application/zstd'],
  [/\.tar$/i, 'application/x-tar'],
];

export class Uploads {
  #all = [];
  #last = Promise.resolve();

  /** Uploads these sources one after the other. The event stream reports new packages. */
  add(sources) {
    for (const { name, file, entries } of sources) {
      this.#add({ name, file, entries });
    }
  }

  #add({ name, file, entries, force = false }) {
    const one = {
      name,
      stage: 'waiting',
      done: 0,
      total: 0,
      problem: null,
      end: new AbortController(),
    };
    // An existing version is replaced only after a confirmation.
    one.retryWithForce = () => {
      this.#forget(one);
      this.#add({ name, file, entries, force: true });
    };
    // A read error is reported when its turn comes.
    entries?.catch(() => {});
    change(() => this.#all.push(one));
    this.#last = this.#last.then(() => this.#send(one, { file, entries, force }));
  }

  async #send(one, { file, entries, force }) {
    const { name, end } = one;
    if (end.signal.aborted) return this.#forget(one);
    try {
      change(() => (one.stage = entries ? 'packing' : 'sending'));
      const { blob, type } = entries
        ? { blob: await packFolder(name, await entries), type: 'application/x-tar' }
        : { blob: await file, type: typeOf(name) };
      change(() => Object.assign(one, { stage: 'sending', total: blob.size }));
      const onProgress = (done) =>
        change(() =>
          Object.assign(one, { done, stage: done < blob.size ? 'sending' : 'checking' }),
        );
      const view = await upload(force ? '/packages?force=true' : '/packages', blob, type, {
        onProgress,
        signal: end.signal,
      });
      this.#forget(one);
      const { name: stored, version } = view.package;
      notify(`${stored}@${version} uploaded.`, [hrefTo(['packages', stored], { version }), 'View']);
    } catch (error) {
      if (end.signal.aborted) return this.#forget(one);
      change(() =>
        Object.assign(one, {
          problem: errorText(error),
          isVersionTaken: error.code === 'version_taken',
        }),
      );
    }
  }

  #forget(one) {
    change(() => (this.#all = this.#all.filter((other) => other !== one)));
  }

  #cancel(one) {
    one.end.abort();
    this.#forget(one);
  }

  get isEmpty() {
    return !this.#all.length;
  }

  /** Cancels all uploads. */
  stop() {
    for (const { end } of this.#all) end.abort();
  }

  view() {
    if (!this.#all.length) return nothing;
    return html`<ul class="uploads" aria-label="Uploads">${this.#all.map((one) =>
      this.#one(one),
    )}</ul>`;
  }

  #one(one) {
    const { name, stage, done, total, problem, isVersionTaken, retryWithForce } = one;
    return html`
      <li class="upload">
        <p><strong>${name}</strong>
          ${
            problem
              ? nothing
              : html`<span class="quiet">${STAGES[stage]}</span>
            ${
              total
                ? html`<progress max=${total} .value=${done}
                    aria-label=${`Upload of ${name}`}></progress><span
                    class="quiet">${bytes({ done, total })}</span>`
                : nothing
            }`
          }
          <button class="plain link"
            @click=${() => this.#cancel(one)}>${problem ? 'Dismiss' : 'Cancel'}</button></p>
        ${
          isVersionTaken
            ? html`<p><button class="plain link" @click=${retryWithForce}>Replace this version;
                robots with the old content are marked as outdated</button></p>`
            : nothing
        }
        <p class="bad problem" role="alert">${problem ? `▲ ${problem}` : ''}</p>
      </li>`;
  }
}

const STAGES = {
  waiting: 'waiting',
  packing: 'packing',
  sending: 'uploading',
  checking: 'the server is checking the package',
};

async function packFolder(name, entries) {
  const isPackage = entries.some(
    ({ path, file }) => file && (path === 'task.toml' || path === 'package.xml'),
  );
  if (!isPackage) throw new Error(`${name}: contains neither task.toml nor package.xml`);
  return pack(entries);
}

function typeOf(name) {
  const type = MEDIA_TYPES.find(([ending]) => ending.test(name))?.[1];
  if (!type) throw new Error(`${name}: not a .tar.zst, a .tar or a folder`);
  return type;
}

function errorText(error) {
  if (error instanceof SignedOut) return 'You are signed out.';
  if (error.status === 404 || error.status === 405)
    return 'This server accepts packages only from the command line: taskd push DIRECTORY';
  return error.message;
}
