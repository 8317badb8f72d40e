// Packages on their way to the server. They go on while somebody looks at other parts of the page.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { SignedOut, upload } from '../api.js';
import { bytes } from '../format.js';
import { change } from '../frame.js';
import { tell } from '../notice.js';
import { at } from '../router.js';
import { pack } from './pack.js';

const TYPES = [
  [/\.(tar\.zst|tzst|taskd)$/i, 'application/zstd'],
  [/\.tar$/i, 'application/x-tar'],
];

export class Uploads {
  #all = [];
  #last = Promise.resolve();

  /**
   * Sends what was chosen, one after the other. That a package has come, everybody hears from the
   * stream.
   */
  add(chosen) {
    for (const { name, file, entries } of chosen) {
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
    // A version that is taken is taken over only at somebody's word.
    one.insist = () => {
      this.#forget(one);
      this.#add({ name, file, entries, force: true });
    };
    // What can't be read is said in its turn.
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
        ? { blob: await packed(name, await entries), type: 'application/x-tar' }
        : { blob: await file, type: typeOf(name) };
      change(() => Object.assign(one, { stage: 'sending', total: blob.size }));
      const told = (done) =>
        change(() =>
          Object.assign(one, { done, stage: done < blob.size ? 'sending' : 'checking' }),
        );
      const view = await upload(force ? '/packages?force=true' : '/packages', blob, type, {
        told,
        signal: end.signal,
      });
      this.#forget(one);
      const { name: stored, version } = view.package;
      tell(`${stored}@${version} is there.`, [at(['packages', stored], { version }), 'Look at it']);
    } catch (error) {
      if (end.signal.aborted) return this.#forget(one);
      change(() =>
        Object.assign(one, { problem: problemOf(error), isTaken: error.code === 'version_taken' }),
      );
    }
  }

  #forget(one) {
    change(() => (this.#all = this.#all.filter((other) => other !== one)));
  }

  #end(one) {
    one.end.abort();
    this.#forget(one);
  }

  get isEmpty() {
    return !this.#all.length;
  }

  /** Breaks all of them off. */
  stop() {
    for (const { end } of this.#all) end.abort();
  }

  view() {
    if (!this.#all.length) return nothing;
    return html`<ul class="uploads" aria-label="Uploads">${this.#all.map((one) => this.#one(one))}</ul>`;
  }

  #one(one) {
    const { name, stage, done, total, problem, isTaken, insist } = one;
    return html`
      <li class="upload">
        <p><strong>${name}</strong>
          ${
            problem
              ? nothing
              : html`<span class="quiet">${STAGES[stage]}</span>
            ${total ? html`<progress max=${total} .value=${done} aria-label=${`${name} sent`}></progress><span class="quiet">${bytes({ done, total })}</span>` : nothing}`
          }
          <button class="plain link" @click=${() => this.#end(one)}>${problem ? 'Dismiss' : 'Break off'}</button></p>
        ${isTaken ? html`<p><button class="plain link" @click=${insist}>Replace the version: robots that have the other content are marked as outdated</button></p>` : nothing}
        <p class="bad problem" role="alert">${problem ? `▲ ${problem}` : ''}</p>
      </li>`;
  }
}

const STAGES = {
  waiting: 'waits',
  packing: 'is being packed',
  sending: 'is being sent',
  checking: 'is being checked and packed by the server',
};

async function packed(name, entries) {
  const isPackage = entries.some(
    ({ path, file }) => file && (path === 'task.toml' || path === 'package.xml'),
  );
  if (!isPackage) throw new Error(`${name}: there is neither a task.toml nor a package.xml in it`);
  return pack(entries);
}

function typeOf(name) {
  const type = TYPES.find(([ending]) => ending.test(name))?.[1];
  if (!type) throw new Error(`${name}: a package is a .tar.zst, a .tar or a folder`);
  return type;
}

function problemOf(error) {
  if (error instanceof SignedOut) return 'You are signed out.';
  if (error.status === 404 || error.status === 405)
    return 'This server takes packages from the command line alone: taskd push DIRECTORY';
  return error.message;
}
