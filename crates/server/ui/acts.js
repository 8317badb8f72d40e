// What is asked before something is done with robots that are chosen.

import { html, nothing } from './vendor/lit-html-3.3.3/lit-html.js';
import { newKey, order, patch, post, remove } from './api.js';
import { open } from './dialog.js';
import { idsOf, isWaiting, labelsOf } from './fleet.js';
import { number, plural } from './format.js';
import { tell } from './notice.js';

/** `3 robots`, or the one robot's name. */
export const whom = (ids, fleet) =>
  ids.size === 1 ? (fleet.robots.get([...ids][0])?.name ?? '1 robot') : plural(ids.size, 'robot');

/** The names of a few of them, so that nobody acts on others than they think. */
export function names(ids, fleet) {
  const some = [...ids].slice(0, 5).map((id) => fleet.robots.get(id)?.name ?? id);
  const rest = ids.size - some.length;
  return html`<p class="quiet names">${some.join(', ')}${rest > 0 ? ` and ${number(rest)} more` : ''}</p>`;
}

/** Those of them that get what is ordered. */
export const receivers = (ids, fleet) =>
  new Set([...ids].filter((id) => !isWaiting(fleet.robots.get(id))));

/** Says that some of those who were chosen get nothing. */
export const leftOut = (count) =>
  count
    ? html`<p class="quiet">${number(count)} of those that were chosen ${count === 1 ? 'waits' : 'wait'} for approval and ${count === 1 ? 'gets' : 'get'} nothing until then.</p>`
    : nothing;

/** The tasks that these robots have, each with how many have it. */
function tasksOf(ids, fleet) {
  const counts = new Map();
  for (const id of ids)
    for (const { task } of fleet.robots.get(id)?.tasks ?? [])
      counts.set(task, (counts.get(task) ?? 0) + 1);
  return [...counts].sort();
}

const VERBS = {
  start: { title: 'Start', done: 'started' },
  stop: { title: 'Stop', done: 'stopped' },
  restart: { title: 'Restart', done: 'restarted' },
  rollback: { title: 'Roll back', done: 'rolled back' },
  remove: { title: 'Remove', done: 'removed', isDangerous: true },
};

/** Orders a task started, stopped, restarted, rolled back or removed on these robots. */
export function askTask(app, verb, ids, only = null) {
  const { title, done, isDangerous } = VERBS[verb];
  const chosen = receivers(ids, app.fleet);
  const tasks = tasksOf(chosen, app.fleet).filter(([task]) => !only || task === only);
  const left = ids.size - chosen.size;
  const [key, selector] = [newKey(), idsOf(chosen)];
  open({
    title: `${title} ${only ?? 'tasks'} on ${whom(chosen, app.fleet)}`,
    isDangerous,
    action: tasks.length ? title : null,
    body: () => html`${names(chosen, app.fleet)}${leftOut(left)}
      ${
        tasks.length
          ? html`<fieldset><legend>Which task</legend>${tasks.map(([task, count], index) => html`<label class="choice"><input type="checkbox" name="task" value=${task} ?checked=${index === 0 && tasks.length === 1}> ${task} <span class="quiet">on ${plural(count, 'robot')}</span></label>`)}</fieldset>`
          : html`<p>None of them has a task.</p>`
      }`,
    async act({ task = [] }) {
      const wanted = [task].flat();
      if (!wanted.length) throw new Error('Choose a task.');
      const robots = new Set();
      const without = new Set();
      for (const name of wanted) {
        const answer = await order(`/tasks/${name}/${verb}`, { selector }, `${key}-${name}`);
        answer.robots.forEach(({ id }) => robots.add(id));
        answer.without?.forEach(({ id }) => without.add(id));
      }
      const rest = without.size
        ? ` On ${plural(without.size, 'robot')} no earlier package ever ran.`
        : '';
      tell(`${wanted.join(', ')}: to be ${done} on ${plural(robots.size, 'robot')}.${rest}`);
    },
  });
}

