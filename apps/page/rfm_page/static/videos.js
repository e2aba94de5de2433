// SPDX-License-Identifier: MIT
// The videos of the page, which move together: one time for all of them.

import { colourName, colourOf } from "./chart.js";
import { failedOf } from "./curves.js";
import { nameable, remover } from "./nameable.js";

const AS_STORED = { orient: "none", channels: "rgb" };
const MOST_IN_A_ROW = 6; // of more the videos are small, so that all names are to be seen
const LONG_LETTERS = 14; // a longer name may need two lines
const UNSHOWN = { // by the state of its curve
  waiting: "This browser cannot show this file.",
  done: "This browser cannot show this file. It was scored all the same.",
  failed: "This browser cannot show this file, and it was not scored: see the numbers below.",
};
const NEAR_S = 0.05; // a video that is so near to a time shows it
const IN_STEP_S = 0.015; // less than half a frame of most cameras
const NEAR_LEADER_S = 0.2; // so near, the frames that are drawn count, else the times
const CATCH_UP = 4; // times its lag that a video makes up for in a second
const SLOWEST = 0.1; // times the usual speed
const INSIDE_S = 0.001; // behind the begin of a frame, so that rounding does not show the one before

/**
 * Videos in `host`. `onTime(seconds, video)` is called as long as one plays. The page has the controls.
 * Where videos can be changed: onName(): one has another title; onColour(): one has another colour;
 * onRemove(video): somebody wants one away
 */
export class Videos {
  #host;
  #onTime;
  #changing;
  #entries = [];
  #numAdded = 0;

  constructor(host, onTime, changing = null) {
    this.#host = host;
    this.#onTime = onTime;
    this.#changing = changing;
  }

  get all() {
    return this.#entries;
  }

  get isPlaying() {
    return this.#entries.some(({ player }) => !player.paused && !player.ended);
  }

