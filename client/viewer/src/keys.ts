// The keyboard, and the panel that says what it does.

import { byId, fill, h } from "./dom.js";

/** A shortcut: the key as it is written, what it does, and how it is recognised. */
export interface Shortcut {
  label: string;
  does: string;
  keys: string[];
  act(event: KeyboardEvent): void;
}

/** Listens for shortcuts where the keyboard is not needed for something else. */
export function keys(shortcuts: Shortcut[]): void {
  const help = byId<HTMLDialogElement>("help");
  const close = h("button", { type: "button" }, "Close");
  close.addEventListener("click", () => help.close());
  const pairs = shortcuts.filter(({ does }) => does !== "").flatMap(({ label, does }) => [h("dt", {}, h("kbd", {}, label)), h("dd", {}, does)]);
  fill(
    help,
    h("h2", { id: "help-title" }, "Mouse and keyboard"),
    h("dl", {}, h("dt", {}, "Drag"), h("dd", {}, "A body: push it. Beside it, or with Shift: turn the view."), h("dt", {}, "Right drag"), h("dd", {}, "Move the view."), h("dt", {}, "Wheel"), h("dd", {}, "Zoom."), h("dt", {}, "Click a plot"), h("dd", {}, "Hold the cursor there: the view shows that state. Drag zooms, a double click shows all."), ...pairs),
    close,
  );
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || help.open) return;
    const target = event.target as HTMLElement;
    const writes = target instanceof HTMLSelectElement || (target instanceof HTMLInputElement && target.type !== "range");
    const arrow = event.key.startsWith("Arrow");
    const presses = event.key === " " && (target instanceof HTMLButtonElement || target.tagName === "SUMMARY");
    if ((writes && event.key !== "Escape") || presses) return;
    if (arrow && target.id !== "canvas" && target !== document.body) return;
    const shortcut = shortcuts.find((each) => each.keys.includes(event.key));
    if (!shortcut) return;
    event.preventDefault();
    shortcut.act(event);
  });
}

/** Opens the panel with the shortcuts. */
export function showHelp(): void {
  byId<HTMLDialogElement>("help").showModal();
}
