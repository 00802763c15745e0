// The page: which map, what is drawn of it, and what a click means.

import { grabbed, aim, placed } from "./acts.js";
import { ask, mapPath } from "./api.js";
import { NOTHING, app, element, of } from "./app.js";
import { loadEdits, loadSession, notice, signInOrOut } from "./editing.js";
import { hands } from "./hands.js";
import { LiveMap } from "./map.js";
import { besides, clickedHere, closeMerge, marksHere, openMerge } from "./merging.js";
import { choose, compare, showSelection } from "./panel.js";
import { View } from "./view.js";

const FADES_MS = 4000, FADING_MS = 100; // between two pictures while the last step fades
const view = app.view = new View(of("map"));
let drawing = false, fetching = false, fading = 0;
app.select = () => app.selection.size && showSelection();

// For the console, and for tests that drive the page.
window.factorbus = {
  get revision() { return app.map ? app.map.revision : 0; },
  placeOf: (key) => app.map && app.map.placeOf(key),
  pixelOf: (key) => pixelIn(app.map, view, key),
  pixelThere: (key) => besides() && pixelIn(besides().map, besides().view, key),
  get closures() { return app.asked.closures; },
  get ellipses() { return app.asked.ellipses; },
  get suspects() { return app.asked.suspects; },
  get session() { return app.session; },
};

function pixelIn(map, seen, key) {
  const place = map && map.placeOf(key);
  if (place) seen.fit(map); // as it will be drawn next
  return place && seen.pixelOf(place);
}

app.redraw = () => {
  if (drawing || !app.map) return;
  drawing = true;
  requestAnimationFrame(() => {
    drawing = false;
    view.draw(app.map, app.asked, { selection: app.selection, ghost: app.ghost, marks: marksHere() });
    clearTimeout(fading);
    if (app.map.fresh(FADES_MS) > 0) fading = setTimeout(app.redraw, FADING_MS);
  });
};

function changed() {
  const { map } = app;
  const { chi2, step_ms: ms, strategy, converging, budget_ms: budget, complete, deferred_relinearizations: deferred } = map.report;
  const { removed_variables: removed } = map.report; // by a change, or by the map's own policy
  const words = [`revision ${map.revision}`, `${map.variables.size} variables`];
  if (chi2 !== undefined) words.push(`χ² ${chi2.toPrecision(6)}`);
  const ofBudget = budget === undefined ? "" : `of ${budget} `;
  if (ms !== undefined) words.push(`step ${ms.toFixed(2)} ${ofBudget}ms ${strategy ?? ""}`);
  if (complete === false) words.push(`${deferred} relinearizations and more are left for later steps`);
  if (removed) words.push(`${removed} taken out`);
  if (converging) words.push("converging");
  of("state").textContent = map.state === "live" ? words.join(" · ") : map.state;
  refresh();
  app.redraw();
}

// All factors have to be asked for, and covariances computed: not more often than every two seconds.
async function refresh() {
  const old = () => Object.values(app.asked).some((each) => each.revision !== app.map.revision);
  if (fetching || !old()) return;
  fetching = true;
  const { name } = app.map;
  for (const what of Object.keys(app.asked)) {
    try {
      const found = await ask(`${mapPath(name)}/${what}`);
      if (app.map.name === name) app.asked = { ...app.asked, [what]: found };
    } catch (error) {
      of("state").title = `${what}: ${error.message}`; // the map itself is shown all the same
    }
  }
  setTimeout(() => { fetching = false; if (old()) refresh(); }, 2000);
  app.redraw();
  loadEdits(); // somebody else may have made the step
}

// What can be selected beside variables; asked for when one clicks, and again when the map is another.
async function edges() {
  const { map } = app;
  const suspects = app.asked.suspects.closures;
  if (app.edges.name === map.name && app.edges.revision === map.revision) return [...app.edges.list, ...suspects];
  const found = await ask(`${mapPath(map.name)}/edges`);
  const list = found.factors.flatMap(({ kind, ids, keys }) => ids.map((id, i) => ({ id, kind, keys: keys[i] })));
  app.edges = { name: map.name, revision: found.revision, list };
  return [...list, ...suspects];
}

