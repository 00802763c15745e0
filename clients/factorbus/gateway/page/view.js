// The canvas: what is drawn of a map, and what is near a pixel.

import { drawGrid, drawScale } from "./grid.js";
import { Projection, dot3 } from "./projection.js";

const COLOURS = getComputedStyle(document.documentElement);
const colour = (name) => COLOURS.getPropertyValue(`--${name}`).trim();
const REACH_PX = 14, CLOSE_PX = 8, LINE_PX = 7;
const FEW_TOUCHED = 60; // at most this number of variables of the last step is shown in full
const FADES_MS = 4000;
const LABEL_PX = [20, 16]; // no two names lie upon the same of such fields
const HOLDS_95 = 2.447747; // √5.991: standard deviations that hold 95 % in a plane

export class View {
  constructor(canvas) {
    this.canvas = canvas;
    this.seen = new Projection(canvas);
    this.follow = true; // fit until a hand moves it
    this.labels = false;
  }

  pixelOf(place) { return this.seen.pixelOf(place); }

  // All of it is in view, unless a hand has moved it.
  fit(map) {
    if (this.follow || !this.seen.scale) this.seen.fit([...map.variables.keys()].map((key) => map.placeOf(key)).filter(Boolean));
  }

  // A variable or a factor, whichever is meant by a click there: { key }, { factor }, or null.
  at(map, edges, x, y) {
    const [key, apart] = this.nearest(map, x, y);
    if (key && apart <= CLOSE_PX) return { key };
    const factor = this.nearestEdge(map, edges, x, y);
    return factor ? { factor } : key ? { key } : null;
  }

  // The variable nearest to a pixel, if one is in reach, and how far it is.
  nearest(map, x, y) {
    let best = null, least = REACH_PX;
    for (const key of map.variables.keys()) {
      const place = map.placeOf(key);
      if (!place) continue;
      const [px, py] = this.pixelOf(place);
      const apart = Math.hypot(px - x, py - y);
      if (apart < least) [best, least] = [key, apart];
    }
    return [best, least];
  }

  nearestEdge(map, edges, x, y) {
    let best = null, least = LINE_PX;
    for (const factor of edges) {
      if (!factor.keys.every((key) => isPose(map.variables.get(key)?.kind))) continue; // of others no line is drawn
      for (const [from, to] of this.segments(map, factor)) {
        const apart = fromSegment([x, y], from, to);
        if (apart < least) [best, least] = [factor, apart];
      }
    }
    return best;
  }

  // The lines that stand for a factor: from each of its variables that has a place to the next.
  segments(map, { keys }) {
    const pixels = keys.map((key) => map.placeOf(key)).filter(Boolean).map((place) => this.pixelOf(place));
    return pixels.slice(1).map((to, i) => [pixels[i], to]);
  }

  draw(map, { closures, ellipses, suspects }, { selection = null, ghost = null, marks = [] } = {}) {
    this.fit(map);
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.canvas.width = w * ratio;
    this.canvas.height = h * ratio;
    if (!this.seen.scale) return;
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    drawGrid(pen, this.seen, colour("grid"));
    this.drawTouched(pen, map);
    this.drawEllipses(pen, map, ellipses);
    this.drawClosures(pen, map, closures);
    this.drawSuspects(pen, map, suspects);
    for (const keys of map.tracks().values()) this.drawTrack(pen, map, keys);
    for (const [key, { kind }] of map.variables) {
      if (kind.startsWith("point")) this.dot(pen, map.placeOf(key), 3.5, colour("landmark"));
    }
    if (selection) this.drawSelection(pen, map, selection);
    this.drawLabels(pen, map, this.named(map, selection));
    marks.forEach(([key, text]) => this.mark(pen, map.placeOf(key), text));
    if (ghost) this.drawGhost(pen, ghost);
    drawScale(pen, this.seen, colour("ink"));
  }

