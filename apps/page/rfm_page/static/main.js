// SPDX-License-Identifier: MIT
// The page: what its controls do.

import { aboutServer, compare, GatewayAway, hasKey, KeyWanted, score, served, ServerError, useKey } from "./api.js";
import { Address } from "./address.js";
import { Asking } from "./asking.js";
import { Curve, failedOf } from "./curves.js";
import { DatasetTab } from "./dataset.js";
import { exampleFiles } from "./examples.js";
import { failure, noModel, otherModel, serverAway, tritonAway, useRemedies } from "./faults.js";
import { pngFigure, svgFigure } from "./figure.js";
import { onKeys } from "./keys.js";
import { Legend } from "./legend.js";
import { byQuestion, giveLooks } from "./looks.js";
import { Queue } from "./queue.js";
import { Settings } from "./settings.js";
import { Sidebar } from "./sidebar.js";
import { copied, Place } from "./states.js";
import { showTable } from "./table.js";
import { Tabs } from "./tabs.js";
import { Timeline } from "./timeline.js";
import { commands, csv, json, save } from "./takeaway.js";
import { learn, toldAt } from "./signals.js";
import { writeCommand } from "./text.js";
import { addVerdict, ofOneFile, sentenceOf } from "./verdicts.js";

const CURVES_AT_A_TIME = 3;
const OF_EPISODES = ["fps", "orient", "channels"]; // settings that an episode brings

const page = Object.fromEntries([...document.querySelectorAll("[id]")].map((element) => [element.id, element]));
const queue = new Queue(CURVES_AT_A_TIME);
const timeline = new Timeline(
  { videos: page.videos, chart: page.chart, slider: page.time, button: page.play, told: page["time-told"] },
  { changing: { onName: showNames, onColour: changed, onRemove: removeVideo }, onThreshold: dragThreshold },
);
const legend = new Legend(page.legend, { onChange: changed, onRemove: removeCurves });
const sidebar = new Sidebar(page.fold);
const { videos, chart } = timeline;
const TABS = ["score", "dataset"];
const tabs = new Tabs(TABS.map((name) => [page[`${name}-tab`], page[`${name}-panel`]]), shownTab);
const places = { away: new Place(page.away), errors: new Place(page.errors), served: new Place(page["served-state"]) };
const datasetTab = new DatasetTab(page, { onScore: scoreEpisode, onShown: told, failedAnywhere });
const choices = new Settings(page, chooseRule);
const address = new Address(go);
let shownIndex = 0; // of the tab
let curves = [];
let verdicts = [];
let usual = null; // the values of OF_EPISODES before an episode; null: they are still there
const gateway = { models: [], rules: [], url: "" };
let stopping = new AbortController();
let comparing = null; // ends the comparison on the way

const askingServer = new Asking(askServer);
const askingModels = new Asking(askServed);

/** Asks what is there; again until the server answers, and then until there is something to show. */
function begin() {
  askingServer.begin();
}

/** Begins the tabs as soon as the server answers. Says whether it does, or a key is wanted first. */
async function askServer(isCurrent) {
  let about;
  try {
    about = await aboutServer();
  } catch (error) {
    if (isCurrent()) showAnywhere(error);
    return isCurrent() && error instanceof KeyWanted; // the page begins again with a key
  }
  learn(about.scores); // before a tab draws a curve
  if (!isCurrent()) return true;
  if (!gateway.rules.length) offer(about);
  useRemedies(about.remedies, about.url);
  places.away.clear();
  page["key-form"].hidden = true;
  showWhetherReady();
  datasetTab.begin();
  if (!gateway.models.length) askingModels.begin();
  return true;
}

/** Offers the choices of this server. */
function offer(about) {
  Object.assign(gateway, about);
  page.rule.replaceChildren(...gateway.rules.map(({ name }) => new Option(name)));
  page.orient.replaceChildren(...gateway.orientations.map((name) => new Option(name === "none" ? "as stored" : name, name)));
  page.channels.replaceChildren(...gateway.channel_orders.map((name) => new Option(name.toUpperCase(), name)));
  videos.correct(correction());
  page.fps.value = page["usual-fps"].textContent = gateway.fps;
}