/** Sets and takes away labels. */
export function askLabels(app, ids) {
  const chosen = receivers(ids, app.fleet);
  const left = ids.size - chosen.size;
  // A field must not be called like what a form can do: `remove` would be no function any more.
  const there = () =>
    [
      ...new Set([...chosen].flatMap((id) => Object.keys(app.fleet.robots.get(id)?.labels ?? {}))),
    ].sort();
  open({
    title: `Label ${whom(chosen, app.fleet)}`,
    action: chosen.size ? 'Label' : null,
    body: () => html`${names(chosen, app.fleet)}${leftOut(left)}
      <label for="labels">Labels to set</label>
      <input id="labels" name="labels" placeholder="site=lab, floor=2" autocomplete="off" autocapitalize="none" spellcheck="false">
      ${there().length ? html`<fieldset><legend>Labels to take away</legend>${there().map((label) => html`<label class="choice"><input type="checkbox" name="taken" value=${label}> ${label}</label>`)}</fieldset>` : nothing}`,
    async act({ labels, taken = [] }) {
      const [set, remove] = [parseLabels(labels), [taken].flat()];
      if (!Object.keys(set).length && !remove.length) throw new Error('Say which labels.');
      const { robots } = await post('/bulk/labels', { selector: idsOf(chosen), set, remove });
      tell(`${plural(robots.length, 'robot')} labelled.`);
    },
  });
}

/** `site=lab, floor=2` as an object. */
export function parseLabels(text) {
  const pairs = text
    .split(',')
    .map((pair) => pair.trim())
    .filter(Boolean)
    .map((pair) => {
      const [label, ...value] = pair.split('=');
      if (!value.length) throw new Error(`${pair}: a label is written as name=value`);
      return [label.trim(), value.join('=').trim()];
    });
  return Object.fromEntries(pairs);
}

/**
 * Removes those that get orders at once, and one by one those that wait, whom no selector means.
 * Whoever is gone leaves `left`.
 */
async function removeAll(left, fleet) {
  const ordered = receivers(left, fleet);
  if (ordered.size) await post('/bulk/remove', { selector: idsOf(ordered) });
  for (const id of ordered) left.delete(id);
  for (const id of left) {
    await remove(`/robots/${id}`).catch(ifGone);
    left.delete(id);
  }
}

/** The server gives up those that have waited for too long. */
function ifGone(error) {
  if (error.status !== 404) throw error;
}

/** Removes robots for good. */
export function askDelete(app, ids) {
  const [chosen, left] = [new Set(ids), new Set(ids)];
  open({
    title: `Delete ${whom(chosen, app.fleet)}?`,
    action: 'Delete',
    isDangerous: true,
    body: () =>
      html`${names(chosen, app.fleet)}<p>Their tokens end. What runs there goes on running, but nothing new starts. They come back by enrolling again.</p>`,
    async act() {
      await removeAll(left, app.fleet);
      tell(`${plural(chosen.size, 'robot')} deleted.`);
    },
  });
}

/**
 * These labels with what was changed from `before` to `after`: what somebody else has changed
 * meanwhile stays.
 */
export function relabelled(labels, before, after) {
  const kept = Object.entries(labels).filter(([label]) => !(label in before) || label in after);
  const set = Object.entries(after).filter(([label, value]) => before[label] !== value);
  return Object.fromEntries([...kept, ...set]);
}

/**
 * What of a robot's name and labels was changed since they were as in `robot`, and nothing else.
 */
function changesOf(app, robot, name, labels) {
  const body = {};
  if (name !== robot.name) body.name = name;
  if (labels !== labelsOf(robot).join(', '))
    body.labels = relabelled(
      (app.fleet.robots.get(robot.id) ?? robot).labels,
      robot.labels,
      parseLabels(labels),
    );
  return body;
}

/** Changes a robot's name and labels; the rest of its settings is on its own page. */
export function askEdit(app, robot) {
  open({
    title: `Edit ${robot.name}`,
    action: 'Save',
    body: () => html`
      <label for="name">Name</label>
      <input id="name" name="name" required .defaultValue=${robot.name} autocomplete="off" autocapitalize="none" spellcheck="false">
      <label for="labels">Labels</label>
      <input id="labels" name="labels" .defaultValue=${labelsOf(robot).join(', ')} placeholder="site=lab, floor=2" autocomplete="off" autocapitalize="none" spellcheck="false">
      <label for="mac">MAC</label>
      <input id="mac" class="code" readonly .defaultValue=${robot.mac}>
      <p class="quiet"><a href=${`#/robots/${encodeURIComponent(robot.name)}/edit`}>Workspace, underlays and limits…</a></p>`,
    async act({ name, labels }) {
      const body = changesOf(app, robot, name.trim(), labels);
      if (!Object.keys(body).length) return;
      await patch(`/robots/${robot.id}`, body);
      tell(`${name.trim()} is changed.`);
    },
  });
}
