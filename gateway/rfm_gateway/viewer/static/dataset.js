// SPDX-License-Identifier: MIT
// The tab of datasets: how their episodes end, which one wants to see first, and one that is watched.

import { curvesOf, datasets, episodesOf, videoOf } from "./api.js";
import { EpisodeTable, ORDER_NAMES, PLAIN_ORDER, sorted } from "./episodes.js";
import { Histogram } from "./histogram.js";
import { shown } from "./text.js";
import { Timeline } from "./timeline.js";

const CAMERA_PREFIX = "observation.images.";
const NOTHING = { episodes: [], cameras: [], orientations: [], bins: null, threshold: 0.5 };

export class DatasetTab {
  #page;
  #onScore;
  #onError;
  #histogram;
  #table;
  #timeline;
  #datasets = [];
  #told = NOTHING;
  #watched = null;
  #curves = [];
  #stopping = new AbortController();

  /** onScore({ files, task, fps, orientations, origins }): somebody wants an episode scored; onError(error): something went wrong */
  constructor(page, { onScore, onError }) {
    this.#page = page;
    this.#onScore = onScore;
    this.#onError = onError;
    this.#histogram = new Histogram(page.histogram);
    this.#table = new EpisodeTable(page.episodes, page["more-episodes"], (episode) => this.#watch(episode));
    const elements = {
      videos: page["episode-videos"], chart: page["episode-chart"], slider: page["episode-time"], button: page["episode-play"],
    };
    this.#timeline = new Timeline(elements);
    page.dataset.addEventListener("change", () => this.#choose());
    page.labels.addEventListener("change", () => this.#load(this.#labels));
    page.shelf.addEventListener("change", () => page.errors.replaceChildren());
    page.order.addEventListener("change", () => this.#showTable());
    page.shelf.addEventListener("submit", (event) => event.preventDefault());
    page["score-episode"].addEventListener("click", () => this.#score());
    page.order.replaceChildren(...ORDER_NAMES.map((name) => new Option(name)));
  }

  /** Asks which datasets there are, and shows the first. */
  async begin() {
    try {
      this.#datasets = await datasets();
    } catch (error) {
      this.#onError(error);
      return;
    }
    const { dataset } = this.#page;
    dataset.replaceChildren(...this.#datasets.map(({ name, kind }, index) => new Option(`${name} (${kind})`, index)));
    this.#page.datasets.hidden = !this.#datasets.length;
    this.#page["no-datasets"].hidden = this.#datasets.length > 0;
    if (this.#datasets.length) await this.#choose();
  }

  get #number() {
    return Number(this.#page.dataset.value);
  }

  get #labels() {
    return this.#page.labels.value || null;
  }

  async #choose() {
    const { labels } = this.#datasets[this.#number];
    this.#page.labels.replaceChildren(...(labels.length ? labels.map((name) => new Option(name)) : [new Option("none", "")]));
    await this.#load(this.#labels);
  }

  async #load(labels) {
    this.#leave();
    const { signal } = this.#stopping;
    try {
      this.#told = await episodesOf(this.#number, labels, signal);
    } catch (error) {
      if (signal.aborted) return;
      this.#told = NOTHING;
      this.#onError(error);
    }
    this.#page.order.value = this.#told.bins ? ORDER_NAMES[0] : PLAIN_ORDER;
    this.#timeline.chart.setThreshold(this.#told.threshold);
    this.#showTable();
    this.#showEnds();
  }

  /** Ends what is shown of an episode. */
  #leave() {
    this.#stopping.abort();
    this.#stopping = new AbortController();
    this.#timeline.videos.clear();
    this.#watched = null;
    this.#page.episode.hidden = true;
    this.#page["score-episode"].disabled = true;
    this.#table.mark(null);
  }

  #showTable() {
    const { order } = this.#page;
    this.#table.show(sorted(this.#told.episodes, order.value), this.#watched?.episode ?? null);
  }

  #showEnds() {
    const { bins, episodes } = this.#told;
    this.#page.ends.hidden = !bins;
    if (!bins) return;
    const labelled = episodes.filter(({ backwards }) => backwards !== undefined);
    const never = labelled.filter(({ never_succeeds }) => never_succeeds).length;
    const hasSuccess = labelled.some(({ best_success }) => best_success !== undefined);
    const told = [`${labelled.length} of ${episodes.length} episodes are labelled.`];
    if (hasSuccess) told.push(`${never} never ${never === 1 ? "succeeds" : "succeed"}: success stays below ${this.#told.threshold}.`);
    this.#page["ends-told"].textContent = told.join(" ");
    const bars = bins.counts.map((count, index) => `${count} from ${bins.edges[index].toFixed(2)}`);
    this.#page.histogram.setAttribute("aria-label", `Episodes by final progress: ${bars.join(", ")}`);
    this.#histogram.show(bins);
  }

