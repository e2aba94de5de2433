// SPDX-License-Identifier: MIT
// Tabs, of which one is shown. Arrow keys go from one to the next.

const KEYS = { ArrowRight: 1, ArrowLeft: -1 };

export class Tabs {
  #pairs;
  #onSelect;

  /** pairs: each tab with its panel; onSelect(index): another one is shown */
  constructor(pairs, onSelect) {
    this.#pairs = pairs;
    this.#onSelect = onSelect;
    pairs.forEach(([tab], index) => {
      tab.addEventListener("click", () => this.select(index));
      tab.addEventListener("keydown", ({ key }) => {
        if (!KEYS[key]) return;
        const next = (index + KEYS[key] + pairs.length) % pairs.length;
        this.select(next);
        pairs[next][0].focus();
      });
    });
  }

  /** Shows one panel, and hides the others. */
  select(chosen) {
    this.#pairs.forEach(([tab, panel], index) => {
      tab.setAttribute("aria-selected", index === chosen);
      tab.tabIndex = index === chosen ? 0 : -1;
      panel.hidden = index !== chosen;
    });
    this.#onSelect(chosen);
  }
}