/** Asks which models are served, and offers them. Says whether there is one. */
async function askServed(isCurrent) {
  let answer;
  try {
    answer = await served();
  } catch (error) {
    if (!isCurrent()) return true;
    page.status.textContent = "";
    if (failedAnywhere(error)) return true; // the page begins again
    places.served.show(tritonAway(error, () => askingModels.begin()));
    return false;
  }
  if (!isCurrent()) return true;
  Object.assign(gateway, answer);
  page.model.replaceChildren(...gateway.models.map(({ name }) => new Option(name)));
  if (gateway.models.some(({ name }) => name === gateway.model)) page.model.value = gateway.model;
  chooseRule();
  if (gateway.models.length) warnOfModel(choices.begin());
  showWhetherReady();
  page.examples.hidden = !gateway.models.length;
  page.status.textContent = "";
  if (gateway.models.length) places.served.clear();
  else places.served.show(noModel(() => askingModels.begin()));
  return gateway.models.length > 0;
}

/** Shows on every tab that a key is wanted, or that the server is away. Says whether one of them is so. */
function showAnywhere(error) {
  if (error instanceof KeyWanted) {
    page["key-wrong"].textContent = hasKey() ? "This is not the key. Type it again." : "";
    page["key-form"].hidden = false;
    page.key.focus();
    page.key.select();
    page.status.textContent = "";
    places.away.clear();
  } else if (error instanceof GatewayAway) {
    places.away.show(serverAway(error, begin));
    places.served.clear();
    showWhetherReady();
  } else return false;
  return true;
}

/** Shows what is wrong on every tab, and begins again when the server is back. Says whether something of that kind is wrong. */
function failedAnywhere(error) {
  if (error instanceof GatewayAway) {
    places.away.clear(); // somebody asked: say it again, though it was closed
    askingServer.begin();
  }
  return showAnywhere(error);
}

/** Shows on the tab of videos what went wrong. */
function failed(error, title, retry) {
  if (!failedAnywhere(error)) places.errors.show(failure(title, error, retry));
}

/** Chooses the rule of the model's training. */
function chooseRule() {
  const model = gateway.models.find(({ name }) => name === page.model.value);
  if (model) page.rule.value = model.rule;
  page["one-view"].hidden = !model?.reads_views;
  const [, command = "", about = ""] = model?.remedy?.match(/^(rfm \S+ \S+)(.*)/) ?? [];
  page.warning.replaceChildren(...(model?.warning ? [`${model.warning}; `, Object.assign(document.createElement("code"), { textContent: command }), about] : []));
  page.threshold.parentElement.hidden = model?.has_success === false;
  showLimits();
}

function showLimits() {
  const model = gateway.models.find(({ name }) => name === page.model.value);
  const rule = gateway.rules.find(({ name }) => name === page.rule.value);
  const isOpen = rule?.frames === "any";
  page.frames.disabled = !isOpen;
  if (!isOpen) page.frames.value = "";
  page.frames.placeholder = isOpen ? `${model?.max_frames ?? ""} as trained`.trim() : `${rule?.frames ?? "all"}`;
}

/** Says that a link names a model that is not served. wanted: its name; null: all is well */
function warnOfModel(wanted) {
  if (wanted !== null) places.errors.show(otherModel(wanted, page.model.value));
  videos.correct(correction());
  showThreshold();
}

/** What the address of the page is now. */
function shownParams() {
  const ofTab = shownIndex ? datasetTab.params : choices.params;
  return [...(shownIndex ? [["tab", TABS[shownIndex]]] : []), ...ofTab];
}

/** Writes into the address what is shown now. isStep: Back leads to what was shown before */
function told(isStep = false) {
  if (isStep) address.step(shownParams());
  else address.correct(shownParams);
}

/** Shows what an address says. */
function go(params) {
  shownIndex = Math.max(TABS.indexOf(params.get("tab")), 0); // so that the tab is no new step
  tabs.select(shownIndex);
  if (shownIndex === 0) warnOfModel(choices.show(params));
  if (shownIndex === 1) datasetTab.show(params);
}

