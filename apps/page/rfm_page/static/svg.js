// SPDX-License-Identifier: MIT
// Elements of SVG.

const { namespaceURI } = document.querySelector("svg"); // the page holds one

/** A new element of SVG. */
export function svgElement(name, attributes) {
  const element = document.createElementNS(namespaceURI, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}
