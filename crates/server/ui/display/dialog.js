// The modal dialog. There is one at a time; the caller defines its form and what a submission does.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { SignedOut } from '../api/api.js';
import { change } from './display.js';
import { notifyError } from './notice.js';

let current = null;
/** The dialog that has received the focus. */
let focused = null;
/**
 * The number of `close` events still expected for dialogs that were closed by script. The browser
 * sends them late: the next dialog may be open by then.
 */
let pendingCloseEvents = 0;
/**
 * Whether the pointer was pressed outside the dialog. A click that only ends there has begun
 * inside, as in a text selection.
 */
let isPressedOutside = false;

/**
 * Opens a dialog. `options` has a `title`, a `body()` (a template, drawn every frame), the
 * `submitLabel`, whether it `isDangerous`, the `cancelLabel` if `Cancel` would be unclear, and
 * `onSubmit(fields)`, which gets the form fields and may throw: then the dialog stays open and
 * shows the error, unless the error `isShown` already. Without a `submitLabel` the dialog is only
 * to read. A dialog that `isSecret` shows a value once: only its buttons close it. Returns the
 * dialog, for `isCurrentDialog`.
 */
export function openDialog(options) {
  const dialog = { ...options, problem: null, isBusy: false };
  change(() => (current = dialog));
  return dialog;
}

export const isDialogOpen = () => current !== null;

/** Whether this dialog is still the open one. */
export const isCurrentDialog = (dialog) => current === dialog;

/** Closes the dialog synchronously, so that the next key goes to the view. */
export function closeDialog() {
  change(() => (current = null));
  const element = document.getElementById('dialog');
  if (!element?.open) return;
  pendingCloseEvents += 1;
  element.close();
}

/** The browser's dialog was closed, by script or by a gesture such as back on a phone. */
function onClose() {
  if (pendingCloseEvents > 0) pendingCloseEvents -= 1;
  // The next drawing reopens it.
  else if (current?.isSecret) change();
  else closeDialog();
}

/**
 * Returns whether the dialog handles the key. Escape is handled here: the browser reports the
 * closing late, and keys in between would get lost.
 */
export function handleDialogKey(event) {
  if (!current) return false;
  if (event.key === 'Escape') {
    event.preventDefault();
    if (!current.isSecret) closeDialog();
  }
  return true;
}

async function submit(event) {
  event.preventDefault();
  const dialog = current;
  if (dialog.isBusy) return;
  const form = new FormData(event.currentTarget);
  const fields = Object.fromEntries(
    [...new Set(form.keys())].map((name) => [
      name,
      form.getAll(name).length > 1 ? form.getAll(name) : form.get(name),
    ]),
  );
  change(() => Object.assign(dialog, { isBusy: true, problem: null }));
  try {
    await dialog.onSubmit(fields);
    if (current === dialog) closeDialog();
  } catch (error) {
    if (error instanceof SignedOut) closeDialog();
    else if (current !== dialog) notifyError(error.message);
    else
      change(() =>
        Object.assign(dialog, { isBusy: false, problem: error.isShown ? null : error.message }),
      );
  }
}

const isOutside = ({ target, currentTarget }) => target === currentTarget;

/** A click outside closes the dialog. */
function onClick(event) {
  if (isOutside(event) && isPressedOutside && !current?.isSecret) closeDialog();
}

export const dialogView = () => html`
  <dialog id="dialog" aria-labelledby="dialog-title" @close=${onClose}
    @pointerdown=${(event) => (isPressedOutside = isOutside(event))} @click=${onClick}>
    ${current ? content(current) : nothing}
  </dialog>`;

const content = ({
  title,
  body,
  submitLabel,
  cancelLabel = 'Cancel',
  isDangerous,
  isSecret,
  isBusy,
  problem,
}) => html`
  <form @submit=${submit}>
    <header>
      <h2 id="dialog-title">${title}</h2>
      <button type="button" class="plain" aria-label="Close" @click=${closeDialog}>✕</button>
    </header>
    ${body()}
    <p class="bad" role="alert">${problem ? `▲ ${problem}` : ''}</p>
    ${
      submitLabel
        ? html`<footer><button type="button" class="quiet-button"
            @click=${closeDialog}>${cancelLabel}</button><button
            class=${isDangerous ? 'danger' : 'primary'}
            ?disabled=${isBusy}>${submitLabel}</button></footer>`
        : nothing
    }
    ${
      isSecret
        ? html`<footer><button type="button" class="primary"
            @click=${closeDialog}>${cancelLabel}</button></footer>`
        : nothing
    }
  </form>`;

/** Shows the browser dialog of a new dialog and sets its focus. Call this after each drawing. */
export function syncDialog() {
  const element = document.getElementById('dialog');
  if (!element) return;
  if (current && !element.open) element.showModal();
  // Focuses the first field, not the close button; without fields, a harmless button.
  if (current && current !== focused)
    element
      .querySelector(
        'form :is(input, select, textarea):not([readonly]), form :is(footer, .command) button',
      )
      ?.focus();
  focused = current;
}
