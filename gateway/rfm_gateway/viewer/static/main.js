// SPDX-License-Identifier: MIT
// The page: what its controls do.

import { compare, KeyWanted, score, served, useKey } from "./api.js";
import { Chart } from "./chart.js";
import { Curve } from "./curves.js";
import { Videos } from "./videos.js";
import { Queue } from "./queue.js";
import { showTable, shown } from "./table.js";
import { commands, csv, json, save } from "./takeaway.js";
import { addVerdict } from "./verdicts.js";

const CURVES_AT_A_TIME = 3;

const page = Object.fromEntries([...document.querySelectorAll("[id]")].map((element) => [element.id, element]));
const queue = new Queue(CURVES_AT_A_TIME);
const videos = new Videos(page.videos, (seconds, video) => moveTo(seconds, video));
const chart = new Chart(page.chart, pointedAt);
let curves = [];
let verdicts = [];
let gateway = { models: [], rules: [], url: "" };
let stopping = new AbortController();
let time = 0;
let numCurves = 0;

async function begin() {
  try {
    gateway = await served();
  } catch (error) {
    page.status.textContent = "";
    failed(error);
    return;
  }
  page["key-form"].hidden = true;
  page.errors.replaceChildren();
  page.model.replaceChildren(...gateway.models.map(({ name }) => new Option(name)));
  page.rule.replaceChildren(...gateway.rules.map(({ name }) => new Option(name)));
  page.rule.value = gateway.rule;
  page.fps.value = gateway.fps;
  if (gateway.models.some(({ name }) => name === gateway.model)) page.model.value = gateway.model;
  showLimits();
  const none = "model: expected one that scores frames of videos, got none";
  page.status.textContent = gateway.models.length ? "Ready." : none;
}

/** Shows an error, and the form for the key if that is what is wrong. */
function failed(error) {
  if (error instanceof KeyWanted) {
    page["key-form"].hidden = false;
    page.key.focus();
  }
  const line = document.createElement("p");
  line.textContent = error.message;
  page.errors.replaceChildren(line);
}

function showLimits() {
  const model = gateway.models.find(({ name }) => name === page.model.value);
  const rule = gateway.rules.find(({ name }) => name === page.rule.value);
  const isOpen = rule?.frames === "any";
  page.frames.disabled = !isOpen;
  if (!isOpen) page.frames.value = "";
  page.frames.placeholder = isOpen ? `as trained${model?.max_frames ? `: ${model.max_frames}` : ""}` : `${rule?.frames ?? "all"}`;
}

function settings() {
  const { model, rule, frames, fps, resize } = page;
  return { model: model.value, rule: rule.value, frames: frames.value, fps: Number(fps.value), resize: resize.checked };
}

function tasks() {
  return [...new Set(page.tasks.value.split("\n").map((line) => line.trim()).filter(Boolean))];
}

function form(fields, files) {
  const data = new FormData();
  for (const [name, value] of Object.entries(fields)) data.append(name, value ?? "");
  for (const [name, file] of Object.entries(files)) data.append(name, file, file.name);
  return data;
}

/** Adds files, and scores them at once if a task is there. */
function addFiles(files) {
  for (const file of files) videos.add(file);
  page["no-videos"].hidden = videos.all.length > 0;
  update();
  if (tasks().length && page.model.value) scoreAll();
}

/** Asks about each video and task that was not yet asked about with these settings. */
function scoreAll() {
  page.errors.replaceChildren();
  const missing = [
    [!videos.all.length, "video: expected a file, got none: drop one"],
    [!tasks().length, "task: expected what is to be done, as a sentence, got none"],
    [!page.model.value, "model: expected one that is served, got none"],
  ].find(([isMissing]) => isMissing);
  if (missing) {
    failed(new Error(missing[1]));
    return;
  }
  const known = new Set(curves.filter(({ error }) => !error).map(({ identity }) => identity));
  for (const video of videos.all) {
    for (const task of tasks()) {
      const curve = new Curve(numCurves, video, { task, ...settings() });
      if (known.has(curve.identity)) continue;
      curves = curves.filter(({ identity }) => identity !== curve.identity); // one that failed is asked again
      curves.push(curve);
      numCurves += 1;
      queue.add(() => ask(curve, stopping.signal));
    }
  }
  update();
}

async function ask(curve, signal) {
  const { video, task, model, rule, frames, fps, resize } = curve;
  const fields = { task, model, sampling: rule, frames, fps, resize };
  try {
    await score(form(fields, { video: video.file }), signal, (name, document) => {
      curve.take(name, document);
      update();
    });
  } catch (error) {
    curve.state = "failed";
    curve.error = signal.aborted ? "stopped" : error.message;
    if (!signal.aborted) failed(error instanceof KeyWanted ? error : new Error(`${video.name}: ${error.message}`));
  }
  setTimeout(update); // when the queue knows, too
}

