// SPDX-License-Identifier: MIT
// The chart: progress of each curve above, or what its model predicts in place of it, success in a band below, over time or over steps, drawn by uPlot.

import { pointAt } from "./curves.js";
import { leadingOf, marksOf, numberOf, scaleOf, titleOf } from "./signals.js";
import { sampleOf } from "./svg.js";
import { signed } from "./text.js";
import uPlot from "./uplot/uPlot.esm.js";

export const NUM_COLOURS = 12;
const LEFT_PX = 60; // of the numbers and names to the left
const VALUE_PX = 16; // height of a number beside the chart
const RIGHT_PX = 64; // of the numbers to the right; of several curves each with a piece of its line
const STUB_PX = 12; // length of such a piece
const MOST_VALUES = 6; // of more curves those of one colour have numbers
export const MARK_PX = 72; // at least between the marks of the axis below
const POINT_PX = 20; // nearer to each other, points are not drawn as dots
const MARKER_PX = 7; // of a dot at a frame between frames that the model skips
const LARGE_PX = 400; // a chart so high and so wide has larger letters
const LOW_PX = 240; // a chart so low has fewer marks
const WITH_SUCCESS = { leading: [0.37, 0.98], success: [0.03, 0.27] }; // shares of the height
const LOW_WITH_SUCCESS = { leading: [0.46, 0.98], success: [0.03, 0.36] };
const WITHOUT_SUCCESS = { leading: [0.03, 0.98] };
const HALVING_PX = 200; // turns of the wheel that halve the time that is shown
const MOST_ZOOM = 500;
const [GAP, LOW_GAP] = [0.06, 0.12]; // of the height, between progress and what other models predict in place of it; half of it is room for a name

/** The name of the colour of curve number `index`, which the style sheet has for each theme. */
export function colourName(index) {
  return `curve-${index % NUM_COLOURS}`;
}

/** What the style sheet says for this theme, or within an element. */
export function themed(name, element = document.documentElement) {
  return getComputedStyle(element).getPropertyValue(name).trim();
}

/** The colour of a curve: its own, or that of its number. */
export function colourOf({ colour, index }, element = undefined) {
  return colour ?? themed(`--${colourName(index)}`, element);
}

