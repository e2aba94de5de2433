// SPDX-License-Identifier: MIT
// How the episodes of each run have ended: a chart of return and success, and the means of the last ones.

import { Chart } from "./chart.js";
import { namedLine } from "./looks.js";
import { learn, shortOf } from "./signals.js";

const FEWEST_IN_A_CHART = 2;
const AXES = { final_progress: { short: "progress", unit: "", bounds: [0, 1] }, return: { short: "return", unit: "", bounds: [null, null] } };

export class History {
  #host;
  #legend;
  #chart;
  #ends = new Map(); // by id of the episode, the oldest first
  #drawn = "";

  constructor(host, legend) {
    this.#host = host;
    this.#legend = legend;
    this.#chart = new Chart(host, (number) => this.#chart.moveTo(number), { label: "ended episodes; bold: means", isOfSteps: true });
    this.#chart.setThreshold(null);
    this.#chart.moveTo(NaN); // there is no episode to mark
    host.addEventListener("pointerleave", () => this.#chart.moveTo(NaN));
    learn(AXES);
  }

  /** Takes over the results of episodes. isWhole: in place of all that were there */
  take(ended, isWhole) {
    if (isWhole) this.#ends.clear();
    for (const end of ended) this.#ends.set(end.id, end);
  }

  /** The names of the runs, as their first episodes ended. */
  get runs() {
    return [...new Set([...this.#ends.values()].map(({ run }) => run))];
  }

  /** How the episodes of a run have ended, the oldest first. */
  of(run) {
    return [...this.#ends.values()].filter((end) => end.run === run);
  }

  /** Draws the chart. last: episodes in a mean; names: run and title, in the order of their colours */
  show(last, names) {
    const runs = names.map(([run, title], index) => ({ index, title, ends: this.of(run) })).filter(({ ends }) => ends.length);
    const isThere = runs.some(({ ends }) => ends.length >= FEWEST_IN_A_CHART);
    this.#host.hidden = this.#legend.hidden = !isThere;
    const state = JSON.stringify([last, [...this.#ends.values()]]);
    if (!isThere || state === this.#drawn) return;
    this.#drawn = state;
    const curves = runs.map((run) => curveOf(run, last));
    const single = runs.map((run) => ({ ...curveOf(run, 1), success: run.ends.map(() => null), isFaint: true }));
    this.#chart.show([...curves, ...single]);
    this.#legend.replaceChildren(...curves.map(namedLine));
    const told = curves.map((curve) => `${curve.label}: ${shortOf(curve.leading)} ${curve[curve.leading].at(-1)?.toFixed(3)}, success ${curve.success.at(-1).toFixed(3)}`);
    this.#host.setAttribute("aria-label", `Means over the last ${last} episodes. ${told.join("; ")}`);
  }
}

/** What a chart draws of a run: return where rewards are reported, else how the episodes end; and the share that succeeds. */
function curveOf({ ends, index, title }, last) {
  const { total_reward: paid, leading: newest } = ends.at(-1);
  const leading = paid !== null ? "return" : newest === "progress" ? "final_progress" : newest;
  const valueOf = (end) => (paid !== null ? end.total_reward : end.leading === newest ? end.value : null);
  const times = ends.map(({ number }) => number);
  return {
    index, label: title, times, allTimes: times, begin: times[0], leading,
    [leading]: runningMeans(ends.map(valueOf), last), progress: [],
    success: runningMeans(ends.map(({ succeeded }) => Number(succeeded)), last),
  };
}

/** At each place the mean of the last numbers that are there; null: none of them is. */
function runningMeans(values, last) {
  return values.map((_, place) => mean(values.slice(Math.max(0, place + 1 - last), place + 1)));
}

/** The mean of the numbers that are there; null: none is. */
export function mean(values) {
  const there = values.filter((value) => value !== null && value !== undefined);
  return there.length ? there.reduce((sum, value) => sum + value, 0) / there.length : null;
}