function settings() {
  const { model, rule, frames, fps, resize } = page;
  return { model: model.value, rule: rule.value, frames: frames.value, fps: Number(fps.value), resize: resize.checked };
}

/** How stored frames become upright RGB. */
function correction() {
  return { orient: page.orient.value, channels: page.channels.value };
}

function tasks() {
  return [...new Set(page.tasks.value.split("\n").map((line) => line.trim()).filter(Boolean))];
}

/** Says whether there is something to score, and a model to score it with. */
function showWhetherReady() {
  const isTaskThere = tasks().length > 0;
  if (isTaskThere || !videos.all.length) page["task-wanted"].textContent = "";
  page.score.disabled = !videos.all.length || !isTaskThere || !page.model.value || !places.away.isEmpty;
  const missing = [!videos.all.length && "a video", !isTaskThere && "a task"].filter(Boolean).join(" and ");
  page.score.title = !page.score.disabled ? "" : missing ? `Add ${missing}` : places.away.isEmpty ? "No model is served" : "The server does not answer";
}

function form(fields, files) {
  const data = new FormData();
  for (const [name, value] of Object.entries(fields)) data.append(name, value ?? "");
  for (const [name, file] of Object.entries(files)) data.append(name, file, file.name);
  return data;
}

/** Adds files, and scores them at once if a task is there. about: correction and origin of each */
function addFiles(files, about = []) {
  [...files].forEach((file, index) => {
    const { corrected = correction(), origin = null } = about[index] ?? {};
    videos.add(file, file.name, corrected, { origin });
  });
  page.files.value = "";
  page.undo.hidden = true;
  update();
  if (!videos.all.length || !page.model.value) return;
  if (tasks().length) scoreAll();
  else askForTask();
}

/** Asks for the task of videos that are there without one. */
function askForTask() {
  sidebar.open();
  page["task-wanted"].textContent = "What is the robot to do? Type it, then press Score.";
  page.tasks.focus();
}

/** Scores an episode of a dataset in place of what was there, if the user agrees. fps: frames a second; corrections, origins: of each file */
function scoreEpisode({ files, task, fps, corrections, origins }) {
  const there = videos.all.length;
  if (there && !confirm(`Replace the ${there === 1 ? "video" : `${there} videos`} on the Score tab?`)) return;
  clear();
  usual = valuesOf(OF_EPISODES);
  page.tasks.value = task;
  setValues({ orient: "none", channels: "rgb", ...corrections[0], fps });
  tabs.select(0);
  addFiles(files, files.map((_, index) => ({ corrected: corrections[index], origin: origins[index] })));
}

function valuesOf(names) {
  return Object.fromEntries(names.map((name) => [name, page[name].value]));
}

function setValues(values) {
  for (const [name, value] of Object.entries(values)) page[name].value = value;
}

async function scoreExamples(names) {
  try {
    const { files, origins, task } = await exampleFiles(names);
    page.tasks.value = task;
    addFiles(files, origins.map((origin) => ({ origin })));
    places.errors.clear();
  } catch (error) {
    failed(error, "The example could not be loaded", () => scoreExamples(names));
  }
}

/** Asks about each video and task that was not yet asked about with these settings. */
function scoreAll() {
  places.errors.clear();
  page.status.textContent = "";
  if (page.score.disabled) return;
  sidebar.giveWay();
  const known = new Set(curves.filter(({ error }) => !error).map(({ identity }) => identity));
  for (const video of videos.all) {
    for (const task of tasks()) {
      const curve = new Curve(video, { task, ...settings(), orient: video.orient, channels: video.channels });
      if (known.has(curve.identity)) continue;
      curves = curves.filter(({ identity }) => identity !== curve.identity); // one that failed is asked again
      curves.push(curve);
      queue.add(() => ask(curve, AbortSignal.any([stopping.signal, curve.leaving.signal])));
    }
  }
  update();
}

