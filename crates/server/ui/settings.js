// Settings: who may come in and who may do what, and the rules by which the server decides how
// bytes travel.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { parseLabels } from './acts.js';
import { get, post, remove } from './api.js';
import { command } from './copy.js';
import { open } from './dialog.js';
import { isWaiting } from './fleet.js';
import { duration, moment, number, plural, words } from './format.js';
import { change } from './frame.js';
import { tell } from './notice.js';
import { since } from './signs.js';

const DAY_S = 86_400;

/** Makes a token that robots enrol with. */
export const newEnrolment = (wanted = {}) => post('/enrollment-tokens', wanted);

/** The line that enrols a robot. */
export const enrolCommand = ({ token }) =>
  `task-agent enroll --server ${location.origin} --token ${token}`;

export class SettingsView {
  #enrolment = null;
  #pending = [];
  #isAskingPending = false;
  #isPendingStale = false;
  #tokens = null;
  #users = null;
  #rules = null;
  #server = null;
  /** Fetched for an administrator or not; that is known a moment after the page begins. */
  #isForAll = null;

  constructor(app) {
    this.app = app;
    this.refresh();
  }

  arrive() {}

  async refresh() {
    const { app } = this;
    this.#isForAll = app.can('administer');
    const queries = { '/tokens': { all: this.#isForAll } };
    const [tokens, rules, server] = await Promise.all(
      ['/tokens', '/server/rules', '/server'].map((path) =>
        app.attempt(() => get(path, queries[path])),
      ),
    );
    change(() => {
      this.#tokens = tokens?.tokens ?? [];
      this.#rules = rules;
      this.#server = server;
    });
    if (!this.#isForAll) return;
    this.#refreshPending();
    const [enrolment, users] = await Promise.all(
      ['/enrollment-tokens', '/users'].map((path) => app.attempt(() => get(path))),
    );
    change(() => {
      this.#enrolment = enrolment?.tokens ?? [];
      this.#users = users?.users ?? [];
    });
  }

  /** Asks who waits; asked again meanwhile, once more. */
  async #refreshPending() {
    this.#isPendingStale = this.#isAskingPending;
    if (this.#isPendingStale) return;
    this.#isAskingPending = true;
    const pending = await this.app.attempt(() => get('/pending-robots'));
    this.#isAskingPending = false;
    if (pending) change(() => (this.#pending = pending.robots));
    if (this.#isPendingStale) this.#refreshPending();
  }

  /**
   * A robot that waits and is not listed has come, and one that is listed and waits no longer has
   * gone.
   */
  hear({ type, robot, id }) {
    if (!this.#isForAll || (type !== 'robot' && type !== 'robot_removed')) return;
    const isListed = this.#pending.some((one) => one.id === (robot?.id ?? id));
    if (isListed !== isWaiting(robot)) this.#refreshPending();
  }

  /** Does something, says so, and looks again. */
  async #do(act, said) {
    if ((await this.app.attempt(async () => (await act(), true))) && said) tell(said);
    this.refresh();
  }

  draw(now) {
    if (this.app.can('administer') && !this.#isForAll && this.app.me) this.refresh();
    return html`
      <header class="bar-of-tools"><h1>Settings</h1></header>
      ${this.#pending.length ? this.#pendingRobots(now) : nothing}
      ${this.#enrolment ? this.#enrolmentTokens(now) : nothing}
      ${this.#tokens ? this.#accessTokens(now) : nothing}
      ${this.#users ? this.#people() : nothing}
      ${this.#rules ? this.#deliveryRules() : nothing}
      ${this.#server ? this.#identity() : nothing}`;
  }

  #pendingRobots(now) {
    return html`
      <section aria-labelledby="pending">
        <header><h2 id="pending">Robots that wait to be approved <span class="count">${number(this.#pending.length)}</span></h2></header>
        ${table(
          ['Name', 'MAC', 'Labels', 'From', 'Since', ''],
          this.#pending.map(
            (robot) => html`
          <tr>
            <td>${robot.name}</td><td class="code">${robot.mac}</td><td class="code">${labels(robot.labels)}</td><td class="code">${robot.address ?? '–'}</td><td>${since(robot.since_ms, now)}</td>
            <td class="acts"><button class="quiet-button" @click=${() => this.#do(() => post(`/robots/${robot.id}/approve`), `${robot.name} may come in.`)}>Approve</button>
              <button class="quiet-button danger-text" @click=${() => this.#do(() => post(`/robots/${robot.id}/reject`), `${robot.name} was turned away.`)}>Turn away</button></td>
          </tr>`,
          ),
          'pending',
        )}
      </section>`;
  }

  #enrolmentTokens(now) {
    return html`
      <section aria-labelledby="enrolment">
        <header><h2 id="enrolment">Enrolment tokens <span class="count">robots come in by these</span></h2><button class="primary" @click=${() => this.#askEnrolment()}>New token…</button></header>
        ${
          this.#enrolment.length
            ? table(
                ['ID', 'For', 'Labels', 'Uses left', 'Ends', ''],
                this.#enrolment.map(
                  (token) => html`
              <tr>
                <td class="code">${token.id}</td><td>${token.robot ?? 'any robot'}${token.approval ? html`<span class="quiet">, with approval</span>` : nothing}</td><td class="code">${labels(token.labels)}</td>
                <td>${token.uses_left ?? 'any number'}</td><td>${ends(token.expires_at_ms, now)}</td>
                <td class="acts"><button class="quiet-button danger-text" aria-label=${`Revoke ${token.id}`} @click=${() => this.#do(() => remove(`/enrollment-tokens/${token.id}`), 'The token is revoked.')}>Revoke</button></td>
              </tr>`,
                ),
                'enrolment',
              )
            : html`<p class="quiet">None.</p>`
        }
      </section>`;
  }

  #askEnrolment() {
    open({
      title: 'New enrolment token',
      action: 'Make it',
      body: () => html`
        <div class="fields">
          <label class="wide">Labels each robot gets <input name="labels" class="code" placeholder="site=lab" autocomplete="off" autocapitalize="none" spellcheck="false"></label>
          <label>How many robots <input name="uses" type="number" min="1" placeholder="100"></label>
          <label>Days it is good for <input name="days" type="number" min="1" placeholder="1"></label>
          <label class="wide">Only for a robot that is known <input name="robot" placeholder="name or ID; it may register again" autocomplete="off" spellcheck="false"></label>
        </div>
        <label class="choice"><input type="checkbox" name="approval"> Robots that come by it wait to be approved</label>`,
      act: async ({ labels: text, uses, days, robot, approval }) => {
        const wanted = { labels: parseLabels(text), approval: approval === 'on' };
        if (uses) wanted.uses = Number(uses);
        if (days) wanted.ttl_s = Number(days) * DAY_S;
        if (robot.trim()) wanted.robot = robot.trim();
        const made = await newEnrolment(wanted);
        this.refresh();
        showSecret(
          'Run this on each robot',
          [enrolCommand(made), 'task-agent run'],
          `The token is shown this once. It ends on ${moment(made.expires_at_ms)}.`,
        );
      },
    });
  }

  #accessTokens(now) {
    const tokens = this.#tokens.filter(({ origin }) => origin !== 'page');
    return html`
      <section aria-labelledby="tokens">
        <header><h2 id="tokens">Access tokens <span class="count">programs sign in by these</span></h2><button class="primary" @click=${() => this.#askToken()}>New token…</button></header>
        ${
          tokens.length
            ? table(
                ['ID', 'User', 'What for', 'May', 'Ends', ''],
                tokens.map(
                  (token) => html`
              <tr>
                <td class="code">${token.id}</td><td>${token.user}</td><td>${token.title || html`<span class="quiet">${words(token.origin)}</span>`}</td>
                <td>${token.roles?.join(', ') ?? 'as its user'}${token.scope ? html` on <span class="code">${token.scope}</span>` : nothing}</td>
                <td>${token.revoked_at_ms ? 'revoked' : token.expires_at_ms ? ends(token.expires_at_ms, now) : 'never'}</td>
                <td class="acts">${token.revoked_at_ms ? nothing : html`<button class="quiet-button danger-text" aria-label=${`Revoke ${token.id}`} @click=${() => this.#askRevoke(token)}>Revoke</button>`}</td>
              </tr>`,
                ),
                'tokens',
              )
            : html`<p class="quiet">None.</p>`
        }
      </section>`;
  }

  #askRevoke({ id, user, title }) {
    open({
      title: 'Revoke the token?',
      action: 'Revoke',
      isDangerous: true,
      body: () =>
        html`<p><span class="code">${id}</span> of ${user}${title ? `, ${title}` : ''}. Whoever uses it is out at once.</p>`,
      act: async () => {
        await remove(`/tokens/${id}`);
        tell('The token is revoked.');
        this.refresh();
      },
    });
  }

  #askToken() {
    open({
      title: 'New access token',
      action: 'Make it',
      body: () => html`
        <div class="fields">
          <label class="wide">What it is for <input name="title" required autocomplete="off"></label>
          <label>Limited to the role <select name="roles"><option value="">all of mine</option><option>viewer</option><option>operator</option><option>publisher</option></select></label>
          <label>Days it lives <input name="days" type="number" min="1" placeholder="90"></label>
          <label class="wide">Limited to robots <input name="scope" class="code" placeholder="site=lab" autocomplete="off" autocapitalize="none" spellcheck="false"></label>
        </div>`,
      act: async ({ title, roles, days, scope }) => {
        const wanted = { title: title.trim() };
        if (roles) wanted.roles = [roles];
        if (days) wanted.ttl_s = Number(days) * DAY_S;
        if (scope.trim()) wanted.scope = scope.trim();
        const made = await post('/tokens', wanted);
        this.refresh();
        showSecret(
          'The new token',
          [made.token],
          'It is shown this once. At the command line: TASKD_TOKEN, or --token-file.',
        );
      },
    });
  }

  #people() {
    return html`
      <section aria-labelledby="people">
        <header><h2 id="people">People <span class="count">${number(this.#users.length)}</span></h2></header>
        ${
          this.#users.length
            ? table(
                ['Name', 'Roles', 'Robots', 'Signs in'],
                this.#users.map(
                  ({ name, roles, scope, has_password: hasPassword, subject }) => html`
              <tr><td>${name}</td><td>${[roles].flat().join(', ')}</td><td class="code">${scope ?? '*'}</td><td>${[hasPassword && 'by password', subject && 'by the provider'].filter(Boolean).join(', ') || 'by token'}</td></tr>`,
                ),
                'people',
              )
            : html`<p class="quiet">Only the first token so far. Add people with</p>${command('taskd user add NAME --role operator')}`
        }
      </section>`;
  }

  #deliveryRules() {
    const { rules, limits } = this.#rules;
    return html`
      <section aria-labelledby="rules">
        <header><h2 id="rules">Adaptive delivery <span class="count">the first rule whose condition holds decides</span></h2></header>
        ${table(
          ['', 'Rule', 'If', 'Then', ''],
          rules.map(
            ({ order, name, condition, mechanism, own }) => html`
          <tr><td class="quiet">${order}</td><td>${name}</td><td>${condition || html`<span class="quiet">always</span>`}</td><td>${mechanism}</td><td class="quiet">${own ? 'yours' : 'built in'}</td></tr>`,
          ),
          'rules',
        )}
      </section>
      <section aria-labelledby="limits">
        <header><h2 id="limits">Limits that hold <span class="count">${plural(limits.length, 'setting')}</span></h2></header>
        ${table(
          ['Setting', 'Value'],
          limits.map(
            ({ key, value }) => html`<tr><td class="code">${key}</td><td>${value}</td></tr>`,
          ),
          'limits',
        )}
        <p class="quiet">They are changed in the server’s configuration: <code>taskd serve --help</code>.</p>
      </section>`;
  }

  #identity() {
    const { version, key, ca_pin: pin, mqtt } = this.#server;
    return html`
      <section aria-labelledby="identity">
        <header><h2 id="identity">This server</h2></header>
        <dl class="facts">
          <dt>Version</dt><dd>taskd ${version}</dd>
          <dt>MQTT</dt><dd class="code">${mqtt}</dd>
          <dt>Key</dt><dd class="code">${key}</dd>
          ${pin ? html`<dt>Authority’s pin</dt><dd class="code">${pin}</dd>` : nothing}
          <dt>API</dt><dd><a href="/api/docs">Documentation</a>, <a href="/api/openapi.json">OpenAPI</a></dd>
        </dl>
      </section>`;
  }
}

const labels = (all) =>
  Object.entries(all)
    .map(([label, value]) => `${label}=${value}`)
    .join(', ') || '–';

const ends = (then, now) =>
  html`<time title=${moment(then)}>${then > now ? `in ${duration(then - now)}` : 'has ended'}</time>`;

/** A table that scrolls within itself where it is too wide. `label` is the id of its heading. */
const table = (heads, rows, label) => html`
  <div class="scroll" tabindex="0" role="group" aria-labelledby=${label}><table>
    <thead><tr>${heads.map((head) => (head ? html`<th scope="col">${head}</th>` : html`<td></td>`))}</tr></thead>
    <tbody>${rows}</tbody>
  </table></div>`;

/** Shows lines to copy that can't be had again. */
const showSecret = (title, lines, note) =>
  open({
    title,
    isSecret: true,
    dismissal: 'I have it',
    body: () => html`${lines.map(command)}<p class="quiet">${note}</p>`,
  });
