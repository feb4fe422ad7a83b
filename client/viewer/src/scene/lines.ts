// Lines of a drawing: links as rods, springs as coils, constraints and paths as strokes.

import { CylinderGeometry, DynamicDrawUsage, Group, InstancedMesh, type InstancedInterleavedBuffer, type InterleavedBufferAttribute, Matrix4, type MeshStandardMaterial, Quaternion, Vector3 } from "three";
import { LineMaterial } from "three/addons/lines/LineMaterial.js";
import { LineSegments2 } from "three/addons/lines/LineSegments2.js";
import { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
import { type Drawing, LineKind } from "../gen/plantd/v1/drawing_pb.js";

/** Turns of a coil, and straight pieces in each. */
const TURNS = 9;
const PIECES = 10;

const UP = new Vector3(0, 1, 0);

/** Segments of one width and colour, rewritten for each state. */
class Strokes {
  readonly object: LineSegments2;
  #values: Float32Array;
  #buffer: InstancedInterleavedBuffer;
  #used = 0;

  constructor(segments: number, material: LineMaterial) {
    const geometry = new LineSegmentsGeometry();
    this.#values = new Float32Array(6 * segments);
    geometry.setPositions(this.#values);
    const start = geometry.getAttribute("instanceStart") as InterleavedBufferAttribute;
    this.#buffer = start.data as InstancedInterleavedBuffer;
    this.#buffer.setUsage(DynamicDrawUsage);
    this.#values = this.#buffer.array as Float32Array;
    this.object = new LineSegments2(geometry, material);
    this.object.frustumCulled = false;
  }

  begin(): void {
    this.#used = 0;
  }

  segment(ax: number, ay: number, az: number, bx: number, by: number, bz: number): void {
    this.#values.set([ax, ay, az, bx, by, bz], 6 * this.#used++);
  }

  end(): void {
    this.#buffer.needsUpdate = true;
    this.object.geometry.instanceCount = this.#used;
  }
}

/** Colours of what lines stand for. */
export interface LineColors {
  link: MeshStandardMaterial;
  spring: string;
  constraint: string;
  path: string;
  opacity: number;
}

/** All lines of a drawing. */
export class Lines {
  readonly object = new Group();
  /** Rods of links, and the name of the frame of each. */
  readonly rods: InstancedMesh;
  readonly rodNames: string[] = [];
  #springs: Strokes;
  #constraints: Strokes;
  #paths: Strokes;
  #radius = 0;

  constructor(
    private readonly drawing: Drawing,
    colors: LineColors,
  ) {
    let rods = 0;
    let coils = 0;
    let constraints = 0;
    let paths = 0;
    for (const { kind, points, name } of drawing.lines) {
      if (kind === LineKind.LINK) {
        rods += points - 1;
        for (let i = 1; i < points; i++) this.rodNames.push(name);
      } else if (kind === LineKind.SPRING) coils += points === 2 ? TURNS * PIECES + 2 : points - 1;
      else if (kind === LineKind.CONSTRAINT) constraints += points - 1;
      else paths += points - 1;
    }
    this.rods = new InstancedMesh(new CylinderGeometry(1, 1, 1, 12), colors.link, rods);
    this.rods.instanceMatrix.setUsage(DynamicDrawUsage);
    this.rods.frustumCulled = false;
    this.rods.castShadow = true;
    const stroke = (color: string, linewidth: number): LineMaterial =>
      new LineMaterial({ color, linewidth, opacity: colors.opacity, transparent: colors.opacity < 1 });
    this.#springs = new Strokes(coils, stroke(colors.spring, 2));
    this.#constraints = new Strokes(constraints, stroke(colors.constraint, 1.5));
    this.#paths = new Strokes(paths, stroke(colors.path, 2));
    this.object.add(this.rods, this.#springs.object, this.#constraints.object, this.#paths.object);
  }

  /** Moves them to where `points` says. */
  update(points: number[]): void {
    if (this.#radius === 0) this.#radius = this.#rodRadius(points);
    const sets = [this.#springs, this.#constraints, this.#paths];
    sets.forEach((set) => set.begin());
    let rod = 0;
    let at = 0;
    for (const { kind, points: count } of this.drawing.lines) {
      if (kind === LineKind.SPRING && count === 2) {
        this.#coil(points, at);
      } else {
        for (let i = 1; i < count; i++) {
          const [a, b] = [at + 3 * (i - 1), at + 3 * i];
          if (kind === LineKind.LINK) this.#rod(rod++, points, a, b);
          else {
            const set = kind === LineKind.SPRING ? this.#springs : kind === LineKind.CONSTRAINT ? this.#constraints : this.#paths;
            set.segment(points[a]!, points[a + 1]!, points[a + 2]!, points[b]!, points[b + 1]!, points[b + 2]!);
          }
        }
      }
      at += 3 * count;
    }
    this.rods.instanceMatrix.needsUpdate = true;
    this.rods.boundingSphere = null;
    sets.forEach((set) => set.end());
  }

  /** Thin beside the mechanism, and beside the links themselves. */
  #rodRadius(points: number[]): number {
    const lengths: number[] = [];
    let at = 0;
    for (const { kind, points: count } of this.drawing.lines) {
      for (let i = 1; i < count && kind === LineKind.LINK; i++) {
        const [a, b] = [at + 3 * (i - 1), at + 3 * i];
        const length = Math.hypot(points[a]! - points[b]!, points[a + 1]! - points[b + 1]!, points[a + 2]! - points[b + 2]!);
        if (length > 1e-9) lengths.push(length);
      }
      at += 3 * count;
    }
    lengths.sort((a, b) => a - b);
    const median = lengths[lengths.length >> 1] ?? Infinity;
    const size = this.drawing.sizeM || 1;
    return Math.min(0.008 * size, Math.max(0.14 * median, 0.0025 * size));
  }

  #rod(index: number, points: number[], a: number, b: number): void {
    const from = VECTORS[0].fromArray(points, a);
    const to = VECTORS[1].fromArray(points, b);
    this.rods.setMatrixAt(index, along(from, to, this.#radius, MATRIX));
  }

  #coil(points: number[], at: number): void {
    const from = VECTORS[0].fromArray(points, at);
    const to = VECTORS[1].fromArray(points, at + 3);
    const axis = VECTORS[2].subVectors(to, from);
    const length = axis.length();
    if (length < 1e-12) return;
    axis.divideScalar(length);
    const side = VECTORS[3].set(0, 0, 0).setComponent(smallest(axis), 1).cross(axis).normalize();
    const other = VECTORS[4].crossVectors(axis, side);
    const radius = Math.min(0.018 * (this.drawing.sizeM || 1), 0.12 * length);
    const straight = 0.12 * length;
    const set = this.#springs;
    const pieces = TURNS * PIECES;
    let before = from;
    for (let i = 0; i <= pieces; i++) {
      const phase = (2 * Math.PI * i) / PIECES;
      const reach = radius * Math.min(1, i / PIECES, (pieces - i) / PIECES);
      const next = VECTORS[5 + (i % 2)]!.copy(from)
        .addScaledVector(axis, straight + ((length - 2 * straight) * i) / pieces)
        .addScaledVector(side, reach * Math.cos(phase))
        .addScaledVector(other, reach * Math.sin(phase));
      set.segment(before.x, before.y, before.z, next.x, next.y, next.z);
      before = next;
    }
    set.segment(before.x, before.y, before.z, to.x, to.y, to.z);
  }

  dispose(): void {
    this.rods.geometry.dispose();
    this.rods.dispose();
    for (const { object } of [this.#springs, this.#constraints, this.#paths]) {
      object.geometry.dispose();
      object.material.dispose();
    }
  }
}

const VECTORS = [new Vector3(), new Vector3(), new Vector3(), new Vector3(), new Vector3(), new Vector3(), new Vector3()] as const;
const MATRIX = new Matrix4();
const TURN = new Quaternion();
const SCALE = new Vector3();
const MIDDLE = new Vector3();
const AXIS = new Vector3();

function smallest(vector: Vector3): number {
  const [x, y, z] = [Math.abs(vector.x), Math.abs(vector.y), Math.abs(vector.z)];
  return x <= y && x <= z ? 0 : y <= z ? 1 : 2;
}

/** The matrix that takes a unit cylinder along y to one between two points. */
export function along(from: Vector3, to: Vector3, radius: number, matrix: Matrix4): Matrix4 {
  AXIS.subVectors(to, from);
  const length = AXIS.length();
  if (length > 0) TURN.setFromUnitVectors(UP, AXIS.divideScalar(length));
  MIDDLE.addVectors(from, to).multiplyScalar(0.5);
  return matrix.compose(MIDDLE, TURN, SCALE.set(radius, length, radius));
}
