// Reads every golden message, compares it with its description, and writes both back to the same bytes.
//
//     node vectors.mjs ../../../proto/vectors
import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { deepStrictEqual } from "node:assert";
import { bin, column, FLOATS } from "./contract.mjs";
import { decode, encode, Float } from "./messagepack.mjs";

const KINDS = ["i64", "f64", "u8", "msgpack"];
const root = process.argv[2] ?? "../../../proto/vectors";
const names = readdirSync(root, { recursive: true }).filter((name) => name.endsWith(".msgpack")).sort();
for (const name of names) {
  const bytes = new Uint8Array(readFileSync(join(root, name)));
  const described = parse(readFileSync(join(root, name.replace(/msgpack$/, "json")), "utf8"));
  try {
    const message = decode(bytes);
    deepStrictEqual(describe(message, described), described);
    // By the names of the contract, and by what the description says: fields come after this was written.
    deepStrictEqual(encode(message, new Set([...FLOATS, ...floatsOf(described)])), bytes);
    deepStrictEqual(encode(undescribe(described), new Set()), bytes);
  } catch (error) {
    console.error(`${name}: ${error.message}`);
    process.exitCode = 1;
  }
}
console.log(`${names.length} messages read, compared and written`);

/** A message as the descriptions have it; `like` says of a number that it is a float, and of a bin what is in it. */
function describe(value, like, name = "") {
  if (value instanceof Uint8Array) {
    const told = like && Object.keys(like)[0];
    const { kind, content } = KINDS.includes(told) ? column(name, value, told) : column(name, value);
    if (kind === "msgpack") return { msgpack: describe(decode(content), like?.msgpack) };
    return { [kind]: Array.from(content, (number) => (kind === "f64" ? new Float(number) : small(number))) };
  }
  if (Array.isArray(value)) return value.map((each, i) => describe(each, like?.[i], name));
  if (typeof value === "number" && like instanceof Float) return new Float(value);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, each]) => [key, describe(each, like?.[key], key)]));
}

/** A description as the message it is of. */
function undescribe(value) {
  if (Array.isArray(value)) return value.map(undescribe);
  if (value === null || typeof value !== "object" || value instanceof Float) return value;
  const [[kind, content] = []] = Object.entries(value);
  if (kind === "msgpack") return encode(undescribe(content), new Set());
  if (KINDS.includes(kind)) return bin(kind, content.map((number) => (number instanceof Float ? number.value : number)));
  return Object.fromEntries(Object.entries(value).map(([key, each]) => [key, undescribe(each)]));
}

/** Names of the fields that are floats in a description. */
function floatsOf(value, name = "") {
  if (value instanceof Float) return [name];
  if (Array.isArray(value)) return value.flatMap((each) => floatsOf(each, name));
  if (value === null || typeof value !== "object") return [];
  return Object.entries(value).flatMap(([key, each]) => floatsOf(each, key));
}

/** JSON with large integers as BigInt, which JSON.parse would round, and numbers with a point as Float. */
function parse(json) {
  const token = /"(?:[^"\\]|\\.)*"|-?\d+(\.\d+)?([eE][-+]?\d+)?/g; // a text, which stays, or a number
  const kept = json.replace(token, (found, point, power) =>
    found.startsWith('"') ? found
      : point || power ? `"Float ${found}"` : found.length > 15 ? `"BigInt ${found}"` : found);
  return JSON.parse(kept, (_, value) => {
    if (typeof value !== "string") return value;
    if (value.startsWith("Float ")) return new Float(Number(value.slice(6)));
    return value.startsWith("BigInt ") ? small(BigInt(value.slice(7))) : value;
  });
}

function small(number) {
  return typeof number === "bigint" && number <= Number.MAX_SAFE_INTEGER && number >= Number.MIN_SAFE_INTEGER
    ? Number(number) : number;
}
