// Another map beside this one: pairs of poses that are one place are clicked, and the other is merged into this.

import { Refusal, ask } from "./api.js";
import { NOTHING, app, button, element, field, of, positive } from "./app.js";
import { edit, notice } from "./editing.js";
import { hands } from "./hands.js";
import { LiveMap } from "./map.js";
import { View } from "./view.js";

const DEGREE = Math.PI / 180;
let beside = null; // { map, view, pairs, half: the pose clicked here that has no partner yet }

export async function openMerge() {
  if (beside) return closeMerge();
  let rows;
  try {
    rows = (await ask("/api/maps")).maps.filter((row) => !row.problem && row.name !== app.map.name);
  } catch (error) {
    return notice(error.message, error instanceof Refusal ? error.code : "unavailable");
  }
  if (!rows.length) return notice("There is no other map to merge.", "unknown_map");
  const select = element("select", null, ...rows.map(({ name, variables }) => Object.assign(element("option", `${name}, ${variables} variables`), { value: name })));
  select.id = "beside";
  of("panel").replaceChildren(
    element("h2", "Merge a map into this one"),
    element("p", "It is opened beside. Then click a pose here, and there the pose that is the same place; and so on."),
    element("p", null, select, " ", button("open beside", () => openBeside(select.value)), " ", button("cancel", closeMerge)),
  );
}

export function closeMerge() {
  if (beside) beside.map.close();
  beside = null;
  app.mode = null;
  of("other").hidden = true;
  of("map").classList.remove("aims");
  of("panel").replaceChildren();
  app.view.follow = true;
  app.redraw();
}

function openBeside(name) {
  const view = new View(of("other"));
  const redraw = () => beside && view.draw(beside.map, NOTHING, { marks: marks(1) });
  of("other").hidden = false;
  of("map").classList.add("aims");
  app.selection.clear();
  app.mode = { merge: name };
  app.view.follow = true;
  beside = { map: new LiveMap(name, () => requestAnimationFrame(redraw)), view, pairs: [], half: null, redraw };
  hands(of("other"), view, { redraw, clicked: (x, y) => beside && clickedThere(view.nearest(beside.map, x, y)[0]) });
  showPairs();
}

const marks = (side) => (beside ? [...beside.pairs.map((pair, n) => [pair[side], String(n + 1)]), ...(side === 0 && beside.half ? [[beside.half, "?"]] : [])] : []);

export const marksHere = () => marks(0);
export const besides = () => beside;

const isPose = (map, key) => ["se2", "se3"].includes(map.variables.get(key)?.kind);

export function clickedHere(key) {
  if (!key || !isPose(app.map, key)) return notice("Click a pose of this map.");
  beside.half = key;
  showPairs();
}

function clickedThere(key) {
  if (!beside.half) return notice("Click a pose of this map first, then the same place in the other.");
  if (!key || !isPose(beside.map, key)) return notice("Click a pose of the other map.");
  beside.pairs.push([beside.half, key]);
  beside.half = null;
  showPairs();
}

function showPairs() {
  const { pairs, half, map } = beside;
  const values = ["sigma", "turn"].map((id) => of(id)?.value), out = of("leave")?.checked ?? false;
  notice(half ? `${half} here; now its partner in ${map.name}` : `Click a pose here that ${map.name} has, too.`);
  const leave = Object.assign(document.createElement("input"), { type: "checkbox", id: "leave", checked: out });
  const merge = button(`merge ${map.name} by ${pairs.length} ${pairs.length === 1 ? "pair" : "pairs"}`, doMerge);
  merge.id = "do-merge";
  merge.disabled = !pairs.length;
  of("panel").replaceChildren(
    element("h2", `${map.name} into ${app.map.name}`),
    element("p", pairs.length > 1 ? "Each pair is one place; how the maps are turned follows from the places." : "One pair is one pose, heading included; of several each is one place."),
    element("ul", null, ...pairs.map((pair, n) => element("li", null, `${n + 1}. ${pair[0]} is ${pair[1]} of ${map.name} `, button("remove", () => { pairs.splice(n, 1); showPairs(); })))),
    Object.assign(element("div", null, field("σ place ", "sigma", values[0] ?? "0.1", " m"), field("σ heading ", "turn", values[1] ?? "3", "°"), merge, button("cancel", closeMerge)), { className: "acts" }),
    element("label", null, leave, " leave out what it knows of its own frame (more than one fixed pose or prior)"),
  );
  app.redraw();
  beside.redraw();
}

async function doMerge() {
  const { pairs, map } = beside;
  let sigmas;
  try {
    const [sigma, turn] = [positive("sigma"), positive("turn") * DEGREE];
    sigmas = app.map.variables.get(pairs[0][0]).kind === "se2" ? [sigma, sigma, turn] : [sigma, sigma, sigma, turn, turn, turn];
  } catch (error) {
    return notice(error.message, "bad_option");
  }
  const absolute = of("leave").checked ? "leave_out" : "refuse";
  const made = await edit({ edit: "merge", other: map.name, pairs, sigmas, absolute });
  if (!made) return showPairsAgain();
  const { merge } = made, letters = Object.entries(merge.letters);
  closeMerge();
  const left = Object.entries(merge.left_out).map(([kind, count]) => `${count} ${kind}`).join(", ");
  of("panel").replaceChildren(
    element("h2", made.what),
    element("p", `${merge.variables} variables and ${merge.factors} factors came in, by ${made.who}, at revision ${made.at_revision}; χ² was ${made.chi2_before.toPrecision(5)}, and is ${made.chi2.toPrecision(5)}.`),
    element("p", letters.length ? `Its keys have other letters here: ${letters.map(([old, now]) => `${old || "those without one"} is ${now}`).join(", ")}.` : ""),
    element("p", left ? `Left out: ${left}.` : ""),
    element("p", `Its origin is at (${merge.frame.map((each) => each.toFixed(3)).join(", ")}).`),
    element("ul", null, ...merge.pairs.map(({ keys, misfit }) => element("li", `${keys.join(" and ")}: misfit ${misfit.toFixed(2)}${misfit > 2 ? ", which contradicts the rest: is it the same place?" : ""}`))),
  );
}

// The refusal stays to be read.
function showPairsAgain() {
  const said = of("notice").textContent;
  showPairs();
  of("notice").textContent = said;
  of("notice").classList.add("refused");
}
