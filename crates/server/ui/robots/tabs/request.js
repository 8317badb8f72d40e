// A query to a robot: its last answer with the age, or the reason for none.

import { html, nothing } from '../../vendor/lit-html-3.3.3/lit-html.js';
import { askRobot, SignedOut } from '../../api/api.js';
import { change } from '../../display/display.js';
import { ago } from '../../display/format.js';

/** Advice for refusals, in addition to the message. */
const ADVICE = {
  no_ros:
    'Without ROS there are no nodes, topics or parameters. ' +
    'The Monitor tab lists what the agent found.',
  robot_offline: 'Requests are sent over MQTT. This page retries when the robot is back online.',
  robot_silent: 'The robot may be busy or its network slow.',
  unsupported: 'The agent on this robot is older than the server.',
};

export class RobotRequest {
  answer = null;
  /** Why there is no newer answer: `{ text, advice, code }`. */
  problem = null;
  isBusy = false;
  #page;
  #query;
  #reviver;
  #answeredAt = 0;
  #lastRequest = 0;

  constructor(page, query, reviver) {
    this.#page = page;
    this.#query = query;
    this.#reviver = reviver;
  }

  /** Sends the query. Of concurrent requests, only the last answer counts. */
  async send() {
    const request = (this.#lastRequest += 1);
    change(() => (this.isBusy = true));
    const [answer, problem] = await this.#fetch();
    if (request !== this.#lastRequest) return;
    change(() => {
      this.isBusy = false;
      this.problem = problem;
      if (!answer) return;
      this.answer = answer;
      this.#answeredAt = this.#page.app.now() - (answer.age_ms ?? 0);
    });
  }

  async #fetch() {
    try {
      return [await askRobot(this.#page.robot.id, this.#query, this.#reviver), null];
    } catch (error) {
      if (error instanceof SignedOut) return [null, null];
      return [
        null,
        {
          text: this.#page.withRobotName(error.message),
          advice: ADVICE[error.code],
          code: error.code,
        },
      ];
    }
  }

  /** The age of the answer and a refresh button. `subject` is for screen readers. */
  status(subject, now) {
    const age = this.answer ? `as of ${ago(this.#answeredAt, now)}` : '';
    return html`<p class="request-status quiet"><span>${this.isBusy ? 'loading…' : age}</span>
      <button class="plain link" ?disabled=${this.isBusy} aria-label=${`Refresh ${subject}`}
        @click=${() => this.send()}>Refresh</button></p>`;
  }

  /** The error message. */
  error() {
    if (!this.problem) return nothing;
    const { text, advice } = this.problem;
    return html`<p class="request-error" role="status"><span class="bad"><span
      aria-hidden="true">▲ </span>${text}</span>${
        advice ? html`<br><span class="quiet">${advice}</span>` : nothing
      }</p>`;
  }
}
