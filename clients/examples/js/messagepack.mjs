// MessagePack, as far as proto/README.md needs it: nil, bool, int, float64, str, bin, array, map with string keys.
//
// Why not a package: in JavaScript 1 and 1.0 are the same number, and a package writes both as an int. Which fields are
// floats is in the contract, so `encode` is told by name. Integers beyond 2^53 (epochs, keys) are BigInt.

const text = new TextEncoder();
const words = new TextDecoder("utf-8", { fatal: true });

/** A number that is written as a float64 whatever its field is called. */
export class Float {
  constructor(value) {
    this.value = value;
  }
}

/** The value in `bytes`, which have to be one message and nothing more. Throws Error. */
export function decode(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let at = 0;

  function take(count) {
    if (at + count > bytes.length) throw new Error(`ends at byte ${bytes.length}; wanted ${count} more from ${at}`);
    at += count;
    return at - count;
  }
  const u8 = () => view.getUint8(take(1));
  const u16 = () => view.getUint16(take(2));
  const u32 = () => view.getUint32(take(4));
  const size = (number) => (number >= Number.MIN_SAFE_INTEGER && number <= Number.MAX_SAFE_INTEGER ? Number(number) : number);
  const slice = (count) => bytes.subarray(take(count), at);
  const string = (count) => words.decode(slice(count));
  const array = (count) => Array.from({ length: count }, value);

  function map(count) {
    const made = {};
    for (let i = 0; i < count; i++) {
      const key = value();
      if (typeof key !== "string") throw new Error(`a map has the key ${key}; wanted a string`);
      made[key] = value();
    }
    return made;
  }

  function value() {
    const head = u8();
    if (head < 0x80) return head;
    if (head < 0x90) return map(head & 0x0f);
    if (head < 0xa0) return array(head & 0x0f);
    if (head < 0xc0) return string(head & 0x1f);
    if (head >= 0xe0) return head - 0x100;
    switch (head) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: return slice(u8());
      case 0xc5: return slice(u16());
      case 0xc6: return slice(u32());
      case 0xca: return view.getFloat32(take(4));
      case 0xcb: return view.getFloat64(take(8));
      case 0xcc: return u8();
      case 0xcd: return u16();
      case 0xce: return u32();
      case 0xcf: return size(view.getBigUint64(take(8)));
      case 0xd0: return view.getInt8(take(1));
      case 0xd1: return view.getInt16(take(2));
      case 0xd2: return view.getInt32(take(4));
      case 0xd3: return size(view.getBigInt64(take(8)));
      case 0xd9: return string(u8());
      case 0xda: return string(u16());
      case 0xdb: return string(u32());
      case 0xdc: return array(u16());
      case 0xdd: return array(u32());
      case 0xde: return map(u16());
      case 0xdf: return map(u32());
      default: throw new Error(`byte ${at - 1} is 0x${head.toString(16)}, which no message has`);
    }
  }

  const whole = value();
  if (at !== bytes.length) throw new Error(`${bytes.length - at} bytes follow the message`);
  return whole;
}

/** The bytes of a value. floats: names of the fields whose numbers are float64. */
export function encode(value, floats) {
  const parts = [];
  const put = (length, write) => {
    const part = new Uint8Array(length);
    write(new DataView(part.buffer), part);
    parts.push(part);
  };
  const head = (byte) => parts.push(Uint8Array.of(byte));

  /** The shortest of the forms that holds `count`: within the first byte, or behind it in 1, 2 or 4 bytes. */
  function sized(count, fixed, room, bytes) {
    if (count < room) return head(fixed | count);
    if (bytes[0] && count < 0x100) return put(2, (view) => { view.setUint8(0, bytes[0]); view.setUint8(1, count); });
    if (count < 0x10000) return put(3, (view) => { view.setUint8(0, bytes[1]); view.setUint16(1, count); });
    return put(5, (view) => { view.setUint8(0, bytes[2]); view.setUint32(1, count); });
  }

  function integer(number) {
    if (number >= 0 && number < 0x80) return head(Number(number));
    if (number < 0 && number >= -0x20) return head(0x100 + Number(number));
    const signed = number < 0;
    const bits = [8, 16, 32].find((width) =>
      signed ? number >= -(2 ** (width - 1)) : number < 2 ** width) ?? 64;
    const code = (signed ? 0xd0 : 0xcc) + Math.log2(bits / 8);
    put(1 + bits / 8, (view) => {
      view.setUint8(0, code);
      if (bits === 64) signed ? view.setBigInt64(1, BigInt(number)) : view.setBigUint64(1, BigInt(number));
      else view[`set${signed ? "Int" : "Uint"}${bits}`](1, Number(number));
    });
  }

  function write(of, name) {
    if (of === null) return head(0xc0);
    if (typeof of === "boolean") return head(of ? 0xc3 : 0xc2);
    if (typeof of === "bigint") return integer(of);
    if (of instanceof Float) return put(9, (view) => { view.setUint8(0, 0xcb); view.setFloat64(1, of.value); });
    if (typeof of === "number") {
      if (Number.isInteger(of) && !floats.has(name)) return integer(of);
      return put(9, (view) => { view.setUint8(0, 0xcb); view.setFloat64(1, of); });
    }
    if (typeof of === "string") {
      const bytes = text.encode(of);
      sized(bytes.length, 0xa0, 32, [0xd9, 0xda, 0xdb]);
      return parts.push(bytes);
    }
    if (of instanceof Uint8Array) {
      sized(of.length, 0, 0, [0xc4, 0xc5, 0xc6]);
      return parts.push(of);
    }
    if (Array.isArray(of)) {
      sized(of.length, 0x90, 16, [0, 0xdc, 0xdd]);
      return of.forEach((each) => write(each, name));
    }
    const fields = Object.entries(of);
    sized(fields.length, 0x80, 16, [0, 0xde, 0xdf]);
    for (const [key, each] of fields) {
      write(key, "");
      write(each, key);
    }
  }

  write(value, "");
  const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  parts.reduce((at, part) => (whole.set(part, at), at + part.length), 0);
  return whole;
}
