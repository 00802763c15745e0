// The page: which map, what is said about it, and what a click asks for.

import { LiveMap } from "./map.js";
import { View } from "./view.js";

const of = (id) => document.getElementById(id);
const view = new View(of("map"), "z");
let map = null;
const NOTHING = { closures: { revision: 0, keys: [], misfit: [] }, ellipses: { revision: 0, keys: [], covariances: [] } };
let asked = NOTHING; // what is asked for now and then, and drawn with the estimate
let drawing = false, fetching = false;

// For the console, and for tests that drive the page.
window.factorbus = {
  get revision() { return map ? map.revision : 0; },
  placeOf: (key) => map && map.placeOf(key),
  pixelOf: (key) => { const place = map && map.placeOf(key); return place && view.pixelOf(place); },
  get closures() { return asked.closures; },
  get ellipses() { return asked.ellipses; },
};

async function ask(path) {
  const answer = await fetch(path);
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.problem.message);
  return content;
}

function changed() {
  const { chi2, step_ms: ms, strategy, converging } = map.report;
  const words = [`revision ${map.revision}`, `${map.variables.size} variables`];
  if (chi2 !== undefined) words.push(`χ² ${chi2.toPrecision(6)}`);
  if (ms !== undefined) words.push(`step ${ms.toFixed(2)} ms ${strategy ?? ""}`);
  if (converging) words.push("converging");
  of("state").textContent = map.state === "live" ? words.join(" · ") : map.state;
  refresh();
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(() => { drawing = false; view.draw(map, asked); });
}

// All factors have to be asked for, and covariances computed: not more often than every two seconds.
async function refresh() {
  const old = () => Object.values(asked).some((each) => each.revision !== map.revision);
  if (fetching || !old()) return;
  fetching = true;
  const name = map.name;
  for (const what of Object.keys(asked)) {
    try {
      const found = await ask(`/api/maps/${name}/${what}`);
      if (map.name === name) asked = { ...asked, [what]: found };
    } catch (error) {
      of("state").title = `${what}: ${error.message}`; // the map itself is shown all the same
    }
  }
  setTimeout(() => { fetching = false; if (old()) refresh(); }, 2000);
  view.draw(map, asked);
}

function show(name) {
  if (map) map.close();
  asked = NOTHING;
  view.follow = true;
  view.chosen = null;
  location.hash = name;
  map = new LiveMap(name, changed);
}

function option(row) {
  const made = element("option", row.problem ? `${row.name} (${row.state})` : row.name);
  [made.value, made.disabled] = [row.name, Boolean(row.problem)];
  return made;
}

function element(tag, text, ...children) {
  const made = document.createElement(tag);
  if (text !== null) made.textContent = text;
  made.append(...children);
  return made;
}

async function explain(key) {
  view.chosen = key;
  view.draw(map, asked);
  const panel = of("panel");
  try {
    const found = await ask(`/api/maps/${map.name}/variables/${key}`);
    const head = element("tr", null, ...["factor", "of", "χ²", "misfit", "leverage"].map((name) => element("th", name)));
    const rows = found.factors.map((f) => element("tr", null,
      element("td", f.kind), element("td", f.keys.join(" ")),
      element("td", f.loss ? `${f.rho.toPrecision(3)} of ${f.chi2.toPrecision(3)}, ${f.loss}` : f.chi2.toPrecision(3)),
      element("td", f.misfit.toFixed(2)),
      element("td", f.without === null ? "all" : `${Math.round(100 * f.known)} %`)));
    panel.replaceChildren(
      element("h2", found.key),
      element("p", found.text),
      element("p", `${found.kind} (${found.value.map((v) => v.toFixed(3)).join(", ")}) at revision ${found.revision}`),
      element("p", found.fixed ? "" : `σ ${found.sigmas.map((v) => v.toPrecision(2)).join(", ")} (in its own frame; metres, radians)`),
      element("table", null, head, ...rows),
      element("p", `last step of the map: ${found.step}`),
    );
  } catch (error) {
    panel.replaceChildren(element("h2", key), element("p", error.message));
  }
}

const STARTS = { values: "the map's own values", odometry: "composed odometry", rotations: "averaged rotations" };

async function compare() {
  const panel = of("panel"), name = map.name;
  panel.replaceChildren(element("h2", "The optimum"), element("p", "is being found from scratch"));
  try {
    const found = await ask(`/api/maps/${name}/optimum`);
    const ratio = found.batch > 0 ? `, ${(found.chi2 / found.batch).toFixed(6)} of it` : "";
    const converged = found.batch_converged;
    const there = converged ? "The map is where the optimum is." : "The map is not more than 1 % above that.";
    panel.replaceChildren(
      element("h2", found.notice ? found.notice.code : "The optimum"),
      element("p", `χ² ${found.chi2.toPrecision(7)} at revision ${found.revision}; optimum from ${STARTS[found.start] ?? "a start"}: ${found.batch.toPrecision(7)}${ratio}`),
      element("p", found.notice ? found.notice.message.replace("adopt MAP", `adopt ${name}`) : there),
      element("p", converged ? "" : "The search for the optimum ended before it had converged: the true optimum may be lower."),
    );
  } catch (error) {
    panel.replaceChildren(element("h2", "The optimum"), element("p", error.message));
  }
}

function hands(canvas) {
  let from = null, moved = 0;
  canvas.onpointerdown = (e) => { from = [e.clientX, e.clientY]; moved = 0; canvas.setPointerCapture(e.pointerId); };
  canvas.onpointermove = (e) => {
    if (!from || !map) return;
    const [dx, dy] = [e.clientX - from[0], e.clientY - from[1]];
    moved += Math.hypot(dx, dy);
    if (moved < 4) return;
    view.follow = false;
    view.middle = [view.middle[0] - dx / view.scale, view.middle[1] + dy / view.scale];
    from = [e.clientX, e.clientY];
    view.draw(map, asked);
  };
  canvas.onpointerup = (e) => {
    from = null;
    const key = moved < 4 && map && view.nearest(map, e.offsetX, e.offsetY);
    if (key) explain(key);
  };
  canvas.onwheel = (e) => {
    e.preventDefault();
    if (!map) return;
    view.follow = false;
    const by = Math.exp(-e.deltaY * 0.0015);
    const [x, y] = [e.offsetX - canvas.clientWidth / 2, canvas.clientHeight / 2 - e.offsetY];
    view.middle = [view.middle[0] + (x / view.scale) * (1 - 1 / by), view.middle[1] + (y / view.scale) * (1 - 1 / by)];
    view.scale *= by;
    view.draw(map, asked);
  };
}

async function list() {
  const wanted = decodeURIComponent(location.hash.slice(1));
  try {
    const rows = (await ask("/api/maps")).maps;
    of("maps").replaceChildren(...rows.map(option));
    const maps = rows.filter((row) => !row.problem);  // the others do not open
    if (!maps.length) { of("state").textContent = rows.length ? "no map opens" : "there is no map yet"; setTimeout(list, 1000); return; }
    const name = maps.some((row) => row.name === wanted) ? wanted : maps[0].name;
    of("maps").value = name;
    show(name);
  } catch (error) {
    of("state").textContent = error.message;
    setTimeout(list, 1000);
  }
}

of("maps").onchange = (e) => show(e.target.value);
of("plane").onchange = (e) => { view.plane = e.target.value; view.follow = true; if (map) view.draw(map, asked); };
of("fit").onclick = () => { view.follow = true; if (map) view.draw(map, asked); };
of("compare").onclick = () => map && compare();
window.onresize = () => map && view.draw(map, asked);
hands(of("map"));
list();
