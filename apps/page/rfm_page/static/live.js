// SPDX-License-Identifier: MIT
// The tab of running episodes: each with its newest frame, its curve and its numbers, as clients report them.

import { hasKey, KeyWanted, liveNews } from "./api.js";
import { failure } from "./faults.js";
import { History, mean } from "./history.js";
import { LiveCard, titleOfRun } from "./livecard.js";
import { columnOf, learn } from "./signals.js";
import { Place } from "./states.js";
import { cell, label, named } from "./table.js";
import { NONE, shown } from "./text.js";

const ASK_EVERY_MS = 500;
const ASK_AGAIN_AFTER_MS = 5000;
const ENDED_AT_A_TIME = 24;

export class LiveTab {
  #page;
  #failedAnywhere;
  #errors;
  #cards = new Map();
  #history;
  #runs = []; // their places are those of their colours
  #cursor = "";
  #timer = null;
  #asking = 0; // number of the loop that asks
  #mostEnded = ENDED_AT_A_TIME;

  /** failedAnywhere(error): shows an error that is one on every tab, and says whether it is */
  constructor(page, { failedAnywhere }) {
    this.#page = page;
    this.#failedAnywhere = failedAnywhere;
    this.#errors = new Place(page["live-errors"]);
    this.#history = new History(page["live-history"], page["live-legend"]);
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

  #take({ cursor, is_whole: isWhole, most_points: mostPoints, scores, episodes, ended }) {
    learn(scores);
    this.#cursor = cursor;
    this.#history.take(ended, isWhole);
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
    this.#runs = [...new Set([...this.#runs, ...this.#history.runs, ...cards.map(({ run }) => run)])];
    for (const card of cards) card.mark(this.#runs.indexOf(card.run));
    const visible = [...running, ...ended.slice(0, this.#mostEnded)];
    const page = this.#page;
    place(page["live-episodes"], running);
    place(page["live-ended"], visible.slice(running.length));
    for (const card of visible) card.show();
    page["live-ended-title"].hidden = !ended.length;
    const numHidden = cards.length - visible.length;
    page["no-live"].hidden = cards.length > 0;
    page["live-summary"].hidden = !cards.length;
    page["live-more"].hidden = !numHidden;
    page["live-more"].textContent = `Show more of ${numHidden} ended episodes`;
    const told = `Running: ${running.length}. Ended: ${ended.length}.`;
    if (page["live-told"].textContent !== told) page["live-told"].textContent = told;
    this.#showRuns(cards);
  }

  /** Shows the means of each run over the last episodes that ended. */
  #showRuns(cards) {
    const page = this.#page;
    const last = Math.max(Math.floor(Number(page["live-last"].value)) || 1, 1);
    const head = page["live-runs"].closest("table").querySelectorAll("thead th");
    const runs = this.#runs;
    this.#history.show(last, runs.map((run) => [run, titleOfRun(run)]));
    page["live-running-title"].hidden = !cards.some(({ hasEnded }) => !hasEnded);
    const leadingOfRun = (run) => this.#history.of(run).at(-1)?.leading ?? cards.find((card) => card.run === run)?.leading ?? "progress";
    const column = columnOf(runs.map(leadingOfRun));
    page["live-leading"].textContent = `Mean final ${column.title}`;
    const names = [...head].map(({ textContent }) => textContent);
    const rows = runs.map((run, index) => {
      const all = this.#history.of(run);
      const own = all.slice(-last);
      const numRunning = cards.filter((card) => card.run === run && !card.hasEnded).length;
      const rate = own.length ? `${(100 * mean(own.map(({ succeeded }) => Number(succeeded)))).toFixed(0)} %` : NONE;
      const leading = leadingOfRun(run);
      const alike = own.filter((end) => end.leading === leading); // seconds and shares have no mean
      const means = [
        shown(mean(own.map(({ total_reward: paid }) => paid))),
        column.text(leading, mean(alike.map(({ value }) => value))),
        shown(mean(own.map(({ success }) => success))),
      ];
      const steps = mean(own.map(({ num_steps: count }) => count));
      const texts = [numRunning, all.at(-1)?.number ?? 0, rate, ...means, steps === null ? NONE : steps.toFixed(1)];
      const row = document.createElement("tr");
      row.append(named({ index }, titleOfRun(run)), ...texts.map((text) => cell(text, "number")));
      return label(row, names);
    });
    const isPaid = this.#history.runs.some((run) => this.#history.of(run).at(-1).total_reward !== null);
    head[0].closest("table").classList.toggle("unpaid", !isPaid);
    const text = (each) => each.map(({ textContent }) => textContent).join("\n");
    if (text(rows) !== text([...page["live-runs"].rows])) page["live-runs"].replaceChildren(...rows);
  }
}

/** Puts the elements of cards into a host, in their order. */
function place(host, cards) {
  const elements = cards.map(({ element }) => element);
  const { children } = host;
  if (elements.length === children.length && elements.every((each, index) => each === children[index])) return;
  host.replaceChildren(...elements);
}
