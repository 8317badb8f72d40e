// The order of a package to robots: which package, which robots, how the bytes travel, how
// carefully.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { leftOut, names, receivers, whom } from './acts.js';
import { get, newKey, order, SignedOut } from './api.js';
import { close, isOpen, open } from './dialog.js';
import { idsOf, isWaiting, labelsOf } from './fleet.js';
import { number, plural, short, size, words } from './format.js';
import { change } from './frame.js';
import { tell } from './notice.js';
import { go } from './router.js';

const COUNT_PAUSE_MS = 250;
// An order for more robots than this wants a word of its own, as the command does.
const ASK_ABOVE = 10;
// Robots named after the count of those that a selector means.
const NAMED = 5;
const SHOWN_LABELS = 6;
// With more packages than this, one types a name instead of looking through a list.
const LISTED_PACKAGES = 12;

/** What is wrong where nobody sees it would stop the form without a word. */
const UNFOLD = { handleEvent: ({ currentTarget }) => (currentTarget.open = true), capture: true };

/** Each way for the bytes, in words. */
const DELIVERIES = [
  ['adaptive', 'Adaptive', 'The server’s rules decide, robot by robot.'],
  ['push-pull', 'Push-pull', 'Announced over MQTT, then pulled over HTTP by each robot.'],
  ['direct-push', 'Direct push', 'Inside MQTT messages, published once for all robots.'],
  ['inline', 'Inline', 'Inside the announcement itself; for small packages.'],
  ['poll', 'Poll', 'Nothing is announced: robots ask on their own timers.'],
];

/**
 * Asks what to push. `ids` are the robots, or `null`: then a selector is asked for. `given` may
 * name a `package` and a `manifest` that are chosen already.
 */
export async function askPush(app, ids = null, given = {}) {
  const chosen = ids && receivers(ids, app.fleet);
  const left = ids ? ids.size - chosen.size : 0;
  const title = chosen ? `Push to ${whom(chosen, app.fleet)}` : 'New deployment';
  const waiting = open({ title, body: () => html`<p class="quiet" role="status">Fetching…</p>` });
  const list = await app.attempt(() => get('/packages'));
  // Whoever has left it meanwhile, or asks something else, is not disturbed.
  if (!isOpen(waiting)) return;
  if (!list) return void close();
  const question = new Order(app, chosen, list.packages, given);
  const isPossible = list.packages.length && chosen?.size !== 0;
  open({
    title,
    action: isPossible ? 'Deploy' : null,
    body: () => html`${question.body()}${leftOut(left)}`,
    act: () => question.act(),
  });
}

class Order {
  #key = newKey();
  /** What the key was made for: the same order may be sent again with it, another one may not. */
  #keyed = null;
  #timer;
  #asked = 0;
  /** What the selector means now: `{ total, some }`, or a `problem`. */
  #match = {};
  /** What the server refused, at its field. */
  #problems = {};
  /** For how many robots it was said that so many are meant. */
  #confirmed = 0;

  constructor(app, ids, packages, given) {
    Object.assign(this, { app, ids, packages });
    this.names = [...new Set(packages.map(({ package: { name } }) => name))];
    // What is ordered and of whom is chosen each time: a form that is sent by mistake must order
    // nothing.
    this.fields = {
      delivery: 'adaptive',
      batch: '',
      max_failures: '',
      priority: '',
      hours: '',
      ...remembered(app),
      restart: false,
      selector: '',
      name: given.package ?? '',
      manifest: given.manifest,
    };
    this.hasMore = ['batch', 'max_failures', 'priority', 'hours'].some(
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

  /** How many robots it is for, where that is known. */
  get #robots() {
    return this.ids ? this.ids.size : this.#match.total;
  }

  #set(field, value) {
    change(() => {
      this.fields[field] = value;
      delete this.#problems[field];
    });
  }

  // The form.

