// SPDX-License-Identifier: MIT
// The settings beside what is shown: a button folds them away, and the browser remembers that.

import { remember, remembered } from "./remembered.js";

const KEY = "rfm.settings";
const CLOSED = "closed";
const WIDE = "(min-width: 720px)"; // elsewhere the settings would hide what is shown, so they begin folded away

export class Sidebar {
  #button;

  constructor(button) {
    this.#button = button;
    this.#show(this.#isWide && remembered(KEY) !== CLOSED);
    button.addEventListener("click", () => this.#set(!this.#isOpen));
  }

  /** Shows the field for tasks, which a narrow window always shows. */
  open() {
    if (!this.#isOpen && this.#isWide) this.#set(true);
  }

  /** Folds the settings away where they would hide what is shown. */
  giveWay() {
    if (!this.#isWide) this.#show(false);
  }

  get #isWide() {
    return matchMedia(WIDE).matches;
  }

  get #isOpen() {
    return this.#button.getAttribute("aria-expanded") === "true";
  }

  #set(isOpen) {
    if (this.#isWide) remember(KEY, isOpen ? "open" : CLOSED);
    this.#show(isOpen);
  }

  #show(isOpen) {
    this.#button.setAttribute("aria-expanded", isOpen);
    this.#button.textContent = isOpen ? "Hide settings" : "Settings";
    document.body.classList.toggle("folded", !isOpen);
  }
}
