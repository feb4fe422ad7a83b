// What the plots show: signals over time, gathered from states as they come.

import { type Model, Unit } from "./gen/plantd/v1/model_service_pb.js";
import type { Moment, Subject } from "./state.js";

/** Numbers that are kept; beyond, the older half is forgotten. */
const NUMBERS_MAX = 6_000_000;
/** States that are kept at most. */
const STATES_MAX = 60_000;

/** One curve. */
export interface Signal {
  name: string;
  /** Its value in a state. */
  of(moment: Moment): number;
}

/** Curves of one unit, which share an axis. */
export interface Group {
  key: string;
  title: string;
  unit: string;
  signals: Signal[];
  /** Shown unless it was asked otherwise. */
  isShown: boolean;
}

function coordinates(model: Model, unit: Unit): { name: string; index: number }[] {
  return model.coordinates.map(({ name, unit }, index) => ({ name, unit, index })).filter((each) => each.unit === unit);
}

/** What can be plotted of a subject. */
export function groups(subject: Subject): Group[] {
  const { model, outputs } = subject;
  const all: Group[] = [];
  const add = (key: string, title: string, unit: string, isShown: boolean, signals: Signal[]): void => {
    if (signals.length > 0) all.push({ key, title, unit, isShown, signals });
  };
  const angles = coordinates(model, Unit.RADIAN);
  const positions = coordinates(model, Unit.METRE);
  add("angles", "Angles", "rad", true, angles.map(({ name, index }) => ({ name, of: ({ q }) => q[index] ?? NaN })));
  add("positions", "Positions", "m", true, positions.map(({ name, index }) => ({ name, of: ({ q }) => q[index] ?? NaN })));
  add("energy", "Energy", "J", true, [
    { name: "total", of: ({ kinetic, potential }) => kinetic + potential },
    { name: "kinetic", of: ({ kinetic }) => kinetic },
    { name: "potential", of: ({ potential }) => potential },
  ]);
  add("inputs", "Inputs", "N, N m", model.inputs.length > 0, model.inputs.map((name, index) => ({ name, of: ({ u }) => u[index] ?? NaN })));
  add("outputs", "Sensors", "", true, outputs.map((name, index) => ({ name, of: ({ outputs }) => outputs[index] ?? NaN })));
  add("rates", "Angular velocities", "rad/s", false, angles.map(({ name, index }) => ({ name, of: ({ velocity }) => velocity[index] ?? NaN })));
  add("velocities", "Velocities", "m/s", false, positions.map(({ name, index }) => ({ name, of: ({ velocity }) => velocity[index] ?? NaN })));
  return all;
}

/** States in the order of their time. */
export class History {
  readonly moments: Moment[] = [];

  /** Adds a state; one that lies before the last begins anew. */
  add(moment: Moment): void {
    const last = this.moments.at(-1);
    if (last && (moment.time < last.time || moment.step < last.step)) this.moments.length = 0;
    if (last && moment.step === last.step && moment.time === last.time) this.moments.pop();
    this.moments.push(moment);
    const numbers = moment.q.length * 2 + moment.u.length + moment.outputs.length + (moment.poses ? moment.poses.frames.length + moment.poses.points.length + moment.poses.arrows.length : 0);
    const most = Math.min(STATES_MAX, Math.max(600, NUMBERS_MAX / Math.max(numbers, 1)));
    if (this.moments.length > most) this.moments.splice(0, this.moments.length >> 1);
  }

  clear(): void {
    this.moments.length = 0;
  }

  /** Index of the last state at a time or before it; −1 before the first. */
  before(time: number): number {
    let [low, high] = [0, this.moments.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.moments[middle]!.time <= time + 1e-12) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  /** The state that is nearest to a time. */
  nearest(time: number): Moment | undefined {
    const index = this.before(time);
    const [a, b] = [this.moments[index], this.moments[index + 1]];
    if (!a || !b) return a ?? b;
    return time - a.time <= b.time - time ? a : b;
  }
}
