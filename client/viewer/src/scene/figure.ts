// A mechanism: the frames of a drawing with their shapes, its lines and its arrows.

import { AxesHelper, Color, Group, InstancedMesh, LineSegments, Mesh, type MeshStandardMaterial, type Object3D } from "three";
import type { DrawnShape, Drawing, Poses } from "../gen/plantd/v1/drawing_pb.js";
import { color } from "../theme.js";
import { Arrows } from "./arrows.js";
import { Lines } from "./lines.js";
import { material, shapeObject } from "./shapes.js";

/** What of a mechanism is shown. */
export interface Parts {
  links: boolean;
  axes: boolean;
  inputs: boolean;
  forces: boolean;
}

/** How it is painted: as itself, or as what another one is compared with. */
export type Style = "solid" | "ghost";

/** A mechanism in the scene. */
export class Figure {
  readonly object = new Group();
  readonly frames: Group[] = [];
  readonly lines: Lines;
  readonly arrows: Arrows;
  #axes: AxesHelper[] = [];
  #indices = new Map<string, number>();
  #lit: { mesh: Mesh; material: Mesh["material"] }[] = [];
  #bright: MeshStandardMaterial;

  constructor(
    readonly drawing: Drawing,
    style: Style,
    private readonly changed: () => void,
  ) {
    const ghost = style === "ghost";
    const plain = new Color(color(ghost ? "accent" : "body"));
    const inertia = material(plain, ghost ? 0.22 : 1);
    // A box that only stands for an inertia hides nothing.
    const stand = material(plain, ghost ? 0.12 : 0.32);
    stand.depthWrite = false;
    const paint = (shape: DrawnShape): MeshStandardMaterial => {
      if (shape.standsForInertia && shape.shape.case === "box") return stand;
      const [red, green, blue, opacity = 1] = shape.color;
      if (ghost || red === undefined || green === undefined || blue === undefined) return inertia;
      return material(new Color().setRGB(red, green, blue, "srgb"), opacity);
    };
    this.#bright = material(new Color(color("accent")), 1);
    for (const [index, frame] of drawing.frames.entries()) {
      const group = new Group();
      group.name = frame.name;
      group.matrixAutoUpdate = false;
      for (const shape of frame.shapes) group.add(shapeObject(shape, paint, changed));
      const axes = new AxesHelper(0.08 * (drawing.sizeM || 1));
      axes.visible = false;
      this.#axes.push(axes);
      group.add(axes);
      this.#indices.set(frame.name, index);
      this.frames.push(group);
      this.object.add(group);
    }
    this.lines = new Lines(drawing, {
      link: material(new Color(color(ghost ? "accent" : "rod")), ghost ? 0.22 : 1),
      spring: color(ghost ? "accent" : "spring"),
      constraint: color(ghost ? "accent" : "string"),
      path: color(ghost ? "accent" : "path"),
      opacity: ghost ? 0.4 : 1,
    });
    this.arrows = new Arrows(drawing, material(new Color(color("accent")), 1), material(new Color(color("force")), 1));
    this.arrows.object.visible = !ghost;
    this.object.add(this.lines.object, this.arrows.object);
    this.object.visible = false; // Until it is known where everything is.
  }

  /** Puts everything where it is. */
  update(poses: Poses): void {
    this.object.visible = true;
    const { frames } = poses;
    this.frames.forEach((group, index) => {
      const at = 7 * index;
      group.position.set(frames[at]!, frames[at + 1]!, frames[at + 2]!);
      group.quaternion.set(frames[at + 4]!, frames[at + 5]!, frames[at + 6]!, frames[at + 3]!);
      group.updateMatrix();
    });
    if (poses.points.length > 0) this.lines.update(poses.points);
    this.arrows.update(poses.arrows);
  }

  /** Shows and hides parts. */
  show(parts: Parts): void {
    this.lines.object.visible = parts.links;
    for (const axes of this.#axes) axes.visible = parts.axes;
    this.arrows.inputs.object.visible = parts.inputs;
    this.arrows.constraints.object.visible = parts.forces;
    this.changed();
  }

  /** Index of a frame; none for `world` and frames without anything to show. */
  frame(name: string): number | undefined {
    return this.#indices.get(name);
  }

  /** The frame to which a part belongs that was hit. */
  frameOf(object: Object3D, instance: number | undefined): number | undefined {
    if (object === this.lines.rods && instance !== undefined) {
      const name = this.lines.rodNames[instance];
      return name === undefined ? undefined : this.#indices.get(name);
    }
    for (let part: Object3D | null = object; part; part = part.parent) {
      const index = this.frames.indexOf(part as Group);
      if (index >= 0) return index;
    }
    return undefined;
  }

  /** Paints one frame in the accent colour, or none. */
  light(index: number | undefined): void {
    for (const { mesh, material: before } of this.#lit) mesh.material = before;
    this.#lit = [];
    if (index !== undefined) {
      this.frames[index]?.traverse((part) => {
        if (!(part instanceof Mesh) || part instanceof InstancedMesh) return;
        this.#lit.push({ mesh: part, material: part.material });
        part.material = this.#bright;
      });
    }
    this.changed();
  }

  /** Forgets what the graphics card holds. */
  dispose(): void {
    this.light(undefined);
    this.lines.dispose();
    this.arrows.dispose();
    this.object.traverse((part) => {
      if (!(part instanceof Mesh || part instanceof LineSegments) || part instanceof InstancedMesh) return;
      part.geometry.dispose();
      for (const each of [part.material].flat()) each.dispose();
    });
    for (const axes of this.#axes) axes.dispose();
    this.object.removeFromParent();
  }
}
