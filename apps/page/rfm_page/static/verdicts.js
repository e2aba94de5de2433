// SPDX-License-Identifier: MIT
// Which of two videos does a task better: the model is asked in both orders, and both answers are shown.

import { colourName } from "./chart.js";
import { shown } from "./text.js";

const CHUNK_BYTES = 4 * 2 ** 20;

/** What the model says of a pair, in one sentence. verdict: videos, task, model, and the gateway's answer; null: they are one file */
export function sentenceOf({ videos, answer }) {
  const [first, second] = videos.map(({ title }) => title);
  if (!answer) return `${first} and ${second} are one file, so neither is better.`;
  if (answer.verdict) return `${answer.verdict === "first" ? first : second} does the task better.`;
  return answer.orders_agree ? "No verdict: both answers are exactly 0.5." : "No verdict: the answer changes with the order.";
}

/** Writes the verdict on a pair into `host`, with the sentence as its title, and returns the box. */
export function addVerdict(host, verdict) {
  const { videos, task, model, answer } = verdict;
  const box = document.createElement("div");
  const about = answer ? `${task} (${model}).${answer.verdict ? " Both orders agree." : ""}` : "The files have the same bytes. The model was not asked.";
  box.className = "verdict";
  box.append(element("h2", sentenceOf(verdict).replace(/\.$/, "")), element("p", about));
  box.lastChild.className = "about";
  if (answer) box.append(answersOf(videos, answer));
  host.append(box);
  return box;
}

/** Both answers, each as a number and a bar: how likely the better video is better, or the first one if none is. */
function answersOf(videos, { orders, verdict }) {
  const list = document.createElement("ul");
  const better = verdict ?? "first";
  const ordered = better === "first" ? videos : [...videos].reverse();
  for (const { asked, preference } of orders) {
    const [place, probability] = asked[0] === better ? ["first", preference] : ["second", 1 - preference];
    const item = element("li", `P(${ordered[0].title} is better) = ${shown(probability)} (shown ${place})`);
    const bar = document.createElement("span");
    bar.className = "shares";
    [probability, 1 - probability].forEach((share, index) => {
      const part = bar.appendChild(document.createElement("span"));
      part.style.width = `${100 * share}%`;
      part.style.background = ordered[index].colour ?? `var(--${colourName(ordered[index].place)})`;
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
