// Everything about one robot, in a dialog that goes on updating while it is open.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { ago, bytes, moment, tone, words } from './format.js';
import { outputList } from './outputs.js';
import { remarks, robotState } from './robots.js';

export function robotDialog(robot, outputs, now, close) {
  return html`
    <dialog aria-label="Robot" @close=${close} @click=${(event) => event.target === event.currentTarget && event.currentTarget.close()}>
      ${robot ? details(robot, outputs, now) : nothing}
    </dialog>`;
}

const details = (robot, outputs, now) => html`
  <header>
    <h2>${robot.name}</h2>
    <button class="plain" aria-label="Close" @click=${(event) => event.currentTarget.closest('dialog').close()}>✕</button>
  </header>
  ${robot.conditions.map(({ code, text }) => html`<p class="condition"><span class="bad"><span aria-hidden="true">▲ </span>${words(code)}</span><br>${text}</p>`)}
  <dl>${facts(robot, now).map(([term, fact]) => html`<dt>${term}</dt><dd>${fact}</dd>`)}</dl>
  ${robot.tasks.map(taskDetails)}
  ${outputList(outputs, now)}`;

function facts(robot, now) {
  const { host, labels } = robot;
  const given = [
    ['State', robotState(robot)],
    ['Last seen', robot.last_seen_ms && `${moment(robot.last_seen_ms)} (${ago(robot.last_seen_ms, now)})`],
    ['ID', html`<span class="code">${robot.id}</span>`],
    ['MAC', html`<span class="code">${robot.mac}</span>`],
    ['IP and port', robot.address && html`<span class="code">${robot.address}</span>`],
    ['Labels', Object.entries(labels).map(([label, value]) => `${label}=${value}`).join(', ')],
    ['Enrolled', moment(robot.enrolled_at_ms)],
    ['Generation', robot.generation === robot.observed_generation ? robot.generation : `${robot.generation}, the robot has ${robot.observed_generation}`],
    ['Host', host && `${host.hostname}, ${host.arch}, agent ${host.agent_version}`],
    ['ROS', host && ros(host)],
    ['Isolation', host?.isolation],
    ['Free disk', host?.disk_free_bytes && `${(host.disk_free_bytes / 1e9).toFixed(1)} GB`],
  ];
  return given.filter(([, fact]) => fact || fact === 0);
}

function ros({ ros: used, ros_distros: found }) {
  if (!used) return found.join(', ');
  const domain = used.domain_id != null && `domain ${used.domain_id}${used.localhost_only ? ' on this host only' : ''}`;
  return [used.distro, used.rmw, domain].filter(Boolean).join(', ');
}

/** How its bytes travel, in a word; why, on pointing at it. */
const travels = ({ delivery }) => delivery
  ? html` · <span class="delivery" title=${`${delivery.rule}: ${delivery.because}`}>${delivery.mechanism}</span>` : nothing;

const taskDetails = (task) => html`
  <section>
    <h3>${task.task}<span class="quiet">@${task.version}</span> <span class="phase ${tone(task.phase)}">${words(task.phase)}</span></h3>
    ${task.progress && tone(task.phase) === 'busy' ? html`<p class="quiet">${bytes(task.progress)}</p>` : nothing}
    ${task.failure ? html`<p class="bad">${words(task.failure.code)}</p><pre tabindex="0">${task.failure.text}</pre>` : nothing}
    ${task.degraded ? html`<p class="bad"><span aria-hidden="true">▲ </span>degraded: ${words(task.degraded.code)}</p><pre tabindex="0">${task.degraded.text}</pre>` : nothing}
    <p class="quiet">${[`deployment ${task.deployment}`, `run ${task.run}`, task.active && `process ${task.active.pid}`, ...remarks(task)].filter(Boolean).join(' · ')}${travels(task)}</p>
  </section>`;
