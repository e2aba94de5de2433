// SPDX-License-Identifier: MIT
// Elements of SVG.

const { namespaceURI } = document.querySelector("svg"); // the page holds one
const SAMPLE_PX = 32; // length of the line in a legend

/** A new element of SVG. */
export function svgElement(name, attributes) {
  const element = document.createElementNS(namespaceURI, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

/** A piece of a line as a picture, in the colour of the text around it. */
export function sampleOf(dash, width = SAMPLE_PX) {
  const svg = svgElement("svg", { class: "sample", width, height: 4, "aria-hidden": "true" });
  const look = { stroke: "currentColor", "stroke-width": 2, "stroke-dasharray": (dash ?? []).join(" ") };
  svg.append(svgElement("line", { x2: width, y1: 2, y2: 2, ...look }));
  return svg;
}
