// SPDX-License-Identifier: MIT
// Numbers and names as the page writes them.

export const NONE = "-";

/** A number as the page writes it. */
export function shown(value, digits = 3) {
  return value === null || value === undefined ? NONE : signed(value.toFixed(digits));
}

/** The digits of a number behind a minus sign, which is longer than a hyphen. */
export function signed(number) {
  return `${number}`.replace("-", "−");
}

const MOST_DIGITS = 8;

/** A number below a threshold, with as many digits as show that it is below. */
export function shownBelow(value, threshold) {
  let digits = 3;
  while (digits < MOST_DIGITS && Number(value.toFixed(digits)) >= threshold) digits += 1;
  return value.toFixed(digits);
}

const FEWEST_LETTERS = 12; // fewer tell nothing
const BETWEEN_WORDS = /[\s_\-.,:;/]/;

/** A text of at most `most` letters, and 12 at least: of a longer one the middle is left out, between words if it can be, since names differ at their ends. */
export function cut(text, most) {
  const room = Math.max(most, FEWEST_LETTERS) - 1;
  if (text.length <= room + 1) return text;
  const [begin, end] = [text.slice(0, Math.ceil(room / 2)), text.slice(-Math.floor(room / 2))];
  const isWhole = [BETWEEN_WORDS.test(text[begin.length]), BETWEEN_WORDS.test(text[text.length - end.length - 1])];
  return `${isWhole[0] ? begin : wholeWords(begin)}…${isWhole[1] ? end : reversed(wholeWords(reversed(end)))}`;
}

/** The text up to the last word that may be cut, unless little would be left. */
function wholeWords(text) {
  const place = [...text].findLastIndex((letter) => BETWEEN_WORDS.test(letter));
  return place >= FEWEST_LETTERS / 2 ? text.slice(0, place) : text;
}

function reversed(text) {
  return [...text].reverse().join("");
}

/** Writes a command line into an element, which breaks its lines between words: a browser would break them behind hyphens. */
export function writeCommand(element, command) {
  const pieces = command.split(/(\s+)/);
  element.replaceChildren(...pieces.map((piece, place) => (place % 2 ? piece : Object.assign(document.createElement("span"), { textContent: piece }))));
}

/** Writes a name into an element, which breaks lines between the words of the name. */
export function writeName(element, name) {
  const pieces = name.split(/(?<=[_\-/…])|(?=\.)/);
  element.replaceChildren(...pieces.flatMap((piece, place) => (place ? [document.createElement("wbr"), piece] : [piece])));
}
