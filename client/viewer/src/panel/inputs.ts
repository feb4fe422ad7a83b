// Inputs as sliders. In lockstep a step takes them; a plant that runs by itself is driven under a lease.

import { isCanceled, plants, words } from "../api.js";
import { place } from "../connections.js";
import { fill, h } from "../dom.js";
import { number } from "../format.js";
import type { Model } from "../gen/plantd/v1/model_service_pb.js";
import { Pace } from "../gen/plantd/v1/realtime_pb.js";
import { current, look } from "../live.js";
import { app, complain } from "../state.js";
import { section } from "./section.js";

/** From one input to the next, ms. */
const SEND_MS = 25;
/** Half the range of an input without limits, N or N m. */
const RANGE = 10;
/** How far a prescribed coordinate without limits goes to each side, in sizes of the mechanism. */
const REACH = 0.12;
/** Time in which a prescribed coordinate goes through its range, s: a jump would be a blow. */
const TRAVEL_S = 1.5;

/** An entry of u. */
interface Entry {
  name: string;
  low: number;
  high: number;
  isPrescribed: boolean;
  /** A signal of the scene gives it. */
  isReplaced: boolean;
  wanted: number;
  /** What is sent: on its way to what is wanted. */
  sent: number;
  slider: HTMLInputElement;
  field: HTMLInputElement;
}

let entries: Entry[] = [];
let lease: { plant: string; token: string; stream: AbortController; sequence: bigint } | undefined;
let taking = false;

/** The input that the sliders say, for a step; none for a plant without inputs. */
export function input(): number[] {
  for (const entry of entries) entry.sent = entry.wanted;
  return entries.map(({ wanted }) => wanted);
}

/** Adds the section. */
export function inputs(): void {
  const part = section("inputs", "Inputs", true);
  const take = h("button", { type: "button", id: "lease" }, "Take control");
  const zero = h("button", { type: "button" }, "Zero");
  const hint = h("p", { class: "hint", id: "lease-hint" });
  const sliders = h("div", { class: "body", id: "sliders" });
  sliders.style.padding = "0";
  fill(part.body, sliders, h("div", { class: "row" }, take, zero), hint);
  take.addEventListener("click", () => (lease ? giveBack() : void takeLease()));
  zero.addEventListener("click", () => {
    for (const entry of entries) if (!entry.isPrescribed) want(entry, 0);
  });

  let before = "";
  app.subject.on((subject) => {
    const key = subject?.plant ? JSON.stringify([subject.plant, subject.model.name, subject.model.inputs]) : "";
    if (key === before) return;
    before = key;
    if (lease) giveBack();
    entries = subject?.plant ? make(subject.model, subject.drawing.sizeM) : [];
    fill(sliders, ...entries.map(row));
    part.root.hidden = entries.length === 0;
  });

  const show = (): void => {
    const info = app.info.get();
    const lockstep = (info?.run?.settings?.pace ?? Pace.LOCKSTEP) === Pace.LOCKSTEP;
    const other = !lease && (info?.driver ?? "") !== "" ? (info?.driver ?? "") : "";
    take.hidden = lockstep && !lease;
    take.textContent = lease ? "Give back" : "Take control";
    take.classList.toggle("main", !lease);
    take.disabled = other !== "";
    for (const { slider, field, isReplaced } of entries) slider.disabled = field.disabled = other !== "" || isReplaced;
    part.badge(lease ? "you drive" : other !== "" ? `held by ${other === "link" ? "the link" : `a ${other}`}` : lockstep ? "lockstep" : "free", lease ? "on" : undefined);
    hint.textContent = lease
      ? "This page holds the lease; nobody else can drive until it is given back."
      : other !== ""
        ? "Somebody else drives the plant. Watch, or push."
        : lockstep
          ? "Step takes these inputs. Run the plant to drive it live."
          : "Moving a slider takes the lease.";
  };
  app.info.on((info) => {
    // In lockstep the lease is each step's own.
    if (lease && info?.run && info.run.settings?.pace === Pace.LOCKSTEP) giveBack();
    show();
  });
  app.drives.on(show);
  app.latest.on((moment) => {
    // Until somebody moves them, prescribed coordinates are wanted where they are.
    const first = (moment?.q.length ?? 0) - entries.filter(({ isPrescribed }) => isPrescribed).length;
    if (!moment || lease) return;
    let index = first;
    for (const entry of entries) {
      const value = entry.isPrescribed ? moment.q[index++] : undefined;
      if (value === undefined || document.activeElement === entry.slider || document.activeElement === entry.field) continue;
      entry.wanted = entry.sent = value;
      showValue(entry);
    }
  });
  setInterval(() => void send(), SEND_MS);
}

