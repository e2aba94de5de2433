// SPDX-License-Identifier: MIT
// What each row of a table shows of its episode: the first and the last frame, and the curve of progress.

import { svgElement } from "./svg.js";

const AT_A_TIME = 2;
const REST_MS = 120; // rows that are scrolled past are not asked about
const MOST_KNOWN = 2000;
const [WIDTH, HEIGHT] = [64, 20];

export class Previews {
  #ask;
  #known = null; // by number of the episode; null: the episodes are about to change
  #waiting = [];
  #numAsked = 0;
  #timer = null;

  /** ask(episode): a promise of `progress` and `pictures` in base64, which fails if the table is another meanwhile */
  constructor(ask) {
    this.#ask = ask;
  }

  /** Forgets everything, and asks nothing until ``begin``: the rows are still those of other episodes. */
  clear() {
    this.#known = null;
    this.#waiting = [];
  }

  /** The rows are those of the new episodes. */
  begin() {
    this.#known = new Map();
  }

  /** Fills pictures and a curve as soon as somebody can see their row. */
  fill(episode, row, pictures, curve) {
    if (!this.#known) return;
    const preview = this.#known.get(episode.episode);
    if (preview) {
      draw(preview, pictures, curve);
      return;
    }
    this.#waiting.push({ episode, row, pictures, curve });
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#next(), REST_MS);
  }

  /** Forgets an episode, of which there is more now. */
  forget(number) {
    this.#known?.delete(number);
  }

  #next() {
    this.#waiting = this.#waiting.filter(({ row }) => row.isConnected);
    while (this.#numAsked < AT_A_TIME && this.#waiting.length) this.#fetch(this.#waiting.shift());
  }

  async #fetch({ episode, pictures, curve }) {
    this.#numAsked += 1;
    const known = this.#known;
    try {
      const preview = await this.#ask(episode);
      known.set(episode.episode, preview);
      if (known.size > MOST_KNOWN) known.delete(known.keys().next().value);
      draw(preview, pictures, curve);
    } catch { // the row stays without; whatever is wrong is told where somebody asks for more
    } finally {
      this.#numAsked -= 1;
      this.#next();
    }
  }
}

function draw({ pictures: jpegs, progress }, pictures, curve) {
  jpegs.forEach((jpeg, place) => { pictures[place].src = `data:image/jpeg;base64,${jpeg}`; });
  const there = progress.map((value, index) => [index, value]).filter(([, value]) => value !== null);
  const x = (index) => 1 + (index / Math.max(progress.length - 1, 1)) * (WIDTH - 2);
  const y = (value) => 1 + (1 - Math.min(Math.max(value, 0), 1)) * (HEIGHT - 2);
  curve.firstChild.setAttribute("points", there.map(([index, value]) => `${x(index).toFixed(1)},${y(value).toFixed(1)}`).join(" "));
}

/** Two empty pictures and an empty curve. */
export function blank() {
  const pictures = ["First frame", "Last frame"].map((title) => {
    return Object.assign(document.createElement("img"), { alt: "", title, className: "thumb" });
  });
  const curve = svgElement("svg", { class: "spark", width: WIDTH, height: HEIGHT, "aria-hidden": "true" });
  curve.append(svgElement("polyline", {}));
  return { pictures, curve };
}
