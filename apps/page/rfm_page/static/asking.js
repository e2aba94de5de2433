// SPDX-License-Identifier: MIT
// Asks the server again by itself until there is something to show.

const AGAIN_AFTER_MS = 3000;

export class Asking {
  #ask;
  #number = 0; // of the loop that asks
  #timer = null;

  /** ask(isCurrent): asks once, and says whether there is something; isCurrent() false: another loop has begun meanwhile */
  constructor(ask) {
    this.#ask = ask;
  }

  /** Asks now, and from then on until there is something. */
  async begin() {
    const number = (this.#number += 1);
    const isCurrent = () => number === this.#number;
    clearTimeout(this.#timer);
    const isThere = await this.#ask(isCurrent);
    if (isCurrent() && !isThere) this.#timer = setTimeout(() => this.begin(), AGAIN_AFTER_MS);
  }

  /** Asks no more. */
  end() {
    this.#number += 1;
    clearTimeout(this.#timer);
  }
}
