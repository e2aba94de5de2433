// SPDX-License-Identifier: MIT
// The chart: progress of each curve above, or what its model predicts in place of it, success in a band below, over time or over steps, drawn by uPlot.

import { pointAt } from "./curves.js";
import { leadingOf, marksOf, numberOf, scaleOf, titleOf } from "./signals.js";
import uPlot from "./uplot/uPlot.esm.js";

const NUM_COLOURS = 12;
const LEFT_PX = 60; // of the numbers and names to the left
const VALUE_PX = 16; // height of a number beside a line
const VALUE_WIDTH_PX = 48;
const FEWEST_STEPS = 10; // on an axis of steps, so that it stays as it is from the first step on
export const MARK_PX = 72; // at least between the marks of the axis below
const FAINT = "50"; // opacity, in hexadecimal
const POINT_PX = 20; // nearer to each other, points are not drawn as dots
const MARKER_PX = 7; // of a dot at a frame between frames that the model skips
const LARGE_PX = 400; // a chart so high and so wide has larger letters
const LOW_PX = 240; // a chart so low has fewer marks
const WITH_SUCCESS = { leading: [0.37, 0.98], success: [0.03, 0.27] }; // shares of the height
const LOW_WITH_SUCCESS = { leading: [0.46, 0.98], success: [0.03, 0.36] };
const WITHOUT_SUCCESS = { leading: [0.03, 0.98] };
const GAP = 0.06; // of the height, between progress and what other models predict in place of it

/** The name of the colour of curve number `index`, which the style sheet has for each theme. */
export function colourName(index) {
  return `curve-${index % NUM_COLOURS}`;
}

/** What the style sheet says for this theme, or within an element. */
export function themed(name, element = document.documentElement) {
  return getComputedStyle(element).getPropertyValue(name).trim();
}

/** The colour of a signal of a curve: its own, or that of its number. */
export function colourOf({ colour, index, successIndex }, signal = "progress", element = undefined) {
  return colour ?? themed(`--${colourName(signal === "success" ? successIndex ?? index : index)}`, element);
}

/** Where each signal of the curves lies in a chart: `from` and `to`, shares of its height, stand for `scale`. */
export function panesOf(curves, isLow = false) {
  const hasSuccess = curves.some(({ success }) => success.some((value) => value !== null));
  const { leading, success } = !hasSuccess ? WITHOUT_SUCCESS : isLow ? LOW_WITH_SUCCESS : WITH_SUCCESS;
  const signals = [...new Set(curves.map(leadingOf))].sort();
  if (!signals.length) signals.push("progress");
  const height = (leading[1] - leading[0] - GAP * (signals.length - 1)) / signals.length;
  const panes = signals.map((signal, place) => {
    const to = leading[1] - place * (height + GAP);
    return [signal, { from: to - height, to, scale: scaleOf(signal, curves) }];
  });
  if (success) panes.push(["success", { from: success[0], to: success[1], scale: scaleOf("success", curves) }]);
  return Object.fromEntries(panes);
}

/** The share of a chart's height at which a value of a signal lies; null: it has none. */
export function heightOf(panes, signal, value) {
  if (value === null || value === undefined || !panes[signal]) return null;
  const { from, to, scale: [low, high] } = panes[signal];
  return from + ((value - low) / (high - low)) * (to - from);
}

/**
 * A chart in `host`. `onTime(seconds, isDragged)` is called when somebody points at it or drags in it.
 * label: of the axis below; null: none. onThreshold(value): somebody drags the line at which success counts
 * isOfSteps: the axis below counts steps
 */
export class Chart {
  #host;
  #onTime;
  #onThreshold;
  #label;
  #isOfSteps;
  #plot = null;
  #curves = [];
  #panes = panesOf([]);
  #shape = "";
  #begin = 0;
  #end = 1;
  #threshold = 0.5;
  #time = 0;
  #playhead = made("playhead");
  #line = made("threshold");
  #values = made("values");
  #dots = made("dots");
  #leaving = new AbortController();
  #resizing = new ResizeObserver(() => this.#host.clientWidth && this.#plot?.setSize(this.#size()));

