// Shapes of frames as three.js has them. Lengths are in metres, axes those of the frame.

import {
  BoxGeometry,
  type BufferGeometry,
  CapsuleGeometry,
  Color,
  CylinderGeometry,
  EdgesGeometry,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshStandardMaterial,
  type Object3D,
  SphereGeometry,
} from "three";
import { ColladaLoader } from "three/addons/loaders/ColladaLoader.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { MTLLoader } from "three/addons/loaders/MTLLoader.js";
import { OBJLoader } from "three/addons/loaders/OBJLoader.js";
import { STLLoader } from "three/addons/loaders/STLLoader.js";
import type { DrawnMesh, DrawnShape } from "../gen/plantd/v1/drawing_pb.js";
import { complain } from "../state.js";

/** Segments around a round shape. */
const SEGMENTS = 28;

/** Makes a material: of a colour of its own, or of the theme's for bodies. */
export type Paint = (shape: DrawnShape) => MeshStandardMaterial;

/** A shape at its place in the frame; a mesh arrives later, which `arrived` tells. */
export function shapeObject(shape: DrawnShape, paint: Paint, arrived: () => void): Object3D {
  const object = body(shape, paint, arrived);
  const [x = 0, y = 0, z = 0] = shape.position;
  object.position.set(x, y, z);
  const [w = 1, i = 0, j = 0, k = 0] = shape.orientation;
  object.quaternion.set(i, j, k, w);
  return object;
}

function body(shape: DrawnShape, paint: Paint, arrived: () => void): Object3D {
  const material = paint(shape);
  const solid = (geometry: BufferGeometry): Mesh => {
    const mesh = new Mesh(geometry, material);
    mesh.castShadow = true;
    return mesh;
  };
  switch (shape.shape.case) {
    case "box": {
      const [x = 0, y = 0, z = 0] = shape.shape.value.size;
      const box = solid(new BoxGeometry(x, y, z));
      if (shape.standsForInertia) box.add(edges(box.geometry, material));
      return box;
    }
    case "ellipsoid": {
      const [x = 0, y = 0, z = 0] = shape.shape.value.size;
      return solid(new SphereGeometry(0.5, SEGMENTS, SEGMENTS / 2).scale(x, y, z));
    }
    case "capsule": {
      const { radius, length } = shape.shape.value;
      if (length === 0) return solid(new SphereGeometry(radius, SEGMENTS, SEGMENTS / 2));
      return solid(new CapsuleGeometry(radius, length, 8, SEGMENTS).rotateX(Math.PI / 2));
    }
    case "cylinder": {
      const { radius, length } = shape.shape.value;
      return solid(new CylinderGeometry(radius, radius, length, SEGMENTS).rotateX(Math.PI / 2));
    }
    case "mesh": {
      const group = new Group();
      const { value } = shape.shape;
      if (value.url !== "") void load(group, value, material, shape.color.length > 0, arrived);
      return group;
    }
    default:
      return new Group();
  }
}

/** The edges of a box that only stands for an inertia. */
function edges(geometry: BufferGeometry, { color, opacity }: MeshStandardMaterial): LineSegments {
  return new LineSegments(new EdgesGeometry(geometry), new LineBasicMaterial({ color, transparent: true, opacity: Math.min(1, 2 * opacity) }));
}

/** Reads a mesh from the server. */
async function load(group: Group, mesh: DrawnMesh, material: MeshStandardMaterial, painted: boolean, arrived: () => void): Promise<void> {
  try {
    const object = await read(mesh.url, material, painted);
    const [x = 1, y = 1, z = 1] = mesh.scale;
    object.scale.multiply({ x, y, z });
    object.traverse((part) => {
      if (part instanceof Mesh) part.castShadow = true;
    });
    group.add(object);
    arrived();
  } catch (error) {
    complain(`Mesh ${mesh.file}: ${error instanceof Error ? error.message : String(error)}`);
  }
}

async function read(url: string, material: MeshStandardMaterial, painted: boolean): Promise<Object3D> {
  // Behind the name is the tag of the file.
  const extension = /\.([a-z0-9]+)(?:$|\?)/i.exec(url)?.[1]?.toLowerCase();
  switch (extension) {
    case "stl": {
      const geometry = await new STLLoader().loadAsync(url);
      return new Mesh(geometry, material);
    }
    case "obj": {
      const loader = new OBJLoader();
      if (!painted) await materials(loader, url);
      const object = await loader.loadAsync(url);
      if (!loader.materials) repaint(object, material);
      return object;
    }
    case "dae": {
      const collada = await new ColladaLoader().loadAsync(url);
      if (!collada) throw new Error("holds no scene");
      // The loader turns the axes that the file calls up to y; a frame takes them as they are.
      collada.scene.rotation.set(0, 0, 0);
      if (painted) repaint(collada.scene, material);
      return collada.scene;
    }
    case "glb": {
      const { scene } = await new GLTFLoader().loadAsync(url);
      if (painted) repaint(scene, material);
      return scene;
    }
    default:
      throw new Error(`files of type .${extension} are not read`);
  }
}

/** The materials that an OBJ file names, where the server has their file. */
async function materials(loader: OBJLoader, url: string): Promise<void> {
  const text = await (await fetch(url)).text();
  const name = /^mtllib\s+(.+)$/m.exec(text)?.[1]?.trim();
  if (name === undefined) return;
  const folder = url.slice(0, url.lastIndexOf("/") + 1);
  const answer = await fetch(folder + encodeURIComponent(name));
  if (!answer.ok) return;
  const creator = new MTLLoader().parse(await answer.text(), folder);
  creator.preload();
  loader.setMaterials(creator);
}

function repaint(object: Object3D, material: MeshStandardMaterial): void {
  object.traverse((part) => {
    if (part instanceof Mesh) part.material = material;
  });
}

/** A material of a colour given as numbers from 0 to 1. */
export function material(color: Color, opacity: number): MeshStandardMaterial {
  return new MeshStandardMaterial({ color, opacity, transparent: opacity < 1, roughness: 0.62, metalness: 0.05 });
}
