// The view of the settings: pending robots, tokens, users, delivery rules and limits.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { get, post, remove } from '../api/api.js';
import { command } from '../display/copy.js';
import { openDialog } from '../display/dialog.js';
import { change } from '../display/display.js';
import { duration, moment, number, plural, words } from '../display/format.js';
import { notify } from '../display/notice.js';
import { timeAgo } from '../display/status.js';
import { awaitsApproval } from '../fleet.js';
import { createEnrollmentToken, enrollCommand } from '../orders/enrollment.js';
import { parseLabels } from '../orders/orders.js';

const DAY_S = 86_400;

export class SettingsView {
  #enrollments = null;
  #pending = [];
  #isFetchingPending = false;
  #isPendingStale = false;
  #tokens = null;
  #users = null;
  #rules = null;
  #server = null;
  /**
   * Whether the data was fetched as an administrator; permissions are known shortly after the page
   * loads.
   */
  #isForAdministrator = null;

  constructor(app) {
    this.app = app;
    this.refresh();
  }

  onNavigate() {}

  async refresh() {
    const { app } = this;
    this.#isForAdministrator = app.can('administer');
    const queries = { '/tokens': { all: this.#isForAdministrator } };
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
    if (!this.#isForAdministrator) return;
    this.#refreshPending();
    const [enrollment, users] = await Promise.all(
      ['/enrollment-tokens', '/users'].map((path) => app.attempt(() => get(path))),
    );
    change(() => {
      this.#enrollments = enrollment?.tokens ?? [];
      this.#users = users?.users ?? [];
    });
  }

  /** Fetches the pending robots. Calls during a fetch cause one more fetch. */
  async #refreshPending() {
    this.#isPendingStale = this.#isFetchingPending;
    if (this.#isPendingStale) return;
    this.#isFetchingPending = true;
    const pending = await this.app.attempt(() => get('/pending-robots'));
    this.#isFetchingPending = false;
    if (pending) change(() => (this.#pending = pending.robots));
    if (this.#isPendingStale) this.#refreshPending();
  }

  /**
   * Refreshes when a robot that awaits approval is missing from the list, or a listed one no longer
   * awaits it.
   */
  onEvent({ type, robot, id }) {
    if (!this.#isForAdministrator || (type !== 'robot' && type !== 'robot_removed')) return;
    const isListed = this.#pending.some((one) => one.id === (robot?.id ?? id));
    if (isListed !== awaitsApproval(robot)) this.#refreshPending();
  }

  /** Runs an action, shows its message and refreshes. */
  async #do(action, message) {
    if ((await this.app.attempt(async () => (await action(), true))) && message) notify(message);
    this.refresh();
  }

  draw(now) {
    if (this.app.can('administer') && !this.#isForAdministrator && this.app.me) this.refresh();
    return html`
      <header class="toolbar"><h1>Settings</h1></header>
      ${this.#pending.length ? this.#pendingSection(now) : nothing}
      ${this.#enrollments ? this.#enrollmentSection(now) : nothing}
      ${this.#tokens ? this.#tokenSection(now) : nothing}
      ${this.#users ? this.#userSection() : nothing}
      ${this.#rules ? this.#ruleSection() : nothing}
      ${this.#server ? this.#serverSection() : nothing}`;
  }

  #pendingSection(now) {
    return html`
      <section aria-labelledby="pending">
        <header><h2 id="pending">Robots awaiting approval
          <span class="count">${number(this.#pending.length)}</span></h2></header>
        ${table(
          ['Name', 'MAC', 'Labels', 'Address', 'Since', ''],
          this.#pending.map(
            (robot) => html`
          <tr>
            <td>${robot.name}</td><td class="code">${robot.mac}</td>
            <td class="code">${labels(robot.labels)}</td>
            <td class="code">${robot.address ?? '–'}</td>
            <td>${timeAgo(robot.since_ms, now)}</td>
            <td class="actions"><button class="quiet-button"
                @click=${() => this.#answer(robot, 'approve', 'approved')}>Approve</button>
              <button class="quiet-button danger-text"
                @click=${() => this.#answer(robot, 'reject', 'rejected')}>Reject</button></td>
          </tr>`,
          ),
          'pending',
        )}
      </section>`;
  }

  #answer({ id, name }, verb, done) {
    this.#do(() => post(`/robots/${id}/${verb}`), `${name} ${done}.`);
  }

  #enrollmentSection(now) {
    return html`
      <section aria-labelledby="enrollment">
        <header><h2 id="enrollment">Enrollment tokens <span class="count">for new robots</span></h2>
          <button class="primary"
            @click=${() => this.#openEnrollmentDialog()}>New token…</button></header>
        ${
          this.#enrollments.length
            ? table(
                ['ID', 'For', 'Labels', 'Uses left', 'Expires', ''],
                this.#enrollments.map(
                  (token) => html`
              <tr>
                <td class="code">${token.id}</td>
                <td>${token.robot ?? 'any robot'}${
                  token.approval ? html`<span class="quiet">, with approval</span>` : nothing
                }</td>
                <td class="code">${labels(token.labels)}</td>
                <td>${token.uses_left ?? 'unlimited'}</td>
                <td>${expiry(token.expires_at_ms, now)}</td>
                <td class="actions"><button class="quiet-button danger-text"
                  aria-label=${`Revoke ${token.id}`}
                  @click=${() => this.#revokeEnrollment(token)}>Revoke</button></td>
              </tr>`,
                ),
                'enrollment',
              )
            : html`<p class="quiet">No enrollment tokens.</p>`
        }
      </section>`;
  }

  #revokeEnrollment({ id }) {
    this.#do(() => remove(`/enrollment-tokens/${id}`), 'Token revoked.');
  }

  #openEnrollmentDialog() {
    openDialog({
      title: 'New enrollment token',
      submitLabel: 'Create token',
      body: () => html`
        <div class="fields">
          <label class="wide">Labels of enrolled robots
            <input name="labels" class="code" placeholder="site=lab"
              autocomplete="off" autocapitalize="none" spellcheck="false"></label>
          <label>Maximum uses <input name="uses" type="number" min="1" placeholder="100"></label>
          <label>Valid for (days) <input name="days" type="number" min="1" placeholder="1"></label>
          <label class="wide">Only for an existing robot
            <input name="robot" placeholder="name or ID"
              autocomplete="off" spellcheck="false"></label>
        </div>
        <label class="choice"><input type="checkbox" name="approval"> Require approval</label>`,
      onSubmit: async ({ labels: text, uses, days, robot, approval }) => {
        const request = { labels: parseLabels(text), approval: approval === 'on' };
        if (uses) request.uses = Number(uses);
        if (days) request.ttl_s = Number(days) * DAY_S;
        if (robot.trim()) request.robot = robot.trim();
        const created = await createEnrollmentToken(request);
        this.refresh();
        showSecret(
          'Run these commands on each robot',
          [enrollCommand(created), 'task-agent run'],
          `The token is shown only once. It expires on ${moment(created.expires_at_ms)}.`,
        );
      },
    });
  }

  #tokenSection(now) {
    const tokens = this.#tokens.filter(({ origin }) => origin !== 'page');
    return html`
      <section aria-labelledby="tokens">
        <header><h2 id="tokens">Access tokens <span class="count">for programs</span></h2>
          <button class="primary"
            @click=${() => this.#openTokenDialog()}>New token…</button></header>
        ${
          tokens.length
            ? table(
                ['ID', 'User', 'Description', 'Roles', 'Expires', ''],
                tokens.map(
                  (token) => html`
              <tr>
                <td class="code">${token.id}</td><td>${token.user}</td>
                <td>${token.title || html`<span class="quiet">${words(token.origin)}</span>`}</td>
                <td>${token.roles?.join(', ') ?? 'all roles of the user'}${
                  token.scope ? html` on <span class="code">${token.scope}</span>` : nothing
                }</td>
                <td>${
                  token.revoked_at_ms
                    ? 'revoked'
                    : token.expires_at_ms
                      ? expiry(token.expires_at_ms, now)
                      : 'never'
                }</td>
                <td class="actions">${
                  token.revoked_at_ms
                    ? nothing
                    : html`<button class="quiet-button danger-text"
                        aria-label=${`Revoke ${token.id}`}
                        @click=${() => this.#openRevokeDialog(token)}>Revoke</button>`
                }</td>
              </tr>`,
                ),
                'tokens',
              )
            : html`<p class="quiet">No access tokens.</p>`
        }
      </section>`;
  }

  #openRevokeDialog({ id, user, title }) {
    openDialog({
      title: 'Revoke token?',
      submitLabel: 'Revoke',
      isDangerous: true,
      body: () =>
        html`<p><span class="code">${id}</span> of ${user}${title ? `, ${title}` : ''}.
          Programs that use it lose access immediately.</p>`,
      onSubmit: async () => {
        await remove(`/tokens/${id}`);
        notify('Token revoked.');
        this.refresh();
      },
    });
  }

  #openTokenDialog() {
    openDialog({
      title: 'New access token',
      submitLabel: 'Create token',
      body: () => html`
        <div class="fields">
          <label class="wide">Description <input name="title" required autocomplete="off"></label>
          <label>Role <select name="roles"><option value="">all my roles</option>
            <option>viewer</option><option>operator</option><option>publisher</option>
          </select></label>
          <label>Valid for (days) <input name="days" type="number" min="1" placeholder="90"></label>
          <label class="wide">Robots <input name="scope" class="code" placeholder="site=lab"
            autocomplete="off" autocapitalize="none" spellcheck="false"></label>
        </div>`,
      onSubmit: async ({ title, roles, days, scope }) => {
        const request = { title: title.trim() };
        if (roles) request.roles = [roles];
        if (days) request.ttl_s = Number(days) * DAY_S;
        if (scope.trim()) request.scope = scope.trim();
        const created = await post('/tokens', request);
        this.refresh();
        showSecret(
          'New access token',
          [created.token],
          'The token is shown only once. On the command line, use TASKD_TOKEN or --token-file.',
        );
      },
    });
  }

  #userSection() {
    return html`
      <section aria-labelledby="people">
        <header><h2 id="people">Users
          <span class="count">${number(this.#users.length)}</span></h2></header>
        ${
          this.#users.length
            ? table(
                ['Name', 'Roles', 'Robots', 'Sign-in'],
                this.#users.map(
                  ({ name, roles, scope, has_password: hasPassword, subject }) => html`
              <tr><td>${name}</td><td>${[roles].flat().join(', ')}</td>
                <td class="code">${scope ?? '*'}</td>
                <td>${
                  [hasPassword && 'password', subject && 'identity provider']
                    .filter(Boolean)
                    .join(', ') || 'token'
                }</td></tr>`,
                ),
                'people',
              )
            : html`<p class="quiet">No users yet. Add one with:</p>${command(
                'taskd user add NAME --role operator',
              )}`
        }
      </section>`;
  }

  #ruleSection() {
    const { rules, limits } = this.#rules;
    return html`
      <section aria-labelledby="rules">
        <header><h2 id="rules">Adaptive delivery
          <span class="count">the first matching rule applies</span></h2></header>
        ${table(
          ['', 'Rule', 'If', 'Then', ''],
          rules.map(
            ({ order, name, condition, mechanism, own }) => html`
          <tr><td class="quiet">${order}</td><td>${name}</td>
            <td>${condition || html`<span class="quiet">always</span>`}</td><td>${mechanism}</td>
            <td class="quiet">${own ? 'custom' : 'built-in'}</td></tr>`,
          ),
          'rules',
        )}
      </section>
      <section aria-labelledby="limits">
        <header><h2 id="limits">Limits
          <span class="count">${plural(limits.length, 'setting')}</span></h2></header>
        ${table(
          ['Setting', 'Value'],
          limits.map(
            ({ key, value }) => html`<tr><td class="code">${key}</td><td>${value}</td></tr>`,
          ),
          'limits',
        )}
        <p class="quiet">Change these in the server’s configuration:
          <code>taskd serve --help</code>.</p>
      </section>`;
  }