  drawSelection(pen, map, selection) {
    pen.strokeStyle = colour("chosen");
    pen.lineWidth = 4;
    pen.lineCap = "round";
    pen.beginPath();
    for (const factor of selection.factors.values()) {
      for (const [from, to] of this.segments(map, factor)) {
        pen.moveTo(...from);
        pen.lineTo(...to);
      }
    }
    pen.stroke();
    for (const { keys } of selection.factors.values()) if (keys.length === 1) this.ring(pen, map.placeOf(keys[0]), "chosen");
    for (const key of selection.keys) this.ring(pen, map.placeOf(key), "ink");
  }

  // Which have their names beside them, the first before all others: what is selected, landmarks, poses.
  named(map, selection) {
    const first = selection ? [...selection.keys] : [];
    if (!this.labels) return first;
    const all = [...map.variables], points = all.filter(([, { kind }]) => kind.startsWith("point"));
    return new Set([...first, ...points.map(([key]) => key), ...all.map(([key]) => key)]);
  }

  // Names as far as there is room, each with a pale rim.
  drawLabels(pen, map, keys) {
    const taken = new Set();
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "left";
    pen.lineWidth = 3;
    pen.strokeStyle = "#ffffffd0";
    pen.fillStyle = colour("ink");
    for (const key of keys) {
      const place = map.placeOf(key);
      if (!place) continue;
      const [x, y] = this.pixelOf(place);
      const fields = fieldsOf(x + 9, y - 3, pen.measureText(key).width);
      if (fields.some((field) => taken.has(field))) continue;
      fields.forEach((field) => taken.add(field));
      pen.strokeText(key, x + 9, y - 3);
      pen.fillText(key, x + 9, y - 3);
    }
  }

  // From where it is to where it was dragged, or a cross where somebody clicked.
  drawGhost(pen, { from, to }) {
    const [x, y] = this.pixelOf(to);
    pen.strokeStyle = pen.fillStyle = colour("chosen");
    pen.lineWidth = 2;
    pen.setLineDash([6, 4]);
    pen.beginPath();
    pen.moveTo(...this.pixelOf(from));
    pen.lineTo(x, y);
    pen.stroke();
    pen.setLineDash([]);
    pen.beginPath();
    for (const [dx, dy] of [[8, 0], [0, 8]]) {
      pen.moveTo(x - dx, y - dy);
      pen.lineTo(x + dx, y + dy);
    }
    pen.stroke();
  }

  // A number beside a pose, of a pair.
  mark(pen, place, text) {
    if (!place) return;
    this.dot(pen, place, 9, colour("chosen"));
    pen.fillStyle = "#fff";
    pen.font = "bold 11px system-ui, sans-serif";
    pen.textAlign = "center";
    const [x, y] = this.pixelOf(place);
    pen.fillText(text, x, y + 4);
  }

  // Below everything else, and paler and smaller the more there are, so that a step that moved all hides nothing.
  drawTouched(pen, map) {
    const few = Math.min(1, FEW_TOUCHED / Math.max(map.touched.size, 1));
    const radius = 2 + 2 * few;
    pen.fillStyle = colour("touched");
    pen.globalAlpha = (0.3 + 0.7 * few) * map.fresh(FADES_MS);
    pen.beginPath(); // one for all: where dots lie upon each other they are no darker
    for (const key of map.touched) {
      const place = map.placeOf(key);
      if (!place) continue;
      const [x, y] = this.pixelOf(place);
      pen.moveTo(x + radius, y);
      pen.arc(x, y, radius, 0, 2 * Math.PI);
    }
    pen.fill();
    pen.globalAlpha = 1;
  }

  drawTrack(pen, map, keys) {
    pen.strokeStyle = colour("estimate");
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (const key of keys) pen.lineTo(...this.pixelOf(map.placeOf(key)));
    pen.stroke();
    this.dot(pen, map.placeOf(keys[keys.length - 1]), 5, colour("ink"));
  }

