// One question at a time, in front of everything else. Whoever asks says what the form holds and
// what to do with it.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { SignedOut } from './api.js';
import { change } from './frame.js';
import { complain } from './notice.js';

let current = null;
/** The question that has the focus. */
let settled = null;
/**
 * How often the browser has yet to say that its dialog was closed by us, which it does late: the
 * next question may be open by then.
 */
let ownClosings = 0;
/**
 * Whether the pointer went down beside the dialog: a click that only ends there has begun within,
 * as when text is selected.
 */
let isPressedBeside = false;

/**
 * Opens a dialog. `question` has a `title`, `body()` (a template, drawn again each frame), the
 * `action`'s words, whether it `isDangerous`, the words to leave it by if `Cancel` would be unclear
 * (`dismissal`), and `act(fields)`, which gets what the form holds and may throw: the dialog stays
 * open and says why, unless the error `isSaid` already. Without an `action` there is only something
 * to read. What is shown but once `isSecret`: only buttons close it, one of them with the words of
 * `dismissal`. Answers the question, by which `isOpen` knows it.
 */
export function open(question) {
  const asked = { ...question, problem: null, isBusy: false };
  change(() => (current = asked));
  return asked;
}

/** Whether anything is asked. */
export const isAsking = () => current !== null;

/** Whether it is still this question that is asked. */
export const isOpen = (question) => current === question;

/** At once: the next key is the view's. */
export function close() {
  change(() => (current = null));
  const element = document.getElementById('dialog');
  if (!element?.open) return;
  ownClosings += 1;
  element.close();
}

/** The browser's dialog was closed: by us, or by a gesture that is the browser's. */
function closed() {
  if (ownClosings > 0) ownClosings -= 1;
  // The next drawing opens it again.
  else if (current?.isSecret) change();
  else close();
}

/**
 * Whether a key is the question's. Of Escape the browser would say late that it closed the dialog,
 * and keys in between would be nobody's.
 */
export function takesKey(event) {
  if (!current) return false;
  if (event.key === 'Escape') {
    event.preventDefault();
    if (!current.isSecret) close();
  }
  return true;
}

async function submit(event) {
  event.preventDefault();
  const question = current;
  if (question.isBusy) return;
  const form = new FormData(event.currentTarget);
  const fields = Object.fromEntries(
    [...new Set(form.keys())].map((name) => [
      name,
      form.getAll(name).length > 1 ? form.getAll(name) : form.get(name),
    ]),
  );
  change(() => Object.assign(question, { isBusy: true, problem: null }));
  try {
    await question.act(fields);
    if (current === question) close();
  } catch (error) {
    if (error instanceof SignedOut) close();
    else if (current !== question) complain(error.message);
    else
      change(() =>
        Object.assign(question, { isBusy: false, problem: error.isSaid ? null : error.message }),
      );
  }
}

const isBeside = ({ target, currentTarget }) => target === currentTarget;

/** A click beside the dialog leaves it. */
function click(event) {
  if (isBeside(event) && isPressedBeside && !current?.isSecret) close();
}

export const dialogView = () => html`
  <dialog id="dialog" aria-labelledby="dialog-title" @close=${closed} @pointerdown=${(event) => (isPressedBeside = isBeside(event))} @click=${click}>
    ${current ? content(current) : nothing}
  </dialog>`;

const content = ({
  title,
  body,
  action,
  dismissal = 'Cancel',
  isDangerous,
  isSecret,
  isBusy,
  problem,
}) => html`
  <form @submit=${submit}>
    <header>
      <h2 id="dialog-title">${title}</h2>
      <button type="button" class="plain" aria-label="Close" @click=${close}>✕</button>
    </header>
    ${body()}
    <p class="bad" role="alert">${problem ? `▲ ${problem}` : ''}</p>
    ${action ? html`<footer><button type="button" class="quiet-button" @click=${close}>${dismissal}</button><button class=${isDangerous ? 'danger' : 'primary'} ?disabled=${isBusy}>${action}</button></footer>` : nothing}
    ${isSecret ? html`<footer><button type="button" class="primary" @click=${close}>${dismissal}</button></footer>` : nothing}
  </form>`;

/** Opens the browser's own dialog for a new question; to be called after each drawing. */
export function settleDialog() {
  const element = document.getElementById('dialog');
  if (!element) return;
  if (current && !element.open) element.showModal();
  // Not to the button that closes it, which comes first; where there is nothing to fill in, to what
  // does no harm.
  if (current && current !== settled)
    element
      .querySelector(
        'form :is(input, select, textarea):not([readonly]), form :is(footer, .command) button',
      )
      ?.focus();
  settled = current;
}
