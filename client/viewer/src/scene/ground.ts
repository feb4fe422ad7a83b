// What a mechanism stands over: a grid that fades out, a place for its shadow, and the axes of the world.

import { BufferGeometry, Color, Float32BufferAttribute, Group, LineBasicMaterial, LineSegments, Mesh, PlaneGeometry, Quaternion, ShadowMaterial, Vector3 } from "three";
import { color } from "../theme.js";

/** Lines of the grid to each side. */
const LINES = 14;

/** The grid's cell, m: 1, 2 or 5 by a power of ten, some of them in a mechanism. */
function cell(size: number): number {
  const wanted = size / 4;
  const power = 10 ** Math.floor(Math.log10(wanted));
  return power * ([5, 2, 1].find((factor) => factor * power <= wanted) ?? 1);
}

/** The ground under a mechanism of a size, for an upward direction. */
export class Ground {
  readonly object = new Group();
  readonly axes: LineSegments;
  #up: Vector3;
  #cell: number;
  #shadow: Mesh<PlaneGeometry, ShadowMaterial>;

  constructor(size: number, up: Vector3) {
    this.#up = up;
    this.#cell = cell(size);
    const reach = LINES * this.#cell;
    const grid = new LineSegments(this.#lines(), new LineBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false }));
    this.#shadow = new Mesh(new PlaneGeometry(2 * reach, 2 * reach), new ShadowMaterial({ opacity: 0.16 }));
    this.#shadow.receiveShadow = true;
    this.#shadow.position.z = -1e-3 * size;
    this.object.add(grid, this.#shadow);
    // The group's own up is z.
    this.object.quaternion.copy(new Quaternion().setFromUnitVectors(new Vector3(0, 0, 1), up));
    this.axes = axes(0.12 * size);
  }

  /** Whether anything throws a shadow on it: what would stay clear all over need not be drawn. */
  set hasShadow(has: boolean) {
    this.#shadow.visible = has;
  }

  /** Puts it under the lowest point, on a line of the grid. */
  place(lowest: number, beside: Vector3): void {
    const height = Math.floor(lowest / this.#cell + 1e-6) * this.#cell;
    const level = beside.clone().addScaledVector(this.#up, -beside.dot(this.#up));
    level.divideScalar(this.#cell).round().multiplyScalar(this.#cell);
    this.object.position.copy(level).addScaledVector(this.#up, height);
  }

  #lines(): BufferGeometry {
    const [points, colors]: [number[], number[]] = [[], []];
    const { r, g, b } = new Color(color("grid"));
    const pieces = 2 * LINES;
    const at = (i: number): number => (i - LINES) * this.#cell;
    const alpha = (x: number, y: number): number => Math.max(0, 1 - Math.hypot(x, y) / (LINES * this.#cell)) ** 1.5 * 0.55;
    for (let line = 0; line <= pieces; line++) {
      for (let piece = 0; piece < pieces; piece++) {
        const ends = [
          [at(line), at(piece), at(line), at(piece + 1)],
          [at(piece), at(line), at(piece + 1), at(line)],
        ] as const;
        for (const [ax, ay, bx, by] of ends) {
          points.push(ax, ay, 0, bx, by, 0);
          colors.push(r, g, b, alpha(ax, ay), r, g, b, alpha(bx, by));
        }
      }
    }
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new Float32BufferAttribute(points, 3));
    geometry.setAttribute("color", new Float32BufferAttribute(colors, 4));
    return geometry;
  }

  dispose(): void {
    this.object.traverse((part) => {
      if (part instanceof LineSegments || part instanceof Mesh) {
        part.geometry.dispose();
        part.material.dispose();
      }
    });
    this.axes.geometry.dispose();
    (this.axes.material as LineBasicMaterial).dispose();
    this.object.removeFromParent();
    this.axes.removeFromParent();
  }
}

/** The axes of the world at its origin: x, y and z in the colours of `axis-x`, `axis-y`, `axis-z`. */
function axes(length: number): LineSegments {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new Float32BufferAttribute([0, 0, 0, length, 0, 0, 0, 0, 0, 0, length, 0, 0, 0, 0, 0, 0, length], 3));
  const colors = ["x", "y", "z"].flatMap((axis) => {
    const { r, g, b } = new Color(color(`axis-${axis}`));
    return [r, g, b, r, g, b];
  });
  geometry.setAttribute("color", new Float32BufferAttribute(colors, 3));
  return new LineSegments(geometry, new LineBasicMaterial({ vertexColors: true }));
}