  #serverSection() {
    const { version, key, ca_pin: pin, mqtt } = this.#server;
    return html`
      <section aria-labelledby="identity">
        <header><h2 id="identity">Server</h2></header>
        <dl class="facts">
          <dt>Version</dt><dd>taskd ${version}</dd>
          <dt>MQTT</dt><dd class="code">${mqtt}</dd>
          <dt>Key</dt><dd class="code">${key}</dd>
          ${pin ? html`<dt>CA pin</dt><dd class="code">${pin}</dd>` : nothing}
          <dt>API</dt><dd><a href="/api/docs">Documentation</a>,
            <a href="/api/openapi.json">OpenAPI</a></dd>
        </dl>
      </section>`;
  }
}

const labels = (all) =>
  Object.entries(all)
    .map(([label, value]) => `${label}=${value}`)
    .join(', ') || '–';

const expiry = (then, now) =>
  html`<time title=${moment(then)}>${then > now ? `in ${duration(then - now)}` : 'expired'}</time>`;

/** A table that scrolls horizontally if it is too wide. `label` is the id of its heading. */
const table = (heads, rows, label) => html`
  <div class="scroll" tabindex="0" role="group" aria-labelledby=${label}><table>
    <thead><tr>${heads.map((head) =>
      head ? html`<th scope="col">${head}</th>` : html`<td></td>`,
    )}</tr></thead>
    <tbody>${rows}</tbody>
  </table></div>`;

/** Shows values that are available only once. */
const showSecret = (title, lines, note) =>
  openDialog({
    title,
    isSecret: true,
    cancelLabel: 'Done',
    body: () => html`${lines.map(command)}<p class="quiet">${note}</p>`,
  });