  /** Shows a file under a name as the model sees it, and gives what is known of it. more: what else is known */
  add(file, name = file.name, correction = AS_STORED, more = {}) {
    const [figure, player, caption, trouble] = ["figure", "video", "figcaption", "p"].map((tag) => document.createElement(tag));
    const entry = { id: (this.#numAdded += 1), file, name, title: this.#freeTitle(name), place: this.#freePlace(), colour: null };
    Object.assign(entry, { figure, player, trouble, wanted: null, ...more });
    Object.assign(player, { src: URL.createObjectURL(file), muted: true, playsInline: true, preload: "auto" });
    player.setAttribute("aria-label", `Video ${entry.title}`);
    show(entry, correction);
    trouble.textContent = UNSHOWN.waiting;
    trouble.hidden = true;
    player.addEventListener("error", () => { trouble.hidden = false; });
    entry.swatch = document.createElement(this.#changing ? "input" : "span");
    Object.assign(entry.swatch, { className: "swatch", hidden: true });
    entry.failed = Object.assign(document.createElement("span"), { className: "failed" });
    caption.append(entry.swatch, ...(this.#changing ? this.#controls(entry) : [name]));
    player.addEventListener("play", () => this.#follow(entry));
    player.addEventListener("seeked", () => this.#arrived(entry));
    const drawn = (_, { mediaTime }) => {
      entry.drawn = mediaTime;
      player.requestVideoFrameCallback(drawn);
    };
    player.requestVideoFrameCallback?.(drawn);
    figure.append(caption, player, trouble);
    this.#host.append(figure);
    this.#entries = [...this.#entries, entry]; // whoever has `all` keeps that list
    this.#fit();
    return entry;
  }

  /** The name, with a number if another video has it. */
  #freeTitle(name) {
    const taken = new Set(this.#entries.map(({ title }) => title));
    let number = 1;
    while (taken.has(number === 1 ? name : `${name} (${number})`)) number += 1;
    return number === 1 ? name : `${name} (${number})`;
  }

  /** The first place of a colour that no video has. */
  #freePlace() {
    const taken = new Set(this.#entries.map(({ place }) => place));
    let place = 0;
    while (taken.has(place)) place += 1;
    return place;
  }

  #fit() {
    this.#host.classList.toggle("many", this.#entries.length > MOST_IN_A_ROW);
    this.#host.classList.toggle("tall", this.#entries.some(({ title }) => title.length > LONG_LETTERS));
  }

  /** Shows all videos as their frames become upright RGB before they are scored. */
  correct(correction) {
    for (const entry of this.#entries) show(entry, correction);
  }

  /** Shows the colour of a video's curves; null: they have several. */
  mark(entry, curve) {
    entry.swatch.hidden = !curve;
    if (!curve) return;
    if (this.#changing) entry.swatch.value = colourOf(curve);
    else entry.swatch.style.background = `var(--${colourName(curve.index)})`;
  }

  /** Says whether all its curves failed, and of a video that this browser cannot show whether it was scored. */
  tell(entry, curves) {
    const state = ["done", "failed"].find((each) => curves.some((curve) => curve.state === each)) ?? "waiting";
    entry.failed.textContent = failedOf(curves) === "failed" ? "failed" : ""; // of some, the legend says it
    entry.trouble.textContent = UNSHOWN[state];
  }

  /** Moves all videos to a time, but for `but`. */
  seek(seconds, but = null) {
    for (const entry of this.#entries) {
      if (entry !== but) this.#move(entry, seconds);
    }
  }

  /** Plays all videos from the time at which they are, but for those that have ended; from the start if all have. */
  play() {
    const going = this.#entries.filter(({ player }) => !player.ended && !player.error);
    for (const { player } of going.length ? going : this.#entries) player.play().catch(() => {}); // one that cannot be shown says so itself
  }

  pause() {
    for (const { player } of this.#entries) player.pause();
  }

  /** Removes a video. */
  remove(entry) {
    release(entry.player);
    entry.figure.remove();
    this.#entries = this.#entries.filter((each) => each !== entry);
    this.#fit();
  }

  /** Removes all videos. */
  clear() {
    for (const { player } of this.#entries) release(player);
    this.#entries = [];
    this.#host.replaceChildren();
    this.#fit();
  }

  /** What changes the colour and the title of a video, and what removes it. */
  #controls(entry) {
    const title = nameable((text) => {
      entry.title = text || entry.name;
      write();
      this.#fit();
      this.#changing.onName();
    });
    const away = remover(() => this.#changing.onRemove(entry));
    const { swatch } = entry;
    swatch.type = "color";
    swatch.addEventListener("input", () => {
      entry.colour = swatch.value;
      this.#changing.onColour();
    });
    const write = () => {
      title.show(entry.title, entry.name);
      away.setAttribute("aria-label", `Remove ${entry.title}`);
      swatch.setAttribute("aria-label", `Colour of ${entry.title}`);
    };
    write();
    return [title.element, entry.failed, away];
  }

  #move(entry, seconds) {
    const { player } = entry;
    const end = Number.isFinite(player.duration) ? player.duration : seconds;
    entry.wanted = Math.min(seconds, end) + INSIDE_S;
    if (!player.seeking) player.currentTime = entry.wanted; // else it goes there when it has arrived
  }

  #arrived(entry) {
    const { player, wanted } = entry;
    if (wanted !== null && Math.abs(player.currentTime - wanted) > NEAR_S && wanted < player.duration) {
      player.currentTime = wanted;
    } else {
      entry.wanted = null;
    }
  }

  /** Tells the time of a video as long as it plays; of several the first one leads. */
  #follow(entry) {
    const step = () => {
      if (entry.player.paused || entry.player.ended) {
        if (!this.isPlaying && entry.wanted === null) this.#onTime(entry.player.currentTime); // all stop where it stopped
        return;
      }
      const leader = this.#entries.find(({ player }) => !player.paused && !player.ended);
      entry.player.playbackRate = rateOf(entry, leader);
      if (leader === entry && entry.wanted === null) this.#onTime(entry.player.currentTime, entry);
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }
}

function show(entry, { orient, channels }) {
  Object.assign(entry, { orient, channels });
  entry.player.className = `${orient} ${channels}`;
}

/** The speed at which a video comes to show the same moment as the leader: browsers draw frames up to one frame early or late. */
function rateOf(entry, leader) {
  const lag = leader.player.currentTime - entry.player.currentTime;
  const drawnLag = leader.drawn - entry.drawn; // NaN where a browser does not tell
  const counted = Math.abs(lag) < NEAR_LEADER_S && Number.isFinite(drawnLag) ? drawnLag : lag;
  return Math.abs(counted) < IN_STEP_S ? 1 : Math.min(Math.max(1 + CATCH_UP * counted, SLOWEST), CATCH_UP);
}

/** Ends a player's load, then gives its file back: a load that finds it gone would be an error. */
function release(player) {
  const url = player.src;
  player.pause();
  player.removeAttribute("src");
  player.load();
  URL.revokeObjectURL(url);
}
