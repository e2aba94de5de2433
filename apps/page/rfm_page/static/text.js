// SPDX-License-Identifier: MIT
// Numbers and names as the page writes them.

export const NONE = "-";

/** A number as the page writes it. */
export function shown(value) {
  return value === null || value === undefined ? NONE : value.toFixed(3);
}

/** A text of at most `most` letters; of a longer one the middle is left out, since names differ at their ends. */
export function cut(text, most) {
  if (text.length <= most) return text;
  const begin = Math.ceil((most - 1) / 2);
  return `${text.slice(0, begin)}…${text.slice(text.length - (most - 1 - begin))}`;
}
