// SPDX-License-Identifier: MIT
// The curves as a table: what was asked, and the numbers at the time that is shown.

import { colourName } from "./chart.js";

const NONE = "-";

/** A number as the page writes it. */
export function shown(value) {
  return value === null || value === undefined ? NONE : value.toFixed(3);
}

/** Writes a row for each curve into `body`. */
export function showTable(body, curves, seconds, threshold) {
  body.replaceChildren(...curves.map((curve) => row(curve, seconds, threshold)));
}

function row(curve, seconds, threshold) {
  const element = document.createElement("tr");
  const here = curve.at(seconds);
  const from = curve.succeedsAt(threshold);
  const frames = curve.numFrames === null ? NONE : `${curve.progress.length} of ${curve.numFrames}`;
  element.append(named(curve.index, curve.video.name), ...[curve.task, curve.model, curve.sampling, frames].map((text) => cell(text)));
  const numbers = [curve.progress[here], curve.success[here], curve.progress.at(-1), curve.success.at(-1)];
  element.append(...numbers.map((value) => cell(shown(value), "number")));
  element.append(cell(from === null ? NONE : `${from.toFixed(2)} s`, "number"));
  element.append(cell(curve.error ?? curve.state, curve.error ? "failed" : ""));
  return element;
}

/** The head of a curve's row: its colour and a name. */
export function named(index, name) {
  const header = document.createElement("th");
  const swatch = document.createElement("span");
  header.scope = "row";
  swatch.className = `swatch ${colourName(index)}`;
  header.append(swatch, name);
  return header;
}

/** A cell of a table. */
export function cell(text, kind = "") {
  const element = document.createElement("td");
  element.textContent = text;
  if (kind) element.className = kind;
  return element;
}
