// SPDX-License-Identifier: MIT
// One time for a chart, for videos and for the controls below them: whatever moves moves the others.

import { Chart } from "./chart.js";
import { answeredOf, pointAt } from "./curves.js";
import { toldAt } from "./signals.js";
import { shown } from "./text.js";
import { Videos } from "./videos.js";

const KEYS = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 };
const NEAR_S = 1e-3;

/**
 * elements: `videos`, `chart` and perhaps `motion` hold what is shown, `slider` is an input, `button` plays and pauses,
 * `told` says the time
 * changing: of the videos, as `Videos` takes it; onChosen: of the chart of motion, and chartOptions: as `Chart` takes them
 */
export class Timeline {
  #slider;
  #button;
  #told;
  #curves = [];
  #points = []; // times at which a curve has a point
  #charts;
  time = 0;

  constructor({ videos, chart, motion = null, slider, button, told }, { changing = null, onChosen, ...chartOptions } = {}) {
    this.videos = new Videos(videos, (seconds, video) => this.moveTo(seconds, video), changing);
    const onView = (view) => { for (const each of this.#charts) each.look(view); };
    this.#charts = [chart, motion].filter(Boolean).map((host, place) =>
      new Chart(host, (seconds, isDragged) => this.#pointedAt(seconds, isDragged), place ? { onView, onChosen } : { ...chartOptions, onView }));
    [this.chart] = this.#charts;
    this.#slider = slider;
    this.#button = button;
    this.#told = told;
    button.addEventListener("click", () => this.#play());
    slider.addEventListener("input", () => {
      this.videos.pause();
      this.moveTo(Number(slider.value));
    });
    slider.addEventListener("keydown", (event) => this.#pressed(event));
  }

  /** Draws the curves, and lets the controls reach the end of them. motion: curves of the robot, beside them */
  show(curves, motion = []) {
    this.#curves = curves.map(answeredOf).filter(({ times }) => times.length);
    this.#points = [...new Set(this.#curves.flatMap((curve) => curve.times))].sort((one, other) => one - other);
    [this.#curves, motion].forEach((each, place) => this.#charts[place]?.show(each));
    this.#slider.disabled = this.#button.disabled = !this.#curves.length;
    this.#slider.max = Math.max(0, ...this.#curves.map(({ allTimes }) => allTimes.at(-1))) || 1;
    this.#showTime();
  }

  /** Moves everything to a time, but for the video that it comes from. */
  moveTo(seconds, from = null) {
    this.time = Math.min(seconds, Number(this.#slider.max));
    if (!this.videos.isPlaying || !from) {
      this.time = this.#at;
      this.videos.seek(this.time, from);
    }
    this.#showTime();
  }

  /** The time of the point that is shown: between two points there is no number. */
  get #at() {
    return this.#points[pointAt(this.#points, this.time)] ?? this.time;
  }

  #showTime() {
    this.#button.textContent = this.videos.isPlaying ? "Pause" : "Play";
    this.#button.classList.toggle("pauses", this.videos.isPlaying);
    const at = this.#at;
    this.#slider.value = at;
    const { allTimes = [] } = this.#curves[0] ?? {};
    const isOneRate = this.#curves.every((curve) => curve.allTimes.length === allTimes.length); // else frames have several numbers
    const frame = isOneRate ? `frame ${(pointAt(allTimes, at) ?? 0) + 1} of ${allTimes.length}, ` : "";
    this.#told.textContent = this.#slider.disabled ? "" : `${frame}${at.toFixed(2)} / ${Number(this.#slider.max).toFixed(2)} s`;
    this.#slider.setAttribute("aria-valuetext", [`${at.toFixed(2)} seconds`, ...this.#numbers()].join("; "));
    for (const chart of this.#charts) chart.moveTo(at);
  }

  /** What stands beside the lines, for somebody who hears the page. */
  #numbers() {
    return this.#curves.map((curve) => {
      const index = pointAt(curve.times, this.time) ?? Infinity; // before the first point there is no number
      return `${curve.label}: ${toldAt(curve, index)}, success ${shown(curve.success[index])}`;
    });
  }

  #pointedAt(seconds, isDragged) {
    if (isDragged) this.videos.pause();
    if (this.videos.isPlaying) return;
    const distance = (point) => Math.abs(point - seconds);
    this.moveTo(this.#points.reduce((one, other) => (distance(other) < distance(one) ? other : one), this.#points[0] ?? seconds));
  }

  #play() {
    if (this.videos.isPlaying) {
      this.videos.pause();
    } else {
      if (this.time >= this.#points.at(-1)) this.moveTo(0);
      this.videos.play();
    }
    setTimeout(() => this.#showTime());
  }

  #pressed(event) {
    const direction = KEYS[event.key];
    if (!direction) return;
    event.preventDefault();
    this.videos.pause();
    this.#step(direction);
  }

  /** Moves to the next point of any curve, or to the one before. */
  #step(direction) {
    const next = direction > 0
      ? this.#points.find((each) => each > this.time + NEAR_S)
      : this.#points.findLast((each) => each < this.time - NEAR_S);
    if (next !== undefined) this.moveTo(next);
  }
}