async function ask(curve, signal) {
  if (signal.aborted) return;
  const { video, task, model, rule, frames, fps, orient, channels, resize } = curve;
  const fields = { task, model, sampling: rule, frames, fps, orient, channels, resize };
  try {
    await score(form(fields, { video: video.file }), signal, (name, document) => {
      curve.take(name, document);
      update();
      if (name === "done") showEnds();
    }, (share) => curve.takeSent(share) && update());
  } catch (error) {
    curve.state = "failed";
    curve.error = signal.aborted ? "stopped" : error.message;
    showEnds();
    const faults = new Map(curves.filter((each) => each.error && each.error !== "stopped").map((each) => [each.name, each.error]));
    if (faults.size > 1) error.message = [...faults].map(([name, fault]) => `${name}: ${fault}`).join("; ");
    const title = faults.size > 1 ? `${faults.size} videos` : video.name;
    if (!signal.aborted) failed(error, `${title} could not be scored`, error instanceof ServerError ? scoreAll : null);
  }
  setTimeout(update); // when the queue knows, too
}

/** Moves to the end of the curves once all are there: the numbers beside the chart are then those of the ends. */
function showEnds() {
  const isOver = curves.every(({ state }) => ["done", "failed"].includes(state));
  if (isOver && !videos.isPlaying) timeline.moveTo(Infinity);
}

/** The videos that can be compared: all but those whose every curve failed. */
function comparable() {
  const isFailed = ({ state, error }) => state === "failed" && error !== "stopped";
  return videos.all.filter((video) => {
    const own = curves.filter((curve) => curve.video === video);
    return !own.length || !own.every(isFailed);
  });
}

async function compareAll() {
  const all = comparable();
  const { model, fps, resize } = settings();
  const { orient, channels } = all[0];
  const before = verdicts.length;
  const { signal } = comparing = new AbortController();
  places.errors.clear();
  update();
  try {
    if (!tasks().length) throw new Error("task: expected a sentence, got none");
    for (const name of ["orient", "channels"]) {
      const other = all.find((video) => video[name] !== all[0][name]);
      if (other) throw new Error(`${name}: expected the same of all videos, got ${all[0][name]} and ${other[name]}`);
    }
    page.status.textContent = `Comparing ${all.length} videos.`;
    const twice = await ofOneFile(all);
    signal.throwIfAborted();
    if (twice) tell({ videos: twice, answer: null });
    for (const task of twice ? [] : tasks()) {
      const files = Object.fromEntries(all.map(({ file }, index) => [`video_${index}`, file]));
      const answer = await compare(form({ task, model, fps, orient, channels, resize }, files), signal);
      tell({ videos: all, task, model, fps, orient, channels, resize, answer });
    }
  } catch (error) {
    if (!signal.aborted) {
      error.message = error.message.replace(/\bvideo_(\d+)/g, (field, index) => all[index]?.name ?? field);
      failedAnywhere(error);
      places.errors.show(failure("The videos could not be compared", error, compareAll)); // which stays when the server is back
      page.errors.scrollIntoView({ block: "nearest" });
    }
  }
  comparing = null;
  update();
  if (signal.aborted) return;
  page.status.textContent = "";
  page["verdict-told"].textContent = verdicts.slice(before).map(sentenceOf).join(" ");
}

/** Shows a verdict, and scrolls to it. */
function tell(verdict) {
  verdicts.push(verdict);
  const box = addVerdict(page.pairs, verdict);
  update();
  box.scrollIntoView({ block: "nearest" });
}

function stop() {
  queue.clear();
  comparing?.abort();
  stopping.abort();
  stopping = new AbortController();
  page.status.textContent = "";
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
  page.pairs.replaceChildren();
  places.errors.clear();
  setValues(usual ?? {});
  usual = null;
  timeline.moveTo(0);
  update();
}

/** Clears the tab, and offers to take that back. */
function clearForNow() {
  stop();
  const gone = { entries: videos.all, curves, verdicts };
  const [text, values, before] = [page.tasks.value, valuesOf(OF_EPISODES), usual];
  clear();
  page.status.textContent = `Cleared ${gone.entries.length} ${gone.entries.length === 1 ? "video" : "videos"}.`;
  page.undo.hidden = false;
  page.undo.onclick = () => {
    page.tasks.value ||= text;
    setValues(values);
    usual = before;
    restore(gone);
  };
  page.undo.focus();
}

