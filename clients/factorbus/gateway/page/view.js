// The canvas: where things are drawn, moved and zoomed by hand.

const COLOURS = getComputedStyle(document.documentElement);
const colour = (name) => COLOURS.getPropertyValue(`--${name}`).trim();
const AXES = { z: [0, 1], y: [0, 2], x: [1, 2] };
const REACH_PX = 14;

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

  draw(map, closures) {
    if (this.follow || !this.scale) this.fit(map);
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.canvas.width = w * ratio;
    this.canvas.height = h * ratio;
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    // Below everything else, so that it hides nothing.
    for (const key of map.touched) this.dot(pen, map.placeOf(key), 4, colour("touched"));
    this.drawClosures(pen, map, closures);
    for (const keys of map.tracks().values()) this.drawTrack(pen, map, keys);
    for (const [key, { kind }] of map.variables) {
      if (kind.startsWith("point")) this.dot(pen, map.placeOf(key), 3.5, colour("landmark"));
    }
    if (this.chosen) this.ring(pen, map.placeOf(this.chosen));
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
