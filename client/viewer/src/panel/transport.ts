// Run, pause, step, speed, reset: the bar at the head of the page.

import { attempt, plants } from "../api.js";
import { byId, fill, h, icon, options, write } from "../dom.js";
import { count, number } from "../format.js";
import { Pace } from "../gen/plantd/v1/realtime_pb.js";
import { current, look } from "../live.js";
import { app } from "../state.js";
import { input } from "./inputs.js";

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10];

const speed = h("select", { "aria-label": "Speed", title: "Speed" });
const pace = h("select", { class: "wide", "aria-label": "Who decides when a step is taken", title: "Pace" });
const reset = h("select", { class: "wide", id: "reset", "aria-label": "Reset to", title: "Reset" });
const main = h("button", { type: "button", class: "main icon", id: "run" });
const one = h("button", { type: "button", class: "icon", id: "step", "aria-label": "One step", title: "One step (.)" }, icon("step"));

/** The plant takes steps by itself now. */
function isRunning(): boolean {
  const run = app.info.get()?.run;
  return run !== undefined && run.running && run.settings?.pace !== Pace.LOCKSTEP;
}

/** Runs the plant by the wall clock or as before, or pauses it. */
export async function toggleRun(): Promise<void> {
  const id = current();
  const settings = app.info.get()?.run?.settings;
  if (id === "") return;
  await attempt("Run", async () => {
    if (isRunning()) await plants.pause({ id });
    else if (settings && settings.pace !== Pace.LOCKSTEP) await plants.run({ id });
    else await plants.run({ id, settings: { pace: Pace.PACED, speed: Number(speed.value) || 1 } });
  });
  await look();
}

/** Takes one step. */
export async function step(): Promise<void> {
  const id = current();
  if (id === "" || isRunning()) return;
  await attempt("Step", async () => {
    if ((app.info.get()?.run?.settings?.pace ?? Pace.LOCKSTEP) !== Pace.LOCKSTEP) {
      await plants.run({ id, steps: 1n, wait: true });
      return;
    }
    const data = input();
    await plants.step(data.length > 0 ? { id, u: { rows: 1, cols: data.length, data } } : { id, hold: 1 });
  });
  await look();
}

/** Puts the plant back: to where it began, or to rest at an operating point. */
export async function resetTo(point: string): Promise<void> {
  const id = current();
  if (id === "") return;
  const initial = point === "" ? {} : { initial: { form: { case: "operatingPoint" as const, value: point } } };
  await attempt("Reset", () => plants.reset({ id, ...initial }));
  await look();
}

async function change(): Promise<void> {
  const id = current();
  const { input: policy } = app.info.get()?.run?.settings ?? {};
  const chosen = Number(pace.value) as Pace;
  const settings = { pace: chosen, speed: chosen === Pace.FREE ? 0 : Number(speed.value), ...(policy && chosen !== Pace.LOCKSTEP ? { input: policy } : {}) };
  const wasPaused = !isRunning() && chosen !== Pace.LOCKSTEP;
  await attempt("Run", async () => {
    await plants.run({ id, settings });
    if (wasPaused) await plants.pause({ id });
  });
  await look();
}

/** Fills the bar and the readings. */
export function transport(): void {
  options(pace, [
    [String(Pace.LOCKSTEP), "Lockstep"],
    [String(Pace.PACED), "Real time"],
    [String(Pace.FREE), "As fast as possible"],
  ]);
  options(speed, SPEEDS.map((value) => [String(value), `${value}×`]));
  speed.value = "1";
  main.addEventListener("click", () => void toggleRun());
  one.addEventListener("click", () => void step());
  pace.addEventListener("change", () => void change());
  speed.addEventListener("change", () => pace.value === String(Pace.PACED) && void change());
  reset.addEventListener("change", () => {
    const [kind, point = ""] = reset.value.split(/:(.*)/s);
    reset.value = "";
    if (kind === "to") void resetTo(point);
  });
  fill(byId("transport"), main, one, pace, speed, reset);

  app.subject.on((subject) => {
    byId("transport").hidden = !subject?.plant;
    const points = subject?.model.operatingPoints ?? [];
    options(reset, [["", "Reset…"], ["to:", "Initial state"], ...points.map((name): [string, string] => [`to:${name}`, `At rest, ${name}`])]);
  });
  app.info.on((info) => {
    const running = isRunning();
    const word = running ? "Pause" : "Run";
    if (main.getAttribute("aria-label") !== word) {
      fill(main, icon(running ? "pause" : "play"));
      main.setAttribute("aria-label", word);
      main.title = `${word} (space)`;
    }
    one.disabled = running;
    const settings = info?.run?.settings;
    if (settings && document.activeElement !== pace) pace.value = String(settings.pace);
    if (settings && document.activeElement !== speed && settings.speed > 0) {
      if (!SPEEDS.includes(settings.speed) && ![...speed.options].some(({ value }) => Number(value) === settings.speed)) speed.add(new Option(`${number(settings.speed, 3)}×`, String(settings.speed)));
      speed.value = String(settings.speed);
    }
    speed.disabled = settings?.pace === Pace.FREE;
  });

  const [time, energy, steps] = [h("dd", { id: "time" }), h("dd", {}), h("dd", { id: "steps" })];
  fill(byId("readings"), h("div", {}, h("dt", {}, "t"), time), h("div", {}, h("dt", {}, "E"), energy), h("div", { class: "less" }, h("dt", {}, "step"), steps));
  app.shown.on((moment) => {
    const total = moment ? moment.kinetic + moment.potential : NaN;
    write(time, moment ? `${moment.time.toFixed(2)} s` : "–");
    write(energy, Number.isFinite(total) ? `${number(total, 4)} J` : "–");
    write(steps, moment ? count(moment.step) : "–");
  });
}
