// SPDX-License-Identifier: MIT
// The scores that the page draws: names, units and scales, as the gateway tells them.

import { NONE, shown } from "./text.js";

const MOST_MARKS = { few: 3, usual: 5 };
const SHARE_MARKS = {
  progress: { few: [0, 0.5, 1], usual: [0, 0.25, 0.5, 0.75, 1] },
  success: { few: [0, 1], usual: [0, 0.5, 1] },
};
const SHARE = { unit: "", bounds: [0, 1] };
const known = { progress: { short: "progress", ...SHARE }, success: { short: "success", ...SHARE } };

/** Takes over what the gateway tells of scores: for each by name `short`, `unit` and `bounds`. */
export function learn(scores) {
  Object.assign(known, scores);
}

/** The name of the score that tells how far the task is: progress, or what the model predicts in its place. */
export function leadingOf({ leading }) {
  return leading ?? "progress";
}

/** The title of an axis: the name of a score, with the unit. */
export function titleOf(signal) {
  const { short, unit } = known[signal];
  return unit ? `${short} (${unit})` : short;
}

/** The name of a score in words, without the unit. */
export function shortOf(signal) {
  return known[signal].short;
}

/** A number of a score, with the unit. */
export function measured(signal, value) {
  const text = shown(value);
  return text === NONE ? NONE : [text, known[signal].unit].filter(Boolean).join(" ");
}

/** How far the task is at a point of a curve, in words; index: as of `at`. */
export function toldAt(curve, index) {
  const signal = leadingOf(curve);
  return `${shortOf(signal)} ${measured(signal, curve[signal].at(index))}`;
}

/** A number of a score as a cell below the head "progress". */
export function cellOf(signal, value) {
  const text = measured(signal, value);
  return signal === "progress" || text === NONE ? text : `${text} ${shortOf(signal)}`;
}

/** The smallest and the largest number on the axis of a score: its bounds, or those of the curves with 0 among them. */
export function scaleOf(signal, curves) {
  const [lowest, highest] = known[signal].bounds;
  if (lowest !== null && highest !== null) return [lowest, highest];
  const values = curves.flatMap((curve) => curve[signal] ?? []).filter((value) => value !== null);
  const [low, high] = values.reduce(([least, most], value) => [Math.min(least, value), Math.max(most, value)], [0, 0]);
  const step = stepOf(low, high, MOST_MARKS.usual);
  return [Math.floor(low / step) * step, Math.ceil(high / step) * step || step];
}

/** The numbers that stand beside an axis. kind: few or usual */
export function marksOf(signal, [low, high], kind) {
  if (SHARE_MARKS[signal]) return SHARE_MARKS[signal][kind];
  const step = stepOf(low, high, MOST_MARKS[kind]);
  const [first, last] = [Math.ceil(low / step - 1e-9), Math.floor(high / step + 1e-9)];
  return Array.from({ length: last - first + 1 }, (_, index) => Number(((first + index) * step).toPrecision(12)));
}

/** A round distance of which at most `most` lie between two numbers. */
function stepOf(low, high, most) {
  const span = high - low || 1;
  const power = 10 ** Math.floor(Math.log10(span / most));
  return [1, 2, 5, 10].map((digit) => digit * power).find((each) => span / each <= most + 1e-9);
}
