// Sections of the panel: each can be closed, and stays so in this browser.

import { byId, h } from "../dom.js";
import { alone, remember, remembered } from "../state.js";

/** A section of the panel. */
export interface Section {
  root: HTMLDetailsElement;
  body: HTMLElement;
  /** A word beside the title: text, and whether it stands out. */
  badge(text: string, kind?: "on" | "bad"): void;
  /** Calls when it is opened or closed, and at once. */
  onOpen(listener: (open: boolean) => void): void;
}

/** Adds a section. */
export function section(key: string, title: string, open: boolean): Section {
  const mark = h("span", { class: "badge", hidden: true });
  const body = h("div", { class: "body" });
  const root = h("details", { id: `section-${key}` }, h("summary", {}, title, mark), body);
  root.open = remembered(`section.${key}`, open ? "open" : "closed") === "open";
  root.addEventListener("toggle", () => remember(`section.${key}`, root.open ? "open" : "closed"));
  byId("panel").appendChild(root);
  return {
    root,
    body,
    badge(text, kind) {
      mark.hidden = text === "";
      mark.textContent = text;
      mark.className = kind ? `badge ${kind}` : "badge";
    },
    onOpen(listener) {
      root.addEventListener("toggle", () => listener(root.open));
      listener(root.open);
    },
  };
}

/** Does something every second while a section is open and the page is seen. */
export function everySecond(part: Section, action: () => void): void {
  setInterval(() => {
    if (part.root.open && !document.hidden && alone === null) action();
  }, 1000);
  part.onOpen((open) => {
    if (open && alone === null) action();
  });
}
