// Owns the state of the fleet, and the sorted and filtered list of robots; it draws nothing and
// sends no requests.

import { tone } from './display/format.js';

// Minimum interval between sorts, so that rows do not move constantly.
const SORT_PAUSE_MS = 1_000;

/** The statuses that robots are counted by, each with a symbol. */
export const STATUSES = [
  { id: 'online', title: 'Online', sign: '●' },
  { id: 'offline', title: 'Offline', sign: '○' },
  { id: 'transferring', title: 'Transferring', sign: '↓' },
  { id: 'failed', title: 'Failed', sign: '✕' },
  { id: 'attention', title: 'Needs attention', sign: '▲' },
];

/** The sort keys. */
const KEYS = {
  id: (robot) => robot.id,
  name: (robot) => natural(robot.name),
  address: (robot) => natural(robot.address ?? ''),
  state: (robot) => (robot.online ? 0 : 1),
  seen: (robot) => (robot.online ? -Infinity : -(robot.last_seen_ms ?? 0)),
  task: (robot) =>
    robot.tasks.reduce(
      (least, task) =>
        min(least, `${urgency(task)} ${task.task}@${natural(task.version)} ${task.phase}`),
      '9',
    ),
  labels: (robot) => labelsOf(robot).join(),
  cpu: (robot) => -(robot.vitals?.cpu_percent ?? -1),
  memory: (robot) => -(robot.vitals?.memory_used_bytes ?? -1),
  disk: (robot) => robot.host?.disk_free_bytes ?? Infinity,
  rtt: (robot) => -(robot.link?.rtt_ms ?? -1),
};

const min = (one, other) => (other < one ? other : one);

const naturals = new Map();

/** A sort key in natural order: `arm2` before `arm10`. */
function natural(text) {
  let key = naturals.get(text);
  if (key === undefined) {
    if (naturals.size > 50_000) naturals.clear();
    key = text.toLowerCase().replace(/\d+/g, (digits) => digits.padStart(9, '0'));
    naturals.set(text, key);
  }
  return key;
}

// Tasks that need attention sort first.
const urgency = ({ phase }) => ({ bad: 0, busy: 1, waiting: 2, done: 3, gone: 4 })[tone(phase)];

/** Whether the robot awaits approval: until then it gets no orders. */
export const awaitsApproval = (robot) =>
  Boolean(robot?.conditions.some(({ code }) => code === 'awaits_approval'));

export const labelsOf = ({ labels }) =>
  Object.entries(labels).map(([label, value]) => `${label}=${value}`);

const versionsOf = ({ tasks }) => tasks.map(({ task, version }) => `${task}@${version}`);

/** Search terms with these characters match exactly. */
const EXACT_TERMS = { '=': labelsOf, '@': versionsOf };

/** The statuses that apply to a robot. */
function statusesOf({ online, tasks, conditions }) {
  const isFailed = tasks.some(({ phase }) => tone(phase) === 'bad');
  return {
    online,
    offline: !online,
    transferring: tasks.some(({ phase }) => phase === 'fetching'),
    failed: isFailed,
    attention: isFailed || conditions.length > 0 || tasks.some(({ degraded }) => degraded),
  };
}

export class Fleet {
  robots = new Map();
  /** Newest first: all, or those down to `older`. */
  deployments = [];
  /** The `before` parameter of the next older page; undefined if there are no more. */
  older = undefined;
  /** The ids of the robots to show, sorted and filtered. */
  shown = [];
  /** Number of robots by status. */
  counts = Object.fromEntries(STATUSES.map(({ id }) => [id, 0]));
  /** Number of changes of row heights. */
  heightChanges = 0;
  /** The filter (`text`, `status`) and the order. */
  search = { text: '', status: '', sort: 'name', isDescending: false };
  /** Whether all lists have been loaded once. */
  isLoaded = false;
  #statuses = new Map();
  #texts = new WeakMap();
  #isUnsorted = false;
  #sortedAt = -Infinity;

  robot(idOrName) {
    if (this.robots.has(idOrName)) return this.robots.get(idOrName);
    for (const robot of this.robots.values()) if (robot.name === idOrName) return robot;
    return undefined;
  }

  deployment(id) {
    return this.deployments.find((deployment) => deployment.id === id);
  }

  /** Adds or replaces robots. */
  add(robots) {
    for (const robot of robots) this.#replaceRobot(robot.id, robot);
  }

  /** Drops all robots but these. */
  retain(ids) {
    for (const id of this.robots.keys()) if (!ids.has(id)) this.#replaceRobot(id, null);
  }

  /** Applies an event. Returns whether the lists have to be fetched again. */
  apply(event) {
    switch (event.type) {
      case 'robot':
        this.#replaceRobot(event.robot.id, event.robot);
        return false;
      case 'robot_removed':
        this.#replaceRobot(event.id, null);
        return false;
      case 'deployment':
        this.#replaceDeployment(event.deployment);
        return false;
      default:
        return event.type === 'missed';
    }
  }

