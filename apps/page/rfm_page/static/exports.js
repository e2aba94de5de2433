// SPDX-License-Identifier: MIT
// Episodes of a dataset as other programs take them.

import { commented, quoted } from "./shell.js";
import { csvText } from "./takeaway.js";

/** One number a line. */
export function episodesText(numbers) {
  return numbers.map((number) => `${number}\n`).join("");
}

/** What is known of the episodes, as JSON. about: dataset, labels and threshold */
export function episodesJson(about, episodes) {
  return JSON.stringify({ ...about, episodes }, null, 2) + "\n";
}

/** Outcomes as `rfm-client evaluate` reads them. marked: [name or number, outcome] of each episode */
export function outcomesCsv(marked) {
  return csvText([["episode", "success"], ...marked]);
}

/** By name: what LeRobot is to do with the episodes. */
const USES = {
  train: (_, numbers) => `--dataset.episodes="${list(numbers)}"`,
  delete: (dataset, numbers, all) => edited(dataset, numbers, all, "cleaned"),
  keep: (dataset, numbers, all) => {
    const left = new Set(numbers);
    return edited(dataset, all.filter((number) => !left.has(number)), all, "kept");
  },
};

/** The words for LeRobot's command line. all: the numbers of all episodes of the dataset */
export function lerobotWords(use, dataset, numbers, all) {
  if (!numbers.length) return "# no episode is chosen";
  return USES[use](dataset, numbers, all);
}

function edited({ name, kind }, away, all, ending) {
  if (!away.length) return "# these are all episodes: nothing is to be deleted";
  if (away.length === all.length) return "# no episode would be left";
  const early = kind.includes("v3") ? [] : [`# lerobot-edit-dataset reads v3.0, and this is ${kind}: convert it before`];
  const [source, target] = [quoted(name), quoted(`${name}_${ending}`)];
  const operation = `--operation.type delete_episodes --operation.episode_indices "${list(away)}"`;
  const renumbered = commented(`LeRobot renumbers the episodes and leaves the labels behind: label ${target} again`);
  if (name.includes("/")) { // on the Hub
    return [...early, `lerobot-edit-dataset --repo_id ${source} --new_repo_id ${target} ${operation}`, renumbered].join("\n");
  }
  return [
    ...early,
    "# LeRobot 0.5 or newer, in the folder that holds the dataset:",
    `lerobot-edit-dataset --repo_id ${source} --root ${source} --new_repo_id ${target} --new_root ${target} ${operation}`,
    "# LeRobot 0.4, which has no --new_root:",
    commented(`HF_LEROBOT_HOME=. lerobot-edit-dataset --repo_id ${source} --new_repo_id ${target} ${operation}`),
    renumbered,
  ].join("\n");
}

function list(numbers) {
  return `[${numbers.join(", ")}]`;
}
