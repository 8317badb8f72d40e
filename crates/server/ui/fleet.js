// What is known of the fleet, and which robots are shown in which order. It draws nothing and asks
// nobody.

import { tone } from './format.js';

// While data streams, rows change places at most this often: a table that dances can't be read.
const ORDER_PAUSE_MS = 1_000;

/** What a robot can be counted under, each with the sign it has in words and shapes. */
export const STANDINGS = [
  { id: 'online', title: 'Online', sign: '●' },
  { id: 'offline', title: 'Offline', sign: '○' },
  { id: 'transferring', title: 'Transferring', sign: '↓' },
  { id: 'failed', title: 'Failed', sign: '✕' },
  { id: 'attention', title: 'Needs attention', sign: '▲' },
];

/** The keys robots can be sorted by. Numbers and texts compare as they are. */
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

/** A text whose order is that of its words and numbers: `arm2` before `arm10`. */
function natural(text) {
  let key = naturals.get(text);
  if (key === undefined) {
    if (naturals.size > 50_000) naturals.clear();
    key = text.toLowerCase().replace(/\d+/g, (digits) => digits.padStart(9, '0'));
    naturals.set(text, key);
  }
  return key;
}

// Sorted by task, what needs a look comes first.
const urgency = ({ phase }) => ({ bad: 0, busy: 1, waiting: 2, done: 3, gone: 4 })[tone(phase)];

/** Whether it has yet to be approved: until then it gets nothing of what is ordered. */
export const isWaiting = (robot) =>
  Boolean(robot?.conditions.some(({ code }) => code === 'awaits_approval'));

export const labelsOf = ({ labels }) =>
  Object.entries(labels).map(([label, value]) => `${label}=${value}`);

const versionsOf = ({ tasks }) => tasks.map(({ task, version }) => `${task}@${version}`);

/** What is meant exactly where it is written whole, by the sign in it. */
const NAMED = { '=': labelsOf, '@': versionsOf };