  body() {
    if (!this.packages.length)
      return html`<p>No package has been pushed yet. Drop one on <a href="#/packages">Packages</a>, or <code>taskd push ./my_pkg</code>.</p>`;
    const { delivery } = this.fields;
    return html`
      ${this.ids ? names(this.ids, this.app.fleet) : this.#selector()}
      <div class="fields">
        ${this.#field('name', 'Package', this.#packageInput())}
        ${this.#field('manifest', 'Version', html`<select id="order-manifest" aria-describedby="order-manifest-problem" @change=${({ currentTarget }) => this.#set('manifest', currentTarget.value)}>${this.#versions.map((one) => html`<option value=${one.package.manifest.digest} .selected=${one === this.#version}>${one.package.version} (${size(one.package.content.size)}, ${short(one.package.manifest.digest)})</option>`)}</select>`)}
        ${this.#field(
          'delivery',
          'Delivery',
          html`<select id="order-delivery" aria-describedby="delivery-words order-delivery-problem" @change=${({ currentTarget }) => this.#set('delivery', currentTarget.value)}>${DELIVERIES.map(([id, title]) => html`<option value=${id} .selected=${id === delivery}>${title}</option>`)}</select>
          <span id="delivery-words" class="hint quiet">${DELIVERIES.find(([id]) => id === delivery)?.[2]}</span>`,
          'wide',
        )}
      </div>
      <details class="more" ?open=${this.hasMore} @invalid=${UNFOLD}>
        <summary>Batches, priority, expiry, restart</summary>
        <div class="fields">
          ${this.#number('batch', 'Robots at a time', { min: 1, placeholder: 'all' })}
          ${this.#number('max_failures', 'Failures to bear before pausing', { min: 0, placeholder: 'any number' })}
          ${this.#number('priority', 'Priority', { min: -100, max: 100, placeholder: '0' })}
          ${this.#number('hours', 'Expires after hours', { min: 1, placeholder: 'as the server is set' })}
        </div>
        <label class="choice"><input type="checkbox" .checked=${this.fields.restart} @change=${({ currentTarget }) => this.#set('restart', currentTarget.checked)}> Run it anew where it runs already</label>
      </details>
      <p class="in-words" aria-live="polite">${this.#inWords()}</p>
      ${this.#confirmation()}`;
  }

  /** Of many robots it is asked whether they are meant. */
  #confirmation() {
    const robots = this.#robots ?? 0;
    if (robots <= ASK_ABOVE) return nothing;
    const whom =
      !this.ids && this.fields.selector.trim() === '*'
        ? `all ${number(robots)} robots`
        : `${number(robots)} robots`;
    return this.#field(
      'many',
      '',
      html`<label class="choice"><input id="order-many" type="checkbox" required aria-describedby="order-many-problem" .checked=${this.#confirmed === robots} @change=${({ currentTarget }) => this.#confirm(currentTarget.checked ? robots : 0)}> Yes, order it on ${whom}</label>`,
      'wide',
    );
  }

  #confirm(robots) {
    change(() => {
      this.#confirmed = robots;
      delete this.#problems.many;
    });
  }

  /** A field with its label and, below it, what is wrong with it. */
  #field(field, title, input, kind = '') {
    const problem = this.#problems[field];
    return html`<div class="field ${kind}">${title ? html`<label for=${`order-${field}`}>${title}</label>` : nothing}${input}<p id=${`order-${field}-problem`} class="bad" role="alert" ?hidden=${!problem}>${problem ? `▲ ${problem}` : ''}</p></div>`;
  }

  #number(field, title, { min, max, placeholder }) {
    return this.#field(
      field,
      title,
      html`<input id=${`order-${field}`} type="number" inputmode="numeric" min=${min} max=${max ?? nothing} step="1" placeholder=${placeholder} .value=${this.fields[field]}
      aria-invalid=${field in this.#problems} aria-describedby=${`order-${field}-problem`} @input=${({ currentTarget }) => this.#set(field, currentTarget.value)}>`,
    );
  }

  #packageInput() {
    const { name } = this.fields;
    const choose = ({ currentTarget }) => {
      this.#set('name', currentTarget.value.trim());
      this.#set('manifest', undefined);
    };
    if (this.names.length <= LISTED_PACKAGES)
      return html`<select id="order-name" required aria-invalid=${'name' in this.#problems} aria-describedby="order-name-problem" @change=${choose}><option value="" .selected=${!name}>Choose a package</option>${this.names.map((one) => html`<option value=${one} .selected=${one === name}>${one}</option>`)}</select>`;
    return html`<input id="order-name" list="order-names" required autocomplete="off" autocapitalize="none" spellcheck="false" placeholder=${`one of ${number(this.names.length)}`} .value=${name}
        aria-invalid=${'name' in this.#problems} aria-describedby="order-name-problem" @input=${choose}>
      <datalist id="order-names">${this.names.map((one) => html`<option value=${one}></option>`)}</datalist>`;
  }

