// SPDX-License-Identifier: MIT
// The tab of datasets: how their episodes end, which one wants to see first, one that is watched, some that are taken along.

import { curvesOf, datasets, episodesOf, faultsOf, missingOf, previewOf, videoOf } from "./api.js";
import { Asking } from "./asking.js";
import { EpisodeTable, FILTER_NAMES, judged, kept, PLAIN_ORDER, sorted, toldOf, UNDONE, WORST_FIRST } from "./episodes.js";
import { deadLink, downloading, failure, noDataset, noEpisode, noHit, noLabels, noVideo } from "./faults.js";
import { episodesJson, episodesText, lerobotWords, outcomesCsv } from "./exports.js";
import { pngFigure, svgFigure } from "./figure.js";
import { Histogram } from "./histogram.js";
import { onKeys } from "./keys.js";
import { DASHES, lookOf, namedLine } from "./looks.js";
import { Previews } from "./previews.js";
import { remember, remembered } from "./remembered.js";
import { Place } from "./states.js";
import { save } from "./takeaway.js";
import { cut, NONE, shown } from "./text.js";
import { Timeline } from "./timeline.js";

const CAMERA_PREFIX = "observation.images.";
const MOST_LETTERS = 400; // that are shown of words for LeRobot: thousands of numbers slow the page down
const NARROW = "(max-width: 719px)";
const NOTHING = {
  episodes: [], cameras: [], unused: [], corrections: [], left_out: {}, threshold: 0.5, provenance: null, written_s: null,
};

