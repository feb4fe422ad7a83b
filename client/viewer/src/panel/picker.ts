// Which plant is shown, and new plants from models.

import { attempt, models, plants } from "../api.js";
import { byId, fill, h, options } from "../dom.js";
import { current, list, show } from "../live.js";
import { alone, app } from "../state.js";

const NEW = "\u0000new";

/** Shows a plant and says so in the address, so that a reload shows it again. */
export function choose(id: string): void {
  const address = new URL(location.href);
  address.searchParams.delete("recording");
  if (id === "") address.searchParams.delete("plant");
  else address.searchParams.set("plant", id);
  history.replaceState(null, "", address);
  show(id);
}

/** The plant before or after the one that is shown. */
export function neighbour(by: number): void {
  const ids = app.plants.get().map(({ id }) => id);
  if (ids.length === 0) return;
  const at = ids.indexOf(current());
  choose(ids[(at + by + ids.length) % ids.length] ?? "");
}

/** The list of plants in the head, and the page of one that has none. */
export function picker(): void {
  const select = byId<HTMLSelectElement>("plant");
  const empty = byId("empty");
  let asked = false;
  select.addEventListener("change", () => {
    if (select.value === NEW) {
      select.value = current();
      void offer();
    } else {
      close();
      choose(select.value);
    }
  });
  const showList = (): void => {
    const subject = app.subject.get();
    const all = app.plants.get();
    const ids = all.map(({ id, model }): [string, string] => [id, id === model ? id : `${id} (${model})`]);
    const shown = current();
    if (shown !== "" && !all.some(({ id }) => id === shown)) ids.unshift([shown, shown]);
    const lead: [string, string][] = subject && subject.plant === "" ? [["", `Recording: ${subject.title}`]] : ids.length === 0 ? [["", "No plant"]] : [];
    const more: [string, string][] = alone === null ? [[NEW, "New plant…"]] : [];
    options(select, [...lead, ...ids, ...more]);
    select.value = shown;
    if (app.connection.get() === "none" && !subject && all.length === 0) void offer();
    else if (!asked) empty.hidden = true;
  };
  app.plants.on(showList);
  app.subject.on(showList);
  app.connection.on(showList);

  function close(): void {
    asked = false;
    empty.hidden = true;
  }

  async function offer(): Promise<void> {
    if (!empty.hidden || alone !== null) return;
    asked = app.plants.get().length > 0;
    empty.hidden = false;
    const name = h("input", { type: "text", "aria-label": "Name of a model", placeholder: "chain-12, scissor-6, …" });
    const form = h("form", { class: "row" }, name, h("button", { type: "submit" }, "Make"));
    form.style.justifyContent = "center";
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      if (name.value.trim() !== "") void make(name.value.trim());
    });
    const buttons = h("div", { class: "models" });
    const back = h("button", { type: "button", class: "plain" }, "Back");
    back.addEventListener("click", close);
    fill(empty, h("h2", {}, asked ? "A new plant" : "No plant yet"), h("p", {}, "Choose a model."), buttons, form, asked && back);
    await attempt("Models", async () => {
      const page = await models.listModels({ pageSize: 100 });
      fill(
        buttons,
        ...page.models.map((model) => {
          const button = h("button", { type: "button", title: model.description }, model.name);
          button.addEventListener("click", () => void make(model.name));
          return button;
        }),
      );
    });
  }

  async function make(model: string): Promise<void> {
    const taken = new Set(app.plants.get().map(({ id }) => id));
    let id = model;
    for (let number = 2; taken.has(id); number++) id = `${model}-${number}`;
    await attempt("New plant", async () => {
      const { plant } = await plants.createPlant({ id, model });
      await list();
      close();
      choose(plant?.id ?? id);
    });
  }
}
