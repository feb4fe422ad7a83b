// Faults: what goes wrong with a plant, now or for a while.

import { attempt, channels, isAway, isNotFound, words } from "../api.js";
import { fill, h, options } from "../dom.js";
import { number } from "../format.js";
import { type FaultInfo, FaultPhase, type FaultSpec } from "../gen/plantd/v1/channel_service_pb.js";
import { current } from "../live.js";
import { app, complain } from "../state.js";
import { everySecond, section } from "./section.js";

/** What can be injected here: a name, the unit of its number if it has one, and how it is said. */
const KINDS: Record<string, { name: string; value?: string; of(value: number): FaultSpec["kind"] }> = {
  offset: { name: "Offset", value: "by", of: (value) => ({ case: "offset", value: { $typeName: "plantd.v1.Offset", value } }) },
  off: { name: "Off (zero)", of: () => ({ case: "off", value: true }) },
  stuck: { name: "Stuck", of: () => ({ case: "stuck", value: true }) },
  wrongSign: { name: "Wrong sign", of: () => ({ case: "wrongSign", value: true }) },
  noise: { name: "Noise", value: "deviation", of: (deviation) => ({ case: "noise", value: { $typeName: "plantd.v1.ExtraNoise", deviation } }) },
  delay: { name: "Delay", value: "s", of: (delayS) => ({ case: "delay", value: { $typeName: "plantd.v1.ExtraDelay", delayS } }) },
  loss: { name: "Loss", value: "probability", of: (probability) => ({ case: "loss", value: { $typeName: "plantd.v1.PacketLoss", probability } }) },
};

const PHASES: Record<number, string> = {
  [FaultPhase.WAITING]: "waits",
  [FaultPhase.ACTIVE]: "acts",
  [FaultPhase.PAUSED]: "pauses",
  [FaultPhase.OVER]: "over",
};

/** Adds the section. */
export function faults(): void {
  const part = section("faults", "Faults", false);
  const kind = h("select", { class: "grow", "aria-label": "What goes wrong" });
  options(kind, Object.entries(KINDS).map(([key, { name }]) => [key, name]));
  const target = h("select", { class: "grow", "aria-label": "Input or sensor" });
  const value = h("input", { type: "number", step: "any", value: "1", "aria-label": "Amount" });
  const lasts = h("input", { type: "number", step: "any", min: "0", value: "0", "aria-label": "Duration in seconds, 0 for good" });
  value.style.width = lasts.style.width = "74px";
  const unit = h("span", { class: "hint" }, "by");
  const inject = h("button", { type: "button", id: "inject" }, "Inject");
  const list = h("div", { class: "list" });
  const form = h("div", { class: "body" }, h("div", { class: "row" }, kind, target), h("div", { class: "row" }, unit, value, h("span", { class: "hint" }, "for, s"), lasts, inject));
  form.style.padding = "0";
  fill(part.body, form, list);

  kind.addEventListener("change", () => {
    const word = KINDS[kind.value]?.value;
    value.hidden = unit.hidden = word === undefined;
    unit.textContent = word ?? "";
  });
  inject.addEventListener("click", () => {
    const [where, name = ""] = target.value.split(/:(.*)/s);
    const spec = KINDS[kind.value]?.of(Number(value.value));
    if (!spec) return;
    const fault = { target: { case: where === "output" ? ("output" as const) : ("input" as const), value: name }, kind: spec, durationS: Number(lasts.value) };
    void attempt("Fault", () => channels.injectFault({ id: current(), fault })).then(show);
  });

  app.subject.on((subject) => {
    const inputs = [...(subject?.model.inputs ?? []), ...(subject?.model.coordinates ?? []).filter((each) => each.prescribed).map(({ name }) => name)];
    options(target, [
      ...inputs.map((name): [string, string] => [`input:${name}`, name]),
      ...(subject?.outputs ?? []).map((name): [string, string] => [`output:${name}`, `sensor ${name}`]),
    ]);
    form.hidden = target.options.length === 0;
    part.root.hidden = !subject?.plant;
  });

  async function show(): Promise<void> {
    const id = current();
    if (id === "") return;
    try {
      const { faults } = await channels.listFaults({ id });
      // Pushes by dragging come and go by the dozen.
      const seen = faults.filter(({ fault, phase }) => fault?.kind.case !== "push" || phase !== FaultPhase.OVER);
      const active = seen.filter(({ phase }) => phase === FaultPhase.ACTIVE).length;
      part.badge(active > 0 ? `${active} active` : "", "bad");
      fill(list, ...seen.map((fault) => row(id, fault, show)));
    } catch (error) {
      if (!isAway(error) && !isNotFound(error)) complain(words(error));
    }
  }
  everySecond(part, () => void show());
}

function row(plant: string, { id, fault, phase }: FaultInfo, changed: () => void): HTMLElement {
  const clear = h("button", { type: "button", "aria-label": `Clear fault ${id}` }, "Clear");
  clear.addEventListener("click", () => void attempt("Fault", () => channels.clearFault({ id: plant, faultId: id })).then(changed));
  const what = fault?.kind.case ?? "";
  const name = KINDS[what]?.name ?? (what === "push" ? "Push" : "Parameters");
  const on = fault?.target.value ?? (fault?.kind.case === "push" ? (fault.kind.value.point?.frame ?? "") : "");
  const lasts = fault && fault.durationS > 0 ? `, ${number(fault.durationS, 3)} s` : "";
  return h("div", {}, h("span", { class: "grow" }, `${name} ${on}`, h("small", {}, `${PHASES[phase] ?? ""}${lasts}`)), clear);
}
