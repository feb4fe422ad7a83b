// Dark and light: as the system says, unless the switch says otherwise.

import { remember, remembered, Value } from "./state.js";

export type Theme = "dark" | "light";

const dark = matchMedia("(prefers-color-scheme: dark)");

function chosen(): Theme {
  const asked = new URLSearchParams(location.search).get("theme") ?? remembered("theme", "");
  if (asked === "dark" || asked === "light") return asked;
  return dark.matches ? "dark" : "light";
}

/** The theme in force. */
export const theme = new Value<Theme>(chosen());

theme.on((value) => {
  document.documentElement.dataset["theme"] = value;
});
dark.addEventListener("change", () => theme.set(chosen()));

/** Turns dark to light and back. */
export function switchTheme(): void {
  const next = theme.get() === "dark" ? "light" : "dark";
  remember("theme", next);
  theme.set(next);
}

/** A colour of the style sheet. */
export function color(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** Colours of curves, one after the other. */
export function curve(index: number): string {
  return color(`curve-${(index % 8) + 1}`);
}
