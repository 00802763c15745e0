// Who may edit, an edit and what came of it, and the list of edits with the way back.

import { Refusal, ask, mapPath, send, sign, signedIn } from "./api.js";
import { app, button, element, of } from "./app.js";

const SHOWN = 12; // edits of the list
const SILENT = ["unavailable", "internal"]; // nobody has said that it was refused
const GONE = ["unknown_factor", "unknown_variable"]; // somebody else was faster
let underWay = false;
let asks = 0; // of the list of edits: an answer that is overtaken by a later one is not shown

export function notice(text, code = "") {
  of("notice").textContent = code ? `${text} [${code}]` : text;
  of("notice").classList.toggle("refused", Boolean(code));
}

export async function loadSession() {
  const { name } = app.map;
  let found;
  try {
    found = await ask(`${mapPath(name)}/session`);
  } catch (error) {
    found = { may_edit: false, why: error.message, people: signedIn() };
  }
  if (app.map.name !== name) return;
  app.session = found;
  const { may_edit: may, why, people } = found;
  for (const id of ["undo", "merge"]) of(id).hidden = !may;
  of("role").textContent = may ? (people ? `editing as ${found.name}` : "") : `looking only: ${why}`;
  of("sign").hidden = !people;
  of("token").hidden = signedIn();
  of("sign").querySelector("button").textContent = signedIn() ? "sign out" : "sign in";
  await loadEdits();
}

export function signInOrOut() {
  sign(signedIn() ? "" : of("token").value.trim());
  of("token").value = "";
  notice("");
  return loadSession().then(() => app.select?.());
}

// Sends it; the answer, or null after saying why not.  Nothing is changed then.  One at a time: a second click on a button
// is no second edit.
export async function edit(content) {
  if (underWay) {
    notice("the edit before is under way; press again when it is done");
    return null;
  }
  underWay = true;
  notice("sent");
  try {
    const made = await send(app.map.name, content, app.session.token);
    notice(`${made.undone ? "undone: " : ""}${made.what}; χ² ${short(made.chi2_before)} → ${short(made.chi2)}`);
    app.selection.clear();
    of("panel").replaceChildren(element("h2", made.undone ? "Undone" : "Done"), element("p", `${made.what}, by ${made.who}, at revision ${made.at_revision}.`), element("p", `χ² was ${short(made.chi2_before)}, and is ${short(made.chi2)}.`));
    return made;
  } catch (error) {
    const known = error instanceof Refusal && !SILENT.includes(error.code);
    notice(`${known ? "Nothing was changed" : "It is not known whether it was done, look at the map"}: ${error.message}`, error.code ?? "unavailable");
    if (error.code === "not_allowed") loadSession();
    if (GONE.includes(error.code)) {
      app.selection.clear();
      of("panel").replaceChildren();
    }
    return null;
  } finally {
    underWay = false;
    app.redraw();
    loadEdits();
  }
}

const short = (number) => (typeof number === "number" ? Number(number.toPrecision(5)).toString() : "not known");

export async function loadEdits() {
  const { name } = app.map;
  const number = ++asks;
  let found;
  try {
    found = await ask(`${mapPath(name)}/edits`);
  } catch (error) {
    if (number === asks) of("edits").replaceChildren(element("p", error.message));
    return;
  }
  if (app.map.name !== name || number !== asks) return;
  const { edits, undo, rejected } = found;
  of("undo").disabled = !undo;
  of("undo").textContent = undo ? `undo ${undo.number}: ${undo.what}, by ${undo.who}` : "nothing to undo";
  of("undo").title = undo ? `at revision ${undo.revision}, ${undo.at}` : "";
  of("undo").onclick = () => undo && edit({ edit: "undo", number: undo.number });
  of("edits").replaceChildren(
    ...(rejected.length ? [element("h3", "Rejected"), element("ul", null, ...rejected.map(rejectedRow))] : []),
    ...(edits.length ? [element("h3", "Edits"), element("ul", null, ...edits.slice(0, SHOWN).map(editRow))] : []),
  );
}

function rejectedRow({ id, kind, keys }) {
  const act = app.session.may_edit ? [button("restore", () => edit({ edit: "restore", factors: [id] }))] : [];
  return element("li", null, `${kind.split("(")[0]} (${keys.join(", ")}) `, ...act);
}

function editRow({ number, what, who, at, revision, undone }) {
  const made = element("li", `${number}. ${what}, by ${who}${undone ? `; undone by ${undone}` : ""}`);
  made.title = `at revision ${revision}, ${at}`;
  if (undone) made.className = "undone";
  return made;
}