export class DatasetTab {
  #page;
  #onScore;
  #onShown;
  #failedAnywhere;
  #places;
  #histogram;
  #previews = new Previews(async (episode) => {
    const told = await previewOf(this.#number, episode.episode, this.#labels, this.#loading.signal);
    checkSame(episode, told);
    return told;
  });
  #loading = new AbortController();
  #table;
  #timeline;
  #datasets = [];
  #told = NOTHING;
  #others = null; // rows of the labels beside them, by episode
  #episodes = []; // as the threshold judges them
  #shown = []; // those that are kept, in their order
  #chosen = new Set(); // numbers of the episodes that are selected
  #outcomes = new Map(); // "success" or "failure", as somebody has marked an episode, by `markOf`
  #isTurned = false; // the order is the other way round
  #words = "";
  #watched = null;
  #stopping = new AbortController();
  #checking = new AbortController();
  #asking = new Asking((isCurrent) => this.#ask(isCurrent));
  #wanted = new URLSearchParams(); // what an address says, until the datasets are there
  #numShown = 0; // of addresses
  #isShowing = false; // what an address says
  #faults = {}; // by dataset: one look at all videos for each load of the page

  /**
   * onScore({ files, task, fps, corrections, origins }): somebody wants an episode scored
   * onShown(isStep): something else is shown; isStep: Back should lead to what was shown before
   * failedAnywhere(error): shows an error that is one on every tab, and says whether it is
   */
  constructor(page, { onScore, onShown, failedAnywhere }) {
    this.#page = page;
    this.#onShown = onShown;
    this.#onScore = onScore;
    this.#failedAnywhere = failedAnywhere;
    const places = { none: "no-datasets", errors: "dataset-errors", hits: "no-hits", labels: "no-labels", episode: "episode-errors" };
    this.#places = Object.fromEntries(Object.entries(places).map(([name, id]) => [name, new Place(page[id])]));
    this.#histogram = new Histogram(page.histogram);
    const rows = { scroller: page["episode-list"], body: page.episodes, above: page["episodes-above"], below: page["episodes-below"] };
    this.#table = new EpisodeTable(rows, {
      previews: this.#previews,
      onWatch: (episode) => { this.#watch(episode); this.#onShown(true); },
      chosen: this.#chosen,
      onChoose: () => this.#showChosen(),
      outcomeOf: (episode) => this.#outcomes.get(markOf(episode)),
    });
    const elements = {
      videos: page["episode-videos"], chart: page["episode-chart"], motion: page["motion-chart"], slider: page["episode-time"],
      button: page["episode-play"], told: page["episode-time-told"],
    };
    this.#timeline = new Timeline(elements, {
      onThreshold: (value) => { this.#cutAt(value); this.#onShown(false); },
      onChosen: (labels) => { for (const item of page["motion-legend"].children) item.classList.toggle("chosen", labels.includes(item.textContent)); },
    });
    this.#listen();
  }

  #listen() {
    const page = this.#page;
    const on = (name, event, action) => page[name].addEventListener(event, action);
    on("shelf", "submit", (event) => event.preventDefault());
    on("shelf", "change", () => this.#places.errors.clear());
    on("shelf", "input", () => this.#onShown(false));
    on("order", "change", () => this.#onShown(false));
    on("dataset", "change", () => this.#choose().then(() => this.#onShown(true)));
    on("labels", "change", () => this.#load().then(() => this.#onShown(true)));
    on("others", "change", () => this.#load().then(() => this.#onShown(true)));
    on("cutoff", "input", () => this.#cutAt(Number(page.cutoff.value)));
    on("order", "change", () => this.#orderBy(page.order.value, false));
    on("task-part", "input", () => this.#showTable());
    for (const name of FILTER_NAMES) {
      on(`only-${name}`, "change", () => this.#showTable());
      page[`number-${name}`]?.addEventListener("input", () => this.#judge());
    }
    for (const head of page["episode-list"].querySelectorAll("th[data-order]")) {
      head.querySelector("button").addEventListener("click", () => {
        const { order } = head.dataset;
        this.#orderBy(order, page.order.value === order && !this.#isTurned);
        this.#onShown(false);
      });
    }
    on("choose-shown", "click", () => this.#select(this.#shown.map(({ episode }) => episode)));
    on("choose-none", "click", () => this.#select([]));
    on("use", "change", () => this.#showChosen());
    on("episodes-text", "click", () => save("episodes.txt", episodesText(this.#taken.map(({ episode }) => episode)), "text/plain"));
    on("episodes-json", "click", () => save("episodes.json", this.#json(), "application/json"));
    on("outcomes", "click", () => save("outcomes.csv", outcomesCsv(this.#marked), "text/csv"));
    on("episode-png", "click", async () => save(`episode_${this.#watched.episode}.png`, await pngFigure(this.#figure())));
    on("episode-svg", "click", () => save(`episode_${this.#watched.episode}.svg`, this.#figure(), "image/svg+xml"));
    on("succeeded", "click", () => this.#mark("success"));
    on("failed", "click", () => this.#mark("failure"));
    on("score-episode", "click", () => this.#score());
    on("episode-close", "click", () => this.#close());
    on("episode-before", "click", () => this.#step(-1));
    on("episode-after", "click", () => this.#step(1));
    const keys = {
      " ": () => page["episode-play"].click(), n: () => this.#step(1), p: () => this.#step(-1), Escape: () => this.#close(),
      s: () => this.#mark("success"), f: () => this.#mark("failure"),
    };
    onKeys(keys, () => this.#watched && !page["dataset-panel"].hidden);
  }

  /** Asks which datasets there are until there is one, and shows the first. */
  begin() {
    this.#asking.begin();
  }

  async #ask(isCurrent) {
    let there;
    try {
      there = await datasets();
    } catch (error) {
      if (!isCurrent() || this.#failedAnywhere(error)) return true; // the page begins again
      this.#places.none.show(failure("The datasets cannot be listed", error, () => this.begin()));
      return false;
    }
    if (!isCurrent()) return true;
    if (there.length) this.#places.none.clear();
    else this.#places.none.show(noDataset(() => this.begin()));
    if (there.length && JSON.stringify(there) === JSON.stringify(this.#datasets)) return true; // they are shown
    this.#wanted = new URLSearchParams(this.params);
    this.#datasets = there;
    const { dataset } = this.#page;
    dataset.replaceChildren(...this.#datasets.map(({ name, kind }, index) => new Option(`${name} (${kind.replace("LeRobot ", "")})`, index)));
    this.#page.datasets.hidden = this.#page["dataset-side"].hidden = !this.#datasets.length;
    if (!this.#page["dataset-panel"].hidden) this.#page.fold.disabled = !this.#datasets.length;
    if (this.#datasets.length) await this.show(this.#wanted);
    this.#onShown(false);
    return this.#datasets.length > 0;
  }

  get #number() {
    return Number(this.#page.dataset.value);
  }

  get #labels() {
    return this.#page.labels.value || null;
  }

  get #threshold() {
    return Number(this.#page.cutoff.value);
  }

  /** What LeRobot's command line needs for them, whole. */
  get words() {
    return this.#words;
  }

  /** The episodes that are taken along: those that are selected, else all that are shown. */
  get #taken() {
    const taken = this.#chosen.size ? this.#episodes.filter(({ episode }) => this.#chosen.has(episode)) : [...this.#shown];
    return taken.sort((one, other) => one.episode - other.episode);
  }

  /** What an address says of the dataset, the episode and the settings. */
  get params() {
    const page = this.#page;
    if (!this.#datasets.length || this.#isShowing) return [...this.#wanted].filter(([name]) => name !== "tab");
    const { labels } = this.#datasets[this.#number];
    const settings = [
      ["dataset", this.#name(this.#number), ""],
      ["labels", this.#labels ?? "", labels[0] ?? ""],
      ["beside", page.others.value, ""],
      ["cutoff", page.cutoff.value, `${this.#told.threshold}`],
      ["order", page.order.value, this.#usualOrder],
      ["turned", this.#isTurned ? "1" : "", ""],
      ...FILTER_NAMES.map((name) => [name, page[`only-${name}`].checked ? (page[`number-${name}`]?.value ?? "1") : "", ""]),
      ["contains", page["task-part"].value, ""],
      ["episode", this.#watched ? `${this.#watched.episode}` : "", ""],
    ];
    return settings.filter(([, value, usual]) => value !== usual).map(([name, value]) => [name, value]);
  }

  /** Shows what an address says; as soon as the datasets are there. */
  async show(params) {
    this.#wanted = params;
    if (!this.#datasets.length) return;
    this.#isShowing = true;
    this.#places.errors.clear();
    const number = (this.#numShown += 1);
    const page = this.#page;
    const wanted = params.get("dataset");
    const index = wanted === null ? 0 : this.#datasets.findIndex((_, each) => this.#name(each) === wanted);
    const of = [Math.max(index, 0), params.get("labels"), params.get("beside")];
    if (this.#told === NOTHING || of[0] !== this.#number || (of[1] ?? page.labels.options[0].value) !== page.labels.value
      || (of[2] ?? "") !== page.others.value) await this.#choose(...of);
    if (number !== this.#numShown) return; // another address is shown
    this.#isShowing = false;
    if (this.#told === NOTHING) return;
    this.#showSettings(params);
    if (index < 0) this.#places.errors.show(deadLink(`The dataset ${wanted}`));
    const episode = index < 0 ? null : params.get("episode");
    if (episode === `${this.#watched?.episode ?? ""}`) return;
    const row = this.#episodes.find((each) => `${each.episode}` === episode);
    if (row) this.#watch(row);
    else if (this.#watched) this.#leave();
    if (episode !== null && !row) this.#places.errors.show(deadLink(`Episode ${episode}`));
  }

  #showSettings(params) {
    const page = this.#page;
    for (const name of FILTER_NAMES) {
      page[`only-${name}`].checked = params.has(name) && !(name === "differ" && !page.others.value);
      if (params.has(name) && page[`number-${name}`]) page[`number-${name}`].value = params.get(name);
    }
    page["task-part"].value = params.get("contains") ?? "";
    page.order.value = params.get("order") ?? this.#usualOrder;
    if (!page.order.value) page.order.value = this.#usualOrder; // no such order
    this.#isTurned = params.has("turned");
    this.#cutAt(Number(params.get("cutoff") ?? this.#told.threshold));
  }

  /** The name of a dataset; of the second one of a name with ~2. */
  #name(number) {
    const { name } = this.#datasets[number];
    const before = this.#datasets.slice(0, number).filter((each) => each.name === name).length;
    return before ? `${name}~${before + 1}` : name;
  }

  get #usualOrder() {
    return this.#isLabelled ? WORST_FIRST : PLAIN_ORDER;
  }

  get #isLabelled() {
    return this.#told.episodes.some(({ final_progress: final }) => final !== undefined);
  }

  /** Shows a dataset. chosen, beside: the labels; null: the first, none */
  async #choose(number = this.#number, chosen = null, beside = null) {
    this.#page.dataset.value = number;
    const { labels } = this.#datasets[this.#number];
    this.#page.labels.replaceChildren(...(labels.length ? labels.map((name) => new Option(name)) : [new Option("none", "")]));
    if (labels.includes(chosen)) this.#page.labels.value = chosen;
    await this.#load(beside);
  }

  /** Asks what the chosen labels say. beside: other labels, or null */
  async #load(beside = this.#page.others.value) {
    this.#leave();
    this.#checking.abort();
    this.#loading.abort();
    this.#loading = new AbortController();
    this.#previews.clear();
    this.#places.errors.clear();
    this.#chosen.clear();
    const { signal } = this.#stopping;
    const page = this.#page;
    const names = this.#datasets[this.#number].labels.filter((name) => name !== this.#labels);
    page.others.replaceChildren(new Option("none", ""), ...names.map((name) => new Option(name)));
    if (names.includes(beside)) page.others.value = beside;
    const other = page.others.value;
    try {
      const asked = [episodesOf(this.#number, this.#labels, signal), ...(other ? [episodesOf(this.#number, other, signal)] : [])];
      const [told, others] = await Promise.all(asked);
      this.#told = told;
      this.#others = others ? new Map(others.episodes.map((row) => [row.episode, row])) : null;
    } catch (error) {
      if (signal.aborted) return;
      [this.#told, this.#others] = [NOTHING, null];
      this.#failed("errors", "The dataset cannot be shown", error, () => this.#load());
    }
    this.#previews.begin();
    this.#readOutcomes();
    this.#showOutcomes();
    page.cutoff.value = this.#told.threshold;
    page.order.value = this.#usualOrder;
    this.#isTurned = false;
    page["filter-differ"].hidden = !other;
    if (!other) page["only-differ"].checked = false;
    page["episode-list"].classList.toggle("beside", Boolean(other));
    page["episode-list"].classList.toggle("one-camera", this.#told.cameras.length < 2);
    page.ends.hidden = !this.#isLabelled;
    page["dataset-panel"].classList.toggle("unlabelled", !this.#isLabelled);
    page["labels-warning"].textContent = this.#told.warning ?? "";
    page["dataset-told"].textContent = ` of ${this.#datasets[this.#number].name}`;
    if (this.#isLabelled || !this.#told.episodes.length) this.#places.labels.clear();
    else this.#places.labels.show(noLabels(this.#datasets[this.#number], this.#told.episodes.some(({ task, num_frames: num }) => num && !task)));
    const leftOut = Object.entries(this.#told.left_out).map(([camera, reason]) => `${short(camera)} is left out: ${reason}`);
    page["left-out"].textContent = leftOut.join("; ");
    page["left-out"].hidden = !leftOut.length;
    this.#showMade();
    this.#cutAt(this.#told.threshold);
    this.#check();
  }

  /** Asks which episodes cannot be labelled now, while the others are shown. */
  async #check() {
    const { signal } = this.#checking = new AbortController();
    const told = this.#told;
    try {
      const faults = told === NOTHING ? {} : (this.#faults[this.#number] ??= await faultsOf(this.#number, signal));
      if (told !== this.#told || !Object.keys(faults).length) return;
      for (const row of told.episodes) row.fault = faults[row.episode] ?? null;
      this.#judge();
    } catch (error) {
      if (!signal.aborted) this.#failed("errors", "The videos of the episodes could not be checked", error, () => this.#check());
    }
  }

  #failed(place, title, error, retry) {
    this.#failedAnywhere(error);
    this.#places[place].show(failure(title, error, retry)); // which stays when the server is back
  }

  /** Judges all episodes by another threshold. */
  #cutAt(threshold) {
    this.#page.cutoff.value = threshold;
    this.#page["cutoff-told"].textContent = this.#threshold.toFixed(2);
    this.#timeline.chart.setThreshold(this.#threshold);
    this.#judge();
  }

  #judge() {
    this.#episodes = judged(this.#told.episodes, this.#threshold, this.#others);
    for (const name of FILTER_NAMES) this.#page[`count-${name}`].textContent = this.#isLabelled ? kept(this.#episodes, [this.#filter(name)], "").length : NONE;
    this.#showEnds();
    this.#showTable();
  }

  #filter(name) {
    return [name, Number(this.#page[`number-${name}`]?.value)];
  }

  #orderBy(order, isTurned) {
    this.#page.order.value = order;
    this.#isTurned = isTurned;
    this.#showTable();
  }

  #showTable() {
    const page = this.#page;
    const filters = FILTER_NAMES.filter((name) => page[`only-${name}`].checked).map((name) => this.#filter(name));
    this.#shown = sorted(kept(this.#episodes, filters, page["task-part"].value), page.order.value, this.#isTurned);
    this.#showNoHits();
    this.#table.show(this.#shown, this.#threshold);
    page["order-told"].textContent = this.#isTurned ? "" : page.order.selectedOptions[0]?.title ?? "";
    page["shown-told"].textContent = `${this.#shown.length} of ${this.#episodes.length}`;
    for (const head of page["episode-list"].querySelectorAll("th[data-order]")) {
      const isFalling = ["backwards", "disagreement", "difference"].includes(head.dataset.order) !== this.#isTurned;
      if (head.dataset.order === page.order.value) head.setAttribute("aria-sort", isFalling ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    }
    if (this.#watched) this.#table.mark(this.#watched.episode, this.#shown);
    this.#showChosen();
  }

  /** Says why no episode is listed. */
  #showNoHits() {
    const { hits, errors } = this.#places;
    if (this.#shown.length || !errors.isEmpty) hits.clear();
    else hits.show(this.#episodes.length ? noHit(this.#episodes.length, () => this.#clearFilters()) : noEpisode(() => this.#load()));
    this.#page["episode-list"].hidden = !this.#shown.length;
  }

  #clearFilters() {
    for (const name of FILTER_NAMES) this.#page[`only-${name}`].checked = false;
    this.#page["task-part"].value = "";
    this.#showTable();
    this.#onShown(false);
  }

  #select(numbers) {
    this.#chosen.clear();
    for (const number of numbers) this.#chosen.add(number);
    this.#table.markChosen();
    this.#showChosen();
  }

  /** Shows what is taken along. */
  #showChosen() {
    const page = this.#page;
    const numbers = this.#taken.map(({ episode }) => episode);
    const which = this.#chosen.size ? "selected" : "shown; select rows to export fewer";
    const told = `${numbers.length} ${numbers.length === 1 ? "episode" : "episodes"}`;
    page["chosen-told"].textContent = `${told} ${which}`;
    for (const option of page.use.options) option.textContent = option.textContent.replace(/( \d.*)?$/, ` ${told}`);
    page["choose-none"].disabled = !this.#chosen.size;
    page["episodes-text"].disabled = page["episodes-json"].disabled = !numbers.length;
    const dataset = this.#datasets[this.#number];
    page.lerobot.hidden = !dataset?.kind.startsWith("LeRobot");
    const all = this.#episodes.map(({ episode }) => episode);
    this.#words = dataset ? lerobotWords(page.use.value, dataset, numbers, all) : "";
    const areFailures = numbers.length > 0 && this.#taken.every(({ never_succeeds: never }) => never);
    page["use-told"].textContent = page.use.value === "train" && areFailures ? "All of them never succeed." : "";
    page["use-copy"].disabled = !/^[^#]/m.test(this.#words); // there are only comments
    page["use-words"].textContent = this.#words.split("\n").map((line) => cut(line, MOST_LETTERS)).join("\n");
  }

  #json() {
    const { name } = this.#datasets[this.#number];
    const about = { dataset: name, labels: this.#labels, beside: this.#page.others.value || null, threshold: this.#threshold };
    return episodesJson(about, this.#taken);
  }

  get #remembersAs() {
    return `rfm.outcomes.${this.#name(this.#number)}`;
  }

  #readOutcomes(otherwise = []) {
    this.#outcomes = new Map(JSON.parse(remembered(this.#remembersAs)) ?? otherwise);
  }

  /** The episodes of this dataset that are marked, and their outcomes. */
  get #marked() {
    return this.#told.episodes.map((each) => [idOf(each), this.#outcomes.get(markOf(each))]).filter(([, outcome]) => outcome);
  }

  /** Marks the watched episode, for as long as the browser remembers; takes the same mark away. */
  #mark(outcome) {
    if (!this.#watched.isLoaded) return; // nobody has seen it
    const mark = markOf(this.#watched);
    const isMarked = this.#outcomes.get(mark) === outcome;
    this.#readOutcomes(this.#outcomes); // another window may have marked some since
    if (isMarked) this.#outcomes.delete(mark);
    else this.#outcomes.set(mark, outcome);
    remember(this.#remembersAs, JSON.stringify([...this.#outcomes]));
    this.#table.mark(this.#watched.episode, this.#shown);
    this.#showOutcomes();
  }

  #showOutcomes() {
    const [page, { length }] = [this.#page, this.#marked];
    const outcome = this.#watched && this.#outcomes.get(markOf(this.#watched));
    page.succeeded.setAttribute("aria-pressed", outcome === "success");
    page.failed.setAttribute("aria-pressed", outcome === "failure");
    page.succeeded.disabled = page.failed.disabled = !this.#watched?.isLoaded;
    page.outcomes.textContent = `outcomes.csv (${length} marked)`;
    page.outcomes.disabled = !length;
  }

  #showEnds() {
    const labelled = this.#episodes.filter(({ final_progress: final }) => final !== undefined && final !== null);
    const judgedOnes = labelled.filter(({ never_succeeds: never }) => never !== null);
    const never = judgedOnes.filter(({ never_succeeds: each }) => each).length;
    const undone = judgedOnes.filter(({ verdict }) => verdict === UNDONE).length;
    const [numAll, isWhole] = [this.#episodes.length, labelled.length === this.#episodes.length];
    const told = isWhole ? [] : [`${labelled.length} of ${numAll} episodes are labelled.`];
    const verb = never === 1 ? "succeeds" : "succeed";
    const broken = this.#episodes.filter(({ fault }) => fault).length;
    if (broken) told.push(`${broken} cannot be labelled now: see their tasks.`);
    if (judgedOnes.length) told.push(`${never} of ${judgedOnes.length} ${isWhole ? "episodes" : "of them"} never ${verb}.`);
    if (undone) told.push(`${undone} ${undone === 1 ? "succeeds, then undoes" : "succeed, then undo"} it.`);
    this.#page["ends-told"].textContent = told.join(" ");
    this.#histogram.show(labelled);
  }

  /** Shows checkpoint, recipe and date of the labels. */
  #showMade() {
    const { provenance, written_s: writtenS } = this.#told;
    this.#page["made-box"].hidden = writtenS === null;
    const { checkpoint, sampling, mode, cameras, fuse, orientations, channels, writer } = provenance ?? {};
    const byCamera = (values) => Object.entries(values ?? {}).map(([camera, value]) => `${short(camera)} ${value}`).join(", ");
    const rows = {
      Checkpoint: checkpoint && [checkpoint.source ?? checkpoint.weights_digest, checkpoint.revision].filter(Boolean).join("@"),
      Sampling: sampling && [sampling.rule, sampling.frames && `${sampling.frames} frames`].filter(Boolean).join(", "),
      Mode: mode && { prefix: "prefix: a frame is scored with those before it", whole: "whole: all frames are scored together" }[mode],
      Cameras: cameras && `${cameras.map(short).join(", ")}${cameras.length > 1 ? `; the label is their ${fuse}` : ""}`,
      Turned: byCamera(orientations),
      Channels: byCamera(channels),
      "Written by": writer,
      Written: writtenS === null ? "" : new Date(1000 * writtenS).toISOString().slice(0, 16).replace("T", " ") + " UTC",
    };
    const known = Object.entries(rows).filter(([, text]) => text);
    this.#page.made.replaceChildren(...known.flatMap(([name, text]) => [element("dt", name), element("dd", text)]));
  }

  /** Ends what is shown of an episode. */
  #leave() {
    this.#stopping.abort();
    this.#stopping = new AbortController();
    this.#timeline.videos.clear();
    this.#watched = null;
    this.#page.episode.hidden = true;
    this.#page.datasets.classList.remove("watching");
    for (const name of ["score-episode", "episode-png", "episode-svg"]) this.#page[name].disabled = true;
    this.#table.mark(null, []);
  }

  #close() {
    const { episode } = this.#watched;
    this.#leave();
    this.#onShown(true);
    this.#page.episodes.querySelector(`tr[data-episode="${episode}"] button`)?.focus();
  }

  /** Watches the next episode of the table, or the one before. */
  #step(direction) {
    const place = this.#shown.findIndex(({ episode }) => episode === this.#watched.episode);
    const next = this.#shown[place + direction];
    if (!next) return;
    this.#watch(next);
    this.#onShown(false);
  }

  async #watch(episode) {
    this.#leave();
    this.#watched = { ...episode, files: [], isLoaded: false };
    const page = this.#page;
    const { signal } = this.#stopping;
    this.#places.episode.clear();
    this.#places.errors.clear();
    page.episode.hidden = false;
    this.#showOutcomes();
    this.#showCurves([], []);
    page["episode-chart"].setAttribute("aria-label", "No curves yet.");
    page.datasets.classList.add("watching");
    this.#table.mark(episode.episode, this.#shown);
    page["episode-title"].textContent = `Episode ${episode.episode}`;
    page["episode-told"].textContent = page["episode-told"].title = toldOf(episode);
    const place = this.#shown.findIndex((each) => each.episode === episode.episode);
    page["episode-before"].disabled = place <= 0;
    page["episode-after"].disabled = place < 0 || place === this.#shown.length - 1;
    page["episode-title"].focus({ preventScroll: true });
    page.episode.scrollIntoView({ block: matchMedia(NARROW).matches ? "start" : "nearest" });
    try {
      await this.#fetch(episode, signal);
    } catch (error) {
      if (!signal.aborted) this.#failed("episode", `Episode ${episode.episode} cannot be shown`, error, () => this.#watch(episode));
    }
  }

  /** Lets the server download what it lacks of an episode on the Hub, and says how much; asks before a large download. */
  async #download(episode, signal) {
    if (!this.#told.is_on_hub) return;
    const place = this.#places.episode;
    const { size, asks } = await missingOf(this.#number, episode, signal);
    if (size === null || signal.aborted) return;
    if (asks) await new Promise((accept) => place.show(downloading(episode, size, accept)));
    if (signal.aborted) return;
    place.show(downloading(episode, size));
    await missingOf(this.#number, episode, signal, true);
    if (!signal.aborted) place.clear();
  }

  async #fetch({ episode }, signal) {
    const { cameras, unused, corrections } = this.#told;
    const page = this.#page;
    const other = page.others.value;
    const names = [this.#labels, ...(other ? [other] : [])];
    await this.#download(episode, signal);
    if (this.#told.is_on_hub) this.#table.refill(episode); // also after a download that went on without the page
    const told = await Promise.all(names.map((name) => curvesOf(this.#number, episode, name, signal)));
    checkSame(this.#watched, { name: told[0].name, num_frames: told[0].times_s.length });
    const curves = [...curvesIn(told[0], null), ...told.slice(1).flatMap((each) => curvesIn(each, other).slice(0, 1))];
    this.#timeline.time = 0;
    this.#showCurves(curves, motionIn(told[0]), curves.length ? curves : [emptyCurve(told[0])]);
    page["episode-chart"].setAttribute("aria-label", describe(curves));
    Object.assign(this.#watched, { fps: told[0].fps, curves });
    page["episode-png"].disabled = page["episode-svg"].disabled = !curves.length;
    const found = await Promise.all(cameras.map((_, camera) => videoOf(this.#number, episode, camera, signal)));
    if (signal.aborted) return;
    if (!cameras.length) this.#places.episode.show(noVideo(() => this.#watch(this.#watched)));
    const name = this.#datasets[this.#number].name.replace("/", "_"); // of the Hub
    cameras.forEach((camera, index) => {
      const file = `${name}_episode_${`${episode}`.padStart(6, "0")}.${short(camera)}.mp4`;
      this.#watched.files.push(new File([found[index].blob], file, { type: found[index].blob.type }));
      const title = unused[index] ? `${short(camera)} (${unused[index]}: not scored)` : short(camera);
      const video = this.#timeline.videos.add(this.#watched.files.at(-1), title, corrections[index]);
      this.#timeline.videos.mark(video, curves.find(({ label }) => label === short(camera)));
    });
    const reason = unused.every(Boolean) ? "Off: no camera of this episode has colours" // of no camera, too
      : found.some(({ isStored }, index) => !isStored && !unused[index])
        ? "Off: the page encodes these frames for the browser, which changes their scores slightly. Use rfm-client label." : "";
    this.#watched.isLoaded = true;
    this.#showOutcomes();
    Object.assign(this.#page["score-episode"], { disabled: reason !== "", title: reason });
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.#timeline.videos.play();
  }

  /** Shows the curves of an episode, and of its robot. drawn: with one that is not named */
  #showCurves(curves, motion, drawn = curves) {
    const page = this.#page;
    page["episode-chart"].hidden = !curves.length && motion.length > 0; // nothing would be in it
    page.motion.hidden = !motion.length;
    page["motion-legend"].replaceChildren(...new Map(motion.map((curve) => [curve.label, namedLine(curve)])).values());
    this.#timeline.show(drawn, motion);
    page["episode-legend"].replaceChildren(...curves.map(namedLine));
  }

  /** The curves of the watched episode as a figure, whose legend has the names of the cameras. */
  #figure() {
    const { curves, episode } = this.#watched;
    const video = { title: "" }; // of all curves
    const titles = [toldOf(this.#watched), `${this.#datasets[this.#number].name}, episode ${episode}`, this.#told.warning ?? this.#labels];
    return svgFigure(this.#page.figure, curves.map((curve) => ({ ...curve, video, task: curve.label })), { titles, threshold: this.#threshold });
  }

  #score() {
    this.#timeline.videos.pause();
    const { corrections, cameras, unused } = this.#told;
    const { files, fps, task, episode } = this.#watched;
    const own = this.#told.provenance?.dataset?.task ? null : task; // else the command has to give it
    const { name: dataset, kind } = this.#datasets[this.#number];
    const origins = cameras.map((camera) => ({ dataset, kind, episode, camera, fps, task: own }));
    const used = (each) => each.filter((_, index) => !unused[index]);
    this.#onScore({ files: used(files), task, fps, corrections: used(corrections), origins: used(origins) });
  }
}

/** The labelled curves as a chart takes them. file: of other labels, which are dashed; null: the first labels */
function curvesIn({ times_s: times, curves }, file) {
  const none = times.map(() => null);
  return curves.map(({ camera, progress, success, answered }, index) => {
    const name = camera ? short(camera) : curves.length > 1 ? "all cameras" : "labels";
    const label = file === null ? name : `${name} (${reward(file)})`;
    return { index, label, progress, success: success ?? none, answered, times, allTimes: times, dash: file === null ? null : DASHES[1] };
  });
}

/** The robot's actions and states as a chart takes them: dimensions of one name have one colour. */
function motionIn({ times_s: times, motion }) {
  const names = [...new Set(Object.values(motion).flatMap(({ names: own }) => own))];
  const success = times.map(() => null);
  return Object.entries(motion).flatMap(([leading, { names: own, values }]) => values.map((each, place) => (
    { ...lookOf(names.indexOf(own[place])), label: own[place], leading, [leading]: each, success, times, allTimes: times })));
}

/** A curve without a number, so that there is a time to move in. */
function emptyCurve({ times_s: times }) {
  const none = times.map(() => null);
  return { index: 0, label: "", progress: none, success: none, times, allTimes: times };
}

function describe(curves) {
  const told = curves.map(({ label, progress }) => `${label}: final progress ${shown(progress.at(-1))}`);
  return told.length ? told.join("; ") : "This episode has no labels.";
}

/** What an episode is called in a file of outcomes: its name, if it has one, since the numbers of a folder change. */
function idOf({ name, episode }) {
  return name ?? episode;
}

/** Throws an error if the server has another episode under this number by now. */
function checkSame(known, { name, num_frames: numFrames }) {
  if (known.name === name && known.num_frames === numFrames) return;
  const [expected, got] = [[known.name, known.num_frames], [name, numFrames]].map(([own, num]) => `${own ? `${own}, ` : ""}${num} frames`);
  throw new Error(`episode ${known.episode}: expected ${expected}, got ${got}: reload the page`);
}

/** What marks of an episode are kept under. One that was recorded again seldom has as many frames. */
function markOf(episode) {
  return `${idOf(episode)}, ${episode.num_frames} frames`;
}

function element(name, text) {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}

/** The name of the reward whose labels a file has. */
function reward(file) {
  return file.replace(/^.*\//, "").replace(/(_progress)?\.parquet$/, ""); // of HDF5: file/name
}

function short(camera) {
  return camera.startsWith(CAMERA_PREFIX) ? camera.slice(CAMERA_PREFIX.length) : camera;
}
