// SPDX-License-Identifier: MIT
// What the browser remembers of this page. With cookies blocked it remembers nothing, and the page works all the same.

/** What was remembered under a name; null: nothing. */
export function remembered(name) {
  try {
    return localStorage.getItem(name);
  } catch {
    return null;
  }
}

/** Remembers a text under a name, where the browser allows it. */
export function remember(name, text) {
  try {
    localStorage.setItem(name, text);
  } catch {
    console.info(`This browser does not let the page remember ${name}.`);
  }
}
