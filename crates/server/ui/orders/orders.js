// Owns the dialogs that give orders to robots; it never draws a view.
//
// This module has the actions on selected robots: task actions, labels, deletion, and name and
// labels of one robot.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { newIdempotencyKey, postIdempotent, patch, post, remove } from '../api/api.js';
import { openDialog } from '../display/dialog.js';
import { number, plural } from '../display/format.js';
import { notify } from '../display/notice.js';
import { selectorOf, awaitsApproval, labelsOf } from '../fleet.js';

/** `3 robots`, or the one robot's name. */
export const robotsText = (ids, fleet) =>
  ids.size === 1 ? (fleet.robots.get([...ids][0])?.name ?? '1 robot') : plural(ids.size, 'robot');

/** The names of the first robots, so that users see which robots they act on. */
export function robotNames(ids, fleet) {
  const some = [...ids].slice(0, 5).map((id) => fleet.robots.get(id)?.name ?? id);
  const rest = ids.size - some.length;
  const others = rest > 0 ? ` and ${number(rest)} more` : '';
  return html`<p class="quiet names">${some.join(', ')}${others}</p>`;
}

/** The ids of the robots that accept orders, without those that await approval. */
export const approvedIds = (ids, fleet) =>
  new Set([...ids].filter((id) => !awaitsApproval(fleet.robots.get(id))));

/** Says how many selected robots are skipped because they await approval. */
export function skippedNote(count) {
  if (!count) return nothing;
  const robots =
    count === 1
      ? '1 selected robot awaits approval and is'
      : `${number(count)} selected robots await approval and are`;
  return html`<p class="quiet">${robots} skipped.</p>`;
}

/** A checkbox before its label. */
const choice = (name, value, text, isChecked = false) =>
  html`<label class="choice"><input type="checkbox" name=${name} value=${value}
    ?checked=${isChecked}> ${text}</label>`;

/** The tasks of these robots, each with the number of robots that have it. */
function tasksOf(ids, fleet) {
  const counts = new Map();
  for (const id of ids)
    for (const { task } of fleet.robots.get(id)?.tasks ?? [])
      counts.set(task, (counts.get(task) ?? 0) + 1);
  return [...counts].sort();
}

const VERBS = {
  start: { title: 'Start', noun: 'Start' },
  stop: { title: 'Stop', noun: 'Stop' },
  restart: { title: 'Restart', noun: 'Restart' },
  rollback: { title: 'Roll back', noun: 'Rollback' },
  remove: { title: 'Remove', noun: 'Removal', preposition: 'from', isDangerous: true },
};

/** Asks for tasks, then starts, stops, restarts, rolls back or removes them on these robots. */
export function openTaskDialog(app, verb, ids, only = null) {
  const { title, noun, preposition = 'on', isDangerous } = VERBS[verb];
  const approved = approvedIds(ids, app.fleet);
  const tasks = tasksOf(approved, app.fleet).filter(([task]) => !only || task === only);
  const skipped = ids.size - approved.size;
  const [key, selector] = [newIdempotencyKey(), selectorOf(approved)];
  openDialog({
    title: `${title} ${only ?? 'tasks'} ${preposition} ${robotsText(approved, app.fleet)}`,
    isDangerous,
    submitLabel: tasks.length ? title : null,
    body: () => html`${robotNames(approved, app.fleet)}${skippedNote(skipped)}
      ${
        tasks.length
          ? html`<fieldset><legend>Tasks</legend>${tasks.map(([task, count], index) =>
              choice(
                'task',
                task,
                html`${task} <span class="quiet">on ${plural(count, 'robot')}</span>`,
                index === 0 && tasks.length === 1,
              ),
            )}</fieldset>`
          : html`<p>The selected robots have no tasks.</p>`
      }`,
    async onSubmit({ task = [] }) {
      const selected = [task].flat();
      if (!selected.length) throw new Error('Select a task.');
      const robots = new Set();
      const without = new Set();
      for (const name of selected) {
        const answer = await postIdempotent(
          `/tasks/${name}/${verb}`,
          { selector },
          `${key}-${name}`,
        );
        answer.robots.forEach(({ id }) => robots.add(id));
        answer.without?.forEach(({ id }) => without.add(id));
      }
      const rest = without.size
        ? ` ${plural(without.size, 'robot')} had no earlier package to return to.`
        : '';
      notify(
        `${noun} requested: ${selected.join(', ')} on ${plural(robots.size, 'robot')}.${rest}`,
      );
    },
  });
}

