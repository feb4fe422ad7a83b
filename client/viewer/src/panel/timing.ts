// The plant's own loop: how late, how long, how often too long.

import { attempt, isAway, isNotFound, plants, words } from "../api.js";
import { fill, h } from "../dom.js";
import { count, duration } from "../format.js";
import type { GetTimingResponse, TimeSummary } from "../gen/plantd/v1/realtime_pb.js";
import { current } from "../live.js";
import { app, complain } from "../state.js";
import { everySecond, section } from "./section.js";

/** Adds the section. */
export function timing(): void {
  const part = section("timing", "Timing", false);
  const table = h("div", {});
  const clear = h("button", { type: "button" }, "Count anew");
  fill(part.body, table, h("div", { class: "row" }, clear));
  const show = async (forget = false): Promise<void> => {
    const id = current();
    if (id === "") return;
    try {
      const answer = await plants.getTiming({ id, clear: forget });
      fill(table, ...tables(answer));
      part.badge(answer.overruns > 0n ? `${count(answer.overruns)} overruns` : "", "bad");
    } catch (error) {
      if (!isAway(error) && !isNotFound(error)) complain(words(error));
    }
  };
  clear.addEventListener("click", () => void attempt("Timing", () => show(true)).then(() => show()));
  app.subject.on((subject) => {
    part.root.hidden = !subject?.plant;
    part.badge("");
  });
  everySecond(part, () => void show());
}

function tables(answer: GetTimingResponse): HTMLElement[] {
  const row = (name: string, times: TimeSummary | undefined): HTMLElement | false =>
    !!times && times.count > 0n && h("tr", {}, h("td", {}, name), ...[times.p50Ns, times.p99Ns, times.maxNs].map((time) => h("td", {}, duration(time))));
  const counted = (name: string, value: bigint, isBad = false): HTMLElement | false => value > 0n && h("tr", {}, h("td", {}, name), h("td", { class: isBad ? "bad" : "" }, count(value)));
  if (answer.steps === 0n) return [h("p", { class: "hint" }, "The plant's own loop has taken no step. Run it in real time.")];
  return [
    h("table", {}, h("thead", {}, h("tr", {}, h("th", {}), h("th", {}, "median"), h("th", {}, "99 %"), h("th", {}, "largest"))), h("tbody", {}, row("Begins late by", answer.lateness), row("Step takes", answer.step), row("Age of input", answer.inputAge), row("Round trip", answer.roundTrip))),
    h("table", {}, h("tbody", {}, counted("Steps", answer.steps), h("tr", {}, h("td", {}, "Overruns"), h("td", { class: answer.overruns > 0n ? "bad" : "" }, count(answer.overruns))), counted("Schedule given up", answer.slips, true), counted("Late inputs", answer.lateInputs), counted("Steps without valid input", answer.safeInputs))),
  ];
}