function make(model: Model, size: number): Entry[] {
  const limits = new Map(model.inputLimits.map(({ uIndex, limits }) => [uIndex, limits]));
  const replaced = new Set(model.signals.filter(({ replaces }) => replaces).map(({ uIndex }) => uIndex));
  const prescribed = model.coordinates.filter(({ prescribed }) => prescribed);
  const of = (name: string, index: number, low: number, high: number, wanted: number, isPrescribed: boolean): Entry => {
    const range = limits.get(index) ?? { low, high };
    const common = { min: range.low, max: range.high, step: "any", value: wanted };
    return {
      name,
      low: range.low,
      high: range.high,
      isPrescribed,
      isReplaced: replaced.has(index),
      wanted,
      sent: wanted,
      slider: h("input", { type: "range", ...common, "aria-label": name }),
      field: h("input", { type: "number", step: "any", value: Number(wanted.toPrecision(4)), "aria-label": `${name}, value` }),
    };
  };
  return [
    ...model.inputs.map((name, index) => of(name, index, -RANGE, RANGE, 0, false)),
    ...prescribed.map(({ name, initial, limits: own }, index) => {
      const reach = REACH * (size || 1);
      return of(name, model.inputs.length + index, own?.low ?? initial - reach, own?.high ?? initial + reach, initial, true);
    }),
  ];
}

function row(entry: Entry): HTMLElement {
  const { slider, field, name, low, high } = entry;
  slider.addEventListener("input", () => want(entry, Number(slider.value)));
  slider.addEventListener("dblclick", () => want(entry, entry.isPrescribed ? entry.wanted : 0));
  field.addEventListener("change", () => {
    const value = Number(field.value.replace("−", "-"));
    if (Number.isFinite(value)) want(entry, value);
  });
  const ends = h("div", { class: "ends" }, h("span", {}, number(low, 3)), entry.isReplaced ? h("span", {}, "given by a signal of the scene") : null, h("span", {}, number(high, 3)));
  return h("div", { class: "slider" }, h("span", { class: "name", title: name }, name), field, slider, ends);
}

function showValue(entry: Entry): void {
  entry.slider.value = String(entry.wanted);
  if (document.activeElement !== entry.field) entry.field.value = String(Number(entry.wanted.toPrecision(4)));
}

/** Wants another value, and takes the lease for it where one is needed. */
function want(entry: Entry, value: number): void {
  entry.wanted = value;
  showValue(entry);
  if (!lease) void takeUnlessLockstep();
}

async function takeUnlessLockstep(): Promise<void> {
  if (!app.info.get()?.run) await look();
  const run = app.info.get()?.run;
  if (run && run.settings?.pace !== Pace.LOCKSTEP) await takeLease();
}

/** Takes the lease, and holds it until it is given back. */
async function takeLease(): Promise<void> {
  const plant = current();
  if (taking || lease || plant === "") return;
  taking = true;
  const stream = new AbortController();
  let free: (() => void) | undefined;
  try {
    free = await place("hold");
    if (!free) {
      complain("Two windows of this browser drive already: give the lease back in one of them.");
      return;
    }
    for await (const { leaseToken } of plants.hold({ id: plant }, { signal: stream.signal })) {
      taking = false;
      if (plant !== current()) break;
      lease = { plant, token: leaseToken, stream, sequence: 0n };
      app.drives.set(true);
      void look();
    }
    if (lease?.stream === stream) complain("The server has taken the lease back.");
  } catch (error) {
    if (!isCanceled(error)) complain(`Lease: ${words(error)}`);
  } finally {
    stream.abort();
    free?.();
    taking = false;
    if (lease?.stream === stream) lease = undefined;
    app.drives.set(lease !== undefined);
    void look();
  }
}

/** Gives the lease back. */
export function giveBack(): void {
  const stream = lease?.stream;
  lease = undefined;
  app.drives.set(false);
  stream?.abort();
  for (const entry of entries) {
    if (entry.isPrescribed) continue;
    entry.wanted = entry.sent = 0;
    showValue(entry);
  }
}

let busy = false;
let last = "";

/** Sends the input when it has changed. */
async function send(): Promise<void> {
  if (!lease || busy) return;
  for (const entry of entries) {
    const most = entry.isPrescribed ? ((entry.high - entry.low) * SEND_MS) / 1000 / TRAVEL_S : Infinity;
    entry.sent += Math.max(-most, Math.min(most, entry.wanted - entry.sent));
  }
  const u = entries.map(({ sent }) => sent);
  const key = lease.token + u.join();
  if (key === last) return;
  busy = true;
  const mine = lease;
  try {
    await plants.setInput({ id: mine.plant, leaseToken: mine.token, u, sequence: ++mine.sequence });
    last = key;
  } catch (error) {
    if (lease === mine) {
      complain(`Input: ${words(error)}`);
      giveBack();
    }
  } finally {
    busy = false;
  }
}
