// SPDX-License-Identifier: MIT
// One running episode: its newest frame, its curve and its numbers.

import { liveFrame } from "./api.js";
import { Chart, colourName } from "./chart.js";
import { leadingOf, shortOf, measured, toldAt } from "./signals.js";
import { shown } from "./text.js";

const NUMBERS = ["Step", "Progress", "Success", "Reward", "Return", "Lag", "Last step"];
const IF_PAID = ["Reward", "Return"]; // only where rewards are reported

/** The name of a run on the page. */
export function titleOfRun(run) {
  return run || "Episode";
}

export class LiveCard {
  #id;
  #mostPoints;
  #index = 0; // of the colour of its run
  #about = {};
  #curve = { times: [], progress: [], success: [] };
  #newest = null;
  #heardMs = 0;
  #frame = null;
  #shownFrame = null;
  #isFetching = false;
  #isNew = false;
  #rank = 0;
  #image = document.createElement("img");
  #heading = document.createElement("h2");
  #opener = document.createElement("button");
  #state = document.createElement("p");
  #task = document.createElement("p");
  #chartHost = document.createElement("div");
  #numbers = new Map();
  #chart;
  element = document.createElement("article");

  constructor(id, mostPoints) {
    this.#id = id;
    this.#mostPoints = mostPoints;
    this.#heading.id = `live-${id}`;
    this.element.setAttribute("aria-labelledby", this.#heading.id);
    this.#image.hidden = true;
    this.#chartHost.className = "chart";
    this.#chartHost.setAttribute("role", "img");
    const list = document.createElement("dl");
    for (const name of NUMBERS) {
      const [group, term, value] = ["div", "dt", "dd"].map((tag) => document.createElement(tag));
      term.textContent = name;
      group.append(term, value);
      list.append(group);
      this.#numbers.set(name, value);
    }
    const head = document.createElement("div");
    head.className = "head";
    this.#state.className = "state";
    head.append(this.#heading, this.#state);
    this.#opener.type = "button";
    this.#opener.addEventListener("click", () => this.#open(!this.element.classList.contains("open")));
    this.element.append(head, this.#task, this.#image, this.#chartHost, list);
    this.#chart = new Chart(this.#chartHost, (step) => this.#chart.moveTo(step), { label: null, isOfSteps: true });
    this.#chart.moveTo(NaN); // there is no step to mark
    this.#chartHost.addEventListener("pointerleave", () => this.#chart.moveTo(NaN));
  }

  /** The name of its run. */
  get run() {
    return this.#about.name;
  }

  /** The name of the score that tells how far the task is. */
  get leading() {
    return leadingOf(this.#curve);
  }

  get lastLeading() {
    return this.#curve[this.leading].at(-1) ?? null;
  }

  get title() {
    return `${titleOfRun(this.run)}, environment ${this.#about.env}`;
  }

  get hasEnded() {
    return this.#about.has_ended;
  }

  /** Its place among all episodes: the higher, the later it was heard of. */
  get rank() {
    return this.#rank;
  }

  /** From now on it has the colour of its run. */
  mark(index) {
    this.#index = index;
    this.element.style.setProperty("--run", `var(--${colourName(index)})`);
  }

  /** Takes over what is new, and its rank. */
  take({ id: _id, age_s: ageS, steps, progress, success, instead, newest, frame, ...about }, rank) {
    this.#rank = rank;
    this.#heardMs = performance.now() - 1000 * ageS;
    if (!steps) return; // nothing
    const most = (values) => values.slice(-this.#mostPoints);
    const old = this.#curve;
    const [leading = "progress"] = Object.keys(instead);
    const news = { times: steps, progress, success, ...instead };
    const joined = Object.entries(news).map(([name, values]) => [name, most([...(old[name] ?? []), ...values])]);
    this.#curve = { leading, ...Object.fromEntries(joined) };
    this.#about = about;
    this.#newest = newest;
    this.#frame = frame;
    this.#isNew = true;
  }

  /** Shows what is known. */
  show() {
    const ageS = (performance.now() - this.#heardMs) / 1000;
    this.#numbers.get("Last step").textContent = `${ageS.toFixed(0)} s ago`;
    if (this.#isNew) this.#showNews();
    this.#isNew = false;
    this.#showFrame();
  }

  /** Frees what it holds. */
  remove() {
    this.element.remove();
    this.#chart.remove();
    URL.revokeObjectURL(this.#image.src);
  }

  #showNews() {
    const { task, has_ended: hasEnded, reward, total_reward: total } = this.#about;
    const { step, success, succeeded, ms } = this.#newest ?? {};
    if (hasEnded) {
      this.#opener.textContent = this.title;
      if (!this.#opener.isConnected) this.#heading.replaceChildren(this.#opener);
    } else this.#heading.textContent = this.title;
    this.#state.textContent = `${hasEnded ? "ended" : "running"}${succeeded ? ", succeeded ✓" : hasEnded ? ", no success" : ""}`;
    this.#task.textContent = task;
    this.element.classList.toggle("ended", hasEnded);
    this.#image.alt = `Newest frame of ${this.title}: ${task}`;
    const texts = { Step: `${step ?? "-"}`, Progress: measured(this.leading, this.lastLeading), Success: shown(success), Reward: shown(reward), Return: shown(total), Lag: ms === undefined ? "-" : `${ms.toFixed(0)} ms` };
    for (const [name, text] of Object.entries(texts)) this.#numbers.get(name).textContent = text;
    for (const name of IF_PAID) this.#numbers.get(name).parentElement.hidden = total === null;
    const { times } = this.#curve;
    this.#numbers.get("Progress").previousSibling.textContent = capitalised(shortOf(this.leading));
    this.#opener.setAttribute("aria-expanded", this.element.classList.contains("open"));
    if (!this.#isSmall) this.#draw();
    this.#chartHost.setAttribute("aria-label", `${times.length} steps: final ${toldAt(this.#curve, -1)}, final success ${shown(success)}`);
  }

  /** Whether it is a small picture in the strip of ended episodes. */
  get #isSmall() {
    return this.hasEnded && !this.element.classList.contains("open");
  }

  /** Draws the curve. */
  #draw() {
    const { times } = this.#curve;
    this.#chart.setThreshold(this.#about.threshold);
    this.#chart.show([{ ...this.#curve, index: this.#index, label: this.title, begin: times[0], allTimes: times }]);
  }

  /** Shows an ended episode whole, or as a small picture. */
  #open(isOpen) {
    this.element.classList.toggle("open", isOpen);
    this.#opener.setAttribute("aria-expanded", isOpen);
    if (isOpen) this.#draw();
  }

  /** Fetches the newest frame if somebody can see it. */
  async #showFrame() {
    const { top, bottom } = this.element.getBoundingClientRect();
    if (this.#frame === this.#shownFrame || this.#isFetching || bottom < 0 || top > innerHeight) return;
    this.#shownFrame = this.#frame;
    this.#isFetching = true;
    try {
      const url = URL.createObjectURL(await liveFrame(this.#id));
      URL.revokeObjectURL(this.#image.src);
      Object.assign(this.#image, { src: url, hidden: false });
    } catch { // it has been forgotten meanwhile, or the next question tells what is wrong
    } finally {
      this.#isFetching = false;
    }
  }
}

function capitalised(word) {
  return word[0].toUpperCase() + word.slice(1);
}
