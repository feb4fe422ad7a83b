// The poles of the linearized map in the plane of complex numbers, with the unit circle.

import { fill, h } from "./dom.js";
import { number } from "./format.js";
import type { Complex } from "./gen/plantd/v1/common_pb.js";
import type { Poles } from "./gen/plantd/v1/plant_service_pb.js";
import { color } from "./theme.js";

/** Poles in the list. */
const LISTED = 6;
/** Half the size of a mark, pixels. */
const MARK = 4.5;

/** A pole as a motion in continuous time. */
function motion({ real, imaginary }: Complex, timeStep: number): string {
  const size = Math.hypot(real, imaginary);
  const growth = Math.log(size) / timeStep;
  const omega = Math.abs(Math.atan2(imaginary, real)) / timeStep;
  const time = Math.abs(growth) < 1e-6 ? "keeps" : growth > 0 ? `grows, ×e in ${number(1 / growth, 3)} s` : `decays, ÷e in ${number(-1 / growth, 3)} s`;
  return omega < 1e-6 ? time : `${number(omega / (2 * Math.PI), 3)} Hz, ${time}`;
}

/** The picture of poles, with a list of the slowest to decay. */
export class PolePlot {
  #poles: Poles | undefined;
  #timeStep = 0.01;
  #zoom = 1;
  #center = { x: 0, y: 0 };

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly list: HTMLElement,
  ) {
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const area = canvas.getBoundingClientRect();
      const x = ((event.clientX - area.left) / area.width - 0.5) * 2;
      const y = (0.5 - (event.clientY - area.top) / area.height) * 2;
      this.#scale(Math.exp(-event.deltaY * 0.002), x, y);
    });
    canvas.addEventListener("dblclick", () => this.whole());
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "+" || event.key === "=") this.#scale(1.5, this.#right(), 0);
      else if (event.key === "-") this.#scale(1 / 1.5, this.#right(), 0);
      else if (event.key === "0") this.whole();
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  /** The whole circle again. */
  whole(): void {
    this.#zoom = 1;
    this.#center = { x: 0, y: 0 };
    this.draw();
  }

  /** The poles around 1, where slow motions lie. */
  near(): void {
    const { openLoop = [], closedLoop = [] } = this.#poles ?? {};
    const reach = Math.max(1e-4, ...[...openLoop, ...closedLoop].map(({ real, imaginary }) => Math.hypot(real - 1, imaginary)).filter((far) => far < 0.5));
    this.#zoom = 1.22 / (1.35 * reach);
    this.#center = { x: 1, y: 0 };
    this.draw();
  }

  /** Where 1, around which slow motions lie, is on the canvas, from −1 to 1. */
  #right(): number {
    return (1 - this.#center.x) / this.#half();
  }

  #half(): number {
    return 1.22 / this.#zoom;
  }

  /** Scales about a point of the canvas, whose coordinates go from −1 to 1. */
  #scale(factor: number, x: number, y: number): void {
    const before = this.#half();
    this.#zoom = Math.min(Math.max(this.#zoom * factor, 0.2), 1e5);
    this.#center.x += x * (before - this.#half());
    this.#center.y += y * (before - this.#half());
    this.draw();
  }

  show(poles: Poles | undefined, timeStep: number): void {
    this.#poles = poles;
    this.#timeStep = timeStep;
    this.draw();
    this.#tell();
  }

  #tell(): void {
    const { openLoop = [], closedLoop = [] } = this.#poles ?? {};
    const size = ({ real, imaginary }: Complex): number => Math.hypot(real, imaginary);
    const rows = (title: string, poles: Complex[]): Node | false => {
      if (poles.length === 0) return false;
      const sorted = [...poles].filter(({ imaginary }) => imaginary >= 0).sort((a, b) => size(b) - size(a));
      const unstable = poles.filter((pole) => size(pole) > 1 + 1e-7).length;
      return h(
        "table",
        {},
        h("caption", {}, title, h("span", { class: unstable > 0 ? "bad" : "good" }, unstable > 0 ? `${unstable} outside the circle` : "none outside the circle")),
        h("thead", {}, h("tr", {}, h("th", {}, "|z|"), h("th", {}, "z"), h("th", {}, "motion"))),
        h("tbody", {}, ...sorted.slice(0, LISTED).map((pole) => {
          const { real, imaginary } = pole;
          const text = imaginary === 0 ? real.toFixed(3) : `${real.toFixed(3)} ± ${imaginary.toFixed(3)}i`;
          return h("tr", {}, h("td", {}, size(pole).toFixed(4)), h("td", {}, text), h("td", {}, motion(pole, this.#timeStep)));
        })),
      );
    };
    fill(this.list, rows("Open loop ×", openLoop), rows("Closed loop ○", closedLoop));
  }

  draw(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0) return;
    const ratio = devicePixelRatio;
    this.canvas.width = width * ratio;
    this.canvas.height = height * ratio;
    const context = this.canvas.getContext("2d")!;
    context.scale(ratio, ratio);
    const scale = Math.min(width, height) / 2 / this.#half();
    const x = (real: number): number => width / 2 + (real - this.#center.x) * scale;
    const y = (imaginary: number): number => height / 2 - (imaginary - this.#center.y) * scale;
    context.strokeStyle = color("line");
    context.lineWidth = 1;
    context.beginPath();
    context.moveTo(0, y(0));
    context.lineTo(width, y(0));
    context.moveTo(x(0), 0);
    context.lineTo(x(0), height);
    context.stroke();
    context.strokeStyle = color("muted");
    context.beginPath();
    context.arc(x(0), y(0), scale, 0, 2 * Math.PI);
    context.stroke();
    const { openLoop = [], closedLoop = [] } = this.#poles ?? {};
    context.lineWidth = 1.6;
    for (const { real, imaginary } of openLoop) {
      context.strokeStyle = Math.hypot(real, imaginary) > 1 + 1e-7 ? color("bad") : color("text");
      context.beginPath();
      context.moveTo(x(real) - MARK, y(imaginary) - MARK);
      context.lineTo(x(real) + MARK, y(imaginary) + MARK);
      context.moveTo(x(real) - MARK, y(imaginary) + MARK);
      context.lineTo(x(real) + MARK, y(imaginary) - MARK);
      context.stroke();
    }
    context.strokeStyle = color("accent");
    for (const { real, imaginary } of closedLoop) {
      context.beginPath();
      context.arc(x(real), y(imaginary), MARK, 0, 2 * Math.PI);
      context.stroke();
    }
  }
}
