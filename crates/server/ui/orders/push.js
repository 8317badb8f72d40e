// The push dialog: package, robots, delivery and rollout options of a deployment.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { get, newIdempotencyKey, postIdempotent, SignedOut } from '../api/api.js';
import { closeDialog, isCurrentDialog, openDialog } from '../display/dialog.js';
import { change } from '../display/display.js';
import { number, plural, shortDigest, size, words } from '../display/format.js';
import { notify } from '../display/notice.js';
import { navigate } from '../display/router.js';
import { selectorOf, awaitsApproval, labelsOf } from '../fleet.js';
import { skippedNote, robotNames, approvedIds, robotsText } from './orders.js';

const COUNT_PAUSE_MS = 250;
// Deployments to more robots need a confirmation, as in the command.
const CONFIRM_ABOVE = 10;
// Number of matching robots that are named.
const NAMED_ROBOTS = 5;
const SHOWN_LABELS = 6;
// With more packages, the form has a text field in place of a list.
const LISTED_PACKAGES = 12;

/**
 * Expands the options if one of them is invalid: the browser cannot show errors of hidden fields.
 */
const EXPAND = { handleEvent: ({ currentTarget }) => (currentTarget.open = true), capture: true };

/** The delivery mechanisms. */
const DELIVERIES = [
  ['adaptive', 'Adaptive', 'The server’s rules choose a mechanism for each robot.'],
  ['push-pull', 'Push-pull', 'Announced over MQTT, then downloaded over HTTP by each robot.'],
  ['direct-push', 'Direct push', 'Sent in MQTT messages, published once for all robots.'],
  ['inline', 'Inline', 'Sent inside the announcement; for small packages.'],
  ['poll', 'Poll', 'Not announced; robots poll on their own schedule.'],
];

/**
 * Opens the push dialog. `ids` are the robots, or `null` for a selector field. `given` may
 * preselect a `package` and a `manifest`.
 */
export async function openPushDialog(app, ids = null, given = {}) {
  const selected = ids && approvedIds(ids, app.fleet);
  const skipped = ids ? ids.size - selected.size : 0;
  const title = selected ? `Push to ${robotsText(selected, app.fleet)}` : 'New deployment';
  const loading = openDialog({
    title,
    body: () => html`<p class="quiet" role="status">Loading…</p>`,
  });
  const list = await app.attempt(() => get('/packages'));
  // The user may have closed the dialog or opened another.
  if (!isCurrentDialog(loading)) return;
  if (!list) return void closeDialog();
  const form = new DeploymentForm(app, selected, list.packages, given);
  const isPossible = list.packages.length && selected?.size !== 0;
  openDialog({
    title,
    submitLabel: isPossible ? 'Deploy' : null,
    body: () => html`${form.body()}${skippedNote(skipped)}`,
    onSubmit: () => form.submit(),
  });
}

class DeploymentForm {
  #key = newIdempotencyKey();
  /**
   * The request that the key was created for: a repetition uses the same key, another request a new
   * one.
   */
  #keyBody = null;
  #timer;
  #lastRequest = 0;
  /** The robots that match the selector: `{ total, some }`, or a `problem`. */
  #match = {};
  /** Validation errors by field. */
  #problems = {};
  /** The number of robots that the user has confirmed. */
  #confirmed = 0;

  constructor(app, ids, packages, given) {
    Object.assign(this, { app, ids, packages });
    this.names = [...new Set(packages.map(({ package: { name } }) => name))];
    // Package and robots are never preset: an accidental submission must not deploy anything.
    this.fields = {
      delivery: 'adaptive',
      batch: '',
      max_failures: '',
      priority: '',
      hours: '',
      ...storedOptions(app),
      restart: false,
      selector: '',
      name: given.package ?? '',
      manifest: given.manifest,
    };
    this.isExpanded = ['batch', 'max_failures', 'priority', 'hours'].some(
      (field) => this.fields[field],
    );
  }

