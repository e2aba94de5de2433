// SPDX-License-Identifier: MIT
// Small parts of the page: a name that a click lets one change, a button that removes.

const END_LETTERS = 7; // of a name, which are always to be seen, since names differ at their ends

/**
 * A name that is a button; a click makes it a field. Where it does not fit, its middle is left out.
 * onName(text): somebody gave another name; empty: none
 */
export function nameable(onName) {
  const element = document.createElement("span");
  const button = document.createElement("button");
  const field = document.createElement("input");
  const [begun, ended] = ["span", "span"].map((tag) => button.appendChild(document.createElement(tag)));
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
  /** text: the name; about: what the name stands for */
  const show = (text, about = text) => {
    whole = text;
    button.setAttribute("aria-label", text);
    begun.textContent = text.slice(0, -END_LETTERS);
    ended.textContent = text.slice(-END_LETTERS);
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
