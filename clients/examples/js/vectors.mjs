// Reads every golden message, compares it with its description, and writes both back to the same bytes.
//
//     node vectors.mjs ../../../proto/vectors
import { readdirSync, readFileSync } from "node:fs";
import { join } from "node:path";
import { deepStrictEqual } from "node:assert";
import { bin, column, FLOATS } from "./contract.mjs";
import { decode, encode } from "./messagepack.mjs";

const root = process.argv[2] ?? "../../../proto/vectors";
const names = readdirSync(root, { recursive: true }).filter((name) => name.endsWith(".msgpack")).sort();
for (const name of names) {
  const bytes = new Uint8Array(readFileSync(join(root, name)));
  const described = parse(readFileSync(join(root, name.replace(/msgpack$/, "json")), "utf8"));
  try {
    deepStrictEqual(describe(decode(bytes)), described);
    deepStrictEqual(encode(decode(bytes), FLOATS), bytes);
    deepStrictEqual(encode(undescribe(described), FLOATS), bytes);
  } catch (error) {
    console.error(`${name}: ${error.message}`);
    process.exitCode = 1;
  }
}
console.log(`${names.length} messages read, compared and written`);

/** A message as the descriptions have it. */
function describe(value, name = "") {
  if (value instanceof Uint8Array) {
    const { kind, content } = column(name, value);
    return { [kind]: kind === "msgpack" ? describe(decode(content)) : Array.from(content, small) };
  }
  if (Array.isArray(value)) return value.map((each) => describe(each, name));
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, each]) => [key, describe(each, key)]));
}

/** A description as the message it is of. */
function undescribe(value) {
  if (Array.isArray(value)) return value.map(undescribe);
  if (value === null || typeof value !== "object") return value;
  const [[kind, content] = []] = Object.entries(value);
  if (kind === "msgpack") return encode(undescribe(content), FLOATS);
  if (["i64", "f64", "u8"].includes(kind)) return bin(kind, content);
  return Object.fromEntries(Object.entries(value).map(([key, each]) => [key, undescribe(each)]));
}

/** JSON whose large integers are BigInt: JSON.parse would round them. */
function parse(json) {
  const kept = json.replace(/(?<=[[\s:,])-?\d{16,}(?=[\s,\]}])/g, (digits) => `"BigInt ${digits}"`);
  return JSON.parse(kept, (_, value) =>
    typeof value === "string" && value.startsWith("BigInt ") ? small(BigInt(value.slice(7))) : value);
}

function small(number) {
  return typeof number === "bigint" && number <= Number.MAX_SAFE_INTEGER && number >= Number.MIN_SAFE_INTEGER
    ? Number(number) : number;
}
