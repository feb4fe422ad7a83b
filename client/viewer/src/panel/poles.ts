// The poles at the state on the screen.

import { fill, h } from "../dom.js";
import { PolePlot } from "../poles.js";
import { app } from "../state.js";
import { section } from "./section.js";

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
  let drawn = 0;
  app.shown.on((moment) => {
    part.root.hidden = app.subject.get() !== null && !app.subject.get()?.plant;
    // A few times a second: it is read, not watched.
    if (!part.root.open || performance.now() - drawn < 150) return;
    drawn = performance.now();
    plot.show(moment?.poles, app.subject.get()?.timeStep ?? 0.01);
  });
}
