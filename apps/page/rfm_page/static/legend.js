// SPDX-License-Identifier: MIT
// The legend of the questions: the captions of the videos name the colours, and this names the lines.

import { colourOf } from "./chart.js";
import { failedOf, questionsOf } from "./curves.js";
import { byQuestion } from "./looks.js";
import { nameable, remover } from "./nameable.js";
import { sampleOf } from "./svg.js";
import { cut } from "./text.js";

const [NAME_LETTERS, ERROR_LETTERS] = [48, 120];

export class Legend {
  #host;
  #onChange;
  #onRemove;
  #items = new Map();

  /** onChange(): a colour or a name is another; onRemove(curves): somebody wants these curves away */
  constructor(host, { onChange, onRemove }) {
    this.#host = host;
    this.#onChange = onChange;
    this.#onRemove = onRemove;
  }

  /** Names the questions that these curves answer. One question alone needs no name. */
  show(curves) {
    const all = questionsOf(curves);
    const questions = all.length > 1 ? all : [];
    const isByQuestion = byQuestion(curves, all);
    for (const [key, { element }] of this.#items) {
      if (questions.some((question) => question.key === key)) continue;
      element.remove();
      this.#items.delete(key);
    }
    questions.forEach((question, place) => {
      if (!this.#items.has(question.key)) this.#items.set(question.key, this.#newItem());
      const item = this.#items.get(question.key);
      const { element, colour, line, name, trouble, away } = item;
      const [first] = question.curves;
      item.curves = question.curves;
      if (this.#host.children[place] !== element) this.#host.insertBefore(element, this.#host.children[place] ?? null);
      colour.value = colourOf(first);
      colour.setAttribute("aria-label", `Colour of ${question.name}`);
      line.style.color = isByQuestion ? colourOf(first) : "";
      line.replaceChildren(sampleOf(first.dash));
      const failed = failedOf(question.curves);
      trouble.textContent = failed === "failed" ? `failed: ${cut(first.error, ERROR_LETTERS)}` : failed;
      line.hidden = failed === "failed"; // no line is drawn
      colour.hidden = line.hidden || !isByQuestion;
      name.show(question.name, `${first.task} (${first.model}, ${first.sampling})`, NAME_LETTERS);
      away.setAttribute("aria-label", `Remove the curves of ${question.name}`);
    });
    this.#host.hidden = !questions.length;
  }

  #newItem() {
    const [element, colour, line, trouble] = ["li", "input", "span", "span"].map((tag) => document.createElement(tag));
    const item = { element, colour, line, trouble, curves: [] };
    trouble.className = "failed";
    colour.type = "color";
    colour.className = "swatch";
    colour.addEventListener("input", () => this.#changeAll(item, { questionColour: colour.value }));
    item.name = nameable((text) => this.#changeAll(item, { title: text || null }));
    item.away = remover(() => this.#onRemove(item.curves));
    element.append(colour, line, item.name.element, trouble, item.away);
    return item;
  }

  #changeAll({ curves }, change) {
    for (const curve of curves) Object.assign(curve, change);
    this.#onChange();
  }
}