  drawClosures(pen, map, { keys, misfit }) {
    pen.lineWidth = 1.2;
    const names = misfit.map((m) => (m > 2 ? "contradicts" : m > 1.3 ? "doubtful" : "fits"));
    for (const name of ["fits", "doubtful", "contradicts"]) {
      pen.strokeStyle = colour(name);
      pen.beginPath();
      keys.forEach(([a, b], i) => {
        const [from, to] = [map.placeOf(a), map.placeOf(b)];
        if (names[i] !== name || !from || !to) return;
        pen.moveTo(...this.pixelOf(from));
        pen.lineTo(...this.pixelOf(to));
      });
      pen.stroke();
    }
  }

  // Closures that the estimate does not have: dashed, and paler those that are out for good.
  drawSuspects(pen, map, { closures }) {
    pen.strokeStyle = colour("suspect");
    pen.lineWidth = 1.2;
    pen.setLineDash([5, 4]);
    for (const { state, ...factor } of closures) {
      pen.globalAlpha = state === "rejected" ? 0.35 : 1;
      pen.beginPath();
      for (const [from, to] of this.segments(map, factor)) {
        pen.moveTo(...from);
        pen.lineTo(...to);
      }
      pen.stroke();
    }
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }

  // Each holds 95 % of where the variable may be, seen from here.
  drawEllipses(pen, map, { keys, covariances }) {
    const { right, up } = this.seen;
    pen.strokeStyle = colour("spread");
    pen.fillStyle = `${colour("spread")}22`;
    pen.lineWidth = 1;
    keys.forEach((key, i) => {
      const place = map.placeOf(key);
      if (!place) return;
      const [cxx, cxy, cxz, cyy, cyz, czz] = covariances[i];
      const times = (v) => [dot3([cxx, cxy, cxz], v), dot3([cxy, cyy, cyz], v), dot3([cxz, cyz, czz], v)];
      const [xx, xy, yy] = [dot3(right, times(right)), dot3(right, times(up)), dot3(up, times(up))];
      const middle = (xx + yy) / 2, apart = Math.hypot((xx - yy) / 2, xy);
      const [long, short] = [middle + apart, Math.max(middle - apart, 0)].map((each) => HOLDS_95 * Math.sqrt(each) * this.seen.scale);
      pen.beginPath();
      pen.ellipse(...this.pixelOf(place), long, short, -Math.atan2(2 * xy, xx - yy) / 2, 0, 2 * Math.PI); // y goes down here
      pen.fill();
      pen.stroke();
    });
  }

  dot(pen, place, radius, fill) {
    if (!place) return;
    pen.fillStyle = fill;
    pen.beginPath();
    pen.arc(...this.pixelOf(place), radius, 0, 2 * Math.PI);
    pen.fill();
  }

  ring(pen, place, name) {
    if (!place) return;
    pen.strokeStyle = colour(name);
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(...this.pixelOf(place), 9, 0, 2 * Math.PI);
    pen.stroke();
  }
}

const isPose = (kind) => ["se2", "se3", "sim3"].includes(kind);

// Those that a name lies upon, from its left lower corner.
function fieldsOf(x, y, width) {
  const [left, right] = [x, x + width].map((each) => Math.floor(each / LABEL_PX[0]));
  const [top, bottom] = [y - 11, y].map((each) => Math.floor(each / LABEL_PX[1]));
  const found = [];
  for (let i = left; i <= right; i += 1) for (let j = top; j <= bottom; j += 1) found.push(`${i} ${j}`);
  return found;
}

function fromSegment([x, y], [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay], square = dx * dx + dy * dy;
  const share = square ? Math.max(0, Math.min(1, ((x - ax) * dx + (y - ay) * dy) / square)) : 0;
  return Math.hypot(x - ax - share * dx, y - ay - share * dy);
}