/** Where each signal of the curves lies in a chart: `from` and `to`, shares of its height, stand for `scale`. */
export function panesOf(curves, isLow = false) {
  const hasSuccess = curves.some(({ success }) => success.some((value) => value !== null));
  const { leading, success } = !hasSuccess ? WITHOUT_SUCCESS : isLow ? LOW_WITH_SUCCESS : WITH_SUCCESS;
  const signals = [...new Set(curves.map(leadingOf))].sort();
  if (!signals.length) signals.push("progress");
  const gap = isLow ? LOW_GAP : GAP;
  const height = (leading[1] - leading[0] - gap * (signals.length - 1)) / signals.length;
  const panes = signals.map((signal, place) => {
    const to = leading[1] - place * (height + gap);
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
 * onThreshold(value): somebody drags the line at which success counts
 * onView(view): somebody zooms or pans, as `look` takes it
 * onChosen(labels): of many curves, these have numbers; of few curves none is named
 */
export class Chart {
  #host;
  #onTime;
  #onThreshold;
  #onView;
  #onChosen;
  #plot = null;
  #curves = [];
  #panes = panesOf([]);
  #shape = "";
  #end = 1;
  #view = null; // from and to, seconds; null: all
  #threshold = 0.5;
  #time = 0;
  #pointedTop = 0; // height of the pointer
  #playhead = made("playhead");
  #line = made("threshold");
  #values = made("values");
  #dots = made("dots");
  #resizing = new ResizeObserver(() => this.#host.clientWidth && this.#plot?.setSize(this.#size()));

  constructor(host, onTime, { onThreshold = null, onView = () => {}, onChosen = () => {} } = {}) {
    this.#host = host;
    this.#onTime = onTime;
    this.#onThreshold = onThreshold;
    this.#onView = onView;
    this.#onChosen = onChosen;
    this.#line.classList.toggle("movable", onThreshold !== null);
    this.#resizing.observe(host);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
  }

  /**
   * Draws the curves: each has `times`, `progress` and `success`, of one length, and `allTimes`; one with a `leading`
   * has the array of this name in place of progress.
   * Some have a `colour` or a `dash`: lengths of strokes and gaps.
   * One that `skipsFrames` has a dot at each point.
   */
  show(curves) {
    this.#curves = curves.filter(({ times }) => times.length);
    this.#panes = panesOf(this.#curves, this.#isLow);
    const before = this.#end;
    this.#end = Math.max(0, ...this.#curves.map(({ allTimes }) => allTimes.at(-1))); // so that the axis does not grow
    if (this.#end <= 0) this.#end = 1; // uPlot divides an axis of no length for ever
    if (this.#end !== before) this.#view = null;
    const signals = Object.keys(this.#panes);
    const tables = this.#drawn.map((curve) => [
      curve.times, ...signals.map((signal) => curve.times.map((_, index) => heightOf(this.#panes, signal, curve[signal]?.[index]))),
    ]);
    const data = tables.length ? uPlot.join(tables) : [[], []];
    const shape = `${JSON.stringify(this.#panes)} ${this.#isLow} ${JSON.stringify(this.#curves.map(({ dash, skipsFrames }) => [dash, skipsFrames]))}`;
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

  /** Moves the vertical line to a time, and shows the numbers of this time. */
  moveTo(seconds) {
    this.#time = seconds;
    if (!this.#plot) return;
    const width = this.#plot.over.clientWidth;
    const left = this.#plot.valToPos(seconds, "x");
    const isHidden = !Number.isFinite(left) || left < 0 || left > width + 1;
    this.#playhead.hidden = this.#values.hidden = this.#dots.hidden = isHidden;
    this.#playhead.style.transform = `translateX(${left}px)`;
    if (isHidden) return;
    this.#values.style.setProperty("--bottom", `${this.#plot.over.clientHeight + 12}px`);
    this.#showValues(seconds);
  }

  /** Writes the number of each curve to the right of the chart, where no line is, at the height of its point if there is room. */
  #showValues(seconds) {
    const points = Object.keys(this.#panes).flatMap((signal) => this.#curves.map((curve) => {
      const index = pointAt(curve.times, seconds);
      return { curve, signal, time: curve.times[index], value: index === null ? null : curve[signal]?.[index] };
    })).filter(({ value }) => value !== null && value !== undefined);
    for (const point of points) point.top = this.#top(point.signal, point.value);
    const chosen = this.#chosen(points, seconds);
    this.#onChosen(chosen.length < points.length ? chosen.map(({ curve }) => curve.label) : []);
    this.#dots.replaceChildren(...points.map((point) => this.#dot(point)).reverse()); // as the lines: the first one on top
    const ordered = Object.values(this.#panes); // from above
    const gap = Math.min(...ordered.slice(1).map(({ to }, place) => ordered[place].from - to)) * this.#plot.over.clientHeight;
    const beyond = Math.min(VALUE_PX, gap - VALUE_PX) / 2; // of its pane, so that no number hides one of another pane
    const numbers = Object.entries(this.#panes).flatMap(([signal, { scale }]) => {
      const [lowest, highest] = scale.map((value) => this.#top(signal, value));
      return apart(chosen.filter((point) => point.signal === signal), highest - beyond, lowest + beyond);
    });
    this.#values.replaceChildren(...numbers.map(({ curve, signal, value, top }) => {
      const element = document.createElement("span");
      if (this.#hasSeveral) element.append(sampleOf(curve.dash?.map((length) => length / 2), STUB_PX));
      element.append(numberOf(signal, value));
      element.dataset.signal = signal;
      element.dataset.curve = curve.label;
      element.style.color = colourOf(curve);
      element.style.transform = `translateY(${top.toFixed(1)}px)`;
      return element;
    }));
  }

  /** The points that have numbers: of many curves those of one colour, the one that the pointer is nearest to. */
  #chosen(points, seconds) {
    if (this.#curves.length <= MOST_VALUES || !points.length) return points;
    const distance = ({ top }) => Math.abs(top - this.#pointedTop);
    const here = points.filter(({ curve }) => curve.times[0] <= seconds && seconds <= curve.times.at(-1)); // others have ended
    const nearest = (here.length ? here : points).reduce((one, other) => (distance(other) < distance(one) ? other : one));
    return points.filter(({ curve }) => colourOf(curve) === colourOf(nearest.curve));
  }

  /** Whether pieces of lines tell which number is whose. */
  get #hasSeveral() {
    return this.#curves.length > 1;
  }

  /** The point of a curve. */
  #dot({ curve, time, top }) {
    const element = document.createElement("i");
    element.style.background = colourOf(curve);
    element.style.transform = `translate(${this.#plot.valToPos(time, "x").toFixed(1)}px, ${top.toFixed(1)}px)`;
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
      values: (_, splits) => splits.map((height) => signed(number.get(height))),
    };
    const series = this.#drawn.flatMap((curve, place) => signals.map(() => {
      const stroke = () => colourOf(this.#drawn[place] ?? curve);
      const points = { show: curve.skipsFrames ?? isRoomy, size: curve.skipsFrames ? MARKER_PX : 5, fill: stroke };
      return { stroke, width: 2, dash: curve.dash ?? undefined, points };
    }));
    const options = {
      ...this.#size(),
      padding: [4, RIGHT_PX, 4, 0],
      legend: { show: false },
      cursor: { x: false, y: false, points: { show: false }, drag: { x: false, y: false } },
      scales: { x: { time: false, range: () => this.#view ?? [0, this.#end] }, y: { range: [0, 1] } },
      axes: [{ ...axis, size: 24, space: MARK_PX, label: "time (s)" }, left],
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

  /** Zooms around the pointer with Ctrl, or two fingers; moves what is shown sideways. */
  #turned(event, plot) {
    const isSideways = event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY);
    if (!event.ctrlKey && !(this.#view && isSideways)) return; // the page scrolls
    event.preventDefault();
    const { left, width } = plot.over.getBoundingClientRect();
    const [from, to] = this.#view ?? [0, this.#end];
    const share = (event.clientX - left) / width;
    const zoom = event.ctrlKey ? 2 ** (event.deltaY / HALVING_PX) : 1;
    const length = Math.min(Math.max((to - from) * zoom, this.#end / MOST_ZOOM), this.#end);
    const moved = event.ctrlKey ? share * (to - from - length) : ((event.deltaX || event.deltaY) / width) * length;
    const begin = Math.min(Math.max(from + moved, 0), this.#end - length);
    this.#onView(length < this.#end ? [begin, begin + length] : null);
  }

  /** Shows a part of the time. view: from and to, seconds; null: all */
  look(view) {
    this.#view = view;
    this.#plot?.batch((plot) => plot.setData(plot.data)); // at once, since the line stands on the new scale
    this.moveTo(this.#time);
  }

  #listen(plot) {
    const tell = (event) => {
      const bounds = plot.over.getBoundingClientRect();
      const seconds = plot.posToVal(event.clientX - bounds.left, "x");
      this.#pointedTop = event.clientY - bounds.top;
      this.#onTime(Math.min(Math.max(seconds, 0), this.#end), event.buttons > 0);
    };
    plot.over.addEventListener("pointerdown", (event) => {
      plot.over.setPointerCapture(event.pointerId);
      tell(event);
    });
    plot.over.addEventListener("pointermove", tell);
    plot.over.addEventListener("wheel", (event) => this.#turned(event, plot), { passive: false });
    plot.over.addEventListener("dblclick", () => this.#onView(null));
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
    if ((to - from + LOW_GAP) * bbox.height > ctx.measureText(title).width) ctx.fillText(title, 0, 8 * scale);
    ctx.restore();
  }
  ctx.restore();
}

function made(name) {
  const element = document.createElement("div");
  element.className = name;
  return element;
}

/**
 * Those numbers that fit between two heights, moved so that none hides another. Each has the height of its middle as
 * `top`; on the same pixel they keep their order.
 */
function apart(labels, from, to) {
  const placed = [...labels].sort((one, other) => Math.round(one.top) - Math.round(other.top)).slice(0, Math.floor((to - from) / VALUE_PX) + 1);
  let free = from;
  for (const each of placed) {
    each.top = Math.max(each.top, free);
    free = each.top + VALUE_PX;
  }
  let end = to;
  for (const each of placed.reverse()) {
    each.top = Math.min(each.top, end);
    end = each.top - VALUE_PX;
  }
  return labels.filter((each) => placed.includes(each));
}
