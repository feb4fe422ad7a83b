// Pushing a body: who drags a point of it pulls that point towards the pointer.

import { Vector3 } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { attempt, channels, words } from "../api.js";
import type { Poses } from "../gen/plantd/v1/drawing_pb.js";
import { Pace } from "../gen/plantd/v1/realtime_pb.js";
import { app, complain, inform } from "../state.js";
import { color } from "../theme.js";
import { intoFrame, intoWorld, type Vector } from "./poses.js";
import type { Hit, View } from "./view.js";

/** From one push to the next, ms. */
const RENEW_MS = 40;
/** How long a push lasts unless it is renewed, s of the wall clock: the page may be closed meanwhile. */
const LASTS_S = 0.25;
/** Force at a distance of the mechanism's size, in weights of what is pulled. */
const WEIGHTS = 12;
const GRAVITY = 9.81;

interface Drag {
  plant: string;
  pointer: number;
  frame: number;
  name: string;
  /** The grabbed point in the frame. */
  at: Vector;
  target: Vector3;
  mass: number;
  fault: bigint;
  timer: number;
  ended: boolean;
}

/** Lets bodies be pushed in a view. `label` is told what is under the pointer. */
export function pushing(view: View, label: (text: string, x: number, y: number) => void): void {
  const cord = new LineSegments2(new LineSegmentsGeometry(), new LineMaterial({ linewidth: 2.5, depthTest: false }));
  cord.frustumCulled = false;
  cord.renderOrder = 1;
  cord.visible = false;
  view.scene.add(cord);
  let drag: Drag | undefined;
  let hover: PointerEvent | undefined;

  const grabbed = (): Vector3 | undefined => {
    const poses = app.shown.get()?.poses;
    return drag && poses ? new Vector3(...intoWorld(poses, drag.frame, drag.at)) : undefined;
  };

  const showCord = (): void => {
    const from = grabbed();
    cord.visible = drag !== undefined && from !== undefined;
    if (!drag || !from) return;
    cord.geometry.setPositions([...from.toArray(), ...drag.target.toArray()]);
    cord.material.color.set(color("accent"));
    view.invalidate();
  };
  app.shown.on(showCord);

  const begin = (event: PointerEvent, { frame, point }: Hit, poses: Poses): void => {
    const subject = app.subject.get();
    const drawn = subject?.drawing.frames[frame];
    if (!subject || !drawn) return;
    const all = subject.drawing.frames.reduce((sum, { massKg }) => sum + massKg, 0);
    const mine: Drag = {
      plant: subject.plant,
      pointer: event.pointerId,
      frame,
      name: drawn.name,
      at: intoFrame(poses, frame, point.toArray() as Vector),
      target: point,
      mass: Math.max(drawn.massKg, 0.1 * all) || 1,
      fault: 0n,
      timer: 0,
      ended: false,
    };
    drag = mine;
    view.canvas.setPointerCapture(event.pointerId);
    view.figure?.light(frame);
    const run = app.info.get()?.run;
    if (!run?.running || run.settings?.pace === Pace.LOCKSTEP) inform("The plant stands still: it feels the push when it runs.");
    const renew = async (): Promise<void> => {
      await push(mine, grabbed() ?? point, subject.drawing.sizeM || 1);
      if (!mine.ended) mine.timer = setTimeout(() => void renew(), RENEW_MS);
      else void release(mine);
    };
    void renew();
    showCord();
  };

  const end = (event: PointerEvent): void => {
    if (!drag || event.pointerId !== drag.pointer) return;
    drag.ended = true;
    clearTimeout(drag.timer);
    void release(drag);
    drag = undefined;
    view.figure?.light(undefined);
    showCord();
  };

  // Before the camera's own listeners, which must not turn it while a body is dragged.
  view.canvas.addEventListener(
    "pointerdown",
    (event) => {
      const poses = app.shown.get()?.poses;
      if (event.button !== 0 || event.shiftKey || event.ctrlKey || event.metaKey || !poses || !app.subject.get()?.plant || app.held.get() !== null) return;
      const hit = view.pick(event.clientX, event.clientY);
      if (!hit) return;
      event.stopImmediatePropagation();
      event.preventDefault();
      view.canvas.focus();
      begin(event, hit, poses);
    },
    { capture: true },
  );
  view.canvas.addEventListener("pointermove", (event) => {
    if (!drag) {
      if (hover === undefined) requestAnimationFrame(look);
      hover = event;
      return;
    }
    if (event.pointerId !== drag.pointer) return;
    const from = grabbed();
    if (from) drag.target = view.reach(event.clientX, event.clientY, from) ?? drag.target;
    showCord();
  });
  view.canvas.addEventListener("pointerup", end);
  view.canvas.addEventListener("pointercancel", end);
  view.canvas.addEventListener("pointerleave", () => {
    hover = undefined;
    if (!drag) label("", 0, 0);
  });

  let lit: number | undefined;
  function look(): void {
    const event = hover;
    hover = undefined;
    if (drag || !event || event.buttons !== 0) return;
    const hit = view.pick(event.clientX, event.clientY);
    label(hit ? (app.subject.get()?.drawing.frames[hit.frame]?.name ?? "") : "", event.clientX, event.clientY);
    view.canvas.classList.toggle("grabs", hit !== undefined);
    if (hit?.frame !== lit) view.figure?.light(hit?.frame);
    lit = hit?.frame;
  }
}

/** Takes the push before away and gives the next one. */
async function push(drag: Drag, from: Vector3, size: number): Promise<void> {
  const stiffness = (WEIGHTS * drag.mass * GRAVITY) / size;
  const force = drag.target.clone().sub(from).multiplyScalar(stiffness).toArray();
  const speed = app.info.get()?.run?.settings?.speed || 1;
  await clear(drag);
  if (drag.ended) return;
  try {
    const push = { point: { frame: drag.name, at: drag.at }, force, torque: [] };
    const fault = { kind: { case: "push" as const, value: push }, durationS: LASTS_S * speed };
    const answer = await channels.injectFault({ id: drag.plant, fault });
    drag.fault = answer.fault?.id ?? 0n;
  } catch (error) {
    drag.ended = true;
    complain(`Push: ${words(error)}`);
  }
}

async function clear(drag: Drag): Promise<void> {
  const { fault } = drag;
  if (fault === 0n) return;
  drag.fault = 0n;
  try {
    await channels.clearFault({ id: drag.plant, faultId: fault });
  } catch {
    // It has ended by itself, or the plant has: either way it pushes no more.
  }
}

async function release(drag: Drag): Promise<void> {
  await attempt("Push", () => clear(drag));
}
