// SPDX-License-Identifier: MIT
// Work that is done a few pieces at a time, in order.

/** Runs what is added, at most `most` at a time. */
export class Queue {
  #most;
  #waiting = [];
  #running = 0;

  constructor(most) {
    this.#most = most;
  }

  get isIdle() {
    return !this.#running && !this.#waiting.length;
  }

  add(work) {
    this.#waiting.push(work);
    this.#next();
  }

  /** Forgets what has not begun. */
  clear() {
    this.#waiting = [];
  }

  #next() {
    while (this.#running < this.#most && this.#waiting.length) {
      this.#running += 1;
      this.#waiting.shift()().finally(() => {
        this.#running -= 1;
        this.#next();
      });
    }
  }
}
