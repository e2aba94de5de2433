// SPDX-License-Identifier: MIT
// The episodes of a dataset: which ones somebody wants to see, in which order, and a table of them.

import { cell, label } from "./table.js";
import { blank } from "./previews.js";
import { shown, shownBelow } from "./text.js";
import { VirtualRows } from "./virtual.js";

export const WORST_FIRST = "worst first";
export const [SUCCEEDS, UNDONE, NEVER] = ["succeeds", "succeeds, then undoes it", "never succeeds"];
export const PLAIN_ORDER = "episode"; // of episodes that nothing is known of

/** By name: what an order compares; true: the highest value comes first. */
const ORDERS = {
  [WORST_FIRST]: [["never_succeeds", true], ["backwards", true], ["disagreement", true]],
  episode: [],
  task: [["task", false]],
  num_frames: [["num_frames", false]],
  final_progress: [["final_progress", false]],
  best_success: [["best_success", false]],
  last_success: [["last_success", false]],
  backwards: [["backwards", true]],
  disagreement: [["disagreement", true]],
  difference: [["difference", true]],
};

const PROGRESS = 4; // its column
const NAMES = ["", "", "Task", "Frames", "Final progress", "Best success", "Final success", "Backward steps", "Cameras disagree", "Labels differ"]; // of columns, on a telephone

/** What a filter keeps, by name; the second argument is the number beside it */
const FILTERS = {
  succeed: ({ verdict }) => verdict === SUCCEEDS,
  never: ({ never_succeeds: never }) => never === true,
  undone: ({ verdict }) => verdict === UNDONE,
  backwards: ({ backwards }, percent) => isKnown(backwards) && 100 * backwards >= percent,
  apart: ({ disagreement }, least) => isKnown(disagreement) && disagreement >= least,
  differ: ({ difference, verdict_differs: differs }, least) => differs === true || (isKnown(difference) && difference >= least),
};

export const FILTER_NAMES = Object.keys(FILTERS);

/** The episodes with what follows from a threshold, and from other labels: rows by episode, or null. */
export function judged(episodes, threshold, others) {
  return episodes.map((episode) => {
    const verdict = verdictOf(episode, threshold);
    const other = others?.get(episode.episode);
    const theirs = other && verdictOf(other, threshold);
    const isBoth = isKnown(episode.final_progress) && isKnown(other?.final_progress);
    return {
      ...episode,
      verdict,
      never_succeeds: verdict && verdict === NEVER,
      difference: isBoth ? Math.abs(episode.final_progress - other.final_progress) : null,
      verdict_differs: verdict && theirs ? (verdict === SUCCEEDS) !== (theirs === SUCCEEDS) : null,
    };
  });
}

/** The name of an episode, if it has one, and its task, or that it has none. */
export function toldOf({ name, task, num_frames: numFrames }) {
  return [name, task || (numFrames ? "no task" : "")].filter(Boolean).join(": ");
}

/** Those that every filter keeps. chosen: [name, number] of each filter; text: a part of the name or the task */
export function kept(episodes, chosen, text) {
  const part = text.trim().toLowerCase();
  return episodes.filter((episode) =>
    toldOf(episode).toLowerCase().includes(part) && chosen.every(([name, number]) => FILTERS[name](episode, number)));
}

/** The episodes in an order; those of which nothing is known come last. */
export function sorted(episodes, order, isTurned) {
  const turn = isTurned ? -1 : 1;
  return [...episodes].sort((one, other) => {
    for (const [field, isFalling] of ORDERS[order]) {
      const [a, b] = [one[field] ?? null, other[field] ?? null];
      if (a === b) continue;
      if (a === null || b === null) return a === null ? 1 : -1;
      return turn * (isFalling ? -1 : 1) * (a < b ? -1 : 1);
    }
    return (order === PLAIN_ORDER ? turn : 1) * (one.episode - other.episode);
  });
}

/**
 * A table of episodes. elements: as `VirtualRows` takes them
 * previews: fill the pictures and curves; onWatch(episode): somebody wants to watch one; chosen: the numbers of those that are selected; onChoose(): they are others
 * outcomeOf(episode): "success" or "failure", as somebody has marked it; undefined: not marked
 */
export class EpisodeTable {
  #body;
  #rows;
  #onWatch;
  #previews;
  #chosen;
  #onChoose;
  #outcomeOf;
  #watched = null;
  #threshold = 0.5;

