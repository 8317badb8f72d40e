// The robots that run each version of a package, and those that are assigned it, from the state of
// the fleet.

// Minimum interval between counts, which visit all robots.
const COUNT_PAUSE_MS = 1_000;

/**
 * The name of each version in addresses: the version, or the digest if a newer package has the same
 * version.
 */
export function versionNames(versions) {
  const seen = new Set();
  return new Map(
    versions.map((one) => {
      const { name, version, manifest } = one.package;
      const isFirst = !seen.has(`${name}@${version}`);
      seen.add(`${name}@${version}`);
      return [one, isFirst ? version : manifest.digest];
    }),
  );
}

const byName = (one, other) => (one.name < other.name ? -1 : 1);

export class PackageUsage {
  #fleet;
  #robots = new Map();
  #countedAt = -Infinity;

  constructor(fleet) {
    this.#fleet = fleet;
  }

  /**
   * The robots that run this package, sorted by name. Several packages may have the same version;
   * older agents report only the version.
   */
  robotsRunning({ name, version, manifest }) {
    this.#count();
    const [sure, likely] = [manifest.digest, `${name}@${version}`].map(
      (key) => this.#robots.get(key) ?? [],
    );
    return likely.length ? [...sure, ...likely].sort(byName) : sure;
  }

  /**
   * The robots that are assigned this package, sorted by name. If several packages have the same
   * version, only the deployment tells them apart: robots whose deployment is not loaded count only
   * if the package `isOnly` one.
   */
  robotsAssigned({ name, version, manifest }, isOnly) {
    const isAssigned = ({ task, version: assigned, deployment }) => {
      const known = this.#fleet.deployment(deployment)?.package.manifest.digest;
      return task === name && assigned === version && (known ? known === manifest.digest : isOnly);
    };
    return [...this.#fleet.robots.values()]
      .filter(({ tasks }) => tasks.some(isAssigned))
      .sort(byName);
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