/** Under what a robot is counted. */
function standingsOf({ online, tasks, conditions }) {
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
  /** The newest first: all, or those down to `older`. */
  deployments = [];
  /** What `before` is for the deployments that come after these; absent: there are no more. */
  older = undefined;
  /** The ids of the robots to show, sorted and filtered. */
  shown = [];
  /** How many robots there are of each standing. */
  counts = Object.fromEntries(STANDINGS.map(({ id }) => [id, 0]));
  /** How often a robot came to need more lines or fewer. */
  reflows = 0;
  /** What is shown: `text` that has to occur, a `standing`, and the order. */
  search = { text: '', standing: '', sort: 'name', isDescending: false };
  /** Every list was there once. */
  isLoaded = false;
  #standings = new Map();
  #texts = new WeakMap();
  #isUnordered = false;
  #orderedAt = -Infinity;

  robot(idOrName) {
    if (this.robots.has(idOrName)) return this.robots.get(idOrName);
    for (const robot of this.robots.values()) if (robot.name === idOrName) return robot;
    return undefined;
  }

  deployment(id) {
    return this.deployments.find((deployment) => deployment.id === id);
  }

  /** Takes robots in, as they are now. */
  add(robots) {
    for (const robot of robots) this.#replaceRobot(robot.id, robot);
  }

  /** Forgets all robots but these. */
  keep(ids) {
    for (const id of this.robots.keys()) if (!ids.has(id)) this.#replaceRobot(id, null);
  }

  /** Takes one event in. Answers whether the lists have to be fetched again. */
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
    const before = this.#standings.get(id);
    const after = robot && standingsOf(robot);
    for (const name of Object.keys(this.counts))
      this.counts[name] += Boolean(after?.[name]) - Boolean(before?.[name]);
    if (robot) {
      this.robots.set(id, robot);
      this.#standings.set(id, after);
    } else {
      this.robots.delete(id);
      this.#standings.delete(id);
    }
    if (old?.tasks.length !== robot?.tasks.length) this.reflows += 1;
    // Most news leave a robot where it is, and ten thousand take a while to sort.
    const { text, standing, sort } = this.search;
    const key = KEYS[sort];
    const isInPlace =
      old &&
      robot &&
      !text &&
      old.name === robot.name &&
      key(old) === key(robot) &&
      (!standing || before[standing] === after[standing]);
    if (!isInPlace) this.#isUnordered = true;
  }

  /**
   * Takes in the newest deployments, as the server lists them. Older ones that were asked for stay.
   */
  renew({ deployments, next }) {
    const kept = next
      ? this.deployments.slice(this.deployments.findIndex(({ id }) => id === next) + 1 || Infinity)
      : [];
    if (!kept.length) this.older = next;
    this.deployments = [...deployments, ...kept];
  }

  /** Takes in deployments that are older than all that are here. */
  extend({ deployments, next }) {
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

  /** Shows what `search` says from now on. */
  look(search) {
    this.search = { ...this.search, ...search };
    if (!KEYS[this.search.sort]) this.search.sort = 'name';
    if (!(this.search.standing in this.counts)) this.search.standing = '';
    this.order();
  }

  /** Puts the rows in order again, if they are not and were left in peace for long enough. */
  settle(now) {
    if (this.#isUnordered && now - this.#orderedAt >= ORDER_PAUSE_MS) this.order(now);
  }

  order(now = performance.now()) {
    const { text, standing, sort, isDescending } = this.search;
    const tests = text
      .toLowerCase()
      .split(/\s+/)
      .filter(Boolean)
      .map((word) => this.#testOf(word));
    const rows = [];
    for (const robot of this.robots.values()) {
      if (standing && !this.#standings.get(robot.id)[standing]) continue;
      if (!tests.every((isLike) => isLike(robot))) continue;
      rows.push({ id: robot.id, key: KEYS[sort](robot), name: KEYS.name(robot) });
    }
    const sign = isDescending ? -1 : 1;
    rows.sort((one, other) => sign * compare(one.key, other.key) || compare(one.name, other.name));
    this.shown = rows.map(({ id }) => id);
    this.#isUnordered = false;
    this.#orderedAt = now;
  }

  /**
   * Whether a robot is found by this word. `key=value` means that label and no longer one,
   * `name@version` that version, where there are such labels and tasks; all else may occur anywhere
   * in what a robot is known by.
   */
  #testOf(word) {
    for (const [sign, namesOf] of Object.entries(NAMED)) {
      const [name, value] = word.split(sign, 2);
      const isName = (robot) =>
        namesOf(robot).some((one) => one.toLowerCase().startsWith(`${name}${sign}`));
      if (name && value && [...this.robots.values()].some(isName))
        return (robot) => namesOf(robot).some((one) => one.toLowerCase() === word);
    }
    return (robot) => this.#textOf(robot).includes(word);
  }

  /** A robot's text is made once. */
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

/** Robots that a person has chosen, and how an order names them. */
export class Selection {
  ids = new Set();
  /** Where a range begins. */
  #anchor = null;

  has(id) {
    return this.ids.has(id);
  }

  get size() {
    return this.ids.size;
  }

  /** Chooses one robot or lets it go; with `isRange` all that are shown between it and the last. */
  toggle(id, shown, isRange = false) {
    const [from, to] = [shown.indexOf(this.#anchor), shown.indexOf(id)].sort(
      (one, other) => one - other,
    );
    if (isRange && from >= 0) shown.slice(from, to + 1).forEach((one) => this.ids.add(one));
    else if (!this.ids.delete(id)) this.ids.add(id);
    this.#anchor = id;
  }

  /** Chooses all of these, or none of them if all are chosen already. */
  toggleAll(ids) {
    const isAll = ids.every((id) => this.ids.has(id));
    for (const id of ids) isAll ? this.ids.delete(id) : this.ids.add(id);
  }

  clear() {
    this.ids.clear();
  }

  /** Lets go whoever is no longer there. */
  keep(robots) {
    for (const id of this.ids) if (!robots.has(id)) this.ids.delete(id);
  }
}

/**
 * A selector that names each of them: by what they have in common it would also mean robots that
 * were never shown.
 */
export const idsOf = (ids) => [...ids].join(',');