  #replaceRobot(id, robot) {
    const old = this.robots.get(id);
    const before = this.#statuses.get(id);
    const after = robot && statusesOf(robot);
    for (const name of Object.keys(this.counts))
      this.counts[name] += Boolean(after?.[name]) - Boolean(before?.[name]);
    if (robot) {
      this.robots.set(id, robot);
      this.#statuses.set(id, after);
    } else {
      this.robots.delete(id);
      this.#statuses.delete(id);
    }
    if (old?.tasks.length !== robot?.tasks.length) this.heightChanges += 1;
    // Most events leave a robot at its position, and sorting ten thousand takes a while.
    const { text, status, sort } = this.search;
    const key = KEYS[sort];
    const isInPlace =
      old &&
      robot &&
      !text &&
      old.name === robot.name &&
      key(old) === key(robot) &&
      (!status || before[status] === after[status]);
    if (!isInPlace) this.#isUnsorted = true;
  }

  /** Replaces the newest deployments and keeps older pages that were loaded. */
  setDeployments({ deployments, next }) {
    const kept = next
      ? this.deployments.slice(this.deployments.findIndex(({ id }) => id === next) + 1 || Infinity)
      : [];
    if (!kept.length) this.older = next;
    this.deployments = [...deployments, ...kept];
  }

  /** Appends a page of older deployments. */
  addOlder({ deployments, next }) {
    this.deployments = [
      ...this.deployments,
      ...deployments.filter(({ id }) => !this.deployment(id)),
    ];
    this.older = next;
  }

  #replaceDeployment(deployment) {
    const at = this.deployments.findIndex(({ id }) => id === deployment.id);
    if (at >= 0) return void (this.deployments[at] = deployment);
    const before = this.deployments.findIndex(
      ({ created_at_ms: created }) => created <= deployment.created_at_ms,
    );
    if (before >= 0) this.deployments.splice(before, 0, deployment);
    else if (!this.older) this.deployments.push(deployment);
  }

  /** Changes the filter or the order. */
  setSearch(search) {
    this.search = { ...this.search, ...search };
    if (!KEYS[this.search.sort]) this.search.sort = 'name';
    if (!(this.search.status in this.counts)) this.search.status = '';
    this.sort();
  }

  /** Sorts if robots have moved and the last sort was long enough ago. */
  sortIfDue(now) {
    if (this.#isUnsorted && now - this.#sortedAt >= SORT_PAUSE_MS) this.sort(now);
  }

  sort(now = performance.now()) {
    const { text, status, sort, isDescending } = this.search;
    const matchers = text
      .toLowerCase()
      .split(/\s+/)
      .filter(Boolean)
      .map((word) => this.#matcherOf(word));
    const rows = [];
    for (const robot of this.robots.values()) {
      if (status && !this.#statuses.get(robot.id)[status]) continue;
      if (!matchers.every((matches) => matches(robot))) continue;
      rows.push({ id: robot.id, key: KEYS[sort](robot), name: KEYS.name(robot) });
    }
    const sign = isDescending ? -1 : 1;
    rows.sort((one, other) => sign * compare(one.key, other.key) || compare(one.name, other.name));
    this.shown = rows.map(({ id }) => id);
    this.#isUnsorted = false;
    this.#sortedAt = now;
  }

  /**
   * Returns a predicate for a search term. `key=value` and `name@version` match a label or a
   * version exactly if such labels or tasks exist; other terms match anywhere in the text of a
   * robot.
   */
  #matcherOf(word) {
    for (const [sign, namesOf] of Object.entries(EXACT_TERMS)) {
      const [name, value] = word.split(sign, 2);
      const isName = (robot) =>
        namesOf(robot).some((one) => one.toLowerCase().startsWith(`${name}${sign}`));
      if (name && value && [...this.robots.values()].some(isName))
        return (robot) => namesOf(robot).some((one) => one.toLowerCase() === word);
    }
    return (robot) => this.#textOf(robot).includes(word);
  }

  /** The text of a robot, computed once. */
  #textOf(robot) {
    let text = this.#texts.get(robot);
    if (text === undefined) {
      text = textOf(robot);
      this.#texts.set(robot, text);
    }
    return text;
  }
}

const compare = (one, other) => (one < other ? -1 : one > other ? 1 : 0);

function textOf(robot) {
  const tasks = robot.tasks.map(({ phase, deployment, failure }) => [
    phase,
    deployment,
    failure?.code,
    failure?.text,
  ]);
  const conditions = robot.conditions.flatMap(({ code, text }) => [code, text]);
  const state = robot.online ? 'online' : 'offline';
  const { agent_version: agent, arch, ros_distros: distros = [] } = robot.host ?? {};
  return [
    robot.id,
    robot.name,
    robot.mac,
    robot.address,
    state,
    agent,
    arch,
    distros,
    labelsOf(robot),
    versionsOf(robot),
    tasks,
    conditions,
  ]
    .flat(2)
    .join('\n')
    .toLowerCase();
}

/** The selected robots. */
export class Selection {
  ids = new Set();
  /** Start of a range selection. */
  #anchor = null;

  has(id) {
    return this.ids.has(id);
  }

  get size() {
    return this.ids.size;
  }

  /**
   * Toggles a robot; with `isRange`, selects all shown robots between the previous one and this
   * one.
   */
  toggle(id, shown, isRange = false) {
    const [from, to] = [shown.indexOf(this.#anchor), shown.indexOf(id)].sort(
      (one, other) => one - other,
    );
    if (isRange && from >= 0) shown.slice(from, to + 1).forEach((one) => this.ids.add(one));
    else if (!this.ids.delete(id)) this.ids.add(id);
    this.#anchor = id;
  }

  /** Selects these robots, or deselects them if all are selected. */
  toggleAll(ids) {
    const isAll = ids.every((id) => this.ids.has(id));
    for (const id of ids) isAll ? this.ids.delete(id) : this.ids.add(id);
  }

  clear() {
    this.ids.clear();
  }

  /** Deselects robots that no longer exist. */
  retain(robots) {
    for (const id of this.ids) if (!robots.has(id)) this.ids.delete(id);
  }
}

/** A selector that lists the ids: a label would also match robots that were never shown. */
export const selectorOf = (ids) => [...ids].join(',');
