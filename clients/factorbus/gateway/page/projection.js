// From metres to pixels and back: where one looks from, what is in the middle, how large a metre is.

const DEGREE = Math.PI / 180;
// Turned about z, and raised: from above, from the side, along x; an orbit begins where one sees all three axes.
const LOOKS = { z: [0, 90], y: [0, 0], x: [90, 0], orbit: [35, 35] };

export const dot3 = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const along = (place, direction, by) => place.map((each, i) => each + direction[i] * by);

export class Projection {
  constructor(canvas) {
    this.canvas = canvas;
    this.scale = 0; // pixels per metre; 0: to be fitted
    this.centre = [0, 0, 0]; // what is in the middle, and what an orbit turns around
    this.look("z");
  }

  look(plane) {
    this.plane = plane;
    this.turn(...LOOKS[plane]);
  }

  // Degrees.  right and up of the screen, as directions in the map.
  turn(yaw, pitch) {
    this.yaw = yaw;
    this.pitch = Math.max(-90, Math.min(90, pitch));
    const [a, b] = [this.yaw * DEGREE, this.pitch * DEGREE];
    const round = (v) => (Math.abs(v) < 1e-15 ? 0 : v);
    this.right = [Math.cos(a), Math.sin(a), 0].map(round);
    this.up = [-Math.sin(a) * Math.sin(b), Math.cos(a) * Math.sin(b), Math.cos(b)].map(round);
  }

  flat(place) { return [dot3(place, this.right), dot3(place, this.up)]; }

  pixelOf(place) {
    const [x, y] = this.flat(place), [cx, cy] = this.flat(this.centre);
    const { clientWidth: w, clientHeight: h } = this.canvas;
    return [w / 2 + (x - cx) * this.scale, h / 2 - (y - cy) * this.scale];
  }

  // Where a pixel is, as far away as `place` is.
  placeAt(x, y, place) {
    const [px, py] = this.pixelOf(place);
    return along(along(place, this.right, (x - px) / this.scale), this.up, (py - y) / this.scale);
  }

  pan(dx, dy) {
    this.centre = along(along(this.centre, this.right, -dx / this.scale), this.up, dy / this.scale);
  }

  // What is under the pixel stays there.
  zoom(by, x, y) {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const [dx, dy] = [(x - w / 2) * (1 - 1 / by), (y - h / 2) * (1 - 1 / by)];
    this.pan(-dx, -dy);
    this.scale *= by;
  }

  fit(places) {
    if (!places.length) return;
    const ends = (read) => places.reduce(([low, high], p) => [Math.min(low, read(p)), Math.max(high, read(p))], [Infinity, -Infinity]);
    this.centre = [0, 1, 2].map((i) => ends((p) => p[i])).map(([low, high]) => (low + high) / 2);
    const [cx, cy] = this.flat(this.centre);
    const [x, y] = [0, 1].map((i) => ends((p) => this.flat(p)[i]));
    this.centre = along(along(this.centre, this.right, (x[0] + x[1]) / 2 - cx), this.up, (y[0] + y[1]) / 2 - cy);
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.scale = 0.88 * Math.min(w / Math.max(x[1] - x[0], 1), h / Math.max(y[1] - y[0], 1));
  }
}