async function comparePair() {
  const [first, second] = videos.all;
  const { model, fps, resize } = settings();
  page.errors.replaceChildren();
  page.compare.disabled = true;
  try {
    if (!tasks().length) throw new Error("task: expected what is to be done, as a sentence, got none");
    for (const task of tasks()) {
      const data = form({ task, model, fps, resize }, { first: first.file, second: second.file });
      const verdict = { videos: [first, second], task, model, fps, resize, answer: await compare(data, stopping.signal) };
      verdicts.push(verdict);
      addVerdict(page.pairs, verdict);
      update();
    }
  } catch (error) {
    if (!stopping.signal.aborted) failed(error);
  }
  update();
}

function stop() {
  queue.clear();
  stopping.abort();
  stopping = new AbortController();
  for (const curve of curves.filter(({ state }) => state === "waiting")) {
    Object.assign(curve, { state: "failed", error: "stopped" });
  }
  update();
}

function clear() {
  stop();
  videos.clear();
  curves = [];
  verdicts = [];
  numCurves = 0;
  page.pairs.replaceChildren();
  page.errors.replaceChildren();
  page.files.value = "";
  page["no-videos"].hidden = false;
  moveTo(0);
  update();
}

/** Shows everything anew that depends on the curves. */
function update() {
  const scored = curves.filter(({ times }) => times.length);
  const end = Math.max(0, ...scored.map(({ allTimes }) => allTimes.at(-1)));
  chart.show(curves);
  page.time.disabled = page.play.disabled = !scored.length;
  page.time.max = end || 1;
  page.stop.disabled = queue.isIdle;
  page.compare.disabled = videos.all.length !== 2 || !page.model.value;
  page.take.hidden = !scored.length && !verdicts.length;
  page.verdicts.hidden = !verdicts.length;
  page.png.disabled = page.csv.disabled = !scored.length;
  page.command.textContent = commands(gateway.url, scored, verdicts);
  const done = curves.filter(({ state }) => state === "done").length;
  if (curves.length) page.status.textContent = `${done} of ${curves.length} curves are done.`;
  page.chart.setAttribute("aria-label", scored.length
    ? scored.map((curve) => `${curve.label}: last progress ${shown(curve.progress.at(-1))}`).join("; ")
    : "No curves yet.");
  showTime();
}

function showTime() {
  page.time.value = time;
  page.time.setAttribute("aria-valuetext", `${time.toFixed(2)} seconds`);
  showTable(page.curves, curves, time, Number(page.threshold.value));
  chart.moveTo(time);
}

/** Moves everything to a time, but for the video that it comes from. */
function moveTo(seconds, from = null) {
  time = Math.min(seconds, Number(page.time.max));
  if (!videos.isPlaying || !from) videos.seek(time, from);
  page.play.textContent = videos.isPlaying ? "Pause" : "Play";
  showTime();
}

function pointedAt(seconds, isDragged) {
  if (isDragged) videos.pause();
  if (!videos.isPlaying) moveTo(seconds);
}

/** Moves to the next point of any curve, or to the one before. */
function step(direction) {
  const times = [...new Set(curves.flatMap((curve) => curve.times))].sort((one, other) => one - other);
  const next = direction > 0 ? times.find((each) => each > time + 1e-3) : times.findLast((each) => each < time - 1e-3);
  if (next !== undefined) moveTo(next);
}

function play() {
  if (videos.isPlaying) videos.pause();
  else videos.play();
  setTimeout(() => (page.play.textContent = videos.isPlaying ? "Pause" : "Play"));
}

async function copy() {
  try {
    await navigator.clipboard.writeText(page.command.textContent);
    page.status.textContent = "The command line is copied.";
  } catch { // there is none where the page comes over plain HTTP from another machine
    failed(new Error("clipboard: expected leave to write to it, got none: mark the command line and copy it"));
  }
}

function listen(element, events) {
  for (const [name, action] of Object.entries(events)) element.addEventListener(name, action);
}

listen(page.question, { submit: (event) => { event.preventDefault(); scoreAll(); } });
listen(page["key-form"], { submit: (event) => { event.preventDefault(); useKey(page.key.value.trim()); begin(); } });
listen(page.files, { change: () => addFiles(page.files.files) });
listen(page.model, { change: showLimits });
listen(page.rule, { change: showLimits });
listen(page.stop, { click: stop });
listen(page.clear, { click: clear });
listen(page.compare, { click: comparePair });
listen(page.play, { click: play });
listen(page.threshold, { input: () => { chart.setThreshold(Number(page.threshold.value)); showTime(); } });
listen(page.time, {
  input: () => { videos.pause(); moveTo(Number(page.time.value)); },
  keydown: (event) => {
    const direction = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
    if (!direction) return;
    event.preventDefault();
    videos.pause();
    step(direction);
  },
});
listen(page.csv, { click: () => save("curves.csv", csv(curves), "text/csv") });
listen(page.json, { click: () => save("curves.json", json(gateway.url, curves, verdicts), "application/json") });
listen(page.png, { click: async () => save("curves.png", await chart.png(curves.filter(({ times }) => times.length))) });
listen(page.copy, { click: copy });
listen(document, {
  dragover: (event) => { event.preventDefault(); page.drop.classList.add("over"); },
  dragleave: () => page.drop.classList.remove("over"),
  drop: (event) => {
    event.preventDefault();
    page.drop.classList.remove("over");
    addFiles(event.dataTransfer.files);
  },
});

begin();
