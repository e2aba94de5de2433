// SPDX-License-Identifier: MIT
// The tasks and settings of the tab of videos, as an address has them: those that differ from the usual ones.

const TASK = "task";
const NAMES = ["model", "rule", "frames", "fps", "orient", "channels", "threshold"]; // a rule after its model
const RESIZE = "resize";

export class Settings {
  #page;
  #onModel;
  #usual = null; // null: the choices are not there yet
  #wanted = new URLSearchParams(); // for then

  /** page: the controls; onModel(): another model is chosen, which has a rule of its own */
  constructor(page, onModel) {
    this.#page = page;
    this.#onModel = onModel;
  }

  /** What an address says of them. */
  get params() {
    const tasks = this.#page.tasks.value.split("\n").filter((line) => line.trim()).map((line) => [TASK, line.trim()]);
    if (!this.#usual) return [...tasks, ...[...this.#wanted].filter(([name]) => name === RESIZE || NAMES.includes(name))];
    const others = NAMES.map((name) => [name, this.#page[name].value]).filter(([name, value]) => value !== this.#usual[name]);
    return [...tasks, ...others, ...(this.#page.resize.checked ? [[RESIZE, "1"]] : [])];
  }

  /** From now on, the choices are there, and the usual ones chosen. Returns what `show` returns. */
  begin() {
    this.#usual = Object.fromEntries(NAMES.map((name) => [name, this.#page[name].value]));
    return this.#choose();
  }

  /** Shows what an address says. Returns the model that it names and that is not served; null: none. */
  show(params) {
    this.#page.tasks.value = params.getAll(TASK).join("\n");
    this.#wanted = params;
    return this.#usual ? this.#choose() : null;
  }

  #choose() {
    const wanted = this.#wanted.get("model");
    for (const name of NAMES) {
      const control = this.#page[name];
      const before = control.value;
      const value = this.#wanted.get(name) ?? (name === "rule" ? null : this.#usual[name]); // the model chooses the rule
      if (value !== null) control.value = value;
      if (control.matches("select") && !control.value) control.value = before; // no such choice
      if (name === "model") this.#onModel();
      if (name === "rule") control.dispatchEvent(new Event("change"));
    }
    this.#page.resize.checked = this.#wanted.has(RESIZE);
    if (this.params.some(([name]) => name !== TASK)) this.#page.advanced.open = true; // nobody scores with others unseen
    return wanted === null || wanted === this.#page.model.value ? null : wanted;
  }
}
