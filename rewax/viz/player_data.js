"use strict";
// What the page holds: recordings as JSON, whose arrays are packed as text.

const TYPES = { f4: Float32Array, u1: Uint8Array, u2: Uint16Array, u4: Uint32Array };

// An array from its text: deflated numbers in base64. Arrays with frames hold, after the first frame, differences from
// the frame before; numbers of two bytes hold all low bytes before all high ones.
async function decode({ z, type, frames }) {
  const packed = Uint8Array.from(atob(z), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  if (!frames) return new TYPES[type](bytes.buffer);
  const wide = type === "u2", count = wide ? bytes.length / 2 : bytes.length;
  const numbers = wide ? new Uint16Array(count) : new Uint8Array(count);
  const each = count / frames;
  for (let i = 0; i < count; i++) {
    const difference = wide ? bytes[i] | (bytes[count + i] << 8) : bytes[i];
    numbers[i] = difference + (i < each ? 0 : numbers[i - each]);  // wraps around, as it was written
  }
  return numbers;
}

async function decodeAll(value) {
  if (Array.isArray(value)) return Promise.all(value.map(decodeAll));
  if (value === null || typeof value !== "object") return value;
  if (typeof value.z === "string") return decode(value);  // what has a name is never text: a metric may be named z
  return dictionary(await Promise.all(Object.entries(value).map(async ([key, inner]) => [key, await decodeAll(inner)])));
}

// An object with nothing but its entries: a recording's names may be those of JavaScript's own properties.
function dictionary(entries) {
  return Object.assign(Object.create(null), ...entries.map(([key, value]) => ({ [key]: value })));
}

// The page's data from their JSON. Each run gets `totals`, its return before and after every step, and `ranges`, the
// ends of the scale of each number that may colour its particles.
async function read(text) {
  const data = await decodeAll(JSON.parse(text));
  for (const run of data.runs) {
    run.totals = [0];
    for (const reward of run.rewards) run.totals.push(run.totals[run.totals.length - 1] + reward);
    const values = run.particles ? Object.entries(run.particles.values).map(([name, { low, high }]) => [name, [low, high]]) : [];
    run.ranges = dictionary(run.particles ? [["height", run.particles.heights], ...values] : []);
  }
  return data;
}
