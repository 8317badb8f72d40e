// The assignments of a deployment, as the server listed them and as events have updated them since.

import { tone } from '../display/format.js';

// The throughput is measured over this window.
const WINDOW_MS = 10_000;
const SLICE_MS = 1_000;
const SUMMARY_PAUSE_MS = 250;
// As on the server, which keeps no longer timelines.
const MAX_TIMELINE = 64;
const SERVER_ENDED = ['superseded', 'cancelled', 'expired'];
const BEFORE_FETCHING = new Set(['assigned', 'deferred']);

/** Phases in which an assignment stays, whatever happens to the task later. */
const FINAL_PHASES = new Set(['succeeded', 'failed', 'unmet', 'expired', 'rolled_back']);

export class Assignments {
  /** By robot id, sorted by name. */
  all = new Map();
  #slices = [];
  #summary = null;
  /**
   * For robots whose assignment failed: the deployment of the same task that replaced it and for
   * which the server was asked.
   */
  #otherDeployments = new Map();
  #task;
  #kind;
  /** Size of the content that each robot fetches. */
  size = 0;

  /** Replaces the assignments by the server's list. */
  load({ assignments, kind, package: { name, content } }) {
    this.#task = name;
    this.#kind = kind;
    this.size = content.size;
    this.#summary = null;
    this.all = new Map(
      assignments.map((assignment) => [
        assignment.robot,
        { ...assignment, timeline: this.#timelineOf(assignment) },
      ]),
    );
  }

  /** The server's timeline, or the phases seen here if the server keeps none. */
  #timelineOf({ robot, phase, timeline, updated_at_ms: at_ms }) {
    const seen = this.all.get(robot)?.timeline ?? [];
    if (timeline) return timeline;
    return seen.at(-1)?.phase === phase ? seen : [...seen, { phase, at_ms, attempt: 0 }];
  }

  /**
   * Updates the assignment from the robot's state. Returns whether the server has to be asked,
   * because the assignment has changed and the event does not say how.
   */
  update(robot, deployment, now) {
    const assignment = this.all.get(robot.id);
    if (!assignment) return robot.tasks.some((task) => task.deployment === deployment);
    assignment.online = robot.online;
    const task = robot.tasks.find((one) => one.deployment === deployment);
    if (!task && canRetry(assignment)) return this.#hasNewDeployment(robot);
    // Before its batch starts, the robot does not know the deployment.
    if (!task)
      return (
        assignment.released &&
        !FINAL_PHASES.has(assignment.phase) &&
        tone(assignment.phase) !== 'gone' &&
        !assignment.superseded_by
      );
    const before = this.bytesOf(assignment);
    const wasFetching = assignment.phase === 'fetching';
    const isNew = assignment.phase !== task.phase;
    Object.assign(assignment, {
      released: true,
      phase: task.phase,
      progress: task.progress,
      failure: task.failure,
      degraded: task.degraded,
      delivery: task.delivery ?? assignment.delivery,
    });
    if (isNew) {
      assignment.updated_at_ms = now;
      assignment.timeline = [
        ...assignment.timeline,
        { phase: task.phase, at_ms: now, attempt: 0 },
      ].slice(-MAX_TIMELINE);
    }
    if (wasFetching || task.phase === 'fetching')
      this.#count(this.bytesOf(assignment) - before, now);
    return false;
  }

  /**
   * Whether the robot now has the task from a different deployment: a newer one may have superseded
   * this one.
   */
  #hasNewDeployment({ id, tasks }) {
    const other = tasks.find(({ task }) => task === this.#task)?.deployment;
    const isNew = other !== undefined && this.#otherDeployments.get(id) !== other;
    if (isNew) this.#otherDeployments.set(id, other);
    return isNew;
  }

  /** Drops a deleted robot. */
  remove(id) {
    this.all.delete(id);
  }

  #count(bytes, now) {
    if (bytes <= 0) return;
    const slice = this.#slices.at(-1);
    if (slice && now - slice.at < SLICE_MS) slice.bytes += bytes;
    else this.#slices.push({ at: now, bytes });
  }

  /** Bytes per second over the window. */
  throughput(now) {
    this.#slices = this.#slices.filter(({ at }) => now - at < WINDOW_MS);
    const bytes = this.#slices.reduce((sum, slice) => sum + slice.bytes, 0);
    const since = Math.max(SLICE_MS, now - (this.#slices[0]?.at ?? now));
    return (bytes * 1000) / since;
  }

  /** The number of content bytes that a robot has. */
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
   * Whether the server counts other numbers of superseded, cancelled or expired assignments than
   * known here: events do not report those.
   */
  isBehind(counts, at) {
    const { phases } = this.summary(at);
    const counted = counts.reduce((sum, { count }) => sum + count, 0);
    return (
      this.all.size !== counted ||
      SERVER_ENDED.some(
        (phase) =>
          (phases.get(phase) ?? 0) !== (counts.find((one) => one.phase === phase)?.count ?? 0),
      )
    );
  }

  /**
   * Totals over all assignments. Ten thousand take a while to sum, so a recent result is reused.
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
      mechanisms: new Map(),
      done: 0,
      total: 0,
      awaitedBytes: 0,
      busy: [],
      offline: [],
      retryable: new Set(),
      newer: new Set(),
    };
    for (const assignment of this.all.values()) {
      const { phase, online, released, delivery } = assignment;
      sum.phases.set(phase, (sum.phases.get(phase) ?? 0) + 1);
      if (tone(phase) !== 'bad' && tone(phase) !== 'gone') {
        const bytes = this.bytesOf(assignment);
        sum.done += bytes;
        sum.total += this.size;
        // Offline robots do not fetch, so there is no estimate for them.
        if (online && released) sum.awaitedBytes += this.size - bytes;
        if (!isSettled(phase, this.#kind)) {
          if (!online) sum.offline.push(assignment);
          else if (released) sum.busy.push(assignment);
        }
      }
      if (delivery) gather(sum.mechanisms, `${delivery.mechanism} ${delivery.rule}`, assignment);
      const reason = reasonOf(assignment);
      if (reason) gather(sum.reasons, reason, assignment);
      if (canRetry(assignment)) sum.retryable.add(assignment.robot);
      if (assignment.superseded_by) sum.newer.add(assignment.superseded_by);
    }
    return sum;
  }
}

function gather(groups, key, assignment) {
  const group = groups.get(key);
  if (group) group.push(assignment);
  else groups.set(key, [assignment]);
}

/** The group of a failed assignment: the failure code, or else the phase. */
export const reasonOf = ({ phase, failure }) =>
  tone(phase) === 'bad' ? (failure?.code ?? phase) : null;

/** Whether no further progress is expected: it has ended, or a service runs. */
const isSettled = (phase, kind) =>
  FINAL_PHASES.has(phase) ||
  phase === 'stopped' ||
  SERVER_ENDED.includes(phase) ||
  (phase === 'running' && kind === 'service');

/**
 * Whether the robot can be retried: it failed or was cancelled, and no newer deployment supersedes
 * it.
 */
export const canRetry = ({ phase, superseded_by: newer }) =>
  !newer && (tone(phase) === 'bad' || phase === 'cancelled');
