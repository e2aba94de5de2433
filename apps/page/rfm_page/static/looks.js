// SPDX-License-Identifier: MIT
// What curves look like: a colour for each video, and a line for each question, so that no two look alike.

import { colourName, NUM_COLOURS } from "./chart.js";
import { questionsOf } from "./curves.js";
import { sampleOf } from "./svg.js";

/** Lines: lengths of strokes and gaps; the first one is solid. */
export const DASHES = [null, [8, 4], [2, 3], [12, 3, 2, 3], [5, 2], [16, 4]];

/** Gives each curve a colour, a line, and the title of its question. Where there is only one video, the colour is the question's. */
export function giveLooks(curves) {
  const questions = questionsOf(curves);
  const isByQuestion = byQuestion(curves, questions);
  questions.forEach(({ curves: alike, name, title, colour }, place) => {
    for (const curve of alike) {
      const look = isByQuestion ? { index: place, colour } : { index: curve.video.place, colour: curve.video.colour };
      const asked = questions.length > 1 && name !== curve.task ? name : null; // a column has the task
      Object.assign(curve, { ...look, asked, title, questionColour: colour, dash: DASHES[place % DASHES.length] });
    }
  });
}

/** Whether colours tell questions apart, since there is only one video. */
export function byQuestion(curves, questions = questionsOf(curves)) {
  return questions.length > 1 && new Set(curves.map(({ video }) => video)).size === 1;
}

/** The colour and the line of the curve with this number where no two look alike. */
export function lookOf(index) {
  return { index, dash: DASHES[Math.floor(index / NUM_COLOURS) % DASHES.length] };
}

/** An item of a legend: a piece of a curve's line, and its label. */
export function namedLine({ index, label, dash }) {
  const item = document.createElement("li");
  const line = document.createElement("span");
  line.style.color = `var(--${colourName(index)})`; // of either theme
  line.append(sampleOf(dash));
  item.append(line, label);
  return item;
}
