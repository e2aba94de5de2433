// SPDX-License-Identifier: MIT
// Small parts of the page: a name that a click lets one change, a button that removes.

import { cut, writeName } from "./text.js";

const NAME_LETTERS = 30;

/**
 * A name that is a button; a click makes it a field. Of a long one the middle is left out.
 * onName(text): somebody gave another name; empty: none
 */
export function nameable(onName) {
  const element = document.createElement("span");
  const button = document.createElement("button");
  const field = document.createElement("input");
  let whole = "";
  element.className = "nameable";
  button.type = "button";
  field.hidden = true;
  field.setAttribute("aria-label", "New name");
  const begin = () => {
    Object.assign(field, { value: whole, hidden: false });
    button.hidden = true;
    field.select();
  };
  const end = (isKept) => {
    if (field.hidden) return;
    field.hidden = true;
    button.hidden = false;
    if (isKept && field.value.trim() !== whole) onName(field.value.trim());
  };
  button.addEventListener("click", begin);
  field.addEventListener("blur", () => end(true));
  field.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== "Escape") return;
    event.preventDefault();
    end(event.key === "Enter");
    button.focus();
  });
  element.append(button, field);
  /** text: the name; about: what the name stands for; most: letters */
  const show = (text, about = text, most = NAME_LETTERS) => {
    whole = text;
    button.setAttribute("aria-label", text);
    writeName(button, cut(text, most));
    button.title = about === text ? `${text}: click to rename` : `${text}: ${about}; click to rename`;
  };
  return { element, show };
}

/** A small button that removes something. */
export function remover(onClick) {
  const button = document.createElement("button");
  button.type = "button";
  button.className = "remove";
  button.textContent = "×";
  button.addEventListener("click", onClick);
  return button;
}
