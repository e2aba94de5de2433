// SPDX-License-Identifier: MIT
// What can be taken along: CSV, JSON, files, and the command lines that give the same numbers.

/** The curves as CSV, one line a point. */
export function csv(curves) {
  const columns = ["video", "task", "model", "version", "sampling", "frames", "fps", "orient", "frame", "time_s", "progress", "success"];
  const lines = curves.flatMap((curve) =>
    curve.times.map((time, index) => [
      curve.video.name, curve.task, curve.model, curve.version, curve.rule, curve.sampledFrames, curve.fps,
      curve.orient, index, time, curve.progress[index], curve.success[index],
    ]),
  );
  return [columns, ...lines].map((values) => values.map(csvField).join(",") + "\r\n").join("");
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
    resize: curve.resize,
    num_frames: curve.numFrames,
    progress: curve.progress,
    success: curve.success,
    frame_indices: curve.progress.map((_, index) => index),
    frame_times_s: curve.times,
    ...(curve.error ? { error: curve.error } : {}),
  }));
  const comparisons = verdicts.map(({ videos, task, model, orient, answer }) => ({
    first: videos[0].name, second: videos[1].name, task, model, orient, ...answer,
  }));
  return JSON.stringify({ servers: [url], videos, comparisons }, null, 2) + "\n";
}

/** The command lines that give the same numbers: one for all videos that were asked about alike. */
export function commands(url, curves, verdicts) {
  const alike = new Map();
  for (const curve of curves) alike.set(asked(curve), [...(alike.get(asked(curve)) ?? []), curve]);
  const scores = [...alike.values()].map((group, index) => {
    const [{ rule, sampledFrames }] = group;
    const sampling = ["--sampling", rule, ...(sampledFrames === null ? [] : ["--frames", sampledFrames])];
    const target = `scores${alike.size > 1 ? `_${index + 1}` : ""}.json`;
    return line("score", group.map(({ video }) => video), group[0], url, [...sampling, "--json", target]);
  });
  const comparisons = verdicts.flatMap((verdict) => [
    line("compare", verdict.videos, verdict, url, []),
    line("compare", [...verdict.videos].reverse(), verdict, url, []),
  ]);
  return [...scores, ...comparisons].join("\n");
}

function asked({ task, model, rule, sampledFrames, fps, orient, resize }) {
  return JSON.stringify([task, model, rule, sampledFrames, fps, orient, resize]);
}

function line(command, videos, { task, model, fps, orient, resize }, url, options) {
  const files = videos.map(({ name }) => (name.startsWith("-") ? `./${name}` : name));
  const words = ["rfm-client", command, ...files, "--url", url, "--model", model, "--task", task, "--fps", fps];
  const turned = orient === "none" ? [] : ["--orient", orient];
  return [...words, ...turned, ...(resize ? ["--resize"] : []), ...options].map(quoted).join(" ");
}

/** A word as a shell reads it. */
function quoted(word) {
  const text = `${word}`;
  return /^[\w./:@%+=,-]+$/.test(text) ? text : `'${text.replaceAll("'", `'"'"'`)}'`;
}

/** Lets the browser save a file. */
export function save(name, content, kind) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(content instanceof Blob ? content : new Blob([content], { type: kind }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
