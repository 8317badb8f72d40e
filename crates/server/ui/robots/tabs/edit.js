// The Edit tab: name, labels, ROS settings and limits. The robot's own file takes precedence, so
// each field shows the effective value and its origin.

import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { patch, SignedOut } from '../../api/api.js';
import { change } from '../../display/display.js';
import { notify } from '../../display/notice.js';
import { labelsOf } from '../../fleet.js';
import { parseLabels, mergeLabels } from '../../orders/orders.js';
import { effectiveValue, SETTINGS, settingsWith, valueAt } from './settings.js';

const [ROS, LIMITS] = [
  SETTINGS.filter(({ key }) => !key.startsWith('limits.')),
  SETTINGS.filter(({ key }) => key.startsWith('limits.')),
];

export class Edit {
  #page;
  /** Unsaved input by field. Other fields show the current values, even when those change. */
  #draft = {};
  /** The labels when the edit began. */
  #labels = {};
  /** Errors by field; `all` for those of no field. */
  #problems = {};
  #isBusy = false;
  #isFocusDue = false;

  constructor(page) {
    this.#page = page;
  }

  get isUnsaved() {
    return Object.keys(this.#draft).length > 0;
  }

  draw(robot) {
    const isTouched = this.isUnsaved;
    return html`
      <form class="edit" novalidate @submit=${(event) => this.#save(event)}>
        <section aria-labelledby="identity">
          <header><h2 id="identity">Robot</h2></header>
          <div class="settings">
            ${this.#text({ key: 'name', title: 'Name' }, robot.name)}
            ${this.#text(
              { key: 'labels', title: 'Labels', hint: 'For example site=lab, floor=2' },
              labelsOf(robot).join(', '),
            )}
            <div class="setting"><label for="field-mac">MAC</label><input id="field-mac"
              class="code" readonly .value=${robot.mac}></div>
          </div>
        </section>
        <section aria-labelledby="ros">
          <header><h2 id="ros">ROS</h2></header>
          <div class="settings">${ROS.map((setting) => this.#setting(setting, robot))}</div>
        </section>
        <section aria-labelledby="limits">
          <header><h2 id="limits">Limits</h2></header>
          <p class="quiet intro">Enter sizes as 512 MB, 2 GB or 4096. Empty fields use the robot’s
            own file or the agent’s default.</p>
          <div class="settings">${LIMITS.map((setting) => this.#setting(setting, robot))}</div>
        </section>
        <footer>
          <button class="primary" ?disabled=${!isTouched || this.#isBusy}>Save</button>
          <button type="button" class="quiet-button" ?disabled=${!isTouched || this.#isBusy}
            @click=${() => this.#discard()}>Discard changes</button>
          <p class="bad" role="alert">${this.#problems.all ? `▲ ${this.#problems.all}` : ''}</p>
        </footer>
      </form>`;
  }

  afterDraw() {
    if (!this.#isFocusDue) return;
    this.#isFocusDue = false;
    const field = document.querySelector('.edit [aria-invalid]');
    field?.scrollIntoView({ block: 'center' });
    field?.focus({ preventScroll: true });
  }

  #setting(setting, robot) {
    const set = valueAt(robot.settings, setting.key);
    return this.#text(
      setting,
      set === undefined ? '' : setting.write(set),
      effectiveValue(setting, robot),
    );
  }

  /** A field with its label, control, error, hint and effective value. */
  #text({ key, title, hint, isLong, isPath, isBytes, choices }, saved, effective) {
    const id = `field-${key.replace('.', '-')}`;
    const problem = this.#problems[key];
    const value = this.#draft[key] ?? saved;
    const type = ({ currentTarget }) => this.#setDraft(key, currentTarget.value, saved);
    const described = [hint && `${id}-hint`, effective && `${id}-effective`, `${id}-problem`]
      .filter(Boolean)
      .join(' ');
    const invalid = problem ? 'true' : nothing;
    const control = choices
      ? html`<select id=${id} aria-describedby=${described} aria-invalid=${invalid}
          @change=${type}>
          <option value="" .selected=${!value}>Robot’s default</option>
          ${choices.map(
            (choice) =>
              html`<option value=${choice} .selected=${choice === value}
                >${choice} and above</option>`,
          )}</select>`
      : isLong
        ? html`<textarea id=${id} class="code" rows="3" spellcheck="false" autocapitalize="none"
            aria-describedby=${described} aria-invalid=${invalid}
            .value=${value} @input=${type}></textarea>`
        : html`<input id=${id} class=${isPath ? 'code' : ''}
            autocomplete="off" autocapitalize="none" spellcheck="false"
            inputmode=${key.startsWith('limits.') && !isBytes ? 'numeric' : nothing}
            aria-describedby=${described} aria-invalid=${invalid}
            .value=${value} @input=${type}>`;
    return html`
      <div class="setting ${isLong ? 'wide' : ''} ${key in this.#draft ? 'changed' : ''}">
        <label for=${id}>${title}</label>
        ${control}
        <p id=${`${id}-problem`} class="bad" role="alert">${problem ? `▲ ${problem}` : ''}</p>
        ${hint ? html`<p id=${`${id}-hint`} class="quiet">${hint}</p>` : nothing}
        ${effective ? effectiveText(`${id}-effective`, effective) : nothing}
      </div>`;
  }

  #setDraft(key, text, saved) {
    change(() => {
      if (key === 'labels' && !('labels' in this.#draft)) this.#labels = this.#page.robot.labels;
      if (text === saved) delete this.#draft[key];
      else this.#draft[key] = text;
      delete this.#problems[key];
    });
  }

  #discard() {
    change(() => {
      this.#draft = {};
      this.#problems = {};
    });
  }

  async #save(event) {
    event.preventDefault();
    if (this.#isBusy) return;
    const { robot } = this.#page;
    const draft = { ...this.#draft };
    change(() => {
      this.#problems = {};
      this.#isBusy = true;
    });
    try {
      const changed = await patch(`/robots/${robot.id}`, bodyOf(robot, draft, this.#labels));
      change(() => {
        // Keeps what was typed during the request.
        for (const key of Object.keys(draft))
          if (this.#draft[key] === draft[key]) delete this.#draft[key];
        if (changed) {
          this.#labels = changed.labels;
          this.#page.app.fleet.add([changed]);
        }
      });
      notify(`${changed?.name ?? robot.name} updated.`);
    } catch (error) {
      if (!(error instanceof SignedOut)) change(() => this.#showError(error, draft));
    } finally {
      change(() => (this.#isBusy = false));
    }
  }

  /** Shows an error at its field: server messages begin with the field. */
  #showError({ message, key: ownKey }, draft) {
    const named = /^(?:settings(?:\.|: ))?([a-z_.]+)(?:\[\d+\])?: ?(.*)$/s.exec(message);
    const keys = ['name', 'labels', ...SETTINGS.map(({ key }) => key)];
    const key =
      ownKey ??
      (keys.includes(named?.[1])
        ? named[1]
        : message.includes('name') && 'name' in draft
          ? 'name'
          : null);
    const text = key === named?.[1] && !ownKey ? named[2] : message;
    // A position in the request body means nothing to the user.
    this.#problems = { [key ?? 'all']: text.replace(/ at line \d+ column \d+$/, '') };
    this.#isFocusDue = true;
  }
}

/** The effective value on the robot. */
const effectiveText = (id, { text, isBad }) =>
  html`<p id=${id} class=${isBad ? 'bad effective' : 'quiet effective'}>${
    isBad ? html`<span aria-hidden="true">▲ </span>` : nothing
  }${text}</p>`;

/** The request body with the changes only. */
function bodyOf({ labels, settings }, draft, before) {
  const body = {};
  if ('name' in draft) body.name = draft.name.trim();
  if ('labels' in draft) {
    try {
      body.labels = mergeLabels(labels, before, parseLabels(draft.labels));
    } catch ({ message }) {
      throw Object.assign(new Error(message), { key: 'labels' });
    }
  }
  if (SETTINGS.some(({ key }) => key in draft)) body.settings = settingsWith(settings, draft);
  return body;
}
