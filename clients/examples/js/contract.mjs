// What proto/README.md says of fields: which are floats, which are columns and of what. And keys as they print.

/** Fields of type float, §4, §8, §15 and §16; phases_ms is a map of floats. */
export const FLOATS = new Set([
  "chi2", "batch", "seconds", "convert_below", "retry_after_s", "timeout_s", "probability", "distance", "threshold",
  "rho", "sigma_rho", "sigma_pixel", "influence", "without", "pivot", "conditioning", "residual", "weighted",
  "chi2_before", "damping", "step_ms", "solver_ms", "value", "sigmas", "covariance",
]);

/** What is in a bin, by the name of its field. `distance` and `threshold` are bins in gated, floats in associated. */
const COLUMNS = {
  keys: "i64", others: "i64", dims: "i64", other_dims: "i64", landmarks: "i64", observations: "i64", candidates: "i64",
  values: "f64", measured: "f64", information: "f64", scale: "f64", covariance: "f64", distance: "f64",
  threshold: "f64", gain: "f64", distances: "f64", numbers: "f64", state: "f64", pixels: "f64", y: "f64", rows: "f64",
  cross: "f64", blocks: "f64", turn: "f64", own: "f64", U: "f64", S: "f64",
  factors: "i64", ids: "i64", weight: "f64", // §17
  stamps: "i64", // §4
  plausible: "u8", matched: "u8", payload: "msgpack", ask: "msgpack", shard: "msgpack",
};

const FORMS = { i64: BigInt64Array, f64: Float64Array, u8: Uint8Array };

/** A bin as the array that its field has: BigInt64Array, Float64Array, Uint8Array, or the bytes of a message. */
export function column(name, bytes, kind = COLUMNS[name]) {
  if (kind === undefined) throw new Error(`the contract has no column ${name}`);
  if (kind === "msgpack") return { kind, content: bytes };
  const Form = FORMS[kind];
  if (bytes.length % Form.BYTES_PER_ELEMENT) throw new Error(`${name} has ${bytes.length} bytes`);
  return { kind, content: new Form(bytes.slice().buffer) }; // a copy: a column may begin at any byte
}

/** The bytes of a column: little-endian, as this machine's arrays are (checked where this is loaded). */
export function bin(kind, numbers) {
  const Form = FORMS[kind];
  return new Uint8Array(Form.from(numbers, kind === "i64" ? BigInt : Number).buffer);
}

if (new Uint8Array(new Uint16Array([1]).buffer)[0] !== 1) throw new Error("this machine is big-endian: columns need turning");

/** The int64 of "x12": the letter's code in the top byte. */
export function key(name) {
  const [, letter, index] = /^([A-Za-z]?)(\d+)$/.exec(name);
  return (BigInt(letter ? letter.charCodeAt(0) : 0) << 56n) | BigInt(index);
}
