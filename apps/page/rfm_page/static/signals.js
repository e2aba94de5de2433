// SPDX-License-Identifier: MIT
// The scores that the page draws: names, units and scales, as the gateway tells them.

import { NONE, shown } from "./text.js";

const ROUNDING = 0.005; // by which a score may leave its bounds unseen
const ROUNDED = 1e-6; // of a number, by which another one is the same
const MOST_MARKS = { few: 3, usual: 5 };
const SHARE_MARKS = {
  progress: { few: [0, 0.5, 1], usual: [0, 0.25, 0.5, 0.75, 1] },
  success: { few: [0, 1], usual: [0, 0.5, 1] },
};
const SHARE = { unit: "", bounds: [0, 1] };
const OPEN = { unit: "", bounds: [] };
const known = {
  progress: { short: "progress", ...SHARE }, success: { short: "success", ...SHARE },
  action: { short: "action", ...OPEN }, state: { short: "state", ...OPEN }, // of the robot
};

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
function shortOf(signal) {
  return known[signal].short;
}

/** A number of a score without the unit: seconds to a tenth, shares to a thousandth, others to four digits. */
export function numberOf(signal, value) {
  const { unit, bounds } = known[signal];
  const digits = bounds.length ? 3 : 3 - Math.min(Math.floor(Math.log10(Math.max(Math.abs(value), 1))), 3);
  return shown(value, unit ? 1 : digits);
}

/** A number of a score, with the unit. */
function measured(signal, value) {
  const text = numberOf(signal, value);
  return text === NONE ? NONE : [text, known[signal].unit].filter(Boolean).join(" ");
}

/** How far the task is at a point of a curve, in words; index: as of `at`. */
export function toldAt(curve, index) {
  const signal = leadingOf(curve);
  return `${shortOf(signal)} ${measured(signal, curve[signal].at(index))}`;
}

/** A column of a table: its `title`, and the `text` of a number of a score. signals: the scores of all rows */
export function columnOf(signals) {
  const [only = "progress", ...others] = new Set(signals);
  if (!others.length) return { title: titleOf(only), text: numberOf };
  const text = (signal, value) => [measured(signal, value), shortOf(signal)].join(" ");
  return { title: "score", text: (signal, value) => (shown(value) === NONE ? NONE : text(signal, value)) };
}

/**
 * The smallest and the largest number on the axis of a score: its bounds with 0, or further where curves leave them, as
 * those of Robo-Dopamine may. Without bounds: those of the curves.
 */
export function scaleOf(signal, curves) {
  const bounds = known[signal].bounds.filter((bound) => bound !== null);
  const values = curves.flatMap((curve) => curve[signal] ?? []).filter((value) => value !== null);
  const [first = 0] = bounds.length ? [] : values;
  const [low, high] = values.reduce(([least, most], value) => [Math.min(least, value), Math.max(most, value)], [Math.min(first, ...bounds), Math.max(first, ...bounds)]);
  if (bounds.length === 2 && low > bounds[0] - ROUNDING && high < bounds[1] + ROUNDING) return bounds;
  const step = stepOf(low, high, MOST_MARKS.usual);
  const bottom = Math.floor(low / step) * step;
  return [bottom, Math.max(Math.ceil(high / step) * step, bottom + step)];
}

/** The numbers that stand beside an axis. kind: few or usual */
export function marksOf(signal, [low, high], kind) {
  if (SHARE_MARKS[signal] && low === 0 && high === 1) return SHARE_MARKS[signal][kind];
  const step = stepOf(low, high, MOST_MARKS[kind]);
  const [first, last] = [Math.ceil(low / step - 1e-9), Math.floor(high / step + 1e-9)];
  return Array.from({ length: last - first + 1 }, (_, index) => Number(((first + index) * step).toPrecision(12)));
}

/** A round distance of which at most `most` lie between two numbers. */
function stepOf(low, high, most) {
  const span = Math.max(high - low, ROUNDED * Math.max(Math.abs(low), Math.abs(high))) || 1;
  const power = 10 ** Math.floor(Math.log10(span / most));
  return [1, 2, 5, 10].map((digit) => digit * power).find((each) => span / each <= most + 1e-9);
}
