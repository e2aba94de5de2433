// SPDX-License-Identifier: MIT
// What can be taken along: CSV, JSON, files, and the command lines that give the same numbers.

import { hasKey } from "./api.js";
import { commented, quoted } from "./shell.js";
import { leadingOf } from "./signals.js";

const LOOPBACK = /^\w+:\/\/(localhost|127\.[\d.]+|\[::1\])([:/]|$)/;

/** The curves as CSV, one line a point. */
export function csv(curves) {
  const instead = insteadOf(curves);
  const columns = ["video", "task", "model", "version", "sampling", "frames", "fps", "orient", "channels", "frame", "time_s", "progress", "success", ...instead];
  const lines = curves.flatMap((curve) =>
    curve.times.map((time, index) => [
      curve.video.name, curve.task, curve.model, curve.version, curve.rule, curve.sampledFrames, curve.fps,
      curve.orient, curve.channels, index, time, curve.progress[index], curve.success[index],
      ...instead.map((name) => curve[name]?.[index]),
    ]),
  );
  return csvText([columns, ...lines]);
}

/** Rows of values as CSV. */
export function csvText(rows) {
  return rows.map((values) => values.map(csvField).join(",") + "\r\n").join("");
}

/** The scores that models predict in place of progress. */
function insteadOf(curves) {
  return [...new Set(curves.map(leadingOf))].filter((name) => name !== "progress").sort();
}

function csvField(value) {
  const text = value === null || value === undefined ? "" : `${value}`;
  return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}

/** The curves and verdicts as JSON, under the names that `rfm-client score --json` uses. */
export function json(url, curves, verdicts) {
  const videos = curves.map((curve) => ({
    source: curve.video.name,
    task: curve.task,
    model: curve.model,
    model_version: curve.version,
    fps: curve.fps,
    sampling: curve.rule,
    sampled_frames: curve.sampledFrames,
    orient: curve.orient,
    channels: curve.channels,
    resize: curve.resize,
    num_frames: curve.numFrames,
    progress: curve.progress,
    success: curve.success,
    ...Object.fromEntries(insteadOf([curve]).map((name) => [name, curve[name]])),
    frame_indices: curve.progress.map((_, index) => index),
    frame_times_s: curve.times,
    ...(curve.error ? { error: curve.error } : {}),
  }));
  const comparisons = verdicts.map(({ videos: compared, task, model, orient, channels, answer }) => {
    const named = (each) => ({ ...each, first: compared[each.first].name, second: compared[each.second].name });
    const ranked = answer.videos.map((each, index) => ({ source: compared[index].name, ...each }));
    return { task, model, orient, channels, ...answer, videos: ranked, orders: answer.orders.map(named), pairs: answer.pairs.map(named) };
  });
  return JSON.stringify({ servers: [url], videos, comparisons }, null, 2) + "\n";
}

/**
 * The command lines that give the same numbers: one for all videos that were asked about alike, and one for the
 * cameras of an episode of a dataset. A comment stands for what no command can do.
 */
export function commands(url, curves, verdicts) {
  const ofEpisodes = grouped(curves.filter(({ video }) => video.origin?.dataset), askedOfEpisode).map((group, index, all) => labelLine(group, url, timesBefore(group, all.slice(0, index))));
  const groups = grouped(curves.filter(({ video }) => !video.origin?.dataset), asked);
  const scores = groups.map((group, index) => {
    const [{ rule, sampledFrames }] = group;
    const target = `scores${groups.length > 1 ? `_${index + 1}` : ""}.json`;
    return line("score", group.map(({ video }) => video), group[0], url, [...sampling(rule, sampledFrames), "--json", target]);
  });
  const comparisons = verdicts.map((verdict) => line("compare", verdict.videos, verdict, url, []));
  return [...scores, ...ofEpisodes, ...comparisons].join("\n");
}

/** How many groups are of the same episode as this one. */
function timesBefore([{ video: { origin } }], groups) {
  return groups.filter(([{ video }]) => video.origin.dataset === origin.dataset && video.origin.episode === origin.episode).length;
}