  #selector() {
    const { total, some, problem } = this.#match;
    const isBad = Boolean(problem) || total === 0;
    const take = (selector) => {
      this.#set('selector', selector);
      this.#confirmed = 0;
      this.#count();
    };
    return this.#field(
      'selector',
      'Robots',
      html`
      <input id="order-selector" class="code" required placeholder="site=lab" .value=${this.fields.selector} autocomplete="off" autocapitalize="none" spellcheck="false" aria-invalid=${isBad} aria-describedby="match order-selector-problem" @input=${({ currentTarget }) => take(currentTarget.value)}>
      <p id="match" class=${isBad ? 'bad' : 'quiet'} role="status">${problem ?? (total === undefined ? ' ' : matched(total, some))}</p>
      <p class="suggestions" role="group" aria-label="Robots to choose">${['*', ...this.#labels].map((selector) => html`<button type="button" class="plain link" aria-pressed=${this.fields.selector === selector} @click=${() => take(selector)}>${selector === '*' ? 'all' : selector}</button>`)}</p>
      <p class="hint quiet">Several with a comma, <code>arm,cart</code>; without one, <code>site=lab,!arm</code>.</p>`,
    );
  }

  /** The labels that most robots have. */
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

  /** What is about to be ordered, in a sentence. */
  #inWords() {
    const version = this.#version?.package;
    if (!this.fields.name)
      return html`<span class="quiet">Choose a package${this.ids ? '' : ' and its robots'}.</span>`;
    if (!version) return html`<span class="quiet">There is no package ${this.fields.name}.</span>`;
    const robots = this.#robots;
    const whole = robots
      ? ` to ${plural(robots, 'robot')}, ${size(robots * version.content.size)} in all`
      : '';
    const { batch, max_failures: bears, priority, hours, restart } = this.fields;
    const options = optionsInWords({
      batch: Number(batch),
      max_failures: bears === '' ? null : Number(bears),
      priority: Number(priority),
    });
    return [
      `${version.name}@${version.version}${whole}`,
      ...options,
      hours && `expires after ${plural(Number(hours), 'hour')}`,
      restart && 'anew where it runs already',
    ]
      .filter(Boolean)
      .join('; ');
  }

  // What the selector means.

  /** Asks how many robots it means, once typing has paused. */
  #count() {
    clearTimeout(this.#timer);
    const asked = (this.#asked += 1);
    const selector = this.fields.selector.trim();
    this.#timer = setTimeout(async () => {
      const match = selector ? await matchOf(selector, this.app.fleet) : {};
      if (match && asked === this.#asked) change(() => (this.#match = match));
    }, COUNT_PAUSE_MS);
  }

  // Sending it.

  async act() {
    const { name, delivery, selector } = this.fields;
    const version = this.#version;
    if (!name) this.#refuse('name', 'Choose a package.');
    if (!version) this.#refuse('name', `There is no package ${name}.`);
    await this.#check(selector.trim());
    const body = {
      package: name,
      manifest: version.package.manifest.digest,
      delivery,
      selector: this.ids ? idsOf(this.ids) : selector.trim(),
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
    if (this.#keyed && this.#keyed !== text) this.#key = newKey();
    this.#keyed = text;
    try {
      const { id, assignments = [] } = await order('/deployments', body, this.#key);
      remember(this.app, this.fields);
      const running = assignments.filter(({ phase }) => phase === 'running').length;
      if (running)
        tell(
          `${name}@${version.package.version} runs already on ${plural(running, 'robot')}, and goes on there.`,
        );
      go(['deployments', id]);
    } catch (error) {
      const field = fieldOf(error);
      if (field && (field !== 'selector' || !this.ids)) this.#refuse(field, error.message);
      throw error;
    }
  }

  /** Whom it is for is known before it is sent, and of many it was said that they are meant. */
  async #check(selector) {
    if (!this.ids) {
      if (!selector) this.#refuse('selector', 'Say which robots.');
      const match = await matchOf(selector, this.app.fleet);
      if (!match) throw new SignedOut();
      change(() => (this.#match = match));
      if (match.problem) this.#refuse('selector', match.problem);
    }
    if (this.#robots > ASK_ABOVE && this.#confirmed !== this.#robots)
      this.#refuse('many', `Say that ${number(this.#robots)} robots are meant.`);
  }

  /** Says what is wrong at the field, and goes there. */
  #refuse(field, message) {
    change(() => {
      this.#problems = { [field]: message.replace(/^[a-z_]+: /, '') };
      this.hasMore ||= ['batch', 'max_failures', 'priority', 'hours'].includes(field);
    });
    requestAnimationFrame(() => document.getElementById(`order-${field}`)?.focus());
    throw Object.assign(new Error(message), { isSaid: true });
  }
}

/** `12 robots now: arm, cart and 10 more`. */
function matched(total, some) {
  if (!total) return 'No robot is meant.';
  const rest = total - some.length;
  return `${plural(total, 'robot')} now: ${some.join(', ')}${rest > 0 ? ` and ${number(rest)} more` : ''}`;
}

/** Whom the selector means of those that get what is ordered. */
async function matchOf(selector, fleet) {
  const waiting = [...fleet.robots.values()].filter(isWaiting).map(({ id }) => `!${id}`);
  try {
    const {
      robots,
      total = robots.length,
      unknown = [],
    } = await get('/robots', { selector: [selector, ...waiting].join(), limit: NAMED });
    if (unknown.length) return { problem: `No robot has the name or id ${unknown.join(', ')}.` };
    return { total, some: robots.slice(0, NAMED).map(({ name }) => name) };
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

/** The field that a refusal is about. */
const fieldOf = ({ code, message }) =>
  FIELD_OF_CODE[code] ?? FIELD_OF_KEY[/^([a-z_]+)(: |\b)/.exec(message)?.[1]];

// How it is to be done is kept for as long as the tab is open, each person's own; what and of whom
// is not.

const placeOf = ({ me }) => `taskd.order.${me?.name}`;

function remembered(app) {
  try {
    return JSON.parse(sessionStorage.getItem(placeOf(app))) ?? {};
  } catch {
    return {};
  }
}

function remember(app, { delivery, batch, max_failures, priority, hours }) {
  sessionStorage.setItem(
    placeOf(app),
    JSON.stringify({ delivery, batch, max_failures, priority, hours }),
  );
}

function optionsInWords({ batch, max_failures: bears, priority }) {
  return [
    batch && `${number(batch)} at a time`,
    bears != null &&
      (bears ? `pauses when more than ${number(bears)} fail` : 'pauses at the first failure'),
    priority ? `priority ${priority}` : null,
  ].filter(Boolean);
}

/** What has been ordered beside the robots, in words. */
export const optionsOf = ({ delivery, ...options }) =>
  [`${words(delivery)} delivery`, ...optionsInWords(options)].join(' · ');
