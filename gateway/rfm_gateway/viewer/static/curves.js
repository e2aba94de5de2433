// SPDX-License-Identifier: MIT
// What is known of each curve: what was asked, the points that have come, and how it stands.

/** One question about one video, and its points. */
export class Curve {
  times = [];
  progress = [];
  success = [];
  state = "waiting";
  error = null;
  version = null;
  numFrames = null;
  sampledFrames = null;

  /** settings: task, model, rule, frames, fps, orient, resize, as in the form */
  constructor(index, video, settings) {
    Object.assign(this, { index, video, ...settings, frames: settings.frames || null });
    this.allTimes = null;
  }

  /** The same for two curves that ask the same. */
  get identity() {
    const { video, task, model, rule, frames, fps, orient, resize } = this;
    return JSON.stringify([video.id, task, model, rule, frames, fps, orient, resize]);
  }

  get sampling() {
    const frames = this.sampledFrames === null ? [] : [`${this.sampledFrames} frames`];
    return [this.rule, ...frames, ...(this.orient === "none" ? [] : [this.orient])].join(", ");
  }

  get label() {
    return `${this.video.name}: ${this.task} (${this.model}, ${this.sampling})`;
  }

  /** Takes an event of the gateway. */
  take(name, document) {
    if (name === "video") {
      this.numFrames = document.num_frames;
      this.sampledFrames = document.sampled_frames;
      this.allTimes = document.times_s ?? Array.from({ length: this.numFrames }, (_, index) => index / this.fps);
      this.state = "scoring";
    } else if (name === "scores") {
      this.progress.push(...document.progress);
      this.success.push(...document.success);
      this.times = this.allTimes.slice(0, this.progress.length);
      this.version = document.model_version;
    } else if (name === "done") {
      this.state = "done";
    }
  }

  /** The index of the point at a time: the last one that is not after it; null: there is none. */
  at(seconds) {
    const after = this.times.findIndex((time) => time > seconds + 1e-3);
    const index = after < 0 ? this.times.length - 1 : after - 1;
    return index < 0 ? null : index;
  }

  /** When success first reaches a threshold; null: it does not. */
  succeedsAt(threshold) {
    const index = this.success.findIndex((value) => value !== null && value >= threshold);
    return index < 0 ? null : this.times[index];
  }
}