function grouped(curves, askedOf) {
  const alike = new Map();
  for (const curve of curves) alike.set(askedOf(curve), [...(alike.get(askedOf(curve)) ?? []), curve]);
  return [...alike.values()];
}

function asked({ task, model, rule, sampledFrames, fps, orient, channels, resize }) {
  return JSON.stringify([task, model, rule, sampledFrames, fps, orient, channels, resize]);
}

function askedOfEpisode({ video, task, model, rule, sampledFrames, fps, resize }) {
  const { dataset, episode } = video.origin;
  return JSON.stringify([dataset, episode, task, model, rule, sampledFrames, fps, resize]);
}

function sampling(rule, frames) {
  return ["--sampling", rule, ...(frames === null ? [] : ["--frames", frames])];
}

/** The command that labels an episode of a dataset as the page has scored it. before: such commands of the same episode */
function labelLine(group, url, before) {
  const [{ video: { origin }, task, model, rule, sampledFrames, fps, resize }] = group;
  const about = `episode ${origin.episode} of ${origin.dataset}`;
  if (fps !== origin.fps) return commented(`${about}: a command scores all of its frames, ${origin.fps} a second, not ${fps}`);
  const cameras = group.map(({ video }) => video.origin.camera);
  const corrections = group.flatMap(({ video, orient, channels }) => corrected({ orient, channels }, `${video.origin.camera}=`));
  const options = ["--episodes", origin.episode, "--cameras", cameras.join(","), ...corrections, ...sampling(rule, sampledFrames)];
  const given = task === origin.task ? [] : ["--task", task, "--override-task"];
  const words = ["rfm-client", "label", ...datasetWords({ name: origin.dataset, kind: origin.kind }), ...serverOption(url), "--model", model, ...given, ...options];
  const target = ["--output", `${origin.dataset.replace("/", "_")}_episode_${origin.episode}${before ? `_${before + 1}` : ""}`, "--format", "progress"];
  return [...words, ...(resize ? ["--resize"] : []), ...target].map(quoted).join(" ");
}

/** The words that name a dataset, in the folder that holds it: of some, also how its files are read. */
export function datasetWords({ name, kind }) {
  const [how, what] = kind.split(/ (.*)/s);
  const option = { pattern: "--videos", reader: "--reader" }[how];
  return option ? [name, option, what] : [name];
}

function line(command, videos, { task, model, fps, orient, channels, resize }, url, options) {
  const cut = videos.find(({ origin }) => origin?.dataset);
  if (cut) return commented(`${command}: no file holds episode ${cut.origin.episode} of ${cut.origin.dataset} alone`);
  const urls = videos.flatMap(({ origin }) => (origin?.url ? ["-O", origin.url] : []));
  const fetched = urls.length ? `${["curl", "-f", ...urls].map(quoted).join(" ")} && ` : "";
  const files = videos.map(({ name }) => (name.startsWith("-") ? `./${name}` : name));
  const words = ["rfm-client", command, ...files, ...serverOption(url), "--model", model, "--task", task, "--fps", fps];
  return fetched + [...words, ...corrected({ orient, channels }), ...(resize ? ["--resize"] : []), ...options].map(quoted).join(" ");
}

/** The options that make frames upright RGB. camera: "" or the camera that is meant, with = behind it */
function corrected({ orient, channels }, camera = "") {
  const turned = orient === "none" ? [] : ["--orient", `${camera}${orient}`];
  return [...turned, ...(channels === "rgb" ? [] : ["--channels", `${camera}${channels}`])];
}

/** The options that say where Triton is, and its key. On a loopback address only a page of the same machine reaches it. */
export function serverOption(url, pageUrl = location.href, asksKey = hasKey()) {
  return LOOPBACK.test(url) && !LOOPBACK.test(pageUrl) ? [] : ["--url", url, ...(asksKey ? ["--api-key-file", "KEY_FILE"] : [])];
}

/** Lets the browser save a file. */
export function save(name, content, kind) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(content instanceof Blob ? content : new Blob([content], { type: kind }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
