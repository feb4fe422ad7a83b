// The plant's feedback: gains, and a regulator about an operating point.

import { attempt, isCanceled, plants, words } from "../api.js";
import { fill, h, options } from "../dom.js";
import { number } from "../format.js";
import type { Gain } from "../gen/plantd/v1/common_pb.js";
import { FeedbackMode } from "../gen/plantd/v1/plant_service_pb.js";
import { current, look } from "../live.js";
import { app, complain } from "../state.js";
import { section } from "./section.js";

/** Columns of a gain that are shown. */
const COLUMNS = 24;

const MODES: Record<number, string> = {
  [FeedbackMode.WATCH_ONLY]: "watched only",
  [FeedbackMode.REPLACE]: "drives the plant",
  [FeedbackMode.ADD]: "added to the inputs",
  [FeedbackMode.GUARD]: "guards the driver",
};

/** The gain in force: the first that WatchGains tells. */
async function gain(id: string): Promise<Gain | undefined> {
  const stream = new AbortController();
  try {
    for await (const message of plants.watchGains({ id }, { signal: stream.signal })) {
      if (message.failure) complain(`Gains: ${message.failure.message}`);
      return message.gain;
    }
  } catch (error) {
    if (!isCanceled(error)) complain(`Gains: ${words(error)}`);
  } finally {
    stream.abort();
  }
  return undefined;
}

/** Adds the section. */
export function feedback(): void {
  const part = section("feedback", "Feedback", false);
  const point = h("select", { class: "grow", "aria-label": "Operating point" });
  const set = h("button", { type: "button", id: "regulate" }, "Regulate");
  const clear = h("button", { type: "button" }, "Clear");
  const table = h("div", { class: "matrix" });
  const hint = h("p", { class: "hint" }, "A linear-quadratic regulator about an operating point, in the plant's own loop, with weights of 1. Inputs are added to it.");
  fill(part.body, h("div", { class: "row" }, point, set, clear), hint, table);
  set.addEventListener("click", () => {
    const model = app.subject.get()?.model;
    if (!model) return;
    const prescribed = model.coordinates.filter((each) => each.prescribed).length;
    const ones = (length: number) => ({ form: { case: "diagonal" as const, value: { values: Array<number>(length).fill(1) } } });
    const weights = { q: ones(2 * model.coordinates.length), r: ones(model.inputs.length + prescribed) };
    const reference = { case: "point" as const, value: { source: { case: "operatingPoint" as const, value: point.value } } };
    void attempt("Regulator", () => plants.setFeedback({ id: current(), reference, weights, mode: FeedbackMode.ADD })).then(look);
  });
  clear.addEventListener("click", () => void attempt("Feedback", () => plants.clearFeedback({ id: current() })).then(look));

  app.subject.on((subject) => {
    const points = subject?.model.operatingPoints ?? [];
    options(point, points.map((name) => [name, name]));
    set.disabled = points.length === 0;
    part.root.hidden = !subject?.plant || subject.model.inputs.length + subject.model.coordinates.filter((each) => each.prescribed).length === 0;
  });

  let shown = "";
  const show = async (): Promise<void> => {
    const info = app.info.get();
    const held = info?.feedback;
    part.badge(held ? (MODES[held.mode] ?? "set") : "none", held && held.mode !== FeedbackMode.WATCH_ONLY ? "on" : undefined);
    clear.disabled = !held;
    const key = held && info ? `${info.id}:${held.revision}` : "";
    if (!part.root.open || key === shown) return;
    shown = key;
    fill(table);
    const found = key === "" || !info ? undefined : await gain(info.id);
    if (found && key === shown) fill(table, matrix(found));
  };
  app.info.on(() => void show());
  part.onOpen(() => void show());
}

/** K, with the names of its rows and columns. */
function matrix({ k }: Gain): HTMLElement {
  const model = app.subject.get()?.model;
  if (!k || !model) return h("p", { class: "hint" }, "The trajectory has no further gains.");
  const dynamic = model.coordinates.filter((each) => !each.prescribed).map(({ name }) => name);
  const prescribed = model.coordinates.filter((each) => each.prescribed).map(({ name }) => name);
  const columns = [...dynamic, ...prescribed, ...dynamic.map((name) => `p(${name})`), ...prescribed.map((name) => `v(${name})`)];
  const rows = [...model.inputs, ...prescribed];
  const entry = (row: number, column: number): string => number(k.data[row * k.cols + column] ?? NaN, 4);
  // Upright: a plant has more states than inputs.
  return h(
    "table",
    {},
    h("caption", {}, "Gain K", k.cols > COLUMNS ? h("span", {}, `first ${COLUMNS} of ${k.cols} states`) : null),
    h("thead", {}, h("tr", {}, h("th", {}), ...rows.map((name) => h("th", {}, name)))),
    h("tbody", {}, ...columns.slice(0, COLUMNS).map((name, column) => h("tr", {}, h("td", {}, name), ...rows.map((_, row) => h("td", {}, entry(row, column)))))),
  );
}
