// A second plant over the first, to compare them.

import { fill, h, options } from "../dom.js";
import { Watcher } from "../live.js";
import type { View } from "../scene/view.js";
import { app, complain } from "../state.js";
import { section } from "./section.js";

/** Adds the section. */
export function compare(view: View): void {
  const part = section("compare", "Compare", false);
  const select = h("select", { id: "compare", "aria-label": "Plant to compare with" });
  const hint = h("p", { class: "hint" }, "Shows another plant as a ghost over this one.");
  fill(part.body, select, hint);
  let watcher: Watcher | undefined;
  let ghost = "";

  const set = (id: string): void => {
    if (id === ghost) return;
    watcher?.end();
    watcher = undefined;
    ghost = id;
    view.compare(undefined);
    part.badge(id, "on");
    if (id === "") return;
    watcher = new Watcher(id, {
      subject: (subject) => ghost === id && view.compare(subject.drawing),
      state: (moment) => {
        if (ghost === id && moment.poses) view.updateGhost(moment.poses);
      },
      connection: () => undefined,
      gone: () => {
        complain(`There is no plant ${id} any more.`);
        set("");
      },
      wantsPoles: () => false,
    });
  };
  select.addEventListener("change", () => set(select.value));
  const list = (): void => {
    const shown = app.subject.get()?.plant ?? "";
    const others = app.plants.get().filter(({ id }) => id !== shown);
    options(select, [["", "None"], ...others.map(({ id }): [string, string] => [id, id])]);
    if (ghost !== "" && others.some(({ id }) => id === ghost)) select.value = ghost;
    else if (ghost !== "") set("");
  };
  app.plants.on(list);
  app.subject.on(list);
  const asked = new URLSearchParams(location.search).get("compare");
  if (asked) {
    ghost = "";
    set(asked);
  }
}
