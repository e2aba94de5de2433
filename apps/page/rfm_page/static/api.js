// SPDX-License-Identifier: MIT
// Asks the gateway. Every error that it answers is an Error whose message reads `where: expected X, got Y`.

import { send } from "./upload.js";

/** An answer that wants the gateway's key. */
export class KeyWanted extends Error {}

/** No answer: the gateway is away. */
export class GatewayAway extends Error {}

/** The gateway answers, but cannot do it now: Triton is not ready, too slow, or refuses the gateway. */
export class ServerError extends Error {}

const OF_SERVER = [502, 503, 504];

let key = "";

/** From now on, requests show this key. */
export function useKey(text) {
  key = text;
}

/** Whether requests show a key. */
export function hasKey() {
  return key !== "";
}

/** What the gateway tells without Triton: the names of scores, and the command lines that mend faults. */
export async function aboutServer() {
  return (await answer("viewer/server")).json();
}

/** Which models are served, and what may be asked of them. */
export async function served() {
  return (await answer("viewer/served")).json();
}

/** How the model ranks videos, each pair asked in both orders. */
export async function compare(form, signal) {
  return (await answer("viewer/compare", { method: "POST", body: form, signal })).json();
}

/** Scores a video, and calls `onEvent(name, document)` with each event as it comes, and before `onSent(share)` while the video leaves. */
export async function score(form, signal, onEvent, onSent) {
  const response = await answer("viewer/score", { body: form, signal }, (path, options) => send(path, options, onSent));
  let isOver = false;
  for await (const [name, document] of events(response.body)) {
    if (name === "failed") throw new (document.is_servers ? ServerError : Error)(document.detail);
    isOver ||= name === "done";
    onEvent(name, document);
  }
  if (!isOver) throw new Error("gateway: expected all points, got an answer that breaks off");
}

/** The datasets that the gateway shows. */
export async function datasets() {
  return (await (await answer("viewer/datasets")).json()).datasets;
}

/** Every episode of a dataset, with what these labels say of it; `labels` null: the first that are there. */
export async function episodesOf(number, labels, signal) {
  return (await answer(`viewer/datasets/${number}${chosen(labels)}`, { signal })).json();
}

/** The fault of each episode that cannot be labelled now, by its number. */
export async function faultsOf(number, signal) {
  return (await answer(`viewer/datasets/${number}/faults`, { signal })).json();
}

/** The labelled curves of an episode. */
export async function curvesOf(number, episode, labels, signal) {
  return (await answer(`viewer/datasets/${number}/episodes/${episode}${chosen(labels)}`, { signal })).json();
}

/** What an episode needs from the Hub: its `size`, null if all is here, and whether it `asks` before; begins: downloads it first */
export async function missingOf(number, episode, signal, begins = false) {
  return (await answer(`viewer/datasets/${number}/episodes/${episode}/missing`, { signal, ...(begins && { method: "POST" }) })).json();
}

/** A few points of an episode's curve, and a small picture. */
export async function previewOf(number, episode, labels, signal) {
  return (await answer(`viewer/datasets/${number}/episodes/${episode}/preview${chosen(labels)}`, { signal })).json();
}

/** The video of an episode by one camera, as a Blob, since an address of its own could not show the key, and whether every pixel is as stored. */
export async function videoOf(number, episode, camera, signal) {
  const response = await answer(`viewer/datasets/${number}/episodes/${episode}/videos/${camera}`, { signal });
  return { blob: await response.blob(), isStored: response.headers.get("X-Frames") === "stored" };
}

/** A clip that comes with the gateway, as a Blob. */
export async function exampleVideo(path) {
  return (await answer(path)).blob();
}

function chosen(labels) {
  return labels === null ? "" : `?labels=${encodeURIComponent(labels)}`;
}

async function answer(path, options = {}, ask = fetch) {
  const headers = key ? { "X-API-Key": key } : {};
  let response;
  try {
    response = await ask(path, { ...options, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new GatewayAway(`the server does not answer: try again when it is back (${error.message})`);
  }
  if (response.ok) return response;
  const reason = await reasonOf(response);
  if (response.status === 401) throw new KeyWanted(reason);
  throw new (OF_SERVER.includes(response.status) ? ServerError : Error)(reason);
}

async function reasonOf(response) {
  try {
    const { detail } = await response.json();
    if (typeof detail === "string") return detail;
    return detail.map(({ loc, msg }) => `${loc.slice(1).join(".")}: ${msg}`).join("; ");
  } catch {
    return `gateway: expected an answer, got the status ${response.status}`;
  }
}

/** The server-sent events of a body, as [name, document]. */
async function* events(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    const whole = text.split("\n\n");
    text = whole.pop();
    for (const each of whole) {
      const fields = Object.fromEntries(each.split("\n").map((line) => line.split(/: (.*)/s, 2)));
      yield [fields.event, JSON.parse(fields.data)];
    }
  }
}