/** Brings back what was cleared, beside what has come since. */
function restore({ entries, curves: old, verdicts: oldVerdicts }) {
  const again = new Map(entries.map((entry) => {
    const { file, name, title, colour, origin, orient, channels } = entry;
    return [entry, videos.add(file, name, { orient, channels }, { origin, title, colour })];
  }));
  for (const curve of old) curve.video = again.get(curve.video);
  for (const verdict of oldVerdicts) verdict.videos = verdict.videos.map((video) => again.get(video));
  curves.push(...old);
  verdicts.push(...oldVerdicts);
  page.undo.hidden = true;
  page.status.textContent = "";
  showNames();
  showEnds();
}

function removeVideo(video) {
  videos.remove(video);
  comparing?.abort();
  for (const curve of curves.filter((each) => each.video === video)) forget(curve);
  verdicts = verdicts.filter((verdict) => !verdict.videos.includes(video));
  page.status.textContent = "";
  showNames();
}

/** Shows everything under the names and colours of now. */
function showNames() {
  page.pairs.replaceChildren();
  for (const verdict of verdicts) addVerdict(page.pairs, verdict);
  update();
}

/** The verdicts that the model gave: those on one file twice have no answer. */
function answered() {
  return verdicts.filter(({ answer }) => answer);
}

function removeCurves(gone) {
  for (const curve of gone) forget(curve);
  update();
}

/** Ends a curve, which is shown no more. */
function forget(curve) {
  curve.leaving.abort();
  curves = curves.filter((each) => each !== curve);
  if (!curves.some(({ error }) => error)) places.errors.clear();
}

/** Shows a curve in another colour or under another name. */
function changed() {
  showNames();
  chart.redraw();
}

function dragThreshold(value) {
  page.threshold.value = value;
  showThreshold();
}

function showThreshold() {
  const value = Number(page.threshold.value);
  page["threshold-told"].textContent = value.toFixed(2);
  chart.setThreshold(value);
  showTable(page.curves, curves, value);
}

/** The figure. Its titles name the task, the episode or video, and the checkpoint, or say how many there are. */
function figure() {
  const scored = curves.filter(({ times }) => times.length);
  const named = (told, kind) => {
    const names = new Set(scored.map(told));
    return names.size === 1 ? told(scored[0]) : `${names.size} ${kind}`;
  };
  const episodeOf = ({ name, video: { origin } }) => (origin?.dataset ? `${origin.dataset}, episode ${origin.episode}` : name);
  const titles = [named(({ task }) => task, "tasks"), named(episodeOf, "videos"), named((curve) => modelOf(curve)?.warning ?? checkpointOf(curve), "checkpoints")];
  return svgFigure(page.figure, scored, { titles, threshold: Number(page.threshold.value) });
}

/** Shows everything anew that depends on the curves. */
function update() {
  const scored = curves.filter(({ times }) => times.length);
  page.empty.hidden = videos.all.length > 0;
  page["served-state"].classList.toggle("whole", !videos.all.length);
  page.clear.hidden = !videos.all.length;
  page.stage.hidden = !videos.all.length;
  page.stage.classList.toggle("unscored", curves.length > 0 && curves.every(({ state, times }) => state === "failed" && !times.length));
  page.numbers.hidden = !curves.length;
  giveLooks(curves);
  timeline.show(curves);
  legend.show(curves);
  const isByQuestion = byQuestion(curves);
  for (const video of videos.all) {
    const own = curves.filter((curve) => curve.video === video);
    videos.mark(video, isByQuestion || failedOf(own) === "failed" ? null : own[0]);
    videos.tell(video, own);
  }
  showTable(page.curves, curves, Number(page.threshold.value));
  page.stop.disabled = queue.isIdle && !comparing;
  page.compare.hidden = comparable().length < 2 || !page.model.value;
  page.compare.disabled = Boolean(comparing);
  page.compare.textContent = comparing ? `Comparing ${comparable().length} videos…` : "Compare videos";
  page.take.hidden = !scored.length && !answered().length;
  page.verdicts.hidden = !verdicts.length;
  page.png.disabled = page.svg.disabled = page.csv.disabled = !scored.length;
  writeCommand(page.command, commands(gateway.url, scored, answered()));
  told();
  showWhetherReady();
  page.scored.textContent = curves.length ? howMany() : "";
  page["scored-by"].textContent = scored.length ? `· ${[...new Set(curves.map(checkpointOf))].join(", ")}` : "";
  page.chart.setAttribute("aria-label", scored.length
    ? scored.map((curve) => `${curve.label}: final ${toldAt(curve, -1)}`).join("; ")
    : "No curves yet.");
}

