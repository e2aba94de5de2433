// SPDX-License-Identifier: MIT
// Empty and failed states: a title, a sentence, a command to copy, what was said word for word, and what one can do.

import { remover } from "./nameable.js";
import { writeCommand } from "./text.js";

const COPIED_FOR_MS = 2000;

/** A place of the page where a state may stand. */
export class Place {
  #host;

  constructor(host) {
    this.#host = host;
  }

  /** Whether nothing is told here, not even in a bar that somebody has closed. */
  get isEmpty() {
    return !this.#host.dataset.told;
  }

  /**
   * Shows a state in place of another one.
   * kind: "fault" or "empty"; command: a line for the shell; details: what another program said;
   * buttons: [text, action] of each; note: what happens by itself
   */
  show({ kind = "fault", title, text = "", command = "", details = "", buttons = [], note = "" }) {
    const told = JSON.stringify([kind, title, text, command, details, note]);
    if (this.#host.dataset.told === told) return; // somebody may be reading it, or have opened the details
    const parts = [made("h2", title)];
    const remedy = [text && made("p", text), command && commandLine(command)].filter(Boolean);
    const isBar = this.#host.classList.contains("bar");
    if (!isBar) parts.push(...remedy);
    if (buttons.length || note) parts.push(actions(buttons, note));
    if (details) parts.push(detailsOf(details, isBar ? remedy : []));
    if (isBar) parts.push(Object.assign(remover(() => this.#host.replaceChildren()), { ariaLabel: "Close" })); // what was told stays told
    const state = document.createElement("div");
    state.className = `state ${kind}`;
    state.append(...parts);
    this.#host.replaceChildren(state);
    this.#host.dataset.told = told;
  }

  clear() {
    this.#host.replaceChildren();
    delete this.#host.dataset.told;
  }
}

/** Copies a text; where the browser forbids it, marks the element that has it, so that the keys copy it. */
export async function copied(text, element) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch { // there is no clipboard where the page comes over plain HTTP from another machine
    getSelection().selectAllChildren(element);
    return false;
  }
}

function commandLine(command) {
  const [line, text, button] = ["div", "pre", "button"].map((name) => document.createElement(name));
  line.className = "command";
  writeCommand(text, command);
  text.tabIndex = 0;
  text.setAttribute("role", "region");
  text.setAttribute("aria-label", `Command line: ${command}`); // two regions need two names
  button.type = "button";
  button.textContent = "Copy";
  button.addEventListener("click", async () => {
    button.textContent = (await copied(command, text)) ? "Copied" : "Press Ctrl+C";
    setTimeout(() => { button.textContent = "Copy"; }, COPIED_FOR_MS);
  });
  line.append(text, button);
  return line;
}

function actions(buttons, note) {
  const line = document.createElement("div");
  line.className = "actions";
  for (const [text, action] of buttons) {
    const button = made("button", text);
    button.type = "button";
    button.addEventListener("click", action);
    line.append(button);
  }
  if (note) line.append(made("span", note));
  return line;
}

function detailsOf(text, before) {
  const details = document.createElement("details");
  details.append(made("summary", "Details"), ...before, Object.assign(made("p", text), { className: "about" }));
  return details;
}

function made(name, text) {
  const element = document.createElement(name);
  element.textContent = text;
  return element;
}
