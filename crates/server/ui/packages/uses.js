// Which robots run which version of a package, and which should, as the stream says.

// Counting goes over all robots: not more often than somebody could read it.
const COUNT_PAUSE_MS = 1_000;

/**
 * By which word each of these versions is meant: its number, or its digest where a newer one has
 * the same.
 */
export function namesOf(versions) {
  const taken = new Set();
  return new Map(
    versions.map((one) => {
      const { name, version, manifest } = one.package;
      const isFirst = !taken.has(`${name}@${version}`);
      taken.add(`${name}@${version}`);
      return [one, isFirst ? version : manifest.digest];
    }),
  );
}

const byName = (one, other) => (one.name < other.name ? -1 : 1);

export class Uses {
  #fleet;
  #robots = new Map();
  #countedAt = -Infinity;

  constructor(fleet) {
    this.#fleet = fleet;
  }

  /**
   * The robots on which a process of this version lives, sorted by name. Several may have the same
   * number; older agents say no more.
   */
  of({ name, version, manifest }) {
    this.#count();
    const [sure, likely] = [manifest.digest, `${name}@${version}`].map(
      (key) => this.#robots.get(key) ?? [],
    );
    return likely.length ? [...sure, ...likely].sort(byName) : sure;
  }

  /**
   * The robots that should have this version, sorted by name. Of several packages with the same
   * number only the order says which one is meant: robots whose order is not known here are left
   * out then, unless it `isOnly` one.
   */
  wanting({ name, version, manifest }, isOnly) {
    const isMeant = ({ task, version: wanted, deployment }) => {
      const known = this.#fleet.deployment(deployment)?.package.manifest.digest;
      return task === name && wanted === version && (known ? known === manifest.digest : isOnly);
    };
    return [...this.#fleet.robots.values()].filter(({ tasks }) => tasks.some(isMeant)).sort(byName);
  }

  #count() {
    const now = performance.now();
    if (now - this.#countedAt < COUNT_PAUSE_MS) return;
    this.#countedAt = now;
    this.#robots = new Map();
    for (const robot of this.#fleet.robots.values()) {
      for (const { task, active } of robot.tasks) {
        if (!active) continue;
        const key = active.manifest ?? `${task}@${active.version}`;
        const others = this.#robots.get(key);
        if (others) others.push(robot);
        else this.#robots.set(key, [robot]);
      }
    }
    for (const robots of this.#robots.values()) robots.sort(byName);
  }
}
