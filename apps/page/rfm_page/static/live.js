// SPDX-License-Identifier: MIT
// The tab of running episodes: each with its newest frame, its curve and its numbers, as clients report them.

import { hasKey, KeyWanted, liveNews } from "./api.js";
import { failure } from "./faults.js";
import { LiveCard } from "./livecard.js";
import { cellOf, learn } from "./signals.js";
import { Place } from "./states.js";
import { cell, label } from "./table.js";
import { NONE, shown } from "./text.js";

const ASK_EVERY_MS = 500;
const ASK_AGAIN_AFTER_MS = 5000;
const ENDED_AT_A_TIME = 12;

export class LiveTab {
  #page;
  #failedAnywhere;
  #errors;
  #cards = new Map();
  #cursor = "";
  #timer = null;
  #asking = 0; // number of the loop that asks
  #mostEnded = ENDED_AT_A_TIME;

  /** failedAnywhere(error): shows an error that is one on every tab, and says whether it is */
  constructor(page, { failedAnywhere }) {
    this.#page = page;
    this.#failedAnywhere = failedAnywhere;
    this.#errors = new Place(page["live-errors"]);
    page["live-more"].addEventListener("click", () => {
      this.#mostEnded += ENDED_AT_A_TIME;
      this.#show();
    });
    page["live-last"].addEventListener("input", () => this.#show());
  }

  /** Asks from now on what is new, as long as the tab is to be seen. */
  begin() {
    const key = hasKey() ? ', api_key="the key of this gateway"' : "";
    this.#page["live-code"].textContent = [
      "from rfm_rl import LiveView",
      `live = LiveView("${new URL(".", location.href).href.replace(/\/$/, "")}"${key})`,
      'episode = client.episode("stack the cups", live=live)',
    ].join("\n");
    clearTimeout(this.#timer);
    this.#asking += 1;
    this.#ask(this.#asking);
  }

  /** Asks again and again, until another loop has begun. */
  async #ask(asking) {
    let after = ASK_EVERY_MS;
    try {
      if (!this.#page["live-panel"].hidden && !document.hidden) {
        const news = await liveNews(this.#cursor);
        if (asking !== this.#asking) return;
        this.#take(news);
        this.#errors.clear();
      }
    } catch (error) {
      if (asking !== this.#asking) return;
      if (!this.#failedAnywhere(error)) this.#errors.show(failure("The running episodes cannot be shown", error));
      if (error instanceof KeyWanted) return; // it begins again with a key
      after = ASK_AGAIN_AFTER_MS;
    }
    this.#timer = setTimeout(() => this.#ask(asking), after);
  }

  #take({ cursor, is_whole: isWhole, most_points: mostPoints, scores, episodes }) {
    learn(scores);
    this.#cursor = cursor;
    const there = new Set(episodes.map(({ id }) => id));
    for (const id of [...this.#cards.keys()].filter((each) => isWhole || !there.has(each))) this.#remove(id);
    episodes.forEach((news, rank) => { // first the one that has been silent for longest
      if (!this.#cards.has(news.id)) this.#cards.set(news.id, new LiveCard(news.id, mostPoints));
      this.#cards.get(news.id).take(news, rank);
    });
    this.#show();
  }

  #remove(id) {
    this.#cards.get(id).remove();
    this.#cards.delete(id);
  }

  /** Those that run by run and environment, then the newest of those that have ended. */
  #show() {
    const cards = [...this.#cards.values()];
    const running = cards.filter(({ hasEnded }) => !hasEnded);
    const ended = cards.filter(({ hasEnded }) => hasEnded).sort((one, other) => other.rank - one.rank);
    running.sort((one, other) => one.title.localeCompare(other.title, "en", { numeric: true }));
    const visible = [...running, ...ended.slice(0, this.#mostEnded)];
    const { children } = this.#page["live-episodes"];
    const elements = visible.map(({ element }) => element);
    if (elements.length !== children.length || elements.some((each, index) => each !== children[index])) {
      this.#page["live-episodes"].replaceChildren(...elements);
    }
    for (const card of visible) card.show();
    const page = this.#page;
    const numHidden = cards.length - visible.length;
    page["no-live"].hidden = cards.length > 0;
    page["live-summary"].hidden = !cards.length;
    page["live-more"].hidden = !numHidden;
    page["live-more"].textContent = `Show more of ${numHidden} ended episodes`;
    const told = `Running: ${running.length}. Ended: ${ended.length}.`;
    if (page["live-told"].textContent !== told) page["live-told"].textContent = told;
    this.#showRuns(cards, ended);
  }

  /** Shows the means of each run. ended: the newest first */
  #showRuns(cards, ended) {
    const last = Math.max(Math.floor(Number(this.#page["live-last"].value)) || 1, 1);
    const head = this.#page["live-runs"].closest("table").querySelectorAll("thead th");
    const names = [...head].map(({ textContent }) => textContent);
    const rows = [...new Set(cards.map(({ run }) => run))].sort().map((run) => {
      const all = ended.filter((card) => card.run === run);
      const own = all.slice(0, last);
      const numRunning = cards.filter((card) => card.run === run && !card.hasEnded).length;
      const rate = own.length ? `${(100 * mean(own.map(({ succeeded }) => Number(succeeded)))).toFixed(0)} %` : NONE;
      const newest = own[0] ?? cards.find((card) => card.run === run);
      const alike = own.filter(({ leading }) => leading === newest.leading); // seconds and shares have no mean
      const means = [
        cellOf(newest.leading, mean(alike.map(({ lastLeading }) => lastLeading))),
        shown(mean(own.map(({ lastSuccess }) => lastSuccess))),
      ];
      const steps = mean(own.map(({ numSteps }) => numSteps));
      const texts = [numRunning, all.length, rate, ...means, steps === null ? NONE : steps.toFixed(1)];
      const row = document.createElement("tr");
      const header = document.createElement("th");
      header.scope = "row";
      header.textContent = run;
      row.append(header, ...texts.map((text) => cell(text, "number")));
      return label(row, names);
    });
    const text = (each) => each.map(({ textContent }) => textContent).join("\n");
    if (text(rows) !== text([...this.#page["live-runs"].rows])) this.#page["live-runs"].replaceChildren(...rows);
  }
}

/** The mean of the numbers that are there; null: none is. */
function mean(values) {
  const there = values.filter((value) => value !== null && value !== undefined);
  return there.length ? there.reduce((sum, value) => sum + value, 0) / there.length : null;
}
