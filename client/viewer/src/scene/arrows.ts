// Arrows of a drawing: forces as straight ones, torques as arcs about their axis.

import { ConeGeometry, CylinderGeometry, DynamicDrawUsage, Group, InstancedMesh, Matrix4, type MeshStandardMaterial, Quaternion, TorusGeometry, Vector3 } from "three";
import { mergeGeometries } from "three/addons/utils/BufferGeometryUtils.js";
import { ArrowKind, type Drawing } from "../gen/plantd/v1/drawing_pb.js";

/** Length of the largest arrow beside the mechanism. */
const LENGTH = 0.32;
/** How much of the largest force is forgotten from one state to the next. */
const FORGET = 0.002;
/** Arrows that are shorter than this part of the largest are left out. */
const LEAST = 0.02;

const UP = new Vector3(0, 1, 0);
const NOWHERE = new Matrix4().makeScale(0, 0, 0);

/** All arrows of one kind. */
class ArrowSet {
  readonly object = new Group();
  #shafts: InstancedMesh;
  #heads: InstancedMesh;
  #arcs: InstancedMesh;
  #largest = { force: 0, torque: 0 };

  constructor(
    private readonly arrows: { index: number; torque: boolean }[],
    private readonly size: number,
    material: MeshStandardMaterial,
  ) {
    const shaft = new CylinderGeometry(0.009, 0.009, 1, 10).translate(0, 0.5, 0);
    const head = new ConeGeometry(0.028, 0.075, 16).translate(0, 0.0375, 0);
    // Seen against its axis y the arc turns to the left, as the torque does.
    const arc = new TorusGeometry(0.5, 0.028, 10, 40, 1.5 * Math.PI).rotateX(-Math.PI / 2);
    const tip = new ConeGeometry(0.09, 0.22, 16).translate(0, 0.08, 0).rotateZ(Math.PI / 2).rotateY(Math.PI).translate(0, 0, 0.5);
    this.#shafts = new InstancedMesh(shaft, material, arrows.length);
    this.#heads = new InstancedMesh(head, material, arrows.length);
    this.#arcs = new InstancedMesh(mergeGeometries([arc, tip])!, material, arrows.length);
    for (const mesh of this.#meshes()) {
      mesh.frustumCulled = false;
      mesh.instanceMatrix.setUsage(DynamicDrawUsage);
      this.object.add(mesh);
    }
  }

  #meshes(): InstancedMesh[] {
    return [this.#shafts, this.#heads, this.#arcs];
  }

  update(values: number[]): void {
    const size = (index: number): number => Math.hypot(values[6 * index + 3] ?? 0, values[6 * index + 4] ?? 0, values[6 * index + 5] ?? 0);
    for (const what of ["force", "torque"] as const) {
      const now = Math.max(0, ...this.arrows.filter(({ torque }) => torque === (what === "torque")).map(({ index }) => size(index)));
      if (Number.isFinite(now)) this.#largest[what] = Math.max(now, this.#largest[what] * (1 - FORGET));
    }
    this.arrows.forEach(({ index, torque }, slot) => {
      const part = size(index) / this.#largest[torque ? "torque" : "force"];
      for (const mesh of this.#meshes()) mesh.setMatrixAt(slot, NOWHERE);
      if (!(part >= LEAST)) return;
      const at = POSITION.fromArray(values, 6 * index);
      const turn = TURN.setFromUnitVectors(UP, AXIS.fromArray(values, 6 * index + 3).normalize());
      const length = LENGTH * part * this.size;
      if (torque) {
        const radius = 0.4 * LENGTH * this.size * (0.35 + 0.65 * part);
        this.#arcs.setMatrixAt(slot, MATRIX.compose(at, turn, SCALE.setScalar(radius)));
        return;
      }
      this.#shafts.setMatrixAt(slot, MATRIX.compose(at, turn, SCALE.set(this.size, length, this.size)));
      at.addScaledVector(AXIS, length);
      this.#heads.setMatrixAt(slot, MATRIX.compose(at, turn, SCALE.setScalar(this.size)));
    });
    for (const mesh of this.#meshes()) mesh.instanceMatrix.needsUpdate = true;
  }

  dispose(): void {
    for (const mesh of this.#meshes()) {
      mesh.geometry.dispose();
      mesh.dispose();
    }
  }
}

/** All arrows of a drawing. */
export class Arrows {
  readonly object = new Group();
  readonly inputs: ArrowSet;
  readonly constraints: ArrowSet;

  constructor(drawing: Drawing, input: MeshStandardMaterial, constraint: MeshStandardMaterial) {
    const of = (wanted: ArrowKind): { index: number; torque: boolean }[] =>
      drawing.arrows.map(({ kind, torque }, index) => ({ kind, torque, index })).filter(({ kind }) => kind === wanted);
    const size = drawing.sizeM || 1;
    this.inputs = new ArrowSet(of(ArrowKind.INPUT), size, input);
    this.constraints = new ArrowSet(of(ArrowKind.CONSTRAINT), size, constraint);
    this.object.add(this.inputs.object, this.constraints.object);
  }

  update(values: number[]): void {
    if (this.inputs.object.visible) this.inputs.update(values);
    if (this.constraints.object.visible) this.constraints.update(values);
  }

  dispose(): void {
    this.inputs.dispose();
    this.constraints.dispose();
  }
}

const POSITION = new Vector3();
const AXIS = new Vector3();
const SCALE = new Vector3();
const TURN = new Quaternion();
const MATRIX = new Matrix4();
