// The configuration of a robot: its name and labels, how its tasks meet ROS, and what they may use.
// The robot's own file wins, so beside each value stands what holds and where that is from.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { parseLabels, relabelled } from '../acts.js';
import { patch, SignedOut } from '../api.js';
import { labelsOf } from '../fleet.js';
import { change } from '../frame.js';
import { tell } from '../notice.js';
import { holding, SETTINGS, settingsWith, valueAt } from './settings.js';

const [ROS, LIMITS] = [
  SETTINGS.filter(({ key }) => !key.startsWith('limits.')),
  SETTINGS.filter(({ key }) => key.startsWith('limits.')),
];

export class Edit {
  #page;
  /**
   * What was typed and not saved, by field. All else shows the robot as it is, also when that
   * changes.
   */
  #draft = {};
  /** The labels that were there when they were typed over. */
  #labels = {};
  /** What is wrong, by field; `all` for what belongs to none. */
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
            ${this.#text({ key: 'labels', title: 'Labels', hint: 'As site=lab, floor=2' }, labelsOf(robot).join(', '))}
            <div class="setting"><label for="field-mac">MAC</label><input id="field-mac" class="code" readonly .value=${robot.mac}></div>
          </div>
        </section>
        <section aria-labelledby="ros">
          <header><h2 id="ros">ROS</h2></header>
          <div class="settings">${ROS.map((setting) => this.#setting(setting, robot))}</div>
        </section>
        <section aria-labelledby="limits">
          <header><h2 id="limits">Limits</h2></header>
          <p class="quiet about">Sizes as 512 MB, 2 GiB or 4096. Empty: the agent’s default, or what the robot’s own file says.</p>
          <div class="settings">${LIMITS.map((setting) => this.#setting(setting, robot))}</div>
        </section>
        <footer>
          <button class="primary" ?disabled=${!isTouched || this.#isBusy}>Save</button>
          <button type="button" class="quiet-button" ?disabled=${!isTouched || this.#isBusy} @click=${() => this.#forget()}>Undo changes</button>
          <p class="bad" role="alert">${this.#problems.all ? `▲ ${this.#problems.all}` : ''}</p>
        </footer>
      </form>`;
  }

  drawn() {
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
      holding(setting, robot),
    );
  }

  /** A field: its words, what it holds, and what is wrong with that. */
  #text({ key, title, hint, isLong, isPath, isBytes, choices }, saved, held) {
    const id = `field-${key.replace('.', '-')}`;
    const problem = this.#problems[key];
    const value = this.#draft[key] ?? saved;
    const type = ({ currentTarget }) => this.#type(key, currentTarget.value, saved);
    const described = [hint && `${id}-hint`, held && `${id}-held`, `${id}-problem`]
      .filter(Boolean)
      .join(' ');
    const invalid = problem ? 'true' : nothing;
    const control = choices
      ? html`<select id=${id} aria-describedby=${described} aria-invalid=${invalid} @change=${type}><option value="" .selected=${!value}>As the robot has it</option>${choices.map((choice) => html`<option value=${choice} .selected=${choice === value}>${choice} and above</option>`)}</select>`
      : isLong
        ? html`<textarea id=${id} class="code" rows="3" spellcheck="false" autocapitalize="none" aria-describedby=${described} aria-invalid=${invalid} .value=${value} @input=${type}></textarea>`
        : html`<input id=${id} class=${isPath ? 'code' : ''} autocomplete="off" autocapitalize="none" spellcheck="false" inputmode=${key.startsWith('limits.') && !isBytes ? 'numeric' : nothing} aria-describedby=${described} aria-invalid=${invalid} .value=${value} @input=${type}>`;
    return html`
      <div class="setting ${isLong ? 'wide' : ''} ${key in this.#draft ? 'touched' : ''}">
        <label for=${id}>${title}</label>
        ${control}
        <p id=${`${id}-problem`} class="bad" role="alert">${problem ? `▲ ${problem}` : ''}</p>
        ${hint ? html`<p id=${`${id}-hint`} class="quiet">${hint}</p>` : nothing}
        ${held ? html`<p id=${`${id}-held`} class=${held.isBad ? 'bad held' : 'quiet held'}>${held.isBad ? html`<span aria-hidden="true">▲ </span>` : nothing}${held.text}</p>` : nothing}
      </div>`;
  }

  #type(key, text, saved) {
    change(() => {
      if (key === 'labels' && !('labels' in this.#draft)) this.#labels = this.#page.robot.labels;
      if (text === saved) delete this.#draft[key];
      else this.#draft[key] = text;
      delete this.#problems[key];
    });
  }

  #forget() {
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
        // What was typed meanwhile stays.
        for (const key of Object.keys(draft))
          if (this.#draft[key] === draft[key]) delete this.#draft[key];
        if (changed) {
          this.#labels = changed.labels;
          this.#page.app.fleet.add([changed]);
        }
      });
      tell(`${changed?.name ?? robot.name} is changed.`);
    } catch (error) {
      if (!(error instanceof SignedOut)) change(() => this.#refuse(error, draft));
    } finally {
      change(() => (this.#isBusy = false));
    }
  }

  /** Says what is wrong where it is: the server names the field first. */
  #refuse({ message, key: ours }, draft) {
    const named = /^(?:settings(?:\.|: ))?([a-z_.]+)(?:\[\d+\])?: ?(.*)$/s.exec(message);
    const keys = ['name', 'labels', ...SETTINGS.map(({ key }) => key)];
    const key =
      ours ??
      (keys.includes(named?.[1])
        ? named[1]
        : message.includes('name') && 'name' in draft
          ? 'name'
          : null);
    const said = key === named?.[1] && !ours ? named[2] : message;
    // Where in the request it stood says nothing to whoever filled in a form.
    this.#problems = { [key ?? 'all']: said.replace(/ at line \d+ column \d+$/, '') };
    this.#isFocusDue = true;
  }
}

/** What has changed, and nothing else. */
function bodyOf({ labels, settings }, draft, before) {
  const body = {};
  if ('name' in draft) body.name = draft.name.trim();
  if ('labels' in draft) {
    try {
      body.labels = relabelled(labels, before, parseLabels(draft.labels));
    } catch ({ message }) {
      throw Object.assign(new Error(message), { key: 'labels' });
    }
  }
  if (SETTINGS.some(({ key }) => key in draft)) body.settings = settingsWith(settings, draft);
  return body;
}
