// SPDX-License-Identifier: MIT
// How many episodes end with which progress, as bars drawn by uPlot.

import { colourName, themed } from "./chart.js";
import uPlot from "./uplot/uPlot.esm.js";

const HEIGHT_PX = 170;
const COUNTS = [1, 2, 5].flatMap((digit) => [1, 10, 100, 1e3, 1e4, 1e5].map((power) => digit * power)).sort((a, b) => a - b);

/** Bars in `host`. */
export class Histogram {
  #host;
  #plot = null;

  constructor(host) {
    this.#host = host;
    new ResizeObserver(() => host.clientWidth && this.#plot?.setSize(this.#size())).observe(host);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#plot?.redraw());
  }

  /** Draws the bars: `edges` has one number more than `counts`. */
  show({ edges, counts }) {
    this.#plot?.destroy();
    const axis = { stroke: () => themed("--text"), grid: { stroke: () => themed("--grid"), width: 1 } };
    const fill = () => themed(`--${colourName(0)}`);
    const options = {
      ...this.#size(),
      legend: { show: false },
      cursor: { show: false },
      scales: { x: { time: false, range: [edges[0], edges.at(-1)] }, y: { range: [0, Math.max(1, ...counts) * 1.05] } },
      axes: [{ ...axis, label: "final progress" }, { ...axis, label: "episodes", incrs: COUNTS }],
      series: [{}, { stroke: fill, fill, width: 0, paths: uPlot.paths.bars({ size: [0.9], align: 1 }), points: { show: false } }],
    };
    this.#plot = new uPlot(options, [edges.slice(0, -1), counts], this.#host);
  }

  #size() {
    return { width: this.#host.clientWidth, height: HEIGHT_PX };
  }
}
