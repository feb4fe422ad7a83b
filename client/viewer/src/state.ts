// What the page knows, in values that tell when they change.

import type { Drawing, Poses } from "./gen/plantd/v1/drawing_pb.js";
import type { Model } from "./gen/plantd/v1/model_service_pb.js";
import type { PlantInfo, Poles } from "./gen/plantd/v1/plant_service_pb.js";
import type { StepTiming } from "./gen/plantd/v1/realtime_pb.js";

/** A value with listeners. */
export class Value<T> {
  #listeners = new Set<(value: T) => void>();
  #value: T;

  constructor(value: T) {
    this.#value = value;
  }

  get(): T {
    return this.#value;
  }

  /** Sets it, and tells even if it is the same: contents may have changed. */
  set(value: T): void {
    this.#value = value;
    for (const listener of this.#listeners) listener(value);
  }

  /** Listens, and is told the present value at once. */
  on(listener: (value: T) => void): void {
    this.#listeners.add(listener);
    listener(this.#value);
  }
}

/** One state of what is shown. */
export interface Moment {
  step: number;
  time: number;
  q: number[];
  velocity: number[];
  /** Input in force. */
  u: number[];
  /** Numbers of the output channels. */
  outputs: number[];
  kinetic: number;
  potential: number;
  poses: Poses | undefined;
  poles: Poles | undefined;
  timing: StepTiming | undefined;
}

/** What is shown: a plant or a recording. */
export interface Subject {
  title: string;
  /** Id of the plant; empty for a recording. */
  plant: string;
  model: Model;
  drawing: Drawing;
  /** Names of the numbers of `outputs`. */
  outputs: string[];
  timeStep: number;
}

/** How it stands with the server; `turns`: a state now and then, because other windows watch. */
export type Connection = "connecting" | "live" | "turns" | "lost" | "hidden" | "none";

/** A message to the person at the page. */
export interface Notice {
  text: string;
  kind: "error" | "info";
}

/** The state of the page. */
export const app = {
  plants: new Value<PlantInfo[]>([]),
  /** The plant that is shown, as it was told last. */
  info: new Value<PlantInfo | null>(null),
  subject: new Value<Subject | null>(null),
  /** The newest state of it. */
  latest: new Value<Moment | null>(null),
  /** The state on the screen: the newest one, or that at the held cursor. */
  shown: new Value<Moment | null>(null),
  /** Time at which the plots' cursor is held, s. */
  held: new Value<number | null>(null),
  connection: new Value<Connection>("connecting"),
  notice: new Value<Notice | null>(null),
  /** Whether poles are wanted. */
  wantsPoles: new Value<boolean>(false),
  /** This page holds the lease. */
  drives: new Value<boolean>(false),
};

const recording = new URLSearchParams(location.search).get("recording");
/** Address of a recording that is shown without a server of plants; null elsewhere, where recordings have names. */
export const alone = recording !== null && !/^[a-z0-9-]{1,63}$/.test(recording) ? recording : null;

/** Says something that went wrong, in words. */
export function complain(text: string): void {
  app.notice.set({ text, kind: "error" });
}

/** Says something that is worth knowing. */
export function inform(text: string): void {
  app.notice.set({ text, kind: "info" });
}

/** A choice that outlives the page, in this browser. */
export function remembered(key: string, fallback: string): string {
  try {
    return localStorage.getItem(`plantd.${key}`) ?? fallback;
  } catch {
    return fallback; // Storage is switched off: choices last as long as the page.
  }
}

/** Remembers a choice. */
export function remember(key: string, value: string): void {
  try {
    localStorage.setItem(`plantd.${key}`, value);
  } catch {
    // As above.
  }
}
