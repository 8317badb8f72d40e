// The Control tab: task actions, push, revocation and deletion.

import { repeat } from '../../vendor/lit-html-3.3.3/directives/repeat.js';
import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { post } from '../../api/api.js';
import { openDialog } from '../../display/dialog.js';
import { tone } from '../../display/format.js';
import { notify } from '../../display/notice.js';
import { phaseBadge, taskNotes } from '../../display/status.js';
import { openDeleteDialog, openTaskDialog } from '../../orders/orders.js';
import { openPushDialog } from '../../orders/push.js';

/** The task actions, and when each has an effect. */
const TASK_ACTIONS = [
  {
    verb: 'start',
    title: 'Start',
    isEnabled: ({ wanted, phase }) =>
      wanted === 'stopped' || ['bad', 'gone'].includes(tone(phase)) || phase === 'succeeded',
  },
  { verb: 'stop', title: 'Stop', isEnabled: ({ wanted }) => wanted === 'running' },
  { verb: 'restart', title: 'Restart', isEnabled: () => true },
  { verb: 'rollback', title: 'Roll back', isEnabled: () => true },
  { verb: 'remove', title: 'Remove', isEnabled: () => true, isDangerous: true },
];

export class Control {
  #page;

  constructor(page) {
    this.#page = page;
  }

  draw(robot) {
    const { app } = this.#page;
    const ids = new Set([robot.id]);
    return html`
      ${
        app.can('operate')
          ? html`
        <section class="control" aria-labelledby="tasks">
          <header><h2 id="tasks">Tasks</h2>
            <button class="primary"
              @click=${() => openPushDialog(app, ids)}>Push a package…</button></header>
          ${
            robot.online
              ? nothing
              : html`<p class="quiet">The robot is offline. Orders take effect when it
                  reconnects.</p>`
          }
          ${
            robot.tasks.length
              ? html`<ul class="orders">${repeat(
                  robot.tasks,
                  ({ task }) => task,
                  (task) => this.#task(task, ids),
                )}</ul>`
              : html`<p class="quiet">No tasks. Push a package to add one.</p>`
          }
        </section>`
          : nothing
      }
      ${app.can('maintain') ? this.#dangerZone(robot, ids) : nothing}`;
  }

  #task(task, ids) {
    const said = taskNotes(task).join(' · ');
    return html`
      <li data-task=${task.task}>
        <p><strong>${task.task}</strong><span class="quiet">@${task.version}</span>
          ${phaseBadge(task.phase)}${
            said ? html`<span class="quiet"> · ${said}</span>` : nothing
          }</p>
        <p class="actions">${TASK_ACTIONS.map(
          ({ verb, title, isEnabled, isDangerous }) =>
            html`<button class="quiet-button ${isDangerous ? 'danger-text' : ''}"
              ?disabled=${!isEnabled(task)} aria-label=${`${title} ${task.task}`}
              @click=${() => openTaskDialog(this.#page.app, verb, ids, task.task)}
              >${title}…</button>`,
        )}</p>
      </li>`;
  }

  #dangerZone(robot, ids) {
    return html`
      <section class="danger-zone" aria-labelledby="danger-zone">
        <header><h2 id="danger-zone">Danger zone</h2></header>
        <div>
          <p>Revoke the robot’s tokens immediately, for example if they have leaked. The robot stays
            listed and can return with an enrollment token created for it.</p>
          <button class="quiet-button danger-text"
            @click=${() => this.#openRevokeDialog(robot)}>Revoke…</button>
        </div>
        <div>
          <p>Revoke the robot’s tokens and delete the robot with its task history.</p>
          <button class="quiet-button danger-text"
            @click=${() => openDeleteDialog(this.#page.app, ids)}>Delete…</button>
        </div>
      </section>`;
  }

  #openRevokeDialog({ id, name }) {
    openDialog({
      title: `Revoke ${name}?`,
      isDangerous: true,
      submitLabel: 'Revoke',
      body: () => html`
        <p>Its tokens are revoked and its connections are closed immediately, even during a
          download.</p>
        <p>Running tasks keep running, as without a network, and no new tasks start. To stop its
          tasks, do so before you revoke it.</p>
        <p>You cannot undo this. To bring the robot back with its name and tasks, use
          <code>taskd enroll-token create --robot ${name} --uses 1</code> and
          <code>task-agent enroll --force</code>.</p>`,
      onSubmit: async () => {
        await post(`/robots/${id}/revoke`);
        notify(`${name} revoked.`);
      },
    });
  }
}
