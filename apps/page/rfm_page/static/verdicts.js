// SPDX-License-Identifier: MIT
// Which of several videos does a task best: the model is asked about each pair in both orders.

import { colourName } from "./chart.js";
import { shown } from "./text.js";

const AND = new Intl.ListFormat("en-GB");
const CHUNK_BYTES = 4 * 2 ** 20;

/** What the model says of videos, in one sentence. verdict: videos, task, model, and the gateway's answer; null: two are one file */
export function sentenceOf({ videos, answer }) {
  const [first, second] = videos.map(({ title }) => title);
  if (!answer) return `${first} and ${second} are one file, so neither is better.`;
  const best = answer.videos.findIndex(({ rank }) => rank === 1);
  const isAnswered = answer.pairs.every(({ verdict }) => verdict);
  if (isAnswered && best < 0) return "No best video: several win equally often.";
  if (isAnswered) return `${videos[best].title} does the task ${videos.length > 2 ? "best" : "better"}.`;
  const [{ orders_agree: agree }, ...others] = answer.pairs;
  const unranked = videos.filter((_, index) => answer.videos[index].rank === null).map(({ title }) => title);
  if (others.length) return `${best < 0 ? "No best video" : `${videos[best].title} does the task best, but ${AND.format(unranked)} have no rank`}: some answers depend on which video comes first.`;
  return agree ? "No verdict: both answers are exactly 0.5." : "No verdict: the answer depends on which video comes first.";
}

/** Writes the verdict on videos into `host`, with the sentence as its title, and returns the box. */
export function addVerdict(host, verdict) {
  const { videos, task, model, answer } = verdict;
  const box = document.createElement("div");
  const agree = answer?.pairs.every(({ verdict: better }) => better) ? ` ${videos.length > 2 ? "All" : "Both"} orders agree.` : "";
  const about = answer ? `${task}, judged by ${model}.${agree}` : "The files have the same bytes. The model was not asked.";
  box.className = "verdict";
  box.append(element("h2", sentenceOf(verdict).replace(/\.$/, "")), element("p", about));
  box.lastChild.className = "about";
  if (answer) box.append(rankingOf(videos, answer), pairsOf(videos, answer));
  host.append(box);
  return box;
}

/** The videos, best first, then those without a rank: each that has one with the mean probability of winning. */
function rankingOf(videos, answer) {
  const list = document.createElement("ol");
  const ranked = videos.map((video, index) => ({ video, ...answer.videos[index] }));
  for (const { video, wins, rank } of ranked.sort((one, other) => (one.rank ?? Infinity) - (other.rank ?? Infinity) || 0)) {
    const [item, place] = ["li", "span"].map((name) => document.createElement(name));
    place.className = rank ? "share" : "unranked";
    place.append(rank ? barOf(video, wins) : "no rank");
    item.append(element("span", rank ? `#${rank} ${video.title}` : video.title), place, element("span", rank ? `mean preference ${shown(wins)}` : ""));
    list.append(item);
  }
  return list;
}

function barOf(video, share) {
  const bar = document.createElement("span");
  bar.style.width = `${100 * share}%`;
  bar.style.background = video.colour ?? `var(--${colourName(video.place)})`;
  return bar;
}

/** What the model answers about each pair, in both orders. */
function pairsOf(videos, { orders, pairs }) {
  const details = document.createElement("details");
  details.append(element("summary", pairs.length > 1 ? "Pairs" : "Both orders"));
  details.open = pairs.length === 1;
  const asked = (first, second) => orders.find((each) => each.first === first && each.second === second).preference;
  for (const { first, second, verdict } of pairs) {
    const [better, other] = verdict === "second" ? [second, first] : [first, second];
    const told = [`${shown(asked(better, other))} shown first`, `${shown(1 - asked(other, better))} shown second`];
    details.append(element("p", `P(${videos[better].title} is better than ${videos[other].title}) = ${told.join(", ")}`));
  }
  return details;
}

/** The first two videos that are one file; null: there are none. */
export async function ofOneFile(videos) {
  for (const [place, one] of videos.entries()) {
    for (const other of videos.slice(place + 1)) if (await areOneFile(one.file, other.file)) return [one, other];
  }
  return null;
}

/** Whether two files have the same bytes. */
async function areOneFile(one, other) {
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
