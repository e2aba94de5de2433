// SPDX-License-Identifier: MIT
// The episodes of a dataset as a table, sorted by what one wants to see first.

import { cell } from "./table.js";
import { shown } from "./text.js";

const ROWS_AT_A_TIME = 200;

/** By name: what an order compares, the first field first; true: the highest value comes first. */
const ORDERS = {
  "never succeeds, then goes backwards, then cameras disagree": [
    ["never_succeeds", true], ["backwards", true], ["disagreement", true],
  ],
  "goes backwards most": [["backwards", true]],
  "cameras disagree most": [["disagreement", true]],
  "lowest final progress": [["final_progress", false]],
  "lowest best success": [["best_success", false]],
  "episode number": [],
};

export const ORDER_NAMES = Object.keys(ORDERS);
export const PLAIN_ORDER = ORDER_NAMES.at(-1); // of episodes that nothing is known of

/** The episodes in an order; those of which nothing is known come last. */
export function sorted(episodes, order) {
  return [...episodes].sort((one, other) => {
    for (const [field, isFalling] of ORDERS[order]) {
      const [a, b] = [one[field] ?? null, other[field] ?? null];
      if (a === b) continue;
      if (a === null || b === null) return a === null ? 1 : -1;
      return isFalling ? b - a : a - b;
    }
    return one.episode - other.episode;
  });
}

/** A table in `body`, and a button for more rows than fit. `onChoose(episode)` is called when somebody chooses one. */
export class EpisodeTable {
  #body;
  #more;
  #onChoose;
  #episodes = [];
  #chosen = null;

  constructor(body, more, onChoose) {
    this.#body = body;
    this.#more = more;
    this.#onChoose = onChoose;
    more.addEventListener("click", () => this.#add());
  }

  /** Shows episodes in their order. chosen: the number of the one that is watched, or null */
  show(episodes, chosen) {
    this.#episodes = episodes;
    this.#chosen = chosen;
    this.#body.replaceChildren();
    this.#add();
  }

  /** Marks the row of an episode. */
  mark(chosen) {
    this.#chosen = chosen;
    for (const row of this.#body.rows) this.#markRow(row, Number(row.dataset.episode));
  }

  #add() {
    const from = this.#body.rows.length;
    this.#body.append(...this.#episodes.slice(from, from + ROWS_AT_A_TIME).map((episode) => this.#row(episode)));
    this.#more.hidden = this.#body.rows.length >= this.#episodes.length;
  }

  #row(episode) {
    const row = document.createElement("tr");
    const header = document.createElement("th");
    const button = document.createElement("button");
    row.dataset.episode = episode.episode;
    header.scope = "row";
    button.type = "button";
    button.textContent = `Watch ${episode.episode}`;
    header.append(button);
    const never = { true: "never", false: "" }[episode.never_succeeds] ?? shown(null);
    row.append(header, cell(episode.task), cell(episode.num_frames, "number"));
    row.append(cell(shown(episode.final_progress), "number"), cell(shown(episode.best_success), "number"), cell(never));
    row.append(cell(percent(episode.backwards), "number"), cell(shown(episode.disagreement), "number"));
    row.addEventListener("click", () => this.#onChoose(episode));
    this.#markRow(row, episode.episode);
    return row;
  }

  #markRow(row, number) {
    row.classList.toggle("shown", number === this.#chosen);
    row.querySelector("button").setAttribute("aria-pressed", number === this.#chosen);
  }
}

function percent(share) {
  return share === null || share === undefined ? shown(null) : `${(100 * share).toFixed(1)} %`;
}
