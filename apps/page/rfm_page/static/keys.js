// SPDX-License-Identifier: MIT
// Keys that do what buttons do, unless somebody writes.

const WRITES = "input:not([type=range], [type=checkbox]), select, textarea, [contenteditable]";
const PRESSES = "button, a, summary, input, [role=tab]"; // elements that have a use for the space bar

/** Lets keys do something. actions: by key, in small letters; isActive(): whether they do now */
export function onKeys(actions, isActive) {
  document.addEventListener("keydown", (event) => {
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    const isForOthers = event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented;
    if (!action || isForOthers || event.target.closest(WRITES) || !isActive()) return;
    if (event.key === " " && event.target.closest(PRESSES)) return;
    event.preventDefault();
    action();
  });
}
