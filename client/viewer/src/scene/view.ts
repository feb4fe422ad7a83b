// The canvas: camera, light, mechanisms. It is drawn when something on it has changed.

import { Box3, Color, DirectionalLight, HemisphereLight, Mesh, type Object3D, PCFShadowMap, PerspectiveCamera, Plane, Raycaster, Scene, Vector2, Vector3, WebGLRenderer } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Drawing, Poses } from "../gen/plantd/v1/drawing_pb.js";
import { color } from "../theme.js";
import { Figure, type Parts, type Style } from "./figure.js";
import { Ground } from "./ground.js";

/** A picture that takes longer than this, ms, is drawn with less. */
const SLOW_MS = 40;
/** Slow pictures in a row after which less is drawn. */
const PATIENCE = 6;

/** A part of a mechanism under the pointer. */
export interface Hit {
  frame: number;
  point: Vector3;
}

function isShown(object: Object3D): boolean {
  return object.visible && (!object.parent || isShown(object.parent));
}

/** A graphics card draws, not the processor. */
function isHardware(): boolean {
  const context = document.createElement("canvas").getContext("webgl2");
  const name = String(context?.getParameter(context.RENDERER) ?? "");
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|software/i.test(name);
}

/** The 3D view. */
export class View {
  readonly scene = new Scene();
  readonly camera = new PerspectiveCamera(36, 1, 0.01, 1000);
  controls: OrbitControls;
  /** Pictures drawn so far. */
  drawn = 0;
  parts: Parts = { links: true, axes: false, inputs: true, forces: false };
  #renderer: WebGLRenderer;
  #sun = new DirectionalLight(0xffffff, 2.1);
  #sky = new HemisphereLight(0xffffff, 0x8a8f96, 1.5);
  #figure: Figure | undefined;
  #ghost: Figure | undefined;
  #ground: Ground | undefined;
  #isStale = true;
  #isPlaced = false;
  #follows: number | undefined;
  #followed = new Vector3();
  #up = new Vector3(0, 0, 1);
  #lowest = Infinity;
  #slow = 0;
  #last = 0;
  /** Asked for by the address: as good as can be, however long it takes. */
  #isBest = new URLSearchParams(location.search).get("quality") === "best";
  #quality: { shadows: boolean; ratio: number };

  constructor(readonly canvas: HTMLCanvasElement) {
    const isFast = isHardware() || this.#isBest;
    this.#renderer = new WebGLRenderer({ canvas, antialias: isFast, powerPreference: "high-performance" });
    this.#renderer.shadowMap.enabled = true;
    this.#renderer.shadowMap.type = PCFShadowMap;
    this.#quality = { shadows: true, ratio: Math.min(devicePixelRatio, 2) };
    this.#sun.castShadow = true;
    this.#sun.shadow.mapSize.set(1024, 1024);
    this.#sun.shadow.radius = 3;
    this.scene.add(this.#sun, this.#sun.target, this.#sky);
    this.controls = this.#controls();
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement!);
    this.#resize();
    const turn = (now: number): void => {
      requestAnimationFrame(turn);
      this.controls.update();
      if (this.#isStale) this.#draw(now);
      else this.#last = 0;
    };
    requestAnimationFrame(turn);
  }

  #controls(): OrbitControls {
    const controls = new OrbitControls(this.camera, this.canvas);
    controls.enableDamping = true;
    controls.dampingFactor = 0.12;
    controls.addEventListener("change", () => this.invalidate());
    return controls;
  }

  /** Something has changed: draw it with the next picture. */
  invalidate(): void {
    this.#isStale = true;
  }

  /** All changes are on the canvas. */
  get isDrawn(): boolean {
    return !this.#isStale;
  }

  /** The camera is where the mechanism is seen. */
  get isPlaced(): boolean {
    return this.#isPlaced;
  }

  get figure(): Figure | undefined {
    return this.#figure;
  }

