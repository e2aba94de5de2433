// SPDX-License-Identifier: MIT
// The chart: progress and success of each curve over the time in its video or over its steps, drawn by uPlot.

import uPlot from "./uplot/uPlot.esm.js";

const HEIGHT_PX = 300;
const NUM_COLOURS = 8;
const PNG_LINE_PX = 22;

/** The name of the colour of curve number `index`, which the style sheet has for each theme. */
export function colourName(index) {
  return `curve-${index % NUM_COLOURS}`;
}

function colour(index) {
  return themed(`--${colourName(index)}`);
}

/** What the style sheet says for this theme. */
export function themed(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/**
 * A chart in `host`. `onTime(seconds, isDragged)` is called when somebody points at it or drags in it.
 * label: of the axis to the right; null: none
 */
export class Chart {
  #host;
  #onTime;
  #plot = null;
  #numCurves = 0;
  #heightPx;
  #label;
  #begin = 0;
  #end = 1;
  #threshold = 0.5;
  #time = 0;
  #playhead = document.createElement("div");
  #leaving = new AbortController();
  #resizing = new ResizeObserver(() => this.#host.clientWidth && this.#plot?.setSize(this.#size()));

  constructor(host, onTime, { heightPx = HEIGHT_PX, label = "seconds" } = {}) {
    this.#host = host;
    this.#heightPx = heightPx;
    this.#label = label;
    this.#onTime = onTime;
    this.#playhead.className = "playhead";
    this.#resizing.observe(host);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#plot?.redraw(), this.#leaving);
  }

  /** Frees what it holds. */
  remove() {
    this.#resizing.disconnect();
    this.#leaving.abort();
    this.#plot?.destroy();
  }

  /** Draws the curves: each has `times`, `progress` and `success`, of one length, and `allTimes`; some have a `begin`. */
  show(curves) {
    const drawn = curves.filter(({ times }) => times.length);
    this.#begin = Math.min(...drawn.map(({ begin }) => begin ?? 0), Infinity);
    this.#end = Math.max(0, ...drawn.map(({ allTimes }) => allTimes.at(-1))); // so that the axis does not grow
    if (this.#end <= this.#begin) this.#end = this.#begin + 1; // uPlot divides an axis of no length for ever
    const tables = drawn.map(({ times, progress, success }) => [times, progress, success]);
    const data = tables.length ? uPlot.join(tables) : [[], []];
    if (drawn.length !== this.#numCurves || !this.#plot) {
      this.#plot?.destroy();
      this.#plot = drawn.length ? this.#newPlot(drawn.map(({ index }) => index), data) : null;
      this.#numCurves = drawn.length;
    } else {
      this.#plot.setData(data);
    }
    this.moveTo(this.#time);
  }

  /** Draws the line at which success counts; null: none. */
  setThreshold(value) {
    this.#threshold = value;
    this.#plot?.redraw(false);
  }

  /** Moves the vertical line to a time. */
  moveTo(seconds) {
    this.#time = seconds;
    if (!this.#plot) return;
    const left = this.#plot.valToPos(seconds, "x");
    this.#playhead.hidden = !Number.isFinite(left) || left < 0 || left > this.#plot.over.clientWidth + 1;
    this.#playhead.style.transform = `translateX(${left}px)`;
  }

  /** A picture of the chart with the names of its curves below, as a Blob. */
  png(curves) {
    const chart = this.#plot.ctx.canvas;
    const scale = devicePixelRatio;
    const canvas = document.createElement("canvas");
    canvas.width = chart.width;
    canvas.height = chart.height + (curves.length + 1) * PNG_LINE_PX * scale;
    const context = canvas.getContext("2d");
    context.fillStyle = themed("--page");
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(chart, 0, 0);
    context.font = `${14 * scale}px sans-serif`;
    curves.forEach(({ index, label }, line) => {
      context.fillStyle = colour(index);
      context.fillText(label, 50 * scale, chart.height + (line + 1) * PNG_LINE_PX * scale);
    });
    return new Promise((done) => canvas.toBlob(done, "image/png"));
  }

  #size() {
    return { width: this.#host.clientWidth, height: this.#heightPx };
  }

  #newPlot(indices, data) {
    const axis = { stroke: () => themed("--text"), grid: { stroke: () => themed("--grid"), width: 1 } };
    const series = indices.flatMap((index) => {
      const line = { stroke: () => colour(index), width: 2, points: { fill: () => themed("--page") } };
      return [line, { ...line, dash: [7, 5] }];
    });
    const options = {
      ...this.#size(),
      legend: { show: false },
      cursor: { x: false, y: false, drag: { x: false, y: false } },
      scales: { x: { time: false, range: () => [this.#begin, this.#end] }, y: { range: [-0.02, 1.02] } },
      axes: [{ ...axis, label: this.#label }, axis],
      series: [{}, ...series],
      hooks: { draw: [(plot) => this.#drawThreshold(plot)], setSize: [() => this.moveTo(this.#time)] },
    };
    const plot = new uPlot(options, data, this.#host);
    plot.over.append(this.#playhead);
    this.#listen(plot);
    return plot;
  }

  #listen(plot) {
    const tell = (event) => {
      const bounds = plot.over.getBoundingClientRect();
      const seconds = plot.posToVal(event.clientX - bounds.left, "x");
      this.#onTime(Math.max(seconds, 0), event.buttons > 0);
    };
    plot.over.addEventListener("pointerdown", (event) => {
      plot.over.setPointerCapture(event.pointerId);
      tell(event);
    });
    plot.over.addEventListener("pointermove", tell);
  }

  #drawThreshold({ ctx, bbox, valToPos }) {
    if (this.#threshold === null) return;
    const y = valToPos(this.#threshold, "y", true);
    ctx.save();
    ctx.strokeStyle = themed("--faint");
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([2 * devicePixelRatio, 4 * devicePixelRatio]);
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    ctx.restore();
  }
}
