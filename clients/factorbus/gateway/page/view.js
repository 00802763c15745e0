// The canvas: where things are drawn, moved and zoomed by hand.

const COLOURS = getComputedStyle(document.documentElement);
const colour = (name) => COLOURS.getPropertyValue(`--${name}`).trim();
const AXES = { z: [0, 1], y: [0, 2], x: [1, 2] };
// Where the entries of a covariance are in xx xy xz yy yz zz.
const ENTRY = [[0, 1, 2], [1, 3, 4], [2, 4, 5]];
const REACH_PX = 14;
const FEW_TOUCHED = 60; // at most this number of variables of the last step is shown in full

export class View {
  constructor(canvas, plane) {
    this.canvas = canvas;
    this.plane = plane;
    this.scale = 0; // pixels per metre; 0: to be fitted
    this.middle = [0, 0];
    this.follow = true; // fit until a hand moves it
    this.chosen = null;
  }

  // Two of the three coordinates, in metres.
  flat(place) {
    const [a, b] = AXES[this.plane];
    return [place[a], place[b]];
  }

  pixelOf(place) {
    const [x, y] = this.flat(place);
    const { clientWidth: w, clientHeight: h } = this.canvas;
    return [w / 2 + (x - this.middle[0]) * this.scale, h / 2 - (y - this.middle[1]) * this.scale];
  }

  fit(map) {
    const places = [...map.variables.keys()].map((key) => map.placeOf(key)).filter(Boolean).map((p) => this.flat(p));
    if (!places.length) return;
    const low = [0, 1].map((i) => places.reduce((m, p) => Math.min(m, p[i]), Infinity));
    const high = [0, 1].map((i) => places.reduce((m, p) => Math.max(m, p[i]), -Infinity));
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const size = [0, 1].map((i) => Math.max(high[i] - low[i], 1));
    this.middle = [0, 1].map((i) => (low[i] + high[i]) / 2);
    this.scale = 0.9 * Math.min(w / size[0], h / size[1]);
  }

  // The variable nearest to a pixel, if one is in reach.
  nearest(map, x, y) {
    let best = null, least = REACH_PX;
    for (const key of map.variables.keys()) {
      const place = map.placeOf(key);
      if (!place) continue;
      const [px, py] = this.pixelOf(place);
      const apart = Math.hypot(px - x, py - y);
      if (apart < least) [best, least] = [key, apart];
    }
    return best;
  }

  draw(map, { closures, ellipses }) {
    if (this.follow || !this.scale) this.fit(map);
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.canvas.width = w * ratio;
    this.canvas.height = h * ratio;
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    this.drawTouched(pen, map);
    this.drawEllipses(pen, map, ellipses);
    this.drawClosures(pen, map, closures);
    for (const keys of map.tracks().values()) this.drawTrack(pen, map, keys);
    for (const [key, { kind }] of map.variables) {
      if (kind.startsWith("point")) this.dot(pen, map.placeOf(key), 3.5, colour("landmark"));
    }
    if (this.chosen) this.ring(pen, map.placeOf(this.chosen));
  }

  // Below everything else, and paler and smaller the more there are, so that a step that moved all hides nothing.
  drawTouched(pen, map) {
    const few = Math.min(1, FEW_TOUCHED / Math.max(map.touched.size, 1));
    const radius = 2 + 2 * few;
    pen.fillStyle = colour("touched");
    pen.globalAlpha = 0.3 + 0.7 * few;
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

  // Each holds 95 % of where the variable may be: √5.991 standard deviations, seen in this plane.
  drawEllipses(pen, map, { keys, covariances }) {
    const [a, b] = AXES[this.plane];
    pen.strokeStyle = colour("spread");
    pen.fillStyle = `${colour("spread")}22`;
    pen.lineWidth = 1;
    keys.forEach((key, i) => {
      const place = map.placeOf(key);
      if (!place) return;
      const [xx, xy, yy] = [ENTRY[a][a], ENTRY[a][b], ENTRY[b][b]].map((at) => covariances[i][at]);
      const middle = (xx + yy) / 2, apart = Math.hypot((xx - yy) / 2, xy);
      const [long, short] = [middle + apart, Math.max(middle - apart, 0)].map((each) => 2.447747 * Math.sqrt(each) * this.scale);
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

  ring(pen, place) {
    if (!place) return;
    pen.strokeStyle = colour("ink");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(...this.pixelOf(place), 9, 0, 2 * Math.PI);
    pen.stroke();
  }
}
