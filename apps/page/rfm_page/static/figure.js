// SPDX-License-Identifier: MIT
// The curves as a figure for a paper: as wide as a column, on white, with title and legend, as SVG or PNG.

import { colourOf, heightOf, panesOf, themed } from "./chart.js";
import { answeredOf, questionsOf } from "./curves.js";
import { marksOf, titleOf } from "./signals.js";
import { cut, signed } from "./text.js";

const [WIDTH, PLOT_HEIGHT] = [252, 150]; // points; 3.5 inches, the column of a two-column paper
const [LEFT, RIGHT, TOP] = [34, 10, 6];
const LINE = 10; // points
const FONT = "Helvetica, Arial, sans-serif";
const LETTERS = 42; // that fit into the width
const SMALL_LETTERS = 54; // of the titles below the first
const NUM_TIMES = 6;
const PNG_WIDTH_PX = 2100; // 600 dots an inch: twice what papers ask of pictures

/**
 * The figure as SVG. template: an svg element of the page in light colours
 * titles: lines above the chart; threshold: at which success counts; label: of the axis below
 */
export function svgFigure(template, curves, { titles, threshold, label = "time (s)" }) {
  const drawn = curves.map(answeredOf).filter(({ times }) => times.length);
  const panes = panesOf(drawn);
  const entries = entriesOf(drawn);
  const top = TOP + titles.length * LINE + 4;
  const height = top + PLOT_HEIGHT + 2 * LINE + 4 + entries.length * (LINE + 2);
  const end = Math.max(...drawn.map(({ allTimes }) => allTimes.at(-1))) || 1;
  const x = (time) => LEFT + (time / end) * (WIDTH - LEFT - RIGHT);
  const y = (signal, value) => top + (1 - heightOf(panes, signal, value)) * PLOT_HEIGHT;
  const [ink, faint, grid] = ["--text", "--faint", "--grid"].map((name) => themed(name, template));
  const made = (name, attributes, text = null) => {
    const element = document.createElementNS(template.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    if (text !== null) element.textContent = text;
    return element;
  };
  const size = { width: `${WIDTH}pt`, height: `${height}pt`, viewBox: `0 0 ${WIDTH} ${height}` };
  const svg = made("svg", { ...size, "font-family": FONT, "font-size": 7 });
  const add = (...rest) => svg.append(made(...rest));
  add("rect", { width: WIDTH, height, fill: themed("--page", template) });
  titles.forEach((text, place) => {
    add("text", { x: LEFT, y: TOP + 8 + place * LINE, "font-size": place ? 7 : 8, fill: place ? faint : ink }, cut(text, place ? SMALL_LETTERS : LETTERS));
  });
  for (const signal of Object.keys(panes)) {
    const { scale } = panes[signal];
    for (const value of marksOf(signal, scale, "few")) {
      add("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y(signal, value), y2: y(signal, value), stroke: grid, "stroke-width": 0.5 });
      add("text", { x: LEFT - 3, y: y(signal, value) + 2.5, "text-anchor": "end", fill: faint }, signed(value));
    }
    const middle = (y(signal, scale[0]) + y(signal, scale[1])) / 2;
    add("text", { x: 0, y: 0, transform: `translate(9 ${middle}) rotate(-90)`, "text-anchor": "middle", fill: ink }, titleOf(signal));
  }
  const bottom = top + PLOT_HEIGHT;
  for (const time of roundTimes(end)) {
    add("line", { x1: x(time), x2: x(time), y1: top, y2: bottom, stroke: grid, "stroke-width": 0.5 });
    add("text", { x: x(time), y: bottom + 8, "text-anchor": "middle", fill: faint }, `${time}`);
  }
  add("text", { x: x(end / 2), y: bottom + 17, "text-anchor": "middle", fill: ink }, label);
  if (panes.success && threshold !== null) {
    const at = y("success", threshold);
    add("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: at, y2: at, stroke: faint, "stroke-width": 0.7, "stroke-dasharray": "1 2" });
  }
  for (const curve of drawn) {
    for (const signal of Object.keys(panes)) {
      for (const points of runs(curve, signal)) {
        const path = points.map(([time, value]) => `${x(time).toFixed(2)},${y(signal, value).toFixed(2)}`).join(" ");
        const stroke = colourOf(curve, template);
        add("polyline", { points: path, fill: "none", stroke, "stroke-width": 1.1, "stroke-linejoin": "round", ...dashOf(curve) });
        for (const [time, value] of curve.skipsFrames ? points : []) {
          add("circle", { cx: x(time).toFixed(2), cy: y(signal, value).toFixed(2), r: 1.5, fill: stroke });
        }
      }
    }
  }
  entries.forEach(({ name, curve, dash }, place) => {
    const at = bottom + 2 * LINE + 8 + place * (LINE + 2);
    const stroke = curve ? colourOf(curve, template) : ink;
    add("line", { x1: LEFT, x2: LEFT + 14, y1: at - 2.5, y2: at - 2.5, stroke, "stroke-width": 1.1, ...dashOf({ dash }) });
    add("text", { x: LEFT + 18, y: at, fill: ink }, cut(name, LETTERS));
  });
  return new XMLSerializer().serializeToString(svg);
}

/** The same figure as PNG. */
export async function pngFigure(svg) {
  const image = new Image();
  image.src = URL.createObjectURL(new Blob([svg], { type: "image/svg+xml" }));
  try {
    await image.decode();
    const canvas = document.createElement("canvas");
    canvas.width = PNG_WIDTH_PX;
    canvas.height = Math.round((PNG_WIDTH_PX * image.naturalHeight) / image.naturalWidth);
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    return await new Promise((done) => canvas.toBlob(done, "image/png"));
  } finally {
    URL.revokeObjectURL(image.src);
  }
}

/** What the legend names, as on the page: the colour of each video, then the line of each question; none where there is only one. */
function entriesOf(curves) {
  const [videos, questions] = [[...new Set(curves.map(({ video }) => video))], questionsOf(curves)];
  const ofVideos = videos.map((video) => ({ name: video.title, curve: curves.find((curve) => curve.video === video), dash: null }));
  const ofQuestions = questions.map(({ name, curves: [curve] }) => ({ name, curve: videos.length > 1 ? null : curve, dash: curve.dash }));
  return [ofVideos, ofQuestions].filter(({ length }) => length > 1).flat();
}

/** The line of a curve: half as large as on the page. */
function dashOf({ dash }) {
  return dash ? { "stroke-dasharray": dash.map((length) => length / 2).join(" ") } : {};
}

/** The points of a signal, as [time, value], in pieces without a gap. */
function runs(curve, signal) {
  const pieces = [[]];
  curve.times.forEach((time, index) => {
    const value = curve[signal]?.[index];
    if (value === null || value === undefined) pieces.push([]);
    else pieces.at(-1).push([time, value]);
  });
  return pieces.filter(({ length }) => length);
}

/** A few round times from 0 to the end. */
function roundTimes(end) {
  const power = 10 ** Math.floor(Math.log10(end / NUM_TIMES));
  const step = [1, 2, 5, 10].map((digit) => digit * power).find((each) => end / each <= NUM_TIMES);
  return Array.from({ length: Math.floor(end / step + 1e-9) + 1 }, (_, index) => Number((index * step).toPrecision(12)));
}
