// SPDX-License-Identifier: MIT
// One line that names the curves: the colour and the name of each can be changed, and each can be removed.

import { colourOf } from "./chart.js";
import { shortNames } from "./curves.js";
import { nameable, remover } from "./nameable.js";

const NAME_LETTERS = 40;

export class Legend {
  #host;
  #onChange;
  #onRemove;
  #items = new Map();

  /** onChange(): a colour or a name is another; onRemove(curve): somebody wants a curve away */
  constructor(host, { onChange, onRemove }) {
    this.#host = host;
    this.#onChange = onChange;
    this.#onRemove = onRemove;
  }

  /** Names these curves. */
  show(curves) {
    for (const [curve, { element }] of this.#items) {
      if (curves.includes(curve)) continue;
      element.remove();
      this.#items.delete(curve);
    }
    const names = shortNames(curves, NAME_LETTERS);
    curves.forEach((curve, place) => {
      if (!this.#items.has(curve)) this.#items.set(curve, this.#newItem(curve));
      const { element, colour, name, away } = this.#items.get(curve);
      if (this.#host.children[place] !== element) this.#host.insertBefore(element, this.#host.children[place] ?? null);
      colour.value = colourOf(curve);
      colour.setAttribute("aria-label", `Colour of ${names[place]}`);
      name.show(names[place], curve.label);
      away.setAttribute("aria-label", `Remove ${names[place]}`);
    });
    this.#host.hidden = !curves.length;
  }

  #newItem(curve) {
    const [element, colour] = [document.createElement("li"), document.createElement("input")];
    colour.type = "color";
    colour.className = "swatch";
    colour.addEventListener("input", () => {
      curve.colour = colour.value;
      this.#onChange();
    });
    const name = nameable((text) => {
      curve.title = text || null;
      this.#onChange();
    });
    const away = remover(() => this.#onRemove(curve));
    element.append(colour, name.element, away);
    return { element, colour, name, away };
  }
}