async function clicked(x, y, event) {
  if (!app.map) return;
  if (app.map.state !== "live") notice(app.map.state, "unavailable");
  if (app.mode?.merge) { clickedHere(view.nearest(app.map, x, y)[0]); return; }
  if (placed(x, y)) return;
  const more = event.shiftKey;
  try {
    const found = view.at(app.map, await edges(), x, y);
    if (found?.key) app.selection.variable(found.key, more);
    else if (found) app.selection.factor(found.factor, more);
    else if (!more) app.selection.clear();
    showSelection();
  } catch (error) {
    notice(error.message, error.code ?? "unavailable");
  }
}

function show(name) {
  if (app.map) app.map.close();
  if (besides()) closeMerge();
  app.asked = NOTHING;
  app.mode = app.ghost = null;
  app.selection.clear();
  of("panel").replaceChildren(...(app.map ? [] : of("panel").childNodes)); // the hint at first, nothing of another map
  view.follow = true;
  location.hash = name;
  app.map = new LiveMap(name, changed);
  notice("");
  loadSession();
}

function option(row) {
  const made = element("option", row.problem ? `${row.name} (${row.state})` : row.name);
  [made.value, made.disabled] = [row.name, Boolean(row.problem)];
  return made;
}

// The names again, when one is about to choose: maps come and go.
async function listAgain() {
  try {
    const rows = (await ask("/api/maps")).maps, name = app.map?.name;
    if (!rows.some((row) => row.name === name)) return;
    of("maps").replaceChildren(...rows.map(option));
    of("maps").value = name;
  } catch (error) {
    of("maps").title = error.message; // those that are listed can be chosen all the same
  }
}

async function list() {
  const wanted = decodeURIComponent(location.hash.slice(1));
  try {
    const rows = (await ask("/api/maps")).maps;
    of("maps").replaceChildren(...rows.map(option));
    const maps = rows.filter((row) => !row.problem); // the others do not open
    if (!maps.length) { of("state").textContent = rows.length ? "no map opens" : "there is no map yet"; setTimeout(list, 1000); return; }
    const name = maps.some((row) => row.name === wanted) ? wanted : maps[0].name;
    of("maps").value = name;
    show(name);
  } catch (error) {
    if (wanted) { // who may only look at one map may not list them
      of("maps").replaceChildren(option({ name: wanted }));
      show(wanted);
      return;
    }
    of("state").textContent = error.message;
    setTimeout(list, 1000);
  }
}

function search(event) {
  event.preventDefault();
  const key = of("key").value.trim();
  const place = app.map && app.map.placeOf(key);
  if (!place) { notice(`There is no ${key || "variable without a name"} with a place in this map.`, "unknown_variable"); return; }
  view.follow = false;
  view.seen.centre = place;
  notice("");
  choose(key);
}

of("maps").onpointerenter = of("maps").onfocus = listAgain;
of("maps").onchange = (e) => show(e.target.value);
of("plane").onchange = (e) => { view.seen.look(e.target.value); view.follow = true; app.redraw(); };
of("fit").onclick = () => { view.follow = true; app.redraw(); };
of("labels").onchange = (e) => { view.labels = e.target.checked; app.redraw(); };
of("search").onsubmit = search;
of("compare").onclick = () => app.map && compare();
of("merge").onclick = openMerge;
of("sign").onsubmit = (e) => { e.preventDefault(); signInOrOut(); };
window.onkeydown = (e) => { if (e.key === "Escape" && app.mode && !app.mode.merge) aim(null, ""); };
window.onresize = () => { app.redraw(); besides()?.redraw(); };
for (const id of ["undo", "merge", "sign"]) of(id).hidden = true;
hands(of("map"), view, { redraw: app.redraw, clicked, grab: grabbed });
list();
