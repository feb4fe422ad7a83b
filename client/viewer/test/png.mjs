// Small pictures: PNG files of at most 256 colours.

import { crc32, deflateSync } from "node:zlib";

/** Bits of each channel by which colours are told apart. */
const BITS = 5;
const COLORS = 256;

function chunk(name, data) {
  const body = Buffer.concat([Buffer.from(name, "latin1"), data]);
  const [length, check] = [Buffer.alloc(4), Buffer.alloc(4)];
  length.writeUInt32BE(data.length);
  check.writeUInt32BE(crc32(body));
  return Buffer.concat([length, body, check]);
}

/** A PNG of pixels (red, green, blue, opacity), in the colours that occur most. */
export function small(width, height, pixels) {
  const mask = (0xff << (8 - BITS)) & 0xff;
  const counts = new Map();
  const key = (at) => ((pixels[at] & mask) << 16) | ((pixels[at + 1] & mask) << 8) | (pixels[at + 2] & mask);
  for (let at = 0; at < pixels.length; at += 4) {
    const of = counts.get(key(at)) ?? [0, 0, 0, 0];
    of[0] += 1;
    for (let part = 0; part < 3; part++) of[part + 1] += pixels[at + part];
    counts.set(key(at), of);
  }
  const sorted = [...counts].sort(([, [a]], [, [b]]) => b - a);
  const palette = sorted.slice(0, COLORS).map(([, [count, ...sums]]) => sums.map((sum) => Math.round(sum / count)));
  const nearest = (color) => {
    const far = palette.map((entry) => entry.reduce((sum, value, part) => sum + (value - color[part]) ** 2, 0));
    return far.indexOf(Math.min(...far));
  };
  const index = new Map(sorted.map(([colour, [count, ...sums]], place) => [colour, place < COLORS ? place : nearest(sums.map((sum) => sum / count))]));
  const rows = Buffer.alloc((width + 1) * height);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) rows[y * (width + 1) + 1 + x] = index.get(key(4 * (y * width + x)));
  }
  const head = Buffer.alloc(13);
  head.writeUInt32BE(width, 0);
  head.writeUInt32BE(height, 4);
  head.set([8, 3, 0, 0, 0], 8);
  const signature = Buffer.from([0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a]);
  return Buffer.concat([signature, chunk("IHDR", head), chunk("PLTE", Buffer.from(palette.flat())), chunk("IDAT", deflateSync(rows, { level: 9 })), chunk("IEND", Buffer.alloc(0))]);
}
