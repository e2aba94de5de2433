// SPDX-License-Identifier: MIT
// A table of any length that keeps only the rows in the document that can be seen.

const BEYOND = 8; // rows above and below those that can be seen

/**
 * Rows in `body`, which scrolls in `scroller`, or with the page, between the table bodies `above` and `below`.
 * All rows are as high as `--row` says. newRow(item): the row of an item
 */
export class VirtualRows {
  #scroller;
  #body;
  #gaps;
  #newRow;
  #items = [];
  #rows = new Map();

  constructor({ scroller, body, above, below }, newRow) {
    this.#scroller = scroller;
    this.#body = body;
    this.#gaps = [above, below].map((gap) => gap.appendChild(document.createElement("tr")).appendChild(document.createElement("td")));
    this.#newRow = newRow;
    document.addEventListener("scroll", () => this.#draw(), true); // of any element
    new ResizeObserver(() => this.#draw()).observe(scroller);
  }

  /** The rows in the document, by their items. */
  get rows() {
    return this.#rows;
  }

  /** Shows items in their order, from the first one on. */
  show(items) {
    this.#items = items;
    this.#rows.clear();
    this.#body.closest("table").setAttribute("aria-rowcount", items.length + 1);
    this.#scroller.scrollTop = 0;
    this.#draw();
  }

  /** Scrolls to an item. */
  reveal(item) {
    const index = this.#items.indexOf(item);
    if (index < 0) return;
    const [height, { scrollTop, clientHeight }] = [this.#height, this.#scroller];
    const top = index * height;
    if (top < scrollTop || top + 2 * height > scrollTop + clientHeight) this.#scroller.scrollTop = top - clientHeight / 2;
    this.#draw();
  }

  get #height() {
    return Number.parseFloat(getComputedStyle(this.#body).getPropertyValue("--row"));
  }

  #draw() {
    const height = this.#height;
    const { top, bottom } = this.#scroller.getBoundingClientRect();
    if (!this.#scroller.getClientRects().length) return; // hidden; a visible list without rows has no height either
    const begin = this.#body.closest("table").getBoundingClientRect().top;
    const [from, to] = [Math.max(top, 0), Math.min(bottom, innerHeight)].map((edge) => Math.max(Math.round((edge - begin) / height), 0));
    const first = Math.max(Math.min(from, this.#items.length) - BEYOND, 0);
    const end = Math.min(to + BEYOND, this.#items.length);
    const seen = this.#items.slice(first, end);
    const before = this.#rows;
    this.#rows = new Map(seen.map((item) => [item, before.get(item) ?? this.#newRow(item)]));
    const rows = [...this.#rows.values()];
    rows.forEach((row, place) => row.setAttribute("aria-rowindex", first + place + 2));
    if (rows.length !== this.#body.rows.length || rows.some((row, place) => row !== this.#body.rows[place])) {
      this.#body.replaceChildren(...rows);
    }
    this.#gaps[0].style.height = `${first * height}px`;
    this.#gaps[1].style.height = `${(this.#items.length - end) * height}px`;
    for (const gap of this.#gaps) gap.parentElement.hidden = gap.style.height === "0px";
  }
}
