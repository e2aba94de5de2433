// SPDX-License-Identifier: MIT
// The address of what is shown. It leads there again: with Back, after a reload, and on the screen of a colleague.
// It stands behind #, which browsers send to no server: tasks are in no log.

const AFTER_MS = 250; // browsers refuse more than some changes a second, and sliders make more

export class Address {
  #timer = null;

  /** onGo(params): somebody goes back, goes forth, or types an address */
  constructor(onGo) {
    addEventListener("popstate", () => {
      clearTimeout(this.#timer);
      onGo(this.params);
    });
  }

  get params() {
    return new URLSearchParams(location.hash.slice(1));
  }

  /** Tells soon what is shown then, in place of what was shown. paramsOf(): what is shown */
  correct(paramsOf) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#write(paramsOf(), "replaceState"), AFTER_MS);
  }

  /** Tells what is shown now; Back leads to what was shown before. */
  step(params) {
    clearTimeout(this.#timer);
    this.#write(params, "pushState");
  }

  #write(params, how) {
    const address = `#${new URLSearchParams(params)}`;
    if (address.slice(1) !== location.hash.slice(1)) history[how](null, "", address === "#" ? location.pathname : address);
  }
}
