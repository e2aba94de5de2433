// SPDX-License-Identifier: MIT
// What the page says of each fault and of each thing that is missing, with the command that mends it.

import { GatewayAway, ServerError } from "./api.js";
import { quoted } from "./shell.js";
import { datasetWords, serverOption } from "./takeaway.js";

const BY_ITSELF = "Checking automatically.";
let remedies = {}; // command lines of this server, by what is missing
let tritonUrl = "";

/** From now on, states name the command lines of this server, and Triton's address. */
export function useRemedies(told, url) {
  [remedies, tritonUrl] = [told, url];
}

/** The server that brought the page is away. */
export function serverAway(error, retry) {
  return {
    title: "The server does not answer",
    text: "It has stopped, or the network is down. If it does not come back, restart it as before:",
    command: remedies.start,
    details: error.message,
    buttons: [["Check now", retry]],
    note: BY_ITSELF,
  };
}

/** Triton is away behind the server. */
export function tritonAway(error, retry) {
  const text = remedies.starts_triton
    ? "It restarts automatically. If this takes more than a minute, check it:"
    : "The server reaches no Triton. Start one where the server looks for it, for example:";
  return {
    title: "Triton is not ready",
    text,
    command: remedies.triton,
    details: error.message,
    buttons: [["Check now", retry]],
    note: BY_ITSELF,
  };
}

export function noModel(retry) {
  return {
    kind: "empty",
    title: "No model is served",
    text: "Triton runs, but has no model that scores videos. Export a checkpoint into its repository:",
    command: remedies.model,
    buttons: [["Check now", retry]],
    note: BY_ITSELF,
  };
}

export function noDataset(retry) {
  return {
    kind: "empty",
    title: "No dataset yet",
    text: "Restart the server with a dataset, and look through its episodes here:",
    command: remedies.dataset,
    buttons: [["Check now", retry]],
    note: BY_ITSELF,
  };
}

export function noEpisode(retry) {
  return {
    kind: "empty",
    title: "No episodes",
    text: "This dataset is empty. Record into it, or restart the server with another one:",
    command: remedies.dataset,
    buttons: [["Check now", retry]],
  };
}

/** dataset: name and kind; needsTask: an episode has none */
export function noLabels(dataset, needsTask) {
  const words = ["rfm-client", "label", ...datasetWords(dataset), ...serverOption(tritonUrl)].map(quoted);
  const isFolder = !dataset.name.includes("/") && !dataset.kind.startsWith("reader"); // not of the Hub; a reader has a path, too
  const where = isFolder ? " in the folder that holds it" : "";
  return {
    kind: "empty",
    title: "No labels",
    text: `Label this dataset${where}${needsTask ? ", with what the robot does as the SENTENCE" : ""}, then reload the page:`,
    command: [...words, ...(needsTask ? ['--task "SENTENCE"'] : [])].join(" "),
  };
}

export function noHit(numEpisodes, clear) {
  const text = numEpisodes === 1 ? "The filters hide the only episode." : `The filters hide all ${numEpisodes} episodes.`;
  return { kind: "empty", title: "No episode matches", text, buttons: [["Clear the filters", clear]] };
}

export function noVideo(retry) {
  return {
    kind: "empty",
    title: "No videos",
    text: "This dataset has no camera; the curves are below. To see episodes, restart the server with a dataset that has cameras:",
    command: remedies.dataset,
    buttons: [["Check now", retry]],
  };
}

/** An episode whose files are on the Hub. accept: begins the download, which is large; null: it has begun */
export function downloading(episode, size, accept = null) {
  const text = `Episode ${episode} needs ${size} from the Hub.`;
  if (accept) return { kind: "empty", title: "A large download", text, buttons: [["Download", accept]] };
  return { kind: "empty", title: "Downloading", text, note: "The episode opens when its files are here." };
}

/** A link names a model that is not served. */
export function otherModel(wanted, chosen) {
  return { title: `The model ${wanted} is not served here`, text: `The link names it. The model ${chosen} is chosen instead.` };
}

/** A link names what the server does not show. what: the dataset or episode, as the subject of a sentence */
export function deadLink(what) {
  return { title: `${what} is not shown here`, text: "The link leads to another server, or to a dataset that has changed." };
}

/** Something failed. title: what, as a sentence without a full stop */
export function failure(title, error, retry = null) {
  const buttons = retry ? [["Try again", retry]] : [];
  if (error instanceof ServerError || error instanceof GatewayAway) return { title, text: "The server could not answer.", details: error.message, buttons };
  return { title, text: error.message, buttons };
}
