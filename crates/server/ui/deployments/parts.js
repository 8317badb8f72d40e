// A deployment's robots as they stand: what the server listed, kept up to date by what the stream
// says of each robot.

import { tone } from '../format.js';

// A throughput is that of the last moments; older ones say nothing of now.
const WINDOW_MS = 10_000;
const SLICE_MS = 1_000;
const SUMMARY_PAUSE_MS = 250;
// As on the server: more of a timeline is not kept.
const MAX_TIMELINE = 64;
const ENDED_BY_ORDER = ['superseded', 'cancelled', 'expired'];
const BEFORE_FETCHING = new Set(['assigned', 'deferred']);

/** Where a part stays, whatever becomes of the robot's task. */
const ENDS = new Set(['succeeded', 'failed', 'unmet', 'expired', 'rolled_back']);

export class Parts {
  /** By the robot's id, sorted by name. */
  all = new Map();
  #slices = [];
  #summary = null;
  /**
   * Of robots whose part ended badly: which other deployment of the same task they have, and the
   * server was asked about.
   */
  #others = new Map();
  #task;
  #kind;
  /** Bytes that each robot has to fetch. */
  size = 0;

  /** Takes in what the server lists. */
  renew({ assignments, kind, package: { name, content } }) {
    this.#task = name;
    this.#kind = kind;
    this.size = content.size;
    this.#summary = null;
    this.all = new Map(
      assignments.map((part) => [part.robot, { ...part, timeline: this.#longer(part) }]),
    );
  }

  /** The server's timeline, or what was seen here, where the server keeps none. */
  #longer({ robot, phase, timeline, updated_at_ms: at_ms }) {
    const seen = this.all.get(robot)?.timeline ?? [];
    if (timeline) return timeline;
    return seen.at(-1)?.phase === phase ? seen : [...seen, { phase, at_ms, attempt: 0 }];
  }

  /**
   * Takes in a robot as it is now. Answers whether the server has to be asked: its part has gone on
   * without a word of how.
   */
  hear(robot, deployment, now) {
    const part = this.all.get(robot.id);
    if (!part) return robot.tasks.some((task) => task.deployment === deployment);
    part.online = robot.online;
    const task = robot.tasks.find((one) => one.deployment === deployment);
    if (!task && canRetry(part)) return this.#isOther(robot);
    // Before its batch begins, the robot knows nothing of it.
    if (!task)
      return (
        part.released && !ENDS.has(part.phase) && tone(part.phase) !== 'gone' && !part.superseded_by
      );
    const before = this.bytesOf(part);
    const wasFetching = part.phase === 'fetching';
    const isNew = part.phase !== task.phase;
    Object.assign(part, {
      released: true,
      phase: task.phase,
      progress: task.progress,
      failure: task.failure,
      degraded: task.degraded,
      delivery: task.delivery ?? part.delivery,
    });
    if (isNew) {
      part.updated_at_ms = now;
      part.timeline = [...part.timeline, { phase: task.phase, at_ms: now, attempt: 0 }].slice(
        -MAX_TIMELINE,
      );
    }
    if (wasFetching || task.phase === 'fetching') this.#count(this.bytesOf(part) - before, now);
    return false;
  }

  /**
   * Whether it has the task from another deployment than before: a newer order may have taken the
   * place of this one.
   */
  #isOther({ id, tasks }) {
    const other = tasks.find(({ task }) => task === this.#task)?.deployment;
    const isNew = other !== undefined && this.#others.get(id) !== other;
    if (isNew) this.#others.set(id, other);
    return isNew;
  }

  /** Forgets a robot that was removed. */
  remove(id) {
    this.all.delete(id);
  }

  #count(bytes, now) {
    if (bytes <= 0) return;
    const slice = this.#slices.at(-1);
    if (slice && now - slice.at < SLICE_MS) slice.bytes += bytes;
    else this.#slices.push({ at: now, bytes });
  }

  /** Bytes that came in a second, over the last moments. */
  throughput(now) {
    this.#slices = this.#slices.filter(({ at }) => now - at < WINDOW_MS);
    const bytes = this.#slices.reduce((sum, slice) => sum + slice.bytes, 0);
    const since = Math.max(SLICE_MS, now - (this.#slices[0]?.at ?? now));
    return (bytes * 1000) / since;
  }

  /** How much of the content a robot has. */
  bytesOf({ phase, progress }) {
    if (BEFORE_FETCHING.has(phase)) return 0;
    if (phase === 'fetching')
      return Math.min(
        this.size,
        progress?.total ? (progress.done * this.size) / progress.total : 0,
      );
    return this.size;
  }

  /**
   * Whether the server counts others as ended by an order than are known here: of those the stream
   * does not tell.
   */
  isBehind(counts, at) {
    const { phases } = this.summary(at);
    const counted = counts.reduce((sum, { count }) => sum + count, 0);
    return (
      this.all.size !== counted ||
      ENDED_BY_ORDER.some(
        (phase) =>
          (phases.get(phase) ?? 0) !== (counts.find((one) => one.phase === phase)?.count ?? 0),
      )
    );
  }

  /**
   * All that is said of them together. Going over ten thousand takes a while, so that of a moment
   * ago will do.
   */
  summary(at) {
    if (!this.#summary || at - this.#summary.at >= SUMMARY_PAUSE_MS)
      this.#summary = { at, ...this.#sum() };
    return this.#summary;
  }

  #sum() {
    const sum = {
      phases: new Map(),
      reasons: new Map(),
      ways: new Map(),
      done: 0,
      total: 0,
      awaited: 0,
      busy: [],
      offline: [],
      retried: new Set(),
      newer: new Set(),
    };
    for (const part of this.all.values()) {
      const { phase, online, released, delivery } = part;
      sum.phases.set(phase, (sum.phases.get(phase) ?? 0) + 1);
      if (tone(phase) !== 'bad' && tone(phase) !== 'gone') {
        const bytes = this.bytesOf(part);
        sum.done += bytes;
        sum.total += this.size;
        // Who is away does not fetch: no time can be told for them.
        if (online && released) sum.awaited += this.size - bytes;
        if (!isSettled(phase, this.#kind)) {
          if (!online) sum.offline.push(part);
          else if (released) sum.busy.push(part);
        }
      }
      if (delivery) gather(sum.ways, `${delivery.mechanism} ${delivery.rule}`, part);
      const reason = reasonOf(part);
      if (reason) gather(sum.reasons, reason, part);
      if (canRetry(part)) sum.retried.add(part.robot);
      if (part.superseded_by) sum.newer.add(part.superseded_by);
    }
    return sum;
  }
}

function gather(groups, key, part) {
  const group = groups.get(key);
  if (group) group.push(part);
  else groups.set(key, [part]);
}

/** What parts that ended badly are grouped by: the failure's code, or how they ended. */
export const reasonOf = ({ phase, failure }) =>
  tone(phase) === 'bad' ? (failure?.code ?? phase) : null;

/** Whether nothing more is waited for there: it has ended, or a service runs. */
const isSettled = (phase, kind) =>
  ENDS.has(phase) ||
  phase === 'stopped' ||
  ENDED_BY_ORDER.includes(phase) ||
  (phase === 'running' && kind === 'service');

/** Whether it may be ordered again: it ended badly and nothing newer took its place. */
export const canRetry = ({ phase, superseded_by: newer }) =>
  !newer && (tone(phase) === 'bad' || phase === 'cancelled');
