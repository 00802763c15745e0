// The buttons of what is selected.  There are none for who may not edit.

import { app, button, element, field, of, positive } from "./app.js";
import { edit, notice } from "./editing.js";

const PLACED = ["se2", "se3", "point2", "point3"];
const DEGREE = Math.PI / 180;

const bar = (...children) => {
  const made = element("div", null, ...children);
  made.className = "acts";
  return app.session.may_edit ? made : element("p", "");
};

export function factorActs(factors) {
  const ids = factors.map((each) => each.id);
  const many = ids.length > 1 ? ` ${ids.length} factors` : "";
  return bar(
    button(`reject${many}`, () => edit({ edit: "reject", factors: ids }), "they go, and can be restored"),
    field("× ", "weight", "0.1"),
    button(`weigh${many}`, () => trying(() => edit({ edit: "weigh", factors: ids, weight: positive("weight") })), "their information is multiplied by it"),
  );
}

// Of a closure that the map tests, and that the estimate does not have.
export function suspectActs({ id, state }) {
  const acts = [button("accept", () => edit({ edit: "accept_closures", factors: [id] }), "in the estimate, for good")];
  if (state !== "rejected") acts.push(button("reject", () => edit({ edit: "reject_closures", factors: [id] }), "out of the estimate, for good"));
  return bar(...acts);
}

export function variableActs(keys, fixed, found = null) {
  const many = keys.length > 1 ? ` ${keys.length} variables` : "";
  const acts = [];
  if (fixed !== true) acts.push(button(`hold${many}`, () => edit({ edit: "fix", keys }), "held where it is"));
  if (fixed !== false) acts.push(button(`let go${many}`, () => edit({ edit: "free", keys }), "estimated again"));
  if (found && PLACED.includes(found.kind)) {
    acts.push(button("drag", () => aim({ drag: found.key }, `Drag ${found.key} to where it is, and drop it.`)));
    acts.push(button("anchor", () => aim({ anchor: found.key }, `Click the point where ${found.key} is.`)));
  }
  return bar(...acts);
}

export function severalActs(keys, factors) {
  const known = factors.filter((each) => !each.state); // suspects are no factors of the estimate
  return element("div", null, ...(known.length ? [factorActs(known)] : []), ...(keys.length ? [variableActs(keys, null)] : []));
}

function trying(act) {
  try {
    return act();
  } catch (error) {
    return notice(error.message, "bad_option");
  }
}

// What the hands do next: another click on the button, or Escape, and they move the view again.
export function aim(mode, said) {
  app.mode = app.mode && mode && JSON.stringify(app.mode) === JSON.stringify(mode) ? null : mode;
  app.ghost = null;
  of("map").classList.toggle("aims", app.mode !== null);
  notice(app.mode ? said : "");
  app.redraw();
}

// The variable that is being dragged goes along with the pointer, in the plane that one looks at.
export function grabbed(x, y) {
  const key = app.mode?.drag, place = key && app.map.placeOf(key);
  if (!place) return null;
  const [px, py] = app.view.pixelOf(place);
  if (Math.hypot(px - x, py - y) > 16) return null;
  return {
    to: (px, py) => { app.ghost = { from: place, to: app.view.seen.placeAt(px, py, place) }; },
    dropped: () => confirmPlace(key, "prior"),
  };
}

// A point was clicked; false: nothing was to be placed.
export function placed(x, y) {
  const key = app.mode?.anchor, place = key && app.map.placeOf(key);
  if (!place) return false;
  app.ghost = { from: place, to: app.view.seen.placeAt(x, y, place) };
  confirmPlace(key, "anchor");
  return true;
}

function confirmPlace(key, what) {
  const { kind, value } = app.map.variables.get(key), size = kind.endsWith("2") ? 2 : 3;
  const to = app.ghost.to.slice(0, size), turns = what === "prior" && kind.startsWith("se");
  aim(null, "");
  app.ghost = { from: app.map.placeOf(key), to: [...to, 0].slice(0, 3) };
  const give = () => trying(() => {
    const sigma = positive("sigma");
    if (what === "anchor") return edit({ edit: "anchor", key, place: to, sigma });
    const turn = turns ? positive("turn") * DEGREE : 0;
    const sigmas = [...to.map(() => sigma), ...(turns ? Array(size === 2 ? 1 : 3).fill(turn) : [])];
    return edit({ edit: "prior", key, value: [...to, ...value.slice(size)], sigmas });
  });
  const where = to.map((each) => each.toFixed(3)).join(", ");
  of("panel").replaceChildren(
    element("h2", `${key} to (${where})?`),
    element("p", what === "anchor" ? "A factor says that it is there, its place alone." : `A prior says that it is there${turns ? ", turned as it is now" : ""}.`),
    bar(
      field("σ place ", "sigma", "0.1", " m"),
      ...(turns ? [field("σ heading ", "turn", "3", "°")] : []),
      button(what === "anchor" ? "place the anchor" : "put it there", () => { app.ghost = null; return give(); }),
      button("cancel", () => { app.ghost = null; app.redraw(); of("panel").replaceChildren(); }),
    ),
  );
  app.redraw();
}
