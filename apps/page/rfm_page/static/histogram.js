// SPDX-License-Identifier: MIT
// How many episodes end with which progress, and how many of them succeed, as bars drawn by uPlot.

import { MARK_PX, themed } from "./chart.js";
import { SUCCEEDS, UNDONE } from "./episodes.js";
import uPlot from "./uplot/uPlot.esm.js";

const NUM_BINS = 20;
const COUNTS = [1, 2, 5].flatMap((digit) => [1, 10, 100, 1e3, 1e4, 1e5].map((power) => digit * power)).sort((a, b) => a - b);

/** Bars in `host`: what succeeds below, what is undone above it, what never succeeds on top. */
export class Histogram {
  #host;
  #plot = null;
  #most = 1;

  constructor(host) {
    this.#host = host;
    new ResizeObserver(() => host.clientWidth && this.#plot?.setSize(this.#size())).observe(host);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#plot?.redraw());
  }

  /** Draws episodes: each with a `final_progress`, and a `verdict` or null. */
  show(episodes) {
    const [all, ever, good] = [0, 1, 2].map(() => new Array(NUM_BINS).fill(0));
    for (const { final_progress: final, verdict } of episodes) {
      const bin = Math.min(Math.floor(Math.min(Math.max(final, 0), 1) * NUM_BINS), NUM_BINS - 1);
      all[bin] += 1;
      if (verdict === SUCCEEDS || verdict === UNDONE) ever[bin] += 1;
      if (verdict === SUCCEEDS) good[bin] += 1;
    }
    const edges = all.map((_, index) => index / NUM_BINS);
    this.#most = Math.max(1, ...all);
    const undone = (bin) => ever[bin] > good[bin] ? ` and ${ever[bin] - good[bin]} succeed but undo it` : "";
    const told = edges.map((edge, bin) => `${all[bin]} from ${edge.toFixed(2)}${ever[bin] ? ` of which ${good[bin]} succeed${undone(bin)}` : ""}`);
    this.#host.setAttribute("aria-label", `Episodes by final progress: ${told.join(", ")}`);
    const beyond = (counts, least) => counts.map((count, bin) => (count > least[bin] ? count : null)); // of a bar that another hides, a fringe would be seen
    const data = [edges, beyond(all, ever), beyond(ever, good), good];
    if (this.#plot) this.#plot.setData(data);
    else this.#plot = this.#newPlot(data);
  }

  #newPlot(data) {
    const axis = {
      stroke: () => themed("--faint"), font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif",
      grid: { stroke: () => themed("--grid"), width: 1 }, ticks: { show: false }, gap: 4, labelSize: 18,
    };
    const bars = (name) => {
      const fill = () => themed(name);
      return { stroke: fill, fill, width: 0, paths: uPlot.paths.bars({ size: [0.9], align: 1 }), points: { show: false } };
    };
    return new uPlot({
      ...this.#size(),
      padding: [8, 12, 0, 0],
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: [0, 1] }, y: { range: () => [0, this.#most * 1.05] } },
      axes: [{ ...axis, size: 24, space: MARK_PX, label: "final progress" }, { ...axis, size: 36, label: "episodes", incrs: COUNTS }],
      series: [{}, bars("--bad-bar"), bars("--undone-bar"), bars("--line")],
    }, data, this.#host);
  }

  #size() {
    return { width: this.#host.clientWidth, height: this.#host.clientHeight };
  }
}
