// SPDX-License-Identifier: MIT
// The curves as a table: what was asked, and how each ends.

import { colourName } from "./chart.js";
import { columnOf, leadingOf } from "./signals.js";
import { cut, NONE, shown } from "./text.js";

const NAME_LETTERS = 28;

/** Writes a row for each curve into `body`. threshold: at which success counts */
export function showTable(body, curves, threshold) {
  const table = body.closest("table");
  const leading = columnOf(curves.map(leadingOf));
  table.querySelector(".leading").textContent = `Final ${leading.title}`;
  const tasks = new Set(curves.map(({ task }) => task));
  table.caption.textContent = tasks.size === 1 ? `Task: ${[...tasks][0]}` : "";
  table.classList.toggle("one-task", tasks.size === 1);
  table.classList.toggle("unjudged", curves.some(({ state }) => state === "done") && curves.every(({ success }) => success.every((value) => value === null)));
  const names = [...table.querySelectorAll("thead th")].map((head) => head.textContent);
  body.replaceChildren(...curves.map((curve) => label(row(curve, threshold, leading.text), names)));
}

/** A row whose cells have the names of their columns, which stand before them where rows are shown as cards. */
export function label(element, names) {
  [...element.cells].forEach((one, place) => { one.dataset.name = names[place]; });
  return element;
}

function row(curve, threshold, leadingText) {
  const element = document.createElement("tr");
  const from = curve.succeedsAt(threshold);
  const frames = curve.numFrames === null ? NONE : `${curve.progress.length} of ${curve.numFrames}`;
  element.append(named(curve, curve.name), ...[curve.task, curve.model, curve.sampling].map((text) => cell(text)), cell(frames, "number"));
  const leading = leadingOf(curve);
  element.append(...[leadingText(leading, curve[leading].at(-1)), shown(curve.success.at(-1))].map((text) => cell(text, "number")));
  const isLost = from !== null && curve.state === "done" && curve.success.findLast((value) => value !== null) < threshold;
  element.append(cell(from === null ? NONE : `${from.toFixed(2)} s${isLost ? ", then lost" : ""}`, "number"));
  const warning = curve.blank && `${curve.blank}: the scores mean nothing`;
  element.append(cell(curve.error ?? [curve.state === "done" ? "scored" : curve.state, warning].filter(Boolean).join("; "), curve.error || warning ? "failed" : ""));
  return element;
}

/** The head of a curve's row: its colour and a name. */
function named(curve, name) {
  const header = document.createElement("th");
  const swatch = document.createElement("span");
  header.scope = "row";
  swatch.className = "swatch";
  swatch.style.background = curve.colour ?? `var(--${colourName(curve.index)})`; // of either theme
  header.title = name;
  header.append(swatch, [cut(name, NAME_LETTERS), curve.asked && cut(curve.asked, NAME_LETTERS)].filter(Boolean).join(", "));
  return header;
}

/** A cell of a table. */
export function cell(text, kind = "") {
  const element = document.createElement("td");
  element.textContent = text;
  if (kind) element.className = kind;
  return element;
}
