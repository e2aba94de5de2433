// SPDX-License-Identifier: MIT
// Which of two videos does a task better: the model is asked in both orders, and both answers are shown.

import { shown } from "./text.js";

/** Writes what the model says of a pair into `host`. verdict: videos, task, model, answer of the gateway */
export function addVerdict(host, { videos, task, model, answer }) {
  const names = Object.fromEntries(["first", "second"].map((side, index) => [side, videos[index].name]));
  const list = document.createElement("ul");
  for (const { asked, preference } of answer.orders) {
    const [one, other] = asked.map((side) => names[side]);
    list.append(element("li", `Asked as ${one}, then ${other}: P(${one} is better) = ${shown(preference)}`));
  }
  const untold = answer.orders_agree ? "No answer: both are exactly 0.5." : "No answer: the orders disagree.";
  const verdict = answer.verdict ? `Both orders agree: ${names[answer.verdict]} is better.` : untold;
  const box = document.createElement("div");
  box.append(element("h3", `${task} (${model})`), list, element("p", verdict));
  host.append(box);
}

function element(name, text) {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}
