// Recordings: made by the server, opened here.

import { attempt, isAway, recordings as service, words } from "../api.js";
import { fill, h, icon } from "../dom.js";
import { bytes, count } from "../format.js";
import { RecordingStatus, type Recording as Listed } from "../gen/plantd/v1/recording_service_pb.js";
import { current } from "../live.js";
import { alone, app, complain } from "../state.js";
import { everySecond, section } from "./section.js";

/** The bytes of a recording of the server. */
export async function download(name: string): Promise<Uint8Array> {
  const parts: Uint8Array[] = [];
  for await (const { data } of service.getRecording({ name })) parts.push(data);
  const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

/** Adds the section. `open` shows a recording. */
export function recordings(open: (name: string, read: () => Promise<Uint8Array>) => void): void {
  const part = section("recordings", "Recordings", false);
  const record = h("button", { type: "button", id: "record" }, "Record");
  const file = h("input", { type: "file", accept: ".mcap", hidden: true, "aria-label": "Recording" });
  const choose = h("button", { type: "button" }, "Open a file…");
  const list = h("div", { class: "list", id: "recording-list" });
  const hint = h("p", { class: "hint" });
  fill(part.body, h("div", { class: "row" }, record, choose, file), hint, list);
  let active: Listed | undefined;

  choose.addEventListener("click", () => file.click());
  file.addEventListener("change", () => {
    const chosen = file.files?.[0];
    if (chosen) open(chosen.name, async () => new Uint8Array(await chosen.arrayBuffer()));
    file.value = "";
  });
  record.addEventListener("click", () => {
    const running = active;
    void attempt("Recording", () => (running ? service.stopRecording({ name: running.name }) : service.startRecording({ id: current() }))).then(show);
  });

  async function show(): Promise<void> {
    try {
      const { recordings } = await service.listRecordings({ pageSize: 1000 });
      active = recordings.find(({ plant, status }) => plant === current() && plant !== "" && status === RecordingStatus.ACTIVE);
      fill(record, icon(active ? "stop" : "record"), active ? " Stop recording" : " Record");
      record.disabled = current() === "";
      part.badge(active ? `${count(active.steps)} steps` : "", "on");
      hint.textContent = recordings.length === 0 ? "None yet. A file can also be dropped on the page." : "";
      fill(list, ...recordings.map((each) => row(each)));
    } catch (error) {
      record.disabled = true;
      fill(list);
      hint.textContent = isAway(error) ? "" : words(error);
    }
  }

  function row({ name, steps, bytes: size, status, failure }: Listed): HTMLElement {
    const look = h("button", { type: "button", "aria-label": `Open ${name}` }, "Open");
    look.addEventListener("click", () => open(name, () => download(name)));
    const about = [steps > 0n ? `${count(steps)} steps` : "", size > 0n ? bytes(size) : "", status === RecordingStatus.ACTIVE ? "in progress" : "", failure].filter((text) => text !== "").join(", ");
    return h("div", {}, h("span", { class: "grow" }, name, h("small", {}, about)), look);
  }
  everySecond(part, () => void show());
  app.subject.on(() => {
    if (part.root.open && alone === null) void show().catch((error: unknown) => complain(words(error)));
  });
}
