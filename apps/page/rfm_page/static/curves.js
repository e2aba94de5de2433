// SPDX-License-Identifier: MIT
// What is known of each curve: what was asked, the points that have come, and how it stands.

import { leadingOf } from "./signals.js";

const SEPARATOR = ", ";

/** What a question can differ in, as a name tells it. */
const ASKED = {
  task: ({ task }) => task,
  model: ({ model }) => model,
  rule: ({ rule, frames }) => (frames ? `${rule}, ${frames} frames` : rule),
  fps: ({ fps }) => `${fps} fps`,
  resize: ({ resize }) => (resize ? "downscaled" : "full size"),
};

/** One question about one video, and its points. */
export class Curve {
  times = [];
  progress = [];
  success = [];
  leading = "progress"; // the score that tells how far the task is
  state = "waiting";
  error = null;
  version = null;
  sentPercent = null;
  numFrames = null;
  sampledFrames = null;
  blank = null; // what the frames show, if nothing
  answered = []; // for each point: whether the model answers about this frame
  index = 0; // of its colour
  colour = null; // that somebody gave its video, or its question
  dash = null; // lengths of strokes and gaps; null: a solid line
  title = null; // that somebody gave its question
  asked = null; // the name of its question, if several need one beside their videos
  questionColour = null; // that somebody gave its question
  leaving = new AbortController(); // aborted as soon as the curve is removed

  /** settings: task, model, rule, frames, fps, orient, channels, resize, as in the form */
  constructor(video, settings) {
    Object.assign(this, { video, ...settings, frames: settings.frames || null });
    this.allTimes = null;
  }

  /** The same for two curves that ask the same. */
  get identity() {
    const { video, task, model, rule, frames, fps, orient, channels, resize } = this;
    return JSON.stringify([video.id, task, model, rule, frames, fps, orient, channels, resize]);
  }

  get sampling() {
    const frames = this.sampledFrames === null ? "" : `: up to ${this.sampledFrames} of the frames so far`;
    return [`${this.rule}${frames}`, ...corrections(this)].join(", ");
  }

  get name() {
    return this.video.title;
  }

  get label() {
    return `${this.name}: ${this.title ?? `${this.task} (${this.model}, ${this.sampling})`}`;
  }

  /** Takes the share of the video that has been sent. Says whether that is news. */
  takeSent(share) {
    const percent = Math.floor(100 * share);
    if (percent === this.sentPercent) return false;
    this.sentPercent = percent;
    this.state = percent < 100 ? `uploading, ${percent} %` : "sent";
    return true;
  }

  /** Whether the video is on the way. */
  get isUploading() {
    return this.state.startsWith("uploading");
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
      this.answered.push(...document.answered);
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

/** How many of the curves failed, in words; "": none. */
export function failedOf(curves) {
  const failed = curves.filter(({ state }) => state === "failed").length;
  return failed && failed < curves.length ? `${failed} failed` : failed ? "failed" : "";
}

/** What is changed in the frames of a video before they are scored. */
function corrections({ orient, channels }) {
  return [orient, channels].filter((value) => value !== "none" && value !== "rgb");
}

/** The curve at the frames about which its model answers; some models skip frames. Frames whose score is missing stay. */
export function answeredOf(curve) {
  if (!curve.answered?.includes(false)) return curve;
  const names = ["times", "success", leadingOf(curve)];
  const kept = names.map((name) => [name, curve[name].filter((_, index) => curve.answered[index])]);
  return Object.assign(Object.create(curve), { skipsFrames: true, ...Object.fromEntries(kept) });
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

/**
 * The questions that curves answer, in the order in which they were first asked: each with a `key`, its `curves`, a
 * `name` that tells it from the others, and the `title` and `colour` that somebody gave it.
 */
export function questionsOf(curves) {
  const isCorrected = new Map(); // a question differs in corrections only if one video was asked about with several
  for (const curve of curves) isCorrected.set(curve.video, (isCorrected.get(curve.video) ?? new Set()).add(`${corrections(curve)}`));
  const fields = { ...ASKED };
  if ([...isCorrected.values()].some(({ size }) => size > 1)) fields.corrected = (curve) => corrections(curve).join(", ") || "as stored";
  const alike = new Map();
  for (const curve of curves) {
    const key = JSON.stringify(Object.values(fields).map((told) => told(curve)));
    alike.set(key, [...(alike.get(key) ?? []), curve]);
  }
  const firsts = [...alike.values()].map(([first]) => first);
  const differing = Object.values(fields).filter((told) => new Set(firsts.map(told)).size > 1);
  return [...alike].map(([key, own]) => {
    const title = own.find((curve) => curve.title)?.title ?? null;
    const colour = own.find((curve) => curve.questionColour)?.questionColour ?? null;
    return { key, curves: own, title, colour, name: title ?? (differing.map((told) => told(own[0])).join(SEPARATOR) || own[0].task) };
  });
}
