// Recordings: MCAP files as plantd writes them, read in the browser.

import { create, createFileRegistry, fromBinary, type DescMessage, type Message } from "@bufbuild/protobuf";
import { FileDescriptorSetSchema } from "@bufbuild/protobuf/wkt";
import { McapStreamReader } from "@mcap/core";
import { type Drawing, LineKind, type Poses, PosesSchema } from "./gen/plantd/v1/drawing_pb.js";
import { PlantRecordSchema, type StepRecord, StepRecordSchema } from "./gen/plantd/v1/recording_pb.js";
import { multiply, rotate, type Vector } from "./scene/poses.js";
import type { Moment, Subject } from "./state.js";

/** Files that are larger are not read into a browser's memory. */
const BYTES_MAX = 1 << 30;
/** Records of one kind that are kept. */
const RECORDS_MAX = 4_000_000;

/** A message of the file that is decoded when it is asked for. */
interface Entry {
  time: number;
  data: Uint8Array;
}

/** foxglove.FrameTransforms, as far as it is read. */
interface Transforms {
  transforms: {
    parentFrameId: string;
    childFrameId: string;
    translation?: { x: number; y: number; z: number };
    rotation?: { x: number; y: number; z: number; w: number };
  }[];
}

/** plantd.Signals, as far as it is read. */
interface Signals {
  energy?: { kinetic: number; potential: number };
}

type Triple = { x: number; y: number; z: number };

/** foxglove.SceneUpdate, as far as it is read: lines and arrows in the order of the drawing. */
interface SceneUpdate {
  entities: {
    id: string;
    metadata: { key: string; value: string }[];
    lines: { points: Triple[] }[];
    arrows: { pose?: { position?: Triple; orientation?: Triple & { w: number } }; shaftLength: number; headLength: number }[];
  }[];
}

/** Name of the entity that has the lines and arrows. */
const LINES = "lines";

/** A recording that can be looked at step by step. */
export class Recording {
  #steps: Entry[] = [];
  #transforms: Entry[] = [];
  #scenes: Entry[] = [];
  #signals: Entry[] = [];
  #types = new Map<string, DescMessage | undefined>();
  readonly subject: Subject;

