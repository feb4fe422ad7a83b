// What lies over the view: which parts are shown, how it stands with the server, the scrubber of a recording.

import { byId, fill, h, icon, options, write } from "./dom.js";
import { count } from "./format.js";
import type { Recording } from "./recording.js";
import type { View } from "./scene/view.js";
import type { Parts } from "./scene/figure.js";
import { app, remember, remembered } from "./state.js";

/** The switches of what is shown, the frame that the camera follows, and the way home. */
export function layers(view: View): void {
  const names: [keyof Parts, string, string][] = [
    ["links", "Lines", "Links, springs and constraints"],
    ["inputs", "Inputs", "Inputs as arrows"],
    ["forces", "Forces", "Constraint forces as arrows"],
    ["axes", "Axes", "Axes of the frames"],
  ];
  const chips = names.map(([key, name, title]) => {
    const parts = { ...view.parts, [key]: remembered(`layer.${key}`, String(view.parts[key])) === "true" };
    view.choose(parts);
    const chip = h("button", { type: "button", class: "chip", title, "aria-pressed": parts[key] }, name);
    chip.addEventListener("click", () => {
      const on = !view.parts[key];
      remember(`layer.${key}`, String(on));
      view.choose({ ...view.parts, [key]: on });
      chip.setAttribute("aria-pressed", String(on));
    });
    return chip;
  });
  const home = h("button", { type: "button", class: "chip", title: "The first view (H)" }, "Home");
  home.addEventListener("click", () => view.home());
  const follow = h("select", { id: "follow", "aria-label": "Frame that the camera follows" });
  follow.addEventListener("change", () => view.follow(follow.value === "" ? undefined : Number(follow.value)));
  fill(byId("layers"), ...chips, home, follow);
  app.subject.on((subject) => {
    const frames = subject?.drawing.frames ?? [];
    options(follow, [["", "Follow…"], ...frames.map(({ name }, index): [string, string] => [String(index), `Follow ${name}`])]);
    follow.value = view.followed === undefined ? "" : String(view.followed);
    byId("layers").hidden = subject === null;
  });
}

/** How it stands with the server, and that the cursor is held. */
export function status(release: () => void): void {
  const line = byId("status");
  const show = (): void => {
    const connection = app.connection.get();
    const held = app.held.get();
    const isLive = app.subject.get()?.plant !== "";
    const stopped = app.info.get()?.run?.stoppedBy?.message ?? "";
    const text = !isLive ? "" : connection === "lost" ? "The server does not answer. Trying again." : connection === "connecting" ? "Connecting" : held !== null ? `Held at ${held.toFixed(3)} s` : stopped !== "" ? `Stopped: ${stopped}` : connection === "turns" ? "Some states a second: other windows watch, too" : "";
    line.hidden = text === "";
    line.classList.toggle("bad", connection === "lost" || text.startsWith("Stopped"));
    if (line.dataset["text"] === text) return;
    line.dataset["text"] = text;
    const button = h("button", { type: "button" }, "Live");
    button.addEventListener("click", release);
    fill(line, text, (connection === "live" || connection === "turns") && held !== null && button);
  };
  app.connection.on(show);
  app.held.on(show);
  app.info.on(show);
  app.subject.on(show);
}

/** Messages come and go; errors stay until they are closed or a while has passed. */
export function notices(): void {
  const line = byId("notice");
  let timer = 0;
  const close = (): void => {
    line.hidden = true;
  };
  app.notice.on((notice) => {
    if (!notice) return;
    clearTimeout(timer);
    const button = h("button", { type: "button", class: "plain icon", "aria-label": "Close" }, icon("close"));
    button.addEventListener("click", close);
    line.className = notice.kind;
    fill(line, notice.text, button);
    line.hidden = false;
    timer = setTimeout(close, notice.kind === "error" ? 12_000 : 4000);
  });
}

/** Plays a recording, or goes to a step of it. */
export class Scrubber {
  #recording: Recording | undefined;
  #index = 0;
  #isPlaying = false;
  #time = 0;
  #last = 0;
  #range = h("input", { type: "range", min: "0", step: "1", "aria-label": "Step of the recording" });
  #play = h("button", { type: "button", class: "icon main", "aria-label": "Play" }, icon("play"));
  #where = h("span", { class: "where" });
  #speed = h("select", { "aria-label": "Speed of playing" });

  constructor(private readonly shown: (index: number) => void, close: () => void) {
    const end = h("button", { type: "button", class: "icon plain", "aria-label": "Close the recording", title: "Back to the plants" }, icon("close"));
    end.addEventListener("click", close);
    options(this.#speed, [0.1, 0.25, 0.5, 1, 2, 5].map((value) => [String(value), `${value}×`]));
    this.#speed.value = "1";
    this.#range.addEventListener("input", () => {
      this.pause();
      this.go(Number(this.#range.value));
    });
    this.#play.addEventListener("click", () => this.toggle());
    fill(byId("scrubber"), this.#play, this.#speed, this.#range, this.#where, end);
  }

  /** Takes a recording, or none. */
  open(recording: Recording | undefined): void {
    this.pause();
    this.#recording = recording;
    byId("scrubber").hidden = !recording;
    if (!recording) return;
    this.#range.max = String(recording.length - 1);
    this.go(0);
  }

  get isOpen(): boolean {
    return this.#recording !== undefined;
  }

  /** Goes to a step. */
  go(index: number): void {
    const recording = this.#recording;
    if (!recording) return;
    this.#index = Math.min(Math.max(index, 0), recording.length - 1);
    this.#time = recording.time(this.#index);
    this.#range.value = String(this.#index);
    write(this.#where, `${this.#time.toFixed(3)} s, ${count(this.#index + 1)} of ${count(recording.length)}`);
    this.shown(this.#index);
  }

  /** Goes on by some steps. */
  by(steps: number): void {
    this.pause();
    this.go(this.#index + steps);
  }

  /** Goes to the step at a time. */
  to(time: number): void {
    if (this.#recording) this.go(this.#recording.at(time));
  }

  toggle(): void {
    if (this.#isPlaying) {
      this.pause();
      return;
    }
    const recording = this.#recording;
    if (!recording) return;
    if (this.#index >= recording.length - 1) this.go(0);
    this.#isPlaying = true;
    this.#last = performance.now();
    this.#show();
    requestAnimationFrame((now) => this.#turn(now));
  }

  pause(): void {
    this.#isPlaying = false;
    this.#show();
  }

  #show(): void {
    fill(this.#play, icon(this.#isPlaying ? "pause" : "play"));
    this.#play.setAttribute("aria-label", this.#isPlaying ? "Pause" : "Play");
  }

  #turn(now: number): void {
    const recording = this.#recording;
    if (!this.#isPlaying || !recording) return;
    const time = this.#time + ((now - this.#last) / 1000) * Number(this.#speed.value);
    this.#last = now;
    const index = recording.at(time);
    if (index !== this.#index) this.go(index);
    this.#time = time;
    if (index >= recording.length - 1) this.pause();
    else requestAnimationFrame((next) => this.#turn(next));
  }
}
