// What is known of the fleet, and which robots are shown in which order. It draws nothing and asks nobody.

const collator = new Intl.Collator('en', { numeric: true });
// While data streams, rows change places at most this often: a table that dances can't be read.
const ORDER_PAUSE_MS = 1_000;

/** The columns robots can be sorted by, each with the key a robot sorts under. */
export const COLUMNS = [
  { id: 'id', title: 'ID', key: (robot) => robot.id },
  { id: 'name', title: 'Name', key: (robot) => robot.name },
  { id: 'address', title: 'IP and port', key: (robot) => robot.address ?? '' },
  { id: 'state', title: 'State', key: (robot) => (robot.online ? 0 : 1) },
  { id: 'seen', title: 'Last seen', key: (robot) => (robot.online ? -Infinity : -(robot.last_seen_ms ?? 0)) },
  { id: 'task', title: 'Task', key: (robot) => robot.tasks.map((task) => `${urgency(task)} ${task.task}@${task.version} ${task.phase}`).sort()[0] ?? '9' },
];

// Sorted by task, what needs a look comes first.
const urgency = (task) => ({ failed: 0, rolled_back: 0, unmet: 0, expired: 0, running: 2, succeeded: 2 })[task.phase] ?? 1;

export class Fleet {
  robots = new Map();
  deployments = [];
  /** The robots to show, sorted and filtered. */
  shown = [];
  online = 0;
  filter = '';
  sort = { column: 'name', isDescending: false };
  isLoaded = false;
  #isUnordered = false;
  #orderedAt = 0;

  load({ robots, deployments }) {
    this.robots = new Map(robots.map((robot) => [robot.id, robot]));
    this.deployments = deployments;
    this.isLoaded = true;
    this.order();
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
      case 'package':
        // Packages are shown only until something is deployed.
        return !this.deployments.length;
      case 'missed':
        return true;
      default:
        return false;
    }
  }

  #replaceRobot(id, robot) {
    const old = this.robots.get(id);
    if (robot) this.robots.set(id, robot);
    else this.robots.delete(id);
    this.online += Boolean(robot?.online) - Boolean(old?.online);
    // Most news leave a robot where it is, and ten thousand names take a while to sort.
    const isInPlace = old && robot && !this.filter && old.name === robot.name && this.#key(old) === this.#key(robot);
    if (!isInPlace) this.#isUnordered = true;
  }

  #key(robot) {
    return COLUMNS.find(({ id }) => id === this.sort.column).key(robot);
  }

  #replaceDeployment(deployment) {
    const at = this.deployments.findIndex(({ id }) => id === deployment.id);
    if (at >= 0) this.deployments[at] = deployment;
    else this.deployments.unshift(deployment);
  }

  deployment(id) {
    return this.deployments.find((deployment) => deployment.id === id);
  }

  sortBy(column) {
    this.sort = { column, isDescending: this.sort.column === column && !this.sort.isDescending };
    this.order();
  }

  filterBy(text) {
    this.filter = text;
    this.order();
  }

  /** Puts the rows in order again, if they are not and were left in peace for long enough. */
  settle(now) {
    if (this.#isUnordered && now - this.#orderedAt >= ORDER_PAUSE_MS) this.order(now);
  }

  order(now = performance.now()) {
    const words = this.filter.toLowerCase().split(/\s+/).filter(Boolean);
    const rows = [];
    this.online = 0;
    for (const robot of this.robots.values()) {
      if (robot.online) this.online += 1;
      if (words.length && !matches(robot, words)) continue;
      rows.push({ id: robot.id, key: this.#key(robot), name: robot.name });
    }
    const sign = this.sort.isDescending ? -1 : 1;
    rows.sort((a, b) => sign * compare(a.key, b.key) || compare(a.name, b.name));
    this.shown = rows.map(({ id }) => id);
    this.#isUnordered = false;
    this.#orderedAt = now;
  }
}

const compare = (a, b) => (typeof a === 'number' ? a - b || 0 : collator.compare(a, b));

/** Whether each word occurs in what the row shows, or in the robot's labels. */
function matches(robot, words) {
  const tasks = robot.tasks.map((task) => [`${task.task}@${task.version}`, task.phase, task.deployment, task.failure?.code, task.failure?.text]);
  const labels = Object.entries(robot.labels).map(([label, value]) => `${label}=${value}`);
  const conditions = robot.conditions.flatMap(({ code, text }) => [code, text]);
  const state = robot.online ? 'online' : 'offline';
  const text = [robot.id, robot.name, robot.mac, robot.address, state, labels, tasks, conditions].flat(2).join('\n').toLowerCase();
  return words.every((word) => text.includes(word));
}
