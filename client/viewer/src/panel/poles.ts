// The poles at the state on the screen.

import { fill, h } from "../dom.js";
import { PolePlot } from "../poles.js";
import { app } from "../state.js";
import { section } from "./section.js";

/** From one picture to the next, ms. */
const PERIOD_MS = 150;

/** Adds the section. */
export function poles(): void {
  const part = section("poles", "Poles", true);
  const canvas = h("canvas", { id: "pole-canvas", tabindex: "0", role: "img", "aria-label": "Poles and the unit circle. Plus and minus zoom about 1, 0 shows all." });
  const list = h("div", { id: "pole-list" });
  const hint = h("p", { class: "hint" }, "Eigenvalues of the linearized map at the state on the screen.");
  const whole = h("button", { type: "button", class: "chip" }, "Circle");
  const near = h("button", { type: "button", class: "chip" }, "Near 1");
  fill(part.body, canvas, h("div", { class: "row" }, whole, near), list, hint);
  const plot = new PolePlot(canvas, list);
  whole.addEventListener("click", () => plot.whole());
  near.addEventListener("click", () => plot.near());
  part.onOpen((open) => {
    app.wantsPoles.set(open);
    if (open) plot.draw();
  });
  let waits = false;
  app.shown.on(() => {
    part.root.hidden = app.subject.get() !== null && !app.subject.get()?.plant;
    if (!part.root.open || waits) return;
    // A few times a second: it is read, not watched. What is drawn is the state of that moment, so that the last one
    // of a plant that stands still is seen, too.
    waits = true;
    setTimeout(() => {
      waits = false;
      plot.show(app.shown.get()?.poles, app.subject.get()?.timeStep ?? 0.01);
    }, PERIOD_MS);
  });
}