  /** Shows a mechanism in place of the one before; none without a drawing. `keeps` the camera where it is. */
  show(drawing: Drawing | undefined, keeps: boolean): void {
    this.#figure?.dispose();
    this.#figure = undefined;
    this.#follows = keeps ? this.#follows : undefined;
    this.scene.background = new Color(color("scene"));
    this.#sky.groundColor.set(color("scene-ground"));
    if (!drawing) {
      this.#ground?.dispose();
      this.#ground = undefined;
      this.invalidate();
      return;
    }
    this.#figure = new Figure(drawing, "solid", () => this.invalidate());
    this.scene.add(this.#figure.object);
    this.#figure.show(this.parts);
    const [x = 0, y = 0, z = 0] = drawing.gravity;
    this.#up = new Vector3(-x, -y, -z);
    if (this.#up.lengthSq() < 1e-12) this.#up.set(0, 0, 1);
    this.#up.normalize();
    this.#ground?.dispose();
    this.#ground = new Ground(drawing.sizeM || 1, this.#up);
    this.#ground.hasShadow = this.#quality.shadows;
    this.scene.add(this.#ground.object, this.#ground.axes);
    if (!keeps) this.#isPlaced = false;
    else this.#ground.place(this.#lowest, this.controls.target);
    this.invalidate();
  }

  /** Shows a second mechanism over the first, to compare them; none without a drawing. */
  compare(drawing: Drawing | undefined): void {
    this.#ghost?.dispose();
    this.#ghost = undefined;
    if (drawing) {
      this.#ghost = this.#make(drawing, "ghost");
      this.#ghost.arrows.object.visible = false;
    }
    this.invalidate();
  }

  #make(drawing: Drawing, style: Style): Figure {
    const figure = new Figure(drawing, style, () => this.invalidate());
    this.scene.add(figure.object);
    return figure;
  }

  /** Moves the mechanism. */
  update(poses: Poses): void {
    if (!this.#figure) return;
    this.#figure.update(poses);
    if (!this.#isPlaced) this.home();
    if (this.#follows !== undefined) this.#move(this.#follows);
    this.invalidate();
  }

  /** Moves what it is compared with. */
  updateGhost(poses: Poses): void {
    this.#ghost?.update(poses);
    this.invalidate();
  }

  /** Shows and hides parts. */
  choose(parts: Parts): void {
    this.parts = parts;
    this.#figure?.show(parts);
  }

  /** The camera goes with a frame; with none it stays where it is. */
  follow(frame: number | undefined): void {
    this.#follows = frame;
    const group = frame === undefined ? undefined : this.#figure?.frames[frame];
    if (group) this.#followed.copy(group.position);
    if (group) {
      const shift = this.#followed.clone().sub(this.controls.target);
      this.camera.position.add(shift);
      this.controls.target.add(shift);
    }
    this.invalidate();
  }

  get followed(): number | undefined {
    return this.#follows;
  }

  #move(frame: number): void {
    const group = this.#figure?.frames[frame];
    if (!group) return;
    const shift = group.position.clone().sub(this.#followed);
    this.#followed.copy(group.position);
    this.camera.position.add(shift);
    this.controls.target.add(shift);
  }

  /** The box that the mechanism fills. */
  get extent(): Box3 {
    const box = new Box3();
    const figure = this.#figure;
    if (!figure) return box;
    this.scene.updateMatrixWorld(true);
    const point = new Vector3();
    for (const group of figure.frames) {
      box.expandByPoint(point.setFromMatrixPosition(group.matrixWorld));
      for (const child of group.children) if (child.type !== "AxesHelper") box.expandByObject(child);
    }
    if (box.isEmpty()) box.expandByPoint(point.set(0, 0, 0));
    return box.union(new Box3().setFromObject(figure.lines.rods));
  }

  /** Puts the camera where a whole box is seen: from the side if it is flat, else from above. */
  home(box = this.extent): void {
    const figure = this.#figure;
    if (!figure) return;
    const extent = box.getSize(new Vector3());
    const size = figure.drawing.sizeM || extent.length() || 1;
    const center = box.getCenter(new Vector3());
    const radius = Math.max(0.56 * extent.length(), 0.46 * size);
    const { side, flat } = this.#side(extent, size);
    const right = new Vector3().crossVectors(this.#up, side);
    const azimuth = flat ? 0.3 : 0.65;
    const elevation = flat ? 0.16 : 0.32;
    const from = side.clone().multiplyScalar(Math.cos(azimuth)).addScaledVector(right, Math.sin(azimuth));
    from.multiplyScalar(Math.cos(elevation)).addScaledVector(this.#up, Math.sin(elevation));
    const aspect = Math.min(1, this.camera.aspect);
    const distance = radius / (Math.sin((this.camera.fov * Math.PI) / 360) * aspect);
    this.camera.up.copy(this.#up);
    // Controls take the camera's up when they are made.
    this.controls.dispose();
    this.controls = this.#controls();
    this.controls.target.copy(center);
    this.camera.position.copy(center).addScaledVector(from, distance);
    this.camera.near = 0.01 * size;
    this.camera.far = 200 * size;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.#lowest = box.min.clone().projectOnVector(this.#up).dot(this.#up);
    const corner = box.max.dot(this.#up);
    this.#lowest = Math.min(this.#lowest, corner) - 0.12 * size;
    this.#ground?.place(this.#lowest, center);
    this.#light(center, size, right, side);
    this.#isPlaced = true;
    this.invalidate();
  }

  #light(center: Vector3, size: number, right: Vector3, side: Vector3): void {
    this.#sky.position.copy(this.#up);
    this.#sun.target.position.copy(center);
    this.#sun.position.copy(center).addScaledVector(this.#up, 3 * size).addScaledVector(right, -1.1 * size).addScaledVector(side, 1.4 * size);
    const { camera } = this.#sun.shadow;
    camera.left = camera.bottom = -1.8 * size;
    camera.right = camera.top = 1.8 * size;
    camera.near = 0.5 * size;
    camera.far = 9 * size;
    camera.updateProjectionMatrix();
    this.#sun.shadow.normalBias = 0.004 * size;
  }

  /** The horizontal direction from which the mechanism is seen, and whether it is flat across it. */
  #side(extent: Vector3, size: number): { side: Vector3; flat: boolean } {
    const level = [new Vector3(0, 0, 1), new Vector3(0, -1, 0), new Vector3(1, 0, 0)].filter((axis) => Math.abs(axis.dot(this.#up)) < 0.5);
    const across = (axis: Vector3): number => Math.abs(axis.x) * extent.x + Math.abs(axis.y) * extent.y + Math.abs(axis.z) * extent.z;
    const side = level.reduce((best, axis) => (across(axis) < across(best) - 0.05 * size ? axis : best));
    side.addScaledVector(this.#up, -side.dot(this.#up)).normalize();
    return { side, flat: across(side) < 0.35 * size };
  }

  /** The boxes that the shapes of a frame fill in the world; of meshes once they have come. */
  boxes(frame: number): Box3[] {
    const parts = this.#figure?.frames[frame]?.children ?? [];
    const boxes = parts.filter(({ type }) => type !== "AxesHelper").map((part) => new Box3().setFromObject(part));
    return boxes.filter((box) => !box.isEmpty());
  }

  /** What is under a point of the window. */
  pick(x: number, y: number): Hit | undefined {
    if (!this.#figure?.object.visible) return undefined;
    const caster = this.#caster(x, y);
    for (const { object, point, instanceId } of caster.intersectObject(this.#figure.object, true)) {
      // Rays hit what is hidden, too, and lines from afar.
      const frame = object instanceof Mesh && isShown(object) ? this.#figure.frameOf(object, instanceId) : undefined;
      if (frame !== undefined) return { frame, point: point.clone() };
    }
    return undefined;
  }

  /** The point under the pointer that is as far away as `at`. */
  reach(x: number, y: number, at: Vector3): Vector3 | undefined {
    const plane = new Plane().setFromNormalAndCoplanarPoint(this.camera.getWorldDirection(new Vector3()), at);
    return this.#caster(x, y).ray.intersectPlane(plane, new Vector3()) ?? undefined;
  }

  #caster(x: number, y: number): Raycaster {
    const area = this.canvas.getBoundingClientRect();
    const caster = new Raycaster();
    caster.setFromCamera(new Vector2((2 * (x - area.left)) / area.width - 1, 1 - (2 * (y - area.top)) / area.height), this.camera);
    return caster;
  }

  /** Where a point of the world is in the window. */
  pixel(point: Vector3): { x: number; y: number } {
    const area = this.canvas.getBoundingClientRect();
    this.camera.updateMatrixWorld();
    const at = point.clone().project(this.camera);
    return { x: area.left + ((at.x + 1) / 2) * area.width, y: area.top + ((1 - at.y) / 2) * area.height };
  }

  /** Turns the camera about its target, rad. */
  orbit(right: number, up: number): void {
    const offset = this.camera.position.clone().sub(this.controls.target);
    offset.applyAxisAngle(this.#up, -right);
    const level = new Vector3().crossVectors(this.#up, offset).normalize();
    const angle = offset.angleTo(this.#up);
    const turn = Math.min(Math.max(up, angle - Math.PI + 0.05), angle - 0.05);
    offset.applyAxisAngle(level, -turn);
    this.camera.position.copy(this.controls.target).add(offset);
    this.invalidate();
  }

  /** Brings the camera nearer by a factor. */
  zoom(factor: number): void {
    this.camera.position.sub(this.controls.target).divideScalar(factor).add(this.controls.target);
    this.invalidate();
  }

  #resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement!;
    if (width === 0 || height === 0) return;
    this.#renderer.setPixelRatio(this.#quality.ratio);
    this.#renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.invalidate();
    this.#draw(performance.now());
  }

  #draw(now: number): void {
    this.#isStale = false;
    this.#renderer.render(this.scene, this.camera);
    this.drawn += 1;
    // Between two pictures that follow each other directly: the time that one takes.
    this.#slow = this.#last > 0 && now - this.#last > SLOW_MS ? this.#slow + 1 : Math.max(0, this.#slow - 1);
    this.#last = now;
    if (this.#slow > PATIENCE && !this.#isBest) this.#spare();
  }

  /** Draws with less: without shadows, then with fewer pixels. */
  #spare(): void {
    this.#slow = 0;
    if (this.#quality.shadows) {
      this.#quality.shadows = false;
      this.#sun.castShadow = false;
      if (this.#ground) this.#ground.hasShadow = false;
    } else if (this.#quality.ratio > 0.7) {
      this.#quality.ratio *= 0.8;
      this.#resize();
    }
  }
}