  constructor(host, onTime, { label = "seconds", onThreshold = null, isOfSteps = false } = {}) {
    this.#host = host;
    this.#label = label;
    this.#isOfSteps = isOfSteps;
    this.#onTime = onTime;
    this.#onThreshold = onThreshold;
    this.#line.classList.toggle("movable", onThreshold !== null);
    this.#resizing.observe(host);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw(), this.#leaving);
  }

  /** Frees what it holds. */
  remove() {
    this.#resizing.disconnect();
    this.#leaving.abort();
    this.#plot?.destroy();
  }

  /**
   * Draws the curves: each has `times`, `progress` and `success`, of one length, and `allTimes`; one with a `leading`
   * has the array of this name in place of progress.
   * Some have a `begin`, a `colour`, a `successIndex` of another colour for success, or a `dash`: lengths of strokes and gaps.
   * One that `isFaint` has no numbers beside it. One that `skipsFrames` has a dot at each point.
   */
  show(curves) {
    this.#curves = curves.filter(({ times }) => times.length);
    this.#panes = panesOf(this.#curves, this.#isLow);
    this.#begin = Math.min(...this.#curves.map(({ begin }) => begin ?? 0), Infinity);
    this.#end = Math.max(0, ...this.#curves.map(({ allTimes }) => allTimes.at(-1))); // so that the axis does not grow
    if (this.#isOfSteps) this.#end = Math.max(this.#end, this.#begin + FEWEST_STEPS);
    if (this.#end <= this.#begin) this.#end = this.#begin + 1; // uPlot divides an axis of no length for ever
    const signals = Object.keys(this.#panes);
    const tables = this.#drawn.map((curve) => [
      curve.times, ...signals.map((signal) => curve.times.map((_, index) => heightOf(this.#panes, signal, curve[signal]?.[index]))),
    ]);
    const data = tables.length ? uPlot.join(tables) : [[], []];
    const shape = `${JSON.stringify(this.#panes)} ${this.#isLow} ${JSON.stringify(this.#curves.map(({ dash, isFaint, skipsFrames }) => [dash, isFaint, skipsFrames]))}`;
    if (shape !== this.#shape || !this.#plot) {
      this.#plot?.destroy();
      this.#plot = this.#curves.length ? this.#newPlot(signals, data) : null;
      this.#shape = shape;
    } else {
      this.#plot.setData(data);
    }
    this.setThreshold(this.#threshold);
    this.moveTo(this.#time);
  }

  /** Draws everything in the colours of now. */
  redraw() {
    this.#plot?.redraw();
    this.moveTo(this.#time);
  }

  /** Draws the line at which success counts; null: none. */
  setThreshold(value) {
    this.#threshold = value;
    this.#line.hidden = value === null || !this.#panes.success;
    if (!this.#plot || this.#line.hidden) return;
    this.#line.dataset.value = value.toFixed(2);
    this.#line.style.transform = `translateY(${this.#top("success", value)}px)`;
  }

  /** Moves the vertical line to a time, and the numbers beside it. */
  moveTo(seconds) {
    this.#time = seconds;
    if (!this.#plot) return;
    const width = this.#plot.over.clientWidth;
    const left = this.#plot.valToPos(seconds, "x");
    const isHidden = !Number.isFinite(left) || left < 0 || left > width + 1;
    this.#playhead.hidden = this.#values.hidden = this.#dots.hidden = isHidden;
    this.#playhead.style.transform = `translateX(${left}px)`;
    if (isHidden) return;
    this.#values.classList.toggle("left", left > width - VALUE_WIDTH_PX - 8);
    this.#values.style.transform = `translateX(${left}px)`;
    this.#showValues(seconds);
  }

  /** Writes the number of each curve beside its line, one below the other where lines meet. */
  #showValues(seconds) {
    const dots = [];
    const labels = Object.keys(this.#panes).flatMap((signal) => {
      const here = this.#curves.filter(({ isFaint }) => !isFaint).map((curve) => {
        const index = pointAt(curve.times, seconds);
        return { curve, signal, time: curve.times[index], value: index === null ? null : curve[signal]?.[index] };
      });
      const known = here.filter(({ value }) => value !== null && value !== undefined);
      dots.push(...known.map(({ curve, time, value }) => this.#dot(curve, signal, time, value)));
      for (const each of known) each.top = this.#top(signal, each.value) - VALUE_PX / 2;
      const [lowest, highest] = this.#panes[signal].scale.map((value) => this.#top(signal, value));
      const texts = known.map(({ value }) => numberOf(signal, value));
      known.forEach((each, place) => { // equal numbers are seen once
        each.isAgain = texts.indexOf(texts[place]) < place;
        each.isShared = texts.lastIndexOf(texts[place]) > place;
      });
      const seen = apart(known.filter(({ isAgain }) => !isAgain), highest - VALUE_PX, lowest + VALUE_PX / 2);
      return known.filter((each) => each.isAgain || seen.includes(each));
    });
    this.#dots.replaceChildren(...dots.reverse()); // as the lines: the first one on top
    while (this.#values.children.length > labels.length) this.#values.lastChild.remove();
    labels.forEach(({ curve, signal, value, top, isAgain, isShared }, place) => {
      const element = this.#values.children[place] ?? this.#values.appendChild(document.createElement("span"));
      element.textContent = numberOf(signal, value);
      element.dataset.signal = signal;
      element.dataset.curve = curve.label;
      element.hidden = isAgain;
      element.style.color = isShared ? themed("--text") : colourOf(curve, signal);
      element.style.transform = `translateY(${top.toFixed(1)}px)`;
    });
  }

  /** The point of a curve that a number beside it tells. */
  #dot(curve, signal, time, value) {
    const element = document.createElement("i");
    element.style.background = colourOf(curve, signal);
    element.style.transform = `translate(${this.#plot.valToPos(time, "x").toFixed(1)}px, ${this.#top(signal, value).toFixed(1)}px)`;
    return element;
  }

  get #isLow() {
    return this.#host.clientHeight < LOW_PX;
  }

  /** The curves as they are drawn: the first one last, so that none hides it. */
  get #drawn() {
    return [...this.#curves].reverse();
  }

  #top(signal, value) {
    return (1 - heightOf(this.#panes, signal, value)) * this.#plot.over.clientHeight;
  }

  #size() {
    return { width: this.#host.clientWidth, height: this.#host.clientHeight };
  }

  #newPlot(signals, data) {
    const panes = this.#panes; // a plot is drawn once more after the curves have gone
    const kind = this.#isLow || signals.length > 2 ? "few" : "usual";
    const marks = signals.flatMap((signal) => marksOf(signal, panes[signal].scale, kind)
      .map((value) => [heightOf(panes, signal, value), value]));
    const { clientWidth, clientHeight } = this.#host;
    const letterPx = Math.min(clientWidth, clientHeight) < LARGE_PX ? 12 : 14;
    const font = `${letterPx}px system-ui, sans-serif`;
    const isRoomy = ({ over }, _, first, last) => over.clientWidth > POINT_PX * (last - first);
    const axis = {
      stroke: () => themed("--faint"), font, labelFont: font,
      grid: { stroke: () => themed("--grid"), width: 1 }, ticks: { show: false }, labelSize: 18, gap: 4,
    };
    const number = new Map(marks);
    const left = {
      ...axis, size: LEFT_PX, splits: () => marks.map(([height]) => height), filter: (_, splits) => splits,
      values: (_, splits) => splits.map((height) => `${number.get(height)}`),
    };
    const series = this.#drawn.flatMap((curve, place) => signals.map((signal) => {
      const stroke = () => `${colourOf(this.#drawn[place] ?? curve, signal)}${curve.isFaint ? FAINT : ""}`;
      const points = { show: curve.skipsFrames ?? isRoomy, size: curve.skipsFrames ? MARKER_PX : 5, fill: stroke };
      return { stroke, width: 2, dash: curve.dash ?? undefined, points };
    }));
    const options = {
      ...this.#size(),
      padding: [4, this.#onThreshold ? 44 : 12, this.#label === null ? 0 : 4, 0], // to the right the threshold is written
      legend: { show: false },
      cursor: { x: false, y: false, points: { show: false }, drag: { x: false, y: false } },
      scales: { x: { time: false, range: () => [this.#begin, this.#end] }, y: { range: [0, 1] } },
      axes: [{ ...axis, size: 24, space: MARK_PX, label: this.#label, ...(this.#isOfSteps ? { incrs: STEPS } : {}) }, left],
      series: [{}, ...series],
      hooks: { drawAxes: [(plot) => clearBetween(plot, panes)], draw: [(plot) => drawNames(plot, panes, letterPx)], setSize: [() => this.#placeAgain()] },
    };
    const plot = new uPlot(options, data, this.#host);
    plot.over.append(this.#line, this.#playhead, this.#dots, this.#values);
    this.#listen(plot);
    return plot;
  }

  #placeAgain() {
    if (!this.#plot) return;
    this.setThreshold(this.#threshold);
    this.moveTo(this.#time);
  }

  #listen(plot) {
    const tell = (event) => {
      const bounds = plot.over.getBoundingClientRect();
      const seconds = plot.posToVal(event.clientX - bounds.left, "x");
      this.#onTime(Math.min(Math.max(seconds, this.#begin), this.#end), event.buttons > 0);
    };
    plot.over.addEventListener("pointerdown", (event) => {
      plot.over.setPointerCapture(event.pointerId);
      tell(event);
    });
    plot.over.addEventListener("pointermove", tell);
    this.#line.onpointerdown = (event) => {
      if (!this.#onThreshold) return;
      event.stopPropagation();
      this.#line.setPointerCapture(event.pointerId);
    };
    this.#line.onpointermove = (event) => {
      if (!this.#onThreshold || !this.#line.hasPointerCapture(event.pointerId)) return;
      event.stopPropagation();
      const { top, height } = plot.over.getBoundingClientRect();
      const { from, to } = this.#panes.success;
      const value = ((1 - (event.clientY - top) / height) - from) / (to - from);
      this.#onThreshold(Math.round(100 * Math.min(Math.max(value, 0), 1)) / 100);
    };
  }
}

const STEPS = [1, 2, 5].flatMap((digit) => [1, 10, 100, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8].map((power) => digit * power))
  .sort((one, other) => one - other);

/** Ends the grid between signals. */
function clearBetween({ ctx, bbox }, panes) {
  const ordered = Object.values(panes); // from above
  ordered.slice(1).forEach(({ to }, place) => {
    const [top, bottom] = [1 - ordered[place].from, 1 - to].map((share) => bbox.top + share * bbox.height + devicePixelRatio);
    ctx.clearRect(bbox.left, top, bbox.width, bottom - top - 2 * devicePixelRatio);
  });
}

/** Writes the name of each signal beside its part of the axis. */
function drawNames({ ctx, bbox }, panes, letterPx) {
  const scale = devicePixelRatio;
  ctx.save();
  ctx.fillStyle = themed("--faint");
  ctx.font = `${letterPx * scale}px system-ui, sans-serif`;
  ctx.textAlign = "center";
  for (const [signal, { from, to }] of Object.entries(panes)) {
    const title = titleOf(signal);
    ctx.save();
    ctx.translate(bbox.left - (LEFT_PX - 2) * scale, bbox.top + (1 - (from + to) / 2) * bbox.height);
    ctx.rotate(-Math.PI / 2);
    if ((to - from) * bbox.height > ctx.measureText(title).width) ctx.fillText(title, 0, 8 * scale);
    ctx.restore();
  }
  ctx.restore();
}

function made(name) {
  const element = document.createElement("div");
  element.className = name;
  return element;
}

/** Those numbers that fit between two heights, moved so that none hides another. */
function apart(labels, from, to) {
  const fitting = Math.max(Math.floor((to - from) / VALUE_PX), 1);
  const placed = [...labels].sort((one, other) => one.top - other.top).slice(0, fitting);
  let free = from;
  for (const each of placed) {
    each.top = Math.max(each.top, free);
    free = each.top + VALUE_PX;
  }
  let end = to;
  for (const each of placed.reverse()) {
    each.top = Math.min(each.top, end - VALUE_PX);
    end = each.top;
  }
  return labels.filter((each) => placed.includes(each));
}
