// What a robot is told to do: its tasks one by one, a package, and putting it out.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { repeat } from '../vendor/lit-html-3.3.3/directives/repeat.js';
import { askDelete, askTask } from '../acts.js';
import { post } from '../api.js';
import { open } from '../dialog.js';
import { tone } from '../format.js';
import { tell } from '../notice.js';
import { askPush } from '../push.js';
import { phaseSign, remarks } from '../signs.js';

/** Each order, and when it would change something. */
const ORDERS = [
  {
    verb: 'start',
    title: 'Start',
    isOf: ({ wanted, phase }) =>
      wanted === 'stopped' || ['bad', 'gone'].includes(tone(phase)) || phase === 'succeeded',
  },
  { verb: 'stop', title: 'Stop', isOf: ({ wanted }) => wanted === 'running' },
  { verb: 'restart', title: 'Restart', isOf: () => true },
  { verb: 'rollback', title: 'Roll back', isOf: () => true },
  { verb: 'remove', title: 'Remove', isOf: () => true, isDangerous: true },
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
          <header><h2 id="tasks">Tasks</h2><button class="primary" @click=${() => askPush(app, ids)}>Push a package…</button></header>
          ${robot.online ? nothing : html`<p class="quiet">It is offline: orders wait for it.</p>`}
          ${
            robot.tasks.length
              ? html`<ul class="orders">${repeat(
                  robot.tasks,
                  ({ task }) => task,
                  (task) => this.#task(task, ids),
                )}</ul>`
              : html`<p class="quiet">It has no task. Push a package to give it one.</p>`
          }
        </section>`
          : nothing
      }
      ${app.can('maintain') ? this.#putOut(robot, ids) : nothing}`;
  }

  #task(task, ids) {
    const said = remarks(task).join(' · ');
    return html`
      <li data-task=${task.task}>
        <p><strong>${task.task}</strong><span class="quiet">@${task.version}</span> ${phaseSign(task.phase)}${said ? html`<span class="quiet"> · ${said}</span>` : nothing}</p>
        <p class="acts">${ORDERS.map(({ verb, title, isOf, isDangerous }) => html`<button class="quiet-button ${isDangerous ? 'danger-text' : ''}" ?disabled=${!isOf(task)} aria-label=${`${title} ${task.task}`} @click=${() => askTask(this.#page.app, verb, ids, task.task)}>${title}…</button>`)}</p>
      </li>`;
  }

  #putOut(robot, ids) {
    return html`
      <section class="put-out" aria-labelledby="put-out">
        <header><h2 id="put-out">Putting it out</h2></header>
        <div>
          <p>Revoking ends its tokens at once, for when somebody else may have them. It stays listed, and comes back with an enrolment token made for it.</p>
          <button class="quiet-button danger-text" @click=${() => this.#askRevoke(robot)}>Revoke…</button>
        </div>
        <div>
          <p>Deleting ends its tokens and forgets the robot, with all that was ordered of it.</p>
          <button class="quiet-button danger-text" @click=${() => askDelete(this.#page.app, ids)}>Delete…</button>
        </div>
      </section>`;
  }

  #askRevoke({ id, name }) {
    open({
      title: `Revoke ${name}?`,
      isDangerous: true,
      action: 'Revoke',
      body: () => html`
        <p>Its tokens end now: its connections are cut, also in the middle of a download, and it is let in no more.</p>
        <p>What runs on it goes on running, as without a network; nothing new begins. To stop its tasks, stop them first.</p>
        <p>It can’t be taken back. The robot comes back to its name and tasks with <code>taskd enroll-token create --robot ${name} --uses 1</code> and <code>task-agent enroll --force</code>.</p>`,
      act: async () => {
        await post(`/robots/${id}/revoke`);
        tell(`${name} is revoked.`);
      },
    });
  }
}
