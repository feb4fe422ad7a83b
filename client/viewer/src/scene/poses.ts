// Positions and orientations as they are drawn.

import type { Poses } from "../gen/plantd/v1/drawing_pb.js";

export type Vector = [number, number, number];

/** A vector turned by a unit quaternion w, x, y, z. */
export function rotate([w, x, y, z]: number[], [a, b, c]: Vector): Vector {
  const [i = 0, j = 0, k = 0] = [x, y, z].map(Number);
  const s = 2 * (j! * c - k! * b);
  const t = 2 * (k! * a - i! * c);
  const r = 2 * (i! * b - j! * a);
  return [a + w! * s + j! * r - k! * t, b + w! * t + k! * s - i! * r, c + w! * r + i! * t - j! * s];
}

/** The product of two quaternions w, x, y, z. */
export function multiply(a: number[], b: number[]): number[] {
  const [aw = 1, ax = 0, ay = 0, az = 0] = a;
  const [bw = 1, bx = 0, by = 0, bz = 0] = b;
  return [
    aw * bw - ax * bx - ay * by - az * bz,
    aw * bx + ax * bw + ay * bz - az * by,
    aw * by - ax * bz + ay * bw + az * bx,
    aw * bz + ax * by - ay * bx + az * bw,
  ];
}

/** Where frame number `index` is: position and quaternion w, x, y, z. */
export function poseOf(poses: Poses, index: number): { position: Vector; orientation: number[] } {
  const at = poses.frames.slice(7 * index, 7 * index + 7);
  return { position: [at[0] ?? 0, at[1] ?? 0, at[2] ?? 0], orientation: at.slice(3) };
}

/** A point of the world in the axes of a frame. */
export function intoFrame(poses: Poses, index: number, point: Vector): Vector {
  const { position, orientation } = poseOf(poses, index);
  const [w = 1, x = 0, y = 0, z = 0] = orientation;
  return rotate([w, -x, -y, -z], [point[0] - position[0], point[1] - position[1], point[2] - position[2]]);
}

/** A point of a frame in the axes of the world. */
export function intoWorld(poses: Poses, index: number, point: Vector): Vector {
  const { position, orientation } = poseOf(poses, index);
  const turned = rotate(orientation, point);
  return [turned[0] + position[0], turned[1] + position[1], turned[2] + position[2]];
}