  constructor(elements, { previews, onWatch, chosen, onChoose, outcomeOf }) {
    this.#body = elements.body;
    this.#previews = previews;
    this.#onWatch = onWatch;
    this.#chosen = chosen;
    this.#onChoose = onChoose;
    this.#outcomeOf = outcomeOf;
    this.#rows = new VirtualRows(elements, (episode) => this.#row(episode));
  }

  show(episodes, threshold) {
    this.#threshold = threshold;
    this.#rows.show(episodes);
  }

  /** Marks the row of an episode, by its number, and scrolls to it. */
  mark(watched, episodes) {
    this.#watched = watched;
    for (const [episode, row] of this.#rows.rows) this.#markRow(row, episode);
    const episode = episodes.find((each) => each.episode === watched);
    if (episode) this.#rows.reveal(episode);
  }

  /** Fills the row of an episode, by its number, which has come from the Hub. */
  refill(number) {
    this.#previews.forget(number);
    const [episode, row] = [...this.#rows.rows].find(([each]) => each.episode === number) ?? [];
    if (row) this.#previews.fill(episode, row, row.querySelectorAll(".thumb"), row.querySelector(".spark"));
  }

  /** Shows which are selected. */
  markChosen() {
    for (const [{ episode }, row] of this.#rows.rows) row.querySelector("input").checked = this.#chosen.has(episode);
  }

  #row(episode) {
    const [row, header, button, box] = ["tr", "th", "button", "input"].map((tag) => document.createElement(tag));
    row.dataset.episode = episode.episode;
    header.scope = "row";
    button.type = "button";
    button.textContent = `${episode.episode}`;
    header.append(button);
    box.type = "checkbox";
    box.checked = this.#chosen.has(episode.episode);
    box.setAttribute("aria-label", `Select episode ${episode.episode}`);
    box.addEventListener("click", (event) => event.stopPropagation());
    box.addEventListener("change", () => {
      if (box.checked) this.#chosen.add(episode.episode);
      else this.#chosen.delete(episode.episode);
      this.#onChoose();
    });
    const first = cell("", "choose");
    first.append(box);
    first.addEventListener("click", (event) => event.stopPropagation());
    const task = cell("", "task");
    const words = document.createElement("span");
    words.textContent = task.title = toldOf(episode);
    task.append(words);
    if (episode.fault) {
      const fault = document.createElement("span");
      fault.className = "failed";
      fault.textContent = ` ${episode.fault}`;
      task.title = episode.fault;
      words.prepend(fault, " ");
    }
    row.append(first, header, task, cell(episode.num_frames, "number frames"));
    const scores = [episode.final_progress, episode.best_success, episode.last_success];
    scores.forEach((value, place) => {
      const isBelow = place > 0 && value !== undefined && value !== null && value < this.#threshold;
      row.append(isBelow ? cell(shownBelow(value, this.#threshold), "number below") : cell(shown(value), "number"));
    });
    const { pictures, curve } = blank();
    header.prepend(...pictures);
    row.cells[PROGRESS].prepend(curve);
    this.#previews.fill(episode, row, pictures, curve);
    row.append(cell(percent(episode.backwards), "number"), cell(shown(episode.disagreement), "number cameras"));
    row.append(cell(`${shown(episode.difference)}${episode.verdict_differs ? " ≠" : ""}`, "number difference"));
    row.addEventListener("click", () => this.#onWatch(episode));
    this.#markRow(row, episode);
    return label(row, NAMES);
  }

  #markRow(row, episode) {
    const [button, outcome, isWatched] = [row.querySelector("button"), this.#outcomeOf(episode), episode.episode === this.#watched];
    row.classList.toggle("shown", isWatched);
    button.setAttribute("aria-pressed", isWatched);
    button.setAttribute("aria-label", `Watch episode ${episode.episode}${outcome ? `, marked as a ${outcome}` : ""}`);
    button.dataset.outcome = outcome ?? "";
  }
}

/** By the vote of the last frames, as in the labels' summary; null: success is not predicted. */
function verdictOf({ best_success: best, voted_success: voted }, threshold) {
  if (!isKnown(best)) return null;
  if (voted >= threshold) return SUCCEEDS;
  return best >= threshold ? UNDONE : NEVER;
}

function isKnown(value) {
  return value !== null && value !== undefined;
}

function percent(share) {
  return isKnown(share) ? `${(100 * share).toFixed(1)} %` : shown(null);
}
