// SPDX-License-Identifier: MIT
// Clips of the toy world that come with the gateway, for somebody without a video at hand.

import { exampleVideo } from "./api.js";

const TASK = "put the red block in the bowl";

/** The clips of these names as files, the address of each, and their task. */
export async function exampleFiles(names) {
  const paths = names.map((name) => `viewer/examples/${name}.mp4`);
  const blobs = await Promise.all(paths.map(exampleVideo));
  return {
    files: names.map((name, index) => new File([blobs[index]], `${name}.mp4`, { type: "video/mp4" })),
    origins: paths.map((path) => ({ url: new URL(path, location.href).href })),
    task: TASK,
  };
}
