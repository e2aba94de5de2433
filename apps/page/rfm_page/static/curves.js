// SPDX-License-Identifier: MIT
// What is known of each curve: what was asked, the points that have come, and how it stands.

import { cut } from "./text.js";

const SEPARATOR = ", ";
const TOLD_APART_BY = ["name", "task", "model", "sampling", "fps"];

/** One question about one video, and its points. */
export class Curve {
  times = [];
  progress = [];
  success = [];
  leading = "progress"; // the score that tells how far the task is
  state = "waiting";
  error = null;
  version = null;
  numFrames = null;
  sampledFrames = null;
  blank = null; // what the frames show, if nothing
  title = null; // that somebody gave it
  colour = null; // that somebody gave it
  leaving = new AbortController(); // aborted as soon as the curve is removed

  /** settings: task, model, rule, frames, fps, orient, channels, resize, as in the form */
  constructor(index, video, settings) {
    Object.assign(this, { index, video, ...settings, frames: settings.frames || null });
    this.allTimes = null;
  }

  /** The same for two curves that ask the same. */
  get identity() {
    const { video, task, model, rule, frames, fps, orient, channels, resize } = this;
    return JSON.stringify([video.id, task, model, rule, frames, fps, orient, channels, resize]);
  }

  get sampling() {
    const frames = this.sampledFrames === null ? [] : [`${this.sampledFrames} frames`];
    return [this.rule, ...frames, ...corrections(this)].join(", ");
  }

  get name() {
    return this.video.title;
  }

  get label() {
    return this.title ?? `${this.name}: ${this.task} (${this.model}, ${this.sampling})`;
  }

  /** Takes an event of the gateway. */
  take(name, document) {
    if (name === "video") {
      this.numFrames = document.num_frames;
      this.sampledFrames = document.sampled_frames;
      this.blank = document.blank;
      this.allTimes = document.times_s ?? Array.from({ length: this.numFrames }, (_, index) => index / this.fps);
      this.state = "scoring";
    } else if (name === "scores") {
      this.leading = document.leading;
      if (this.leading !== "progress") (this[this.leading] ??= []).push(...document[this.leading]);
      this.progress.push(...document.progress);
      this.success.push(...document.success);
      this.times = this.allTimes.slice(0, this.progress.length);
      this.version = document.model_version;
    } else if (name === "done") {
      this.state = "done";
    }
  }

  /** When success first reaches a threshold; null: it does not. */
  succeedsAt(threshold) {
    const index = this.success.findIndex((value) => value !== null && value >= threshold);
    return index < 0 ? null : this.times[index];
  }
}

/** What is changed in the frames of a video before they are scored. */
function corrections({ orient, channels }) {
  return [orient, channels].filter((value) => value !== "none" && value !== "rgb");
}

/** The index of the point at a time: the last one that is not after it; null: there is none. */
export function pointAt(times, seconds) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] > seconds + 1e-3) high = middle;
    else low = middle + 1;
  }
  return low ? low - 1 : null;
}

/** A short name of each curve: what tells it from the others, in at most `most` letters. */
export function shortNames(curves, most) {
  const drawn = curves.filter(({ times }) => times.length); // of the others the sampling is not known
  const told = TOLD_APART_BY.filter((field) => new Set(drawn.map((curve) => curve[field])).size > 1);
  const fields = told.length ? told : ["name"];
  return curves.map((curve) => {
    const parts = fields.map((field) => (field === "fps" ? `${curve.fps} fps` : curve[field]));
    const each = Math.floor((most + SEPARATOR.length) / parts.length) - SEPARATOR.length;
    return cut(curve.title ?? parts.map((part) => cut(part, each)).join(SEPARATOR), most);
  });
}
