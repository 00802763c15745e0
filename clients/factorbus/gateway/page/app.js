// What the parts of the page share: which map is shown, what is selected, who looks, and what the next click means.

import { Selection } from "./selection.js";

export const NOTHING = {
  closures: { revision: 0, keys: [], misfit: [] },
  ellipses: { revision: 0, keys: [], covariances: [] },
  suspects: { revision: 0, closures: [] },
};

export const app = {
  map: null,
  view: null,
  asked: NOTHING, // what is asked for now and then, and drawn with the estimate
  selection: new Selection(),
  session: { may_edit: false, why: "asking whether you may edit", people: false },
  edges: { revision: -1, list: [], fixed: new Set() },
  mode: null, // { drag: key }, { anchor: key } or { merge: ... }: what the hands do instead of moving the view
  ghost: null, // where something is being dragged to, or was clicked
  redraw() {},
};

export const of = (id) => document.getElementById(id);

// Text goes in as text: nothing that a map, a person or a problem says is ever read as HTML.
export function element(tag, text, ...children) {
  const made = document.createElement(tag);
  if (text !== null) made.textContent = text;
  made.append(...children);
  return made;
}

export function button(text, act, title = "") {
  const made = element("button", text);
  made.type = "button";
  made.title = title;
  made.onclick = act;
  return made;
}

export function field(label, id, value, unit = "") {
  const input = document.createElement("input");
  Object.assign(input, { id, value, size: 6, inputMode: "decimal" });
  return element("label", label, input, unit);
}

// The number in a field above zero; says which one is none.
export function positive(id) {
  const number = Number(of(id).value.replace(",", "."));
  if (!(number > 0 && Number.isFinite(number))) throw new Error(`${of(id).parentNode.firstChild.textContent.trim()}: "${of(id).value}"; wanted a number above 0`);
  return number;
}
