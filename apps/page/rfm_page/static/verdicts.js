// SPDX-License-Identifier: MIT
// Which of two videos does a task better: the model is asked in both orders, and both answers are shown.

import { colourOf } from "./chart.js";
import { shown } from "./text.js";

const CHUNK_BYTES = 4 * 2 ** 20;

/** What the model says of a pair, in one sentence. verdict: videos, task, model, and the gateway's answer; null: they are one file */
export function sentenceOf({ videos, answer }) {
  const [first, second] = videos.map(({ title }) => title);
  if (!answer) return `${first} and ${second} are one file, so neither is better.`;
  if (answer.verdict) return `${answer.verdict === "first" ? first : second} does the task better.`;
  return answer.orders_agree ? "No verdict: both answers are exactly 0.5." : "No verdict: the answer changes with the order.";
}

/** Writes the verdict on a pair into `host`, the sentence first, and returns the box. */
export function addVerdict(host, verdict) {
  const { videos, task, model, answer } = verdict;
  const box = document.createElement("div");
  const said = element("p", "");
  said.append(element("strong", sentenceOf(verdict)));
  if (answer?.verdict) said.append(" Both orders agree.");
  box.className = "verdict";
  box.append(said, element("p", answer ? `${task} (${model})` : "The files have the same bytes. The model was not asked."));
  box.lastChild.className = "about";
  if (answer) box.append(answersOf(videos, answer));
  host.append(box);
  return box;
}

/** Both answers, each with a bar: how much of it speaks for the first video, and how much for the second. */
function answersOf(videos, { orders }) {
  const list = document.createElement("ul");
  const titles = { first: videos[0].title, second: videos[1].title };
  for (const { asked, preference } of orders) {
    const [one, other] = asked.map((side) => titles[side]);
    const item = element("li", `Asked as ${one}, then ${other}: P(${one} is better) = ${shown(preference)}`);
    const bar = document.createElement("span");
    bar.className = "shares";
    const ofFirst = asked[0] === "first" ? preference : 1 - preference;
    [ofFirst, 1 - ofFirst].forEach((share, place) => {
      const part = bar.appendChild(document.createElement("span"));
      part.style.width = `${100 * share}%`;
      part.style.background = colourOf({ colour: videos[place].colour, index: videos[place].place });
    });
    item.prepend(bar);
    list.append(item);
  }
  return list;
}

/** Whether two files have the same bytes. */
export async function areOneFile(one, other) {
  if (one.size !== other.size) return false;
  for (let begin = 0; begin < one.size; begin += CHUNK_BYTES) {
    const [some, others] = await Promise.all([one, other].map(async (file) => {
      return new Uint8Array(await file.slice(begin, begin + CHUNK_BYTES).arrayBuffer());
    }));
    if (some.some((byte, index) => byte !== others[index])) return false;
  }
  return true;
}

function element(name, text) {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}