/** Sets and removes labels. */
export function openLabelDialog(app, ids) {
  const approved = approvedIds(ids, app.fleet);
  const skipped = ids.size - approved.size;
  // No field may have the name of a method of the form, such as `remove`: it would hide the method.
  const there = () =>
    [
      ...new Set(
        [...approved].flatMap((id) => Object.keys(app.fleet.robots.get(id)?.labels ?? {})),
      ),
    ].sort();
  openDialog({
    title: `Label ${robotsText(approved, app.fleet)}`,
    submitLabel: approved.size ? 'Label' : null,
    body: () => html`${robotNames(approved, app.fleet)}${skippedNote(skipped)}
      <label for="labels">Labels to set</label>
      <input id="labels" name="labels" placeholder="site=lab, floor=2"
        autocomplete="off" autocapitalize="none" spellcheck="false">
      ${
        there().length
          ? html`<fieldset><legend>Labels to remove</legend>${there().map((label) =>
              choice('taken', label, label),
            )}</fieldset>`
          : nothing
      }`,
    async onSubmit({ labels, taken = [] }) {
      const [set, remove] = [parseLabels(labels), [taken].flat()];
      if (!Object.keys(set).length && !remove.length)
        throw new Error('Enter labels to set or select labels to remove.');
      const { robots } = await post('/bulk/labels', {
        selector: selectorOf(approved),
        set,
        remove,
      });
      notify(`Labels of ${plural(robots.length, 'robot')} updated.`);
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
      if (!value.length) throw new Error(`${pair}: labels have the form name=value`);
      return [label.trim(), value.join('=').trim()];
    });
  return Object.fromEntries(pairs);
}

/**
 * Removes approved robots with one request, and the others one by one, since selectors do not match
 * robots that await approval. Removed ids leave `remaining`.
 */
async function removeAll(remaining, fleet) {
  const approved = approvedIds(remaining, fleet);
  if (approved.size) await post('/bulk/remove', { selector: selectorOf(approved) });
  for (const id of approved) remaining.delete(id);
  for (const id of remaining) {
    await remove(`/robots/${id}`).catch(ifGone);
    remaining.delete(id);
  }
}

/** The server drops robots whose approval takes too long. */
function ifGone(error) {
  if (error.status !== 404) throw error;
}

/** Deletes robots. */
export function openDeleteDialog(app, ids) {
  const [deleted, remaining] = [new Set(ids), new Set(ids)];
  openDialog({
    title: `Delete ${robotsText(deleted, app.fleet)}?`,
    submitLabel: 'Delete',
    isDangerous: true,
    body: () =>
      html`${robotNames(deleted, app.fleet)}<p>Their tokens are revoked. Running tasks keep running,
        but no new tasks start. To bring a robot back, enroll it again.</p>`,
    async onSubmit() {
      await removeAll(remaining, app.fleet);
      notify(`${plural(deleted.size, 'robot')} deleted.`);
    },
  });
}

/**
 * These labels with the changes from `before` to `after`: changes by other users in the meantime
 * are kept.
 */
export function mergeLabels(labels, before, after) {
  const kept = Object.entries(labels).filter(([label]) => !(label in before) || label in after);
  const set = Object.entries(after).filter(([label, value]) => before[label] !== value);
  return Object.fromEntries([...kept, ...set]);
}

/**
 * The request body with the changes of name and labels since `robot` was read, and nothing else.
 */
function changesOf(app, robot, name, labels) {
  const body = {};
  if (name !== robot.name) body.name = name;
  if (labels !== labelsOf(robot).join(', '))
    body.labels = mergeLabels(
      (app.fleet.robots.get(robot.id) ?? robot).labels,
      robot.labels,
      parseLabels(labels),
    );
  return body;
}

/** Edits a robot's name and labels; its other settings have their own tab. */
export function openEditDialog(app, robot) {
  openDialog({
    title: `Edit ${robot.name}`,
    submitLabel: 'Save',
    body: () => html`
      <label for="name">Name</label>
      <input id="name" name="name" required .defaultValue=${robot.name}
        autocomplete="off" autocapitalize="none" spellcheck="false">
      <label for="labels">Labels</label>
      <input id="labels" name="labels" .defaultValue=${labelsOf(robot).join(', ')}
        placeholder="site=lab, floor=2"
        autocomplete="off" autocapitalize="none" spellcheck="false">
      <label for="mac">MAC</label>
      <input id="mac" class="code" readonly .defaultValue=${robot.mac}>
      <p class="quiet"><a href=${`#/robots/${encodeURIComponent(robot.name)}/edit`}
        >Workspace, underlays and limits…</a></p>`,
    async onSubmit({ name, labels }) {
      const body = changesOf(app, robot, name.trim(), labels);
      if (!Object.keys(body).length) return;
      await patch(`/robots/${robot.id}`, body);
      notify(`${name.trim()} updated.`);
    },
  });
}
