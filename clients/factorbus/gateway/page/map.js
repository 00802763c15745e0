// A map as the page has it: the value of each variable, kept up to date by a WebSocket that comes back by itself.

const POSITION = { se2: 2, se3: 3, sim3: 3, point2: 2, point3: 3 };

export class LiveMap {
  constructor(name, changed) {
    this.name = name;
    this.changed = changed;
    this.variables = new Map(); // "x12" → { kind, value }
    this.touched = new Set();
    this.touchedAt = -Infinity; // of performance.now()
    this.revision = 0;
    this.report = {};
    this.state = "connecting";
    this.closed = false;
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/api/maps/${encodeURIComponent(this.name)}/live`);
    this.socket.onmessage = (event) => this.take(JSON.parse(event.data));
    this.socket.onclose = (event) => {
      if (this.closed) return;
      this.state = event.reason || "the gateway does not answer; trying again";
      this.changed();
      setTimeout(() => this.closed || this.open(), 1000);
    };
  }

  close() {
    this.closed = true;
    this.socket.close();
  }

  // A state says whether the values are old.  An estimate brings everything; a delta what changed.  Of an estimate of the same map it is seen what did.
  take(message) {
    if (message.type === "state") {
      this.state = message.stale ? `not live: the service is silent, or has no map ${this.name} any more; this is its revision ${message.revision}` : "live";
      this.changed();
      return;
    }
    const before = this.variables, same = this.epoch === message.epoch;
    if (message.type === "estimate") this.variables = new Map();
    this.touched = new Set();
    for (const { kind, keys, values } of message.variables) {
      keys.forEach((key, i) => {
        const known = before.get(key)?.value;
        if (message.type === "delta" || (same && !values[i].every((each, n) => each === known?.[n]))) this.touched.add(key);
        this.variables.set(key, { kind, value: values[i] });
      });
    }
    this.epoch = message.epoch;
    if (this.touched.size) this.touchedAt = performance.now();
    this.revision = message.revision;
    this.report = message.report ?? {};
    this.state = "live";
    this.changed();
  }

  // How fresh the last step is: 1 at once, 0 when so many milliseconds have gone by.
  fresh(fades) { return Math.max(0, 1 - (performance.now() - this.touchedAt) / fades); }

  // x, y, z of a variable; undefined for one that is not there or has no place.
  placeOf(key) {
    const found = this.variables.get(key);
    const size = found && POSITION[found.kind];
    return size && [found.value[0], found.value[1], size === 3 ? found.value[2] : 0];
  }

  // Poses by robot, in the order of their numbers: letter → [key, ...].
  tracks() {
    const tracks = new Map();
    for (const [key, { kind }] of this.variables) {
      if (!["se2", "se3", "sim3"].includes(kind)) continue;
      const letter = key.replace(/\d+$/, "");
      if (!tracks.has(letter)) tracks.set(letter, []);
      tracks.get(letter).push(key);
    }
    for (const keys of tracks.values()) keys.sort((a, b) => Number(a.replace(/^\D*/, "")) - Number(b.replace(/^\D*/, "")));
    return tracks;
  }
}