  async #watch(episode) {
    this.#leave();
    this.#watched = { ...episode, files: [] };
    this.#table.mark(episode.episode);
    const page = this.#page;
    const { signal } = this.#stopping;
    page.errors.replaceChildren();
    page.episode.hidden = false;
    page["episode-title"].textContent = `Episode ${episode.episode}`;
    page["episode-told"].textContent = episode.task;
    page["episode-title"].focus({ preventScroll: true });
    page.episode.scrollIntoView({ block: "nearest" });
    try {
      await this.#fetch(episode, signal);
    } catch (error) {
      if (!signal.aborted) this.#onError(error);
    }
  }

  async #fetch({ episode }, signal) {
    const { cameras, orientations } = this.#told;
    const told = await curvesOf(this.#number, episode, this.#labels, signal);
    this.#curves = curvesIn(told);
    this.#timeline.time = 0;
    this.#timeline.show(this.#curves);
    this.#page["episode-chart"].setAttribute("aria-label", describe(this.#curves));
    const blobs = await Promise.all(cameras.map((_, camera) => videoOf(this.#number, episode, camera, signal)));
    if (signal.aborted) return;
    const { name } = this.#datasets[this.#number];
    cameras.forEach((camera, index) => {
      const file = `${name}_episode_${`${episode}`.padStart(6, "0")}.${short(camera)}.mp4`;
      this.#watched.files.push(new File([blobs[index]], file, { type: blobs[index].type }));
      this.#timeline.videos.add(this.#watched.files.at(-1), short(camera), orientations[index]);
    });
    this.#page["score-episode"].disabled = !cameras.length;
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.#timeline.videos.play();
  }

  #score() {
    this.#timeline.videos.pause();
    const { fps, orientations, cameras } = this.#told;
    const { files, task, episode } = this.#watched;
    const origins = cameras.map((camera) => ({ dataset: this.#datasets[this.#number].name, episode, camera, fps, task }));
    this.#onScore({ files, task, fps, orientations, origins });
  }
}

/** The curves as a chart takes them; without labels one that is empty, so that there is a time to move in. */
function curvesIn({ times_s: times, curves }) {
  const none = times.map(() => null);
  const labelled = curves.map(({ camera, progress, success }, index) => {
    const label = camera ? short(camera) : curves.length > 1 ? "all cameras" : "labels";
    return { index, label, progress, success: success ?? none, times, allTimes: times, isLabelled: true };
  });
  return labelled.length ? labelled : [{ index: 0, label: "", progress: none, success: none, times, allTimes: times }];
}

function describe(curves) {
  const labelled = curves.filter(({ isLabelled }) => isLabelled);
  const told = labelled.map(({ label, progress }) => `${label}: last progress ${shown(progress.at(-1))}`);
  return told.length ? told.join("; ") : "This episode has no labels.";
}

function short(camera) {
  return camera.startsWith(CAMERA_PREFIX) ? camera.slice(CAMERA_PREFIX.length) : camera;
}