  constructor(name: string, bytes: Uint8Array) {
    if (bytes.length > BYTES_MAX) throw new Error(`has ${bytes.length} bytes; at most ${BYTES_MAX} are read here`);
    const reader = new McapStreamReader({
      validateCrcs: false,
      decompressHandlers: {},
    });
    reader.append(bytes);
    const topics = new Map<number, string>();
    const schemas = new Map<number, { name: string; data: Uint8Array }>();
    let plant: Subject | undefined;
    for (let record = reader.nextRecord(); record; record = reader.nextRecord()) {
      if (record.type === "Schema") schemas.set(record.id, record);
      else if (record.type === "Channel") {
        topics.set(record.id, record.topic);
        if (["/tf", "/scene", "/signals"].includes(record.topic)) this.#types.set(record.topic, type(schemas.get(record.schemaId)));
      } else if (record.type === "Message") {
        const topic = topics.get(record.channelId);
        const entry = { time: Number(record.publishTime) / 1e9, data: record.data };
        if (topic === "/plant") plant = describe(name, record.data);
        else if (topic === "/step" && this.#steps.length < RECORDS_MAX) this.#steps.push(entry);
        else if (topic === "/tf" && this.#transforms.length < RECORDS_MAX) this.#transforms.push(entry);
        else if (topic === "/signals" && this.#signals.length < RECORDS_MAX) this.#signals.push(entry);
        else if (topic === "/scene" && this.#scenes.length < RECORDS_MAX) this.#scenes.push(entry);
      }
    }
    if (!plant) throw new Error("is no recording of plantd: it has no topic /plant");
    if (this.#steps.length === 0) throw new Error("holds no step");
    this.subject = plant;
  }

  /** Number of steps in it. */
  get length(): number {
    return this.#steps.length;
  }

  /** Plant time of a step of the file, s. */
  time(index: number): number {
    return this.#steps[index]?.time ?? 0;
  }

  /** Index of the last step at a time or before it; the first one before that. */
  at(time: number): number {
    return Math.max(0, before(this.#steps, time));
  }

  /** A step of the file, with the poses that were recorded last before it. */
  moment(index: number): Moment | undefined {
    const entry = this.#steps[index];
    if (!entry) return undefined;
    const record: StepRecord = fromBinary(StepRecordSchema, entry.data);
    const time = record.state?.timeS ?? entry.time;
    return {
      step: Number(record.state?.step ?? 0n),
      time,
      q: record.state?.q ?? [],
      velocity: record.state?.velocity ?? [],
      u: record.u,
      outputs: record.outputs?.y ?? [],
      ...this.#energy(time),
      poses: this.#poses(time),
      poles: undefined,
      timing: record.timing,
    };
  }

  /** Some hundred steps from the first to the last, for plots. */
  overview(most: number): Moment[] {
    const stride = Math.max(1, Math.ceil(this.length / most));
    const moments: Moment[] = [];
    for (let index = 0; index < this.length; index += stride) {
      const moment = this.moment(index);
      if (moment) moments.push({ ...moment, poses: undefined });
    }
    return moments;
  }

  /** The energy that was recorded last, J. */
  #energy(time: number): { kinetic: number; potential: number } {
    const energy = this.#decode<Signals>("/signals", this.#signals, time)?.energy;
    return { kinetic: energy?.kinetic ?? NaN, potential: energy?.potential ?? NaN };
  }

  #poses(time: number): Poses | undefined {
    const transforms = this.#decode<Transforms>("/tf", this.#transforms, time);
    if (!transforms) return undefined;
    const scene = this.#decode<SceneUpdate>("/scene", this.#scenes, time);
    const poses = assemble(this.subject.drawing, transforms.transforms);
    const moving = scene?.entities.find(({ id }) => id === LINES);
    if (moving) overlay(this.subject.drawing, poses, moving);
    return poses;
  }

  /** The last message of a topic at a time or before it; the first one before that. */
  #decode<T>(topic: string, entries: Entry[], time: number): T | undefined {
    const entry = entries[Math.max(0, before(entries, time))];
    const type = this.#types.get(topic);
    return entry && type ? (fromBinary(type, entry.data) as Message & T) : undefined;
  }
}

/** The type of a topic's messages, by the descriptors in the file. */
function type(schema: { name: string; data: Uint8Array } | undefined): DescMessage | undefined {
  return schema && createFileRegistry(fromBinary(FileDescriptorSetSchema, schema.data)).getMessage(schema.name);
}

/** Puts the recorded lines and arrows into poses. */
function overlay(drawing: Drawing, poses: Poses, { lines, arrows, metadata }: SceneUpdate["entities"][number]): void {
  const points = lines.flatMap((line) => line.points.flatMap(({ x, y, z }) => [x, y, z]));
  if (points.length === poses.points.length) poses.points = points;
  const scale = (key: string): number => Number(metadata.find((each) => each.key === key)?.value ?? NaN);
  const [perNewton, perNewtonMetre] = [scale("metres_per_newton"), scale("metres_per_newton_metre")];
  poses.arrows = arrows.flatMap(({ pose, shaftLength, headLength }, index) => {
    const { x = 0, y = 0, z = 0 } = pose?.position ?? {};
    const { w = 1, x: i = 0, y: j = 0, z: k = 0 } = pose?.orientation ?? {};
    const size = (shaftLength + headLength) / (drawing.arrows[index]?.torque ? perNewtonMetre : perNewton);
    return [x, y, z, ...rotate([w, i, j, k], [size, 0, 0])];
  });
}

function before(entries: Entry[], time: number): number {
  let [low, high] = [0, entries.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (entries[middle]!.time <= time + 1e-9) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

function describe(name: string, data: Uint8Array): Subject {
  const record = fromBinary(PlantRecordSchema, data);
  if (!record.model || !record.plant) throw new Error("names no model");
  if (!record.drawing) throw new Error("says nothing of what can be seen: it was made by an older plantd");
  return {
    title: name,
    plant: "",
    model: record.model,
    drawing: record.drawing,
    outputs: record.outputs,
    timeStep: record.plant.settings?.timeStepS ?? record.model.timeStepS,
  };
}

/** Poses of a drawing from transforms between frames; links are drawn from frame to frame. */
function assemble(drawing: Drawing, transforms: Transforms["transforms"]): Poses {
  const known = new Map(transforms.map((each) => [each.childFrameId, each]));
  const world = new Map<string, { position: Vector; orientation: number[] }>();
  const find = (name: string): { position: Vector; orientation: number[] } => {
    const there = world.get(name);
    if (there) return there;
    const step = known.get(name);
    const still = { position: [0, 0, 0] as Vector, orientation: [1, 0, 0, 0] };
    world.set(name, still); // Ends circles.
    if (!step) return still;
    const parent = find(step.parentFrameId);
    const { x = 0, y = 0, z = 0 } = step.translation ?? {};
    const { w = 1, x: i = 0, y: j = 0, z: k = 0 } = step.rotation ?? {};
    const moved = rotate(parent.orientation, [x, y, z]);
    const pose = {
      position: [parent.position[0] + moved[0], parent.position[1] + moved[1], parent.position[2] + moved[2]] as Vector,
      orientation: multiply(parent.orientation, [w, i, j, k]),
    };
    world.set(name, pose);
    return pose;
  };
  const frames = drawing.frames.flatMap(({ name }) => {
    const { position, orientation } = find(name);
    return [...position, ...orientation];
  });
  const parents = new Map(drawing.frames.map(({ name, parent }) => [name, parent]));
  const points: number[] = [];
  for (const { kind, name, points: count } of drawing.lines) {
    const isLink = kind === LineKind.LINK && count === 2 && parents.has(name);
    const [from, to] = isLink ? [find(name).position, find(parents.get(name)!).position] : [[NaN, NaN, NaN], [NaN, NaN, NaN]];
    points.push(...from);
    for (let i = 1; i < count; i++) points.push(...to);
  }
  return create(PosesSchema, { frames, points, arrows: [] });
}
