// SPDX-License-Identifier: MIT
// Sends a large form: unlike fetch, this tells how much of it has left.

/** Posts a body as fetch does, and calls `onSent(share)` while it leaves. The answer's body grows as it comes. */
export function send(path, { body, headers, signal }, onSent) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    const encoder = new TextEncoder();
    let stream;
    let numRead = 0;
    const answer = new ReadableStream({ start: (controller) => { stream = controller; } });
    const read = () => {
      const text = request.responseText.slice(numRead);
      numRead += text.length;
      if (text) stream.enqueue(encoder.encode(text));
    };
    const fail = (error) => {
      reject(error);
      stream.error(error);
    };
    request.open("POST", path);
    for (const [name, value] of Object.entries(headers)) request.setRequestHeader(name, value);
    request.upload.addEventListener("progress", ({ loaded, total }) => onSent(total ? loaded / total : 1));
    request.addEventListener("readystatechange", () => {
      if (request.readyState === XMLHttpRequest.HEADERS_RECEIVED && request.status) resolve(new Response(answer, { status: request.status }));
    });
    request.addEventListener("progress", read);
    request.addEventListener("load", () => {
      read();
      stream.close();
    });
    request.addEventListener("error", () => fail(new TypeError("the connection broke")));
    request.addEventListener("abort", () => fail(new DOMException("stopped", "AbortError")));
    signal.addEventListener("abort", () => request.abort());
    request.send(body);
  });
}
