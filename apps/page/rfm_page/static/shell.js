// SPDX-License-Identifier: MIT
// Command lines: names of datasets and files may hold any letter.

/** A word as a shell reads it. */
export function quoted(word) {
  const text = `${word}`;
  return /^[\w./:@%+=,-]+$/.test(text) ? text : `'${text.replaceAll("'", `'"'"'`)}'`;
}

/** A comment, which ends with its line. */
export function commented(text) {
  return `# ${text.replaceAll(/[\r\n]+/g, " ")}`;
}
