// Numbers for people.

/** A number in a few significant digits. */
export function number(value: number, digits = 4): string {
  if (!Number.isFinite(value)) return Number.isNaN(value) ? "–" : value > 0 ? "∞" : "−∞";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size < 1e-12) return "0"; // Round-off.
  const text = size < 1e-3 || size >= 1e5 ? value.toExponential(digits - 2) : value.toFixed(Math.max(0, digits - 1 - Math.floor(Math.log10(size))));
  return text.replace("-", "−").replace("e+", "e");
}

/** A duration given in nanoseconds. */
export function duration(ns: number | bigint): string {
  const value = Number(ns);
  if (value < 1e3) return `${value.toFixed(0)} ns`;
  if (value < 1e6) return `${number(value / 1e3, 3)} µs`;
  if (value < 1e9) return `${number(value / 1e6, 3)} ms`;
  return `${number(value / 1e9, 3)} s`;
}

/** A count with thin spaces. */
export function count(value: number | bigint): string {
  return String(value).replace(/\B(?=(\d{3})+(?!\d))/g, "\u2009");
}

/** A size of a file. */
export function bytes(value: number | bigint): string {
  const size = Number(value);
  if (size < 1e6) return `${number(size / 1e3, 3)} kB`;
  return `${number(size / 1e6, 3)} MB`;
}
