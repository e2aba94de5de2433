// SPDX-License-Identifier: MIT
// The tab of running episodes: each with its newest frame, its curve and its numbers, as clients report them.

import { hasKey, KeyWanted, liveNews } from "./api.js";
import { LiveCard } from "./livecard.js";

const ASK_EVERY_MS = 500;
const ASK_AGAIN_AFTER_MS = 5000;
const ENDED_SHOWN = 12;

export class LiveTab {
  #page;
  #onError;
  #cards = new Map();
  #cursor = "";
  #timer = null;
  #isAway = false;
  #asking = 0; // number of the loop that asks

  /** onError(error): something went wrong */
  constructor(page, { onError }) {
    this.#page = page;
    this.#onError = onError;
  }

  /** Asks from now on what is new, as long as the tab is to be seen. */
  begin() {
    const key = hasKey() ? ', api_key="the key of this gateway"' : "";
    this.#page["live-code"].textContent = [
      "from rfm_client import LiveView",
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
        if (this.#isAway) this.#page.errors.replaceChildren();
        this.#isAway = false;
      }
    } catch (error) {
      if (asking !== this.#asking) return;
      this.#isAway = true;
      this.#onError(error);
      if (error instanceof KeyWanted) return; // it begins again with a key
      after = ASK_AGAIN_AFTER_MS;
    }
    this.#timer = setTimeout(() => this.#ask(asking), after);
  }

  #take({ cursor, is_whole: isWhole, most_points: mostPoints, episodes }) {
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
    const shown = [...running, ...ended.slice(0, ENDED_SHOWN)];
    const { children } = this.#page["live-episodes"];
    const elements = shown.map(({ element }) => element);
    if (elements.length !== children.length || elements.some((each, index) => each !== children[index])) {
      this.#page["live-episodes"].replaceChildren(...elements);
    }
    for (const card of shown) card.show();
    this.#page["no-live"].hidden = cards.length > 0;
    const told = `Running: ${running.length}. Ended: ${ended.length}${ended.length > ENDED_SHOWN ? `, the newest ${ENDED_SHOWN} are shown` : ""}.`;
    if (this.#page["live-told"].textContent !== told) this.#page["live-told"].textContent = told;
    this.#page["live-told"].hidden = !cards.length;
  }
}
