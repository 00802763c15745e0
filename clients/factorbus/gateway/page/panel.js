// What is said about what is selected: a variable, a factor, several of them; and how the map compares with its optimum.

import { ask, mapPath } from "./api.js";
import { app, element, of } from "./app.js";
import { factorActs, severalActs, suspectActs, variableActs } from "./acts.js";

const STARTS = { values: "the map's own values", odometry: "composed odometry", rotations: "averaged rotations" };
let newest = 0; // answers that come after a later click are dropped

export function showSelection() {
  const { keys, factors, size } = app.selection;
  app.redraw();
  if (size > 1) showSeveral();
  else if (keys.size) explain([...keys][0]);
  else if (factors.size) explainFactor([...factors.values()][0]);
  else of("panel").replaceChildren(element("p", "Nothing is selected."));
}

async function showing(title, path, content) {
  const mine = ++newest;
  try {
    const found = await ask(`${mapPath(app.map.name)}/${path}`);
    if (mine === newest) of("panel").replaceChildren(...content(found));
  } catch (error) {
    if (mine === newest) of("panel").replaceChildren(element("h2", title), element("p", error.message));
  }
}

// A number as one reads it: seven digits at most.
const short = (number, digits = 3) => (number === null ? "not known" : Number(number.toPrecision(digits)).toString());
const row = (numbers, digits = 3) => (numbers ? numbers.map((each) => short(each, digits)).join(", ") : "not known");

function link(text, act) {
  const made = element("button", text);
  Object.assign(made, { type: "button", className: "link", onclick: act });
  return made;
}

function explain(key) {
  return showing(key, `variables/${encodeURIComponent(key)}`, (found) => {
    const head = element("tr", null, ...["factor", "of", "χ²", "misfit", "leverage"].map((name) => element("th", name)));
    const rows = found.factors.map((f) => element("tr", null,
      element("td", null, link(f.kind, () => chooseFactor(f))), element("td", f.keys.join(" ")),
      element("td", f.loss ? `${f.rho.toPrecision(3)} of ${f.chi2.toPrecision(3)}, ${f.loss}` : f.chi2.toPrecision(3)),
      element("td", f.misfit.toFixed(2)),
      element("td", f.without === null ? "all" : `${Math.round(100 * f.known)} %`)));
    return [
      element("h2", found.key),
      element("p", found.text),
      element("p", `${found.kind} (${found.value.map((v) => v.toFixed(3)).join(", ")}) at revision ${found.revision}`),
      element("p", found.fixed ? "" : `σ ${found.sigmas.map((v) => v.toPrecision(2)).join(", ")} (in its own frame; metres, radians)`),
      variableActs([found.key], found.fixed, found),
      element("table", null, head, ...rows),
      element("p", `last step of the map: ${found.step}`),
    ];
  });
}

export function chooseFactor(factor) {
  app.selection.factor(factor, false);
  showSelection();
}

// What the map thinks of a closure that it does not believe is known already.
function explainSuspect({ id, kind, keys, state, reason, distance, chance, weight, since }) {
  newest += 1;
  const said = {
    "poses": keys.join(", "), state, reason,
    "d²": distance === null ? "not looked at yet" : short(distance, 4),
    ...(weight === undefined
      ? { "chance": chance === null ? "not looked at yet" : `odds of ${short(chance, 2)} that it is false` }
      : { "weight": weight === null ? "not looked at yet" : short(weight, 2) }),
    "since": `revision ${since}`,
  };
  of("panel").replaceChildren(
    element("h2", `closure ${id}, ${kind.split("(")[0]}`),
    element("dl", null, ...Object.entries(said).flatMap(([name, text]) => [element("dt", name), element("dd", text)])),
    suspectActs({ id, state }),
    element("p", null, "of ", ...keys.flatMap((key) => [link(key, () => choose(key)), " "])),
  );
}

function explainFactor(factor) {
  const { id, kind } = factor;
  if (factor.state) return explainSuspect(factor);
  return showing(`factor ${id}, ${kind}`, `factors/${id}`, (found) => [
    element("h2", `factor ${found.id}, ${found.kind.split("(")[0]}`),
    element("dl", null, ...Object.entries(factorWords(found)).flatMap(([name, said]) => [element("dt", name), element("dd", said)])),
    factorActs([found]),
    element("p", null, "of ", ...found.keys.flatMap((key) => [link(key, () => choose(key)), " "])),
    element("p", found.inactive),
  ]);
}

function factorWords(found) {
  const { inserted } = found;
  return {
    "variables": found.keys.join(", "),
    "measured": row(found.measured, 5),
    "σ of it": row(found.sigmas),
    "residual": row(found.residual),
    "in σ": row(found.weighted),
    "χ²": short(found.chi2, 4),
    "misfit": `${found.misfit.toFixed(2)} (about 1 where its σ is right)`,
    "loss": found.loss ? `${found.loss}: counts ${short(found.rho)}` : "none",
    "weight": short(found.weight),
    "leverage": found.without === null ? "nothing else measures what it does" : `${Math.round(100 * found.known)} % of what it measures is known from it; without it χ² falls by about ${short(found.without)}`,
    "inserted": inserted ? `by ${inserted.who}, edit ${inserted.number} at revision ${inserted.revision}` : "not by an edit here: the journal knows by whom",
  };
}

export function choose(key) {
  app.selection.variable(key, false);
  showSelection();
}

function showSeveral() {
  newest += 1;
  const keys = [...app.selection.keys], factors = [...app.selection.factors.values()];
  of("panel").replaceChildren(
    element("h2", `${keys.length + factors.length} selected`),
    severalActs(keys, factors),
    element("ul", null,
      ...keys.map((key) => element("li", null, link(key, () => choose(key)), ` ${app.map.variables.get(key)?.kind ?? "gone"}`)),
      ...factors.map((f) => element("li", null, link(`factor ${f.id}`, () => chooseFactor(f)), ` ${f.kind} (${f.keys.join(", ")})`))),
  );
}

export async function compare() {
  of("panel").replaceChildren(element("h2", "The optimum"), element("p", "is being found from scratch"));
  const { name } = app.map;
  await showing("The optimum", "optimum", (found) => {
    const ratio = found.batch > 0 ? `, ${(found.chi2 / found.batch).toFixed(6)} of it` : "";
    const converged = found.batch_converged;
    const there = converged ? "The map is where the optimum is." : "The map is not more than 1 % above that.";
    return [
      element("h2", found.notice ? found.notice.code : "The optimum"),
      element("p", `χ² ${found.chi2.toPrecision(7)} at revision ${found.revision}; optimum from ${STARTS[found.start] ?? "a start"}: ${found.batch.toPrecision(7)}${ratio}`),
      element("p", found.notice ? found.notice.message.replace("adopt MAP", `adopt ${name}`) : there),
      element("p", converged ? "" : "The search for the optimum ended before it had converged: the true optimum may be lower."),
    ];
  });
}
