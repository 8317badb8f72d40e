// A question to a robot: what it answered last, how old that is, or why there is no answer.

import { html, nothing } from '../vendor/lit-html-3.3.3/lit-html.js';
import { askRobot, SignedOut } from '../api.js';
import { ago } from '../format.js';
import { change } from '../frame.js';

/** What can be done about a refusal. The refusal itself comes in words. */
const ADVICE = {
  no_ros:
    'Without ROS there are no nodes, topics or parameters. The facts on Monitor say what the agent has found.',
  robot_offline: 'Questions go over MQTT. This page asks again by itself when the robot is back.',
  robot_silent: 'It may be busy, or its network slow.',
  unsupported: 'Its agent is older than this server.',
};

export class Asked {
  answer = null;
  /** Why there is no newer answer, `{ text, advice, code }`. */
  problem = null;
  isBusy = false;
  #page;
  #question;
  #revive;
  #answeredAt = 0;
  #asked = 0;

  constructor(page, question, revive) {
    this.#page = page;
    this.#question = question;
    this.#revive = revive;
  }

  /** Asks; asked again meanwhile, only the last answer counts. */
  async ask() {
    const asked = (this.#asked += 1);
    change(() => (this.isBusy = true));
    const [answer, problem] = await this.#said();
    if (asked !== this.#asked) return;
    change(() => {
      this.isBusy = false;
      this.problem = problem;
      if (!answer) return;
      this.answer = answer;
      this.#answeredAt = this.#page.app.now() - (answer.age_ms ?? 0);
    });
  }

  async #said() {
    try {
      return [await askRobot(this.#page.robot.id, this.#question, this.#revive), null];
    } catch (error) {
      if (error instanceof SignedOut) return [null, null];
      return [
        null,
        { text: this.#page.inWords(error.message), advice: ADVICE[error.code], code: error.code },
      ];
    }
  }

  /**
   * When the robot saw it so, and a button that asks again. `what` it is about is for those who
   * can't see where it stands.
   */
  line(what, now) {
    const age = this.answer ? `as of ${ago(this.#answeredAt, now)}` : '';
    return html`<p class="asked quiet"><span>${this.isBusy ? 'asking…' : age}</span> <button class="plain link" ?disabled=${this.isBusy} aria-label=${`Refresh ${what}`} @click=${() => this.ask()}>Refresh</button></p>`;
  }

  /** Why there is no newer answer, in words. */
  refusal() {
    if (!this.problem) return nothing;
    const { text, advice } = this.problem;
    return html`<p class="refusal" role="status"><span class="bad"><span aria-hidden="true">▲ </span>${text}</span>${advice ? html`<br><span class="quiet">${advice}</span>` : nothing}</p>`;
  }
}