/** How many curves are there, how many failed, and how much of the videos on the way has been sent. */
function howMany() {
  const [done, failed] = ["done", "failed"].map((name) => curves.filter(({ state }) => state === name).length);
  const percents = curves.filter(({ isUploading }) => isUploading).map(({ sentPercent }) => sentPercent);
  const told = failed < curves.length ? [`${done} of ${curves.length} scored`] : [];
  if (failed) told.push(told.length ? `${failed} failed` : `${failed} of ${failed} failed`);
  if (percents.length) told.push(`uploading ${Math.floor(percents.reduce((sum, each) => sum + each) / percents.length)} %`);
  return told.join(", ");
}

/** The checkpoint that answers a question. */
function checkpointOf(curve) {
  return modelOf(curve)?.source ?? curve.model;
}

function modelOf({ model }) {
  return gateway.models.find(({ name }) => name === model);
}

/** The settings belong to the tabs that have some, and what is said of curves to the first. */
function shownTab(index) {
  page.fold.disabled = index === 1 && page["dataset-side"].hidden;
  page.status.textContent = "";
  const isStep = index !== shownIndex;
  if (isStep) address.settle(); // of the tab that was shown
  shownIndex = index;
  if (isStep) told(true);
  if (index === 0) update();
}

async function copy(text, name, element) {
  const isCopied = await copied(text, element);
  page.status.textContent = isCopied ? `The ${name} copied.` : "The browser lets no page copy here: press Ctrl+C.";
}

function listen(element, events) {
  for (const [name, action] of Object.entries(events)) element.addEventListener(name, action);
}

listen(page.question, {
  submit: (event) => { event.preventDefault(); scoreAll(); },
  input: () => { told(); showWhetherReady(); },
  change: () => told(),
});
listen(page["key-form"], { submit: (event) => { event.preventDefault(); useKey(page.key.value.trim()); begin(); } });
listen(page.files, { change: () => addFiles(page.files.files) });
listen(page.model, { change: chooseRule });
listen(page.rule, { change: showLimits });
for (const select of [page.orient, page.channels]) listen(select, { change: () => videos.correct(correction()) });
listen(page.stop, { click: stop });
listen(page.clear, { click: clearForNow });
listen(page.compare, { click: compareAll });
listen(page.threshold, { input: showThreshold });
listen(page.tasks, { keydown: (event) => { if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) scoreAll(); } });
listen(page.examples, { click: ({ target }) => {
  const button = target.closest("button");
  if (button) scoreExamples(button.dataset.example.split(" "));
} });
listen(page.csv, { click: () => save("curves.csv", csv(curves), "text/csv") });
listen(page.json, { click: () => save("curves.json", json(gateway.url, curves, answered()), "application/json") });
listen(page.png, { click: async () => save("curves.png", await pngFigure(figure())) });
listen(page.svg, { click: () => save("curves.svg", figure(), "image/svg+xml") });
listen(page.copy, { click: () => copy(page.command.textContent, "command line is", page.command) });
listen(page["use-copy"], { click: () => copy(datasetTab.words, "words are", page["use-words"]) });
listen(document, {
  dragover: (event) => { event.preventDefault(); page.dropping.hidden = false; },
  dragleave: (event) => { if (!event.relatedTarget) page.dropping.hidden = true; },
  drop: (event) => {
    event.preventDefault();
    page.dropping.hidden = true;
    tabs.select(0);
    addFiles(event.dataTransfer.files);
  },
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", update);

onKeys({ " ": () => page.play.click() }, () => !page["score-panel"].hidden && !page.play.disabled);
showThreshold();
go(address.params);
begin();