  get #versions() {
    return this.packages.filter(({ package: { name } }) => name === this.fields.name);
  }

  get #version() {
    return (
      this.#versions.find(
        ({ package: { manifest } }) => manifest.digest === this.fields.manifest,
      ) ?? this.#versions[0]
    );
  }

  /** The number of robots, if known. */
  get #robots() {
    return this.ids ? this.ids.size : this.#match.total;
  }

  #set(field, value) {
    change(() => {
      this.fields[field] = value;
      delete this.#problems[field];
    });
  }

  // The form

  body() {
    if (!this.packages.length)
      return html`<p>No packages yet. Upload one on <a href="#/packages">Packages</a> or run
        <code>taskd push ./my_pkg</code>.</p>`;
    const { delivery } = this.fields;
    return html`
      ${this.ids ? robotNames(this.ids, this.app.fleet) : this.#selector()}
      <div class="fields">
        ${this.#field('name', 'Package', this.#packageInput())}
        ${this.#field('manifest', 'Version', this.#versionInput())}
        ${this.#field(
          'delivery',
          'Delivery',
          html`<select id="order-delivery" aria-describedby="delivery-words order-delivery-problem"
            @change=${({ currentTarget }) => this.#set('delivery', currentTarget.value)}>
            ${DELIVERIES.map(
              ([id, title]) =>
                html`<option value=${id} .selected=${id === delivery}>${title}</option>`,
            )}</select>
          <span id="delivery-words" class="hint quiet">${
            DELIVERIES.find(([id]) => id === delivery)?.[2]
          }</span>`,
          'wide',
        )}
      </div>
      <details class="more" ?open=${this.isExpanded} @invalid=${EXPAND}>
        <summary>Batches, priority, expiry, restart</summary>
        <div class="fields">
          ${this.#number('batch', 'Batch size', { min: 1, placeholder: 'all' })}
          ${this.#number('max_failures', 'Failures allowed before pausing', {
            min: 0,
            placeholder: 'unlimited',
          })}
          ${this.#number('priority', 'Priority', { min: -100, max: 100, placeholder: '0' })}
          ${this.#number('hours', 'Expires after (hours)', {
            min: 1,
            placeholder: 'server default',
          })}
        </div>
        <label class="choice"><input type="checkbox" .checked=${this.fields.restart}
          @change=${({ currentTarget }) => this.#set('restart', currentTarget.checked)}> Restart
          where it is already running</label>
      </details>
      <p class="order-summary" aria-live="polite">${this.#summary()}</p>
      ${this.#confirmation()}`;
  }

  /** The confirmation for many robots. */
  #confirmation() {
    const robots = this.#robots ?? 0;
    if (robots <= CONFIRM_ABOVE) return nothing;
    const target =
      !this.ids && this.fields.selector.trim() === '*'
        ? `all ${number(robots)} robots`
        : `${number(robots)} robots`;
    return this.#field(
      'confirmation',
      '',
      html`<label class="choice"><input id="order-confirmation" type="checkbox" required
        aria-describedby="order-confirmation-problem" .checked=${this.#confirmed === robots}
        @change=${({ currentTarget }) => this.#confirm(currentTarget.checked ? robots : 0)}> Yes,
        deploy to ${target}</label>`,
      'wide',
    );
  }

  #confirm(robots) {
    change(() => {
      this.#confirmed = robots;
      delete this.#problems.confirmation;
    });
  }

  /** A field with its label and its error. */
  #field(field, title, input, kind = '') {
    const problem = this.#problems[field];
    return html`<div class="field ${kind}">${
      title ? html`<label for=${`order-${field}`}>${title}</label>` : nothing
    }${input}<p id=${`order-${field}-problem`} class="bad" role="alert"
      ?hidden=${!problem}>${problem ? `▲ ${problem}` : ''}</p></div>`;
  }

  #number(field, title, { min, max, placeholder }) {
    return this.#field(
      field,
      title,
      html`<input id=${`order-${field}`} type="number" inputmode="numeric" min=${min}
        max=${max ?? nothing} step="1" placeholder=${placeholder} .value=${this.fields[field]}
        aria-invalid=${field in this.#problems} aria-describedby=${`order-${field}-problem`}
        @input=${({ currentTarget }) => this.#set(field, currentTarget.value)}>`,
    );
  }

  #packageInput() {
    const { name } = this.fields;
    const select = ({ currentTarget }) => {
      this.#set('name', currentTarget.value.trim());
      this.#set('manifest', undefined);
    };
    if (this.names.length <= LISTED_PACKAGES)
      return html`<select id="order-name" required aria-invalid=${'name' in this.#problems}
          aria-describedby="order-name-problem" @change=${select}>
        <option value="" .selected=${!name}>Select a package</option>
        ${this.names.map(
          (one) => html`<option value=${one} .selected=${one === name}>${one}</option>`,
        )}</select>`;
    return html`<input id="order-name" list="order-names" required
        autocomplete="off" autocapitalize="none" spellcheck="false"
        placeholder=${`one of ${number(this.names.length)}`} .value=${name}
        aria-invalid=${'name' in this.#problems} aria-describedby="order-name-problem"
        @input=${select}>
      <datalist id="order-names">${this.names.map(
        (one) => html`<option value=${one}></option>`,
      )}</datalist>`;
  }

  #versionInput() {
    const select = ({ currentTarget }) => this.#set('manifest', currentTarget.value);
    const option = (one) => {
      const { version, manifest, content } = one.package;
      return html`<option value=${manifest.digest} .selected=${one === this.#version}>${version}
        (${size(content.size)}, ${shortDigest(manifest.digest)})</option>`;
    };
    return html`<select id="order-manifest" aria-describedby="order-manifest-problem"
      @change=${select}>${this.#versions.map(option)}</select>`;
  }

  #selector() {
    const { total, some, problem } = this.#match;
    const isBad = Boolean(problem) || total === 0;
    const setSelector = (selector) => {
      this.#set('selector', selector);
      this.#confirmed = 0;
      this.#count();
    };
    return this.#field(
      'selector',
      'Robots',
      html`
      <input id="order-selector" class="code" required placeholder="site=lab"
        .value=${this.fields.selector} autocomplete="off" autocapitalize="none" spellcheck="false"
        aria-invalid=${isBad} aria-describedby="match order-selector-problem"
        @input=${({ currentTarget }) => setSelector(currentTarget.value)}>
      <p id="match" class=${isBad ? 'bad' : 'quiet'} role="status">${
        problem ?? (total === undefined ? ' ' : matchText(total, some))
      }</p>
      <p class="suggestions" role="group" aria-label="Suggested selectors">${[
        '*',
        ...this.#labels,
      ].map(
        (selector) =>
          html`<button type="button" class="plain link"
            aria-pressed=${this.fields.selector === selector}
            @click=${() => setSelector(selector)}>${selector === '*' ? 'all' : selector}</button>`,
      )}</p>
      <p class="hint quiet">Separate terms by commas: <code>arm,cart</code>. Exclude robots with
        <code>!</code>: <code>site=lab,!arm</code>.</p>`,
    );
  }

  /** The most frequent labels. */
  get #labels() {
    if (!this.labels) {
      const counts = new Map();
      for (const robot of this.app.fleet.robots.values())
        for (const label of labelsOf(robot)) counts.set(label, (counts.get(label) ?? 0) + 1);
      this.labels = [...counts]
        .sort(([, one], [, other]) => other - one)
        .slice(0, SHOWN_LABELS)
        .map(([label]) => label);
    }
    return this.labels;
  }

  /** A summary of the deployment. */
  #summary() {
    const version = this.#version?.package;
    if (!this.fields.name)
      return html`<span class="quiet">Select a package${this.ids ? '' : ' and robots'}.</span>`;
    if (!version)
      return html`<span class="quiet">Package ${this.fields.name} does not exist.</span>`;
    const robots = this.#robots;
    const whole = robots
      ? ` to ${plural(robots, 'robot')}, ${size(robots * version.content.size)} in total`
      : '';
    const { batch, max_failures: maxFailures, priority, hours, restart } = this.fields;
    const options = optionsList({
      batch: Number(batch),
      max_failures: maxFailures === '' ? null : Number(maxFailures),
      priority: Number(priority),
    });
    return [
      `${version.name}@${version.version}${whole}`,
      ...options,
      hours && `expires after ${plural(Number(hours), 'hour')}`,
      restart && 'restarts where it is already running',
    ]
      .filter(Boolean)
      .join('; ');
  }

  // The selector

  /** Counts the matching robots once typing has paused. */
  #count() {
    clearTimeout(this.#timer);
    const request = (this.#lastRequest += 1);
    const selector = this.fields.selector.trim();
    this.#timer = setTimeout(async () => {
      const match = selector ? await matchOf(selector, this.app.fleet) : {};
      if (match && request === this.#lastRequest) change(() => (this.#match = match));
    }, COUNT_PAUSE_MS);
  }

  // Submission

  async submit() {
    const { name, delivery, selector } = this.fields;
    const version = this.#version;
    if (!name) this.#reject('name', 'Select a package.');
    if (!version) this.#reject('name', `Package ${name} does not exist.`);
    await this.#check(selector.trim());
    const body = {
      package: name,
      manifest: version.package.manifest.digest,
      delivery,
      selector: this.ids ? selectorOf(this.ids) : selector.trim(),
    };
    const { batch, max_failures, priority, hours } = this.fields;
    for (const [field, value] of Object.entries({
      batch,
      max_failures,
      priority,
      expires_in_s: hours && Number(hours) * 3600,
    }))
      if (value !== '') body[field] = Number(value);
    if (this.fields.restart) body.restart = true;
    const text = JSON.stringify(body);
    if (this.#keyBody && this.#keyBody !== text) this.#key = newIdempotencyKey();
    this.#keyBody = text;
    try {
      const { id, assignments = [] } = await postIdempotent('/deployments', body, this.#key);
      storeOptions(this.app, this.fields);
      const running = assignments.filter(({ phase }) => phase === 'running').length;
      if (running)
        notify(
          `${name}@${version.package.version} is already running on ${plural(running, 'robot')}.`,
        );
      navigate(['deployments', id]);
    } catch (error) {
      const field = fieldOf(error);
      if (field && (field !== 'selector' || !this.ids)) this.#reject(field, error.message);
      throw error;
    }
  }

  /** Checks before submission that the selector matches and that many robots are confirmed. */
  async #check(selector) {
    if (!this.ids) {
      if (!selector) this.#reject('selector', 'Enter a robot selector.');
      const match = await matchOf(selector, this.app.fleet);
      if (!match) throw new SignedOut();
      change(() => (this.#match = match));
      if (match.problem) this.#reject('selector', match.problem);
    }
    if (this.#robots > CONFIRM_ABOVE && this.#confirmed !== this.#robots)
      this.#reject(
        'confirmation',
        `Confirm that you want to deploy to ${number(this.#robots)} robots.`,
      );
  }

  /** Shows an error at its field and focuses the field. */
  #reject(field, message) {
    change(() => {
      this.#problems = { [field]: message.replace(/^[a-z_]+: /, '') };
      this.isExpanded ||= ['batch', 'max_failures', 'priority', 'hours'].includes(field);
    });
    requestAnimationFrame(() => document.getElementById(`order-${field}`)?.focus());
    throw Object.assign(new Error(message), { isShown: true });
  }
}

/** `12 robots match: arm, cart and 10 more`. */
function matchText(total, some) {
  if (!total) return 'No robots match.';
  const rest = total - some.length;
  const names = `${some.join(', ')}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
  return `${plural(total, 'robot')} ${total === 1 ? 'matches' : 'match'}: ${names}`;
}

/** The robots that match the selector, without those that await approval. */
async function matchOf(selector, fleet) {
  const waiting = [...fleet.robots.values()].filter(awaitsApproval).map(({ id }) => `!${id}`);
  try {
    const {
      robots,
      total = robots.length,
      unknown = [],
    } = await get('/robots', { selector: [selector, ...waiting].join(), limit: NAMED_ROBOTS });
    if (unknown.length) return { problem: `No robot has the name or ID ${unknown.join(', ')}.` };
    return { total, some: robots.slice(0, NAMED_ROBOTS).map(({ name }) => name) };
  } catch (error) {
    return error instanceof SignedOut ? null : { problem: error.message };
  }
}

const FIELD_OF_CODE = {
  no_robots_match: 'selector',
  unknown_robots: 'selector',
  out_of_scope: 'selector',
  package_not_found: 'manifest',
  package_too_large: 'delivery',
};
const FIELD_OF_KEY = {
  selector: 'selector',
  package: 'name',
  manifest: 'manifest',
  delivery: 'delivery',
  batch: 'batch',
  max_failures: 'max_failures',
  priority: 'priority',
  expires_in_s: 'hours',
};

/** The field that a refusal concerns. */
const fieldOf = ({ code, message }) =>
  FIELD_OF_CODE[code] ?? FIELD_OF_KEY[/^([a-z_]+)(: |\b)/.exec(message)?.[1]];

// Delivery and rollout options are stored per user until the tab closes; package and robots are
// not.

const storageKey = ({ me }) => `taskd.order.${me?.name}`;

function storedOptions(app) {
  try {
    return JSON.parse(sessionStorage.getItem(storageKey(app))) ?? {};
  } catch {
    return {};
  }
}

function storeOptions(app, { delivery, batch, max_failures, priority, hours }) {
  sessionStorage.setItem(
    storageKey(app),
    JSON.stringify({ delivery, batch, max_failures, priority, hours }),
  );
}

function optionsList({ batch, max_failures: maxFailures, priority }) {
  return [
    batch && `in batches of ${number(batch)}`,
    maxFailures != null &&
      (maxFailures
        ? `pauses after more than ${plural(maxFailures, 'failure')}`
        : 'pauses on the first failure'),
    priority ? `priority ${priority}` : null,
  ].filter(Boolean);
}

/** The options of a deployment in words. */
export const optionsText = ({ delivery, ...options }) =>
  [`${words(delivery)} delivery`, ...optionsList(options)].join(' · ');
