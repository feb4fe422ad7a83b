// The page: what is shown comes from a plant or a recording; everything else follows from it.

import { words } from "./api.js";
import { byId, fill, h, icon, write } from "./dom.js";
import { films } from "./film.js";
import { groups } from "./history.js";
import { keys, showHelp } from "./keys.js";
import { current, follow, list, show } from "./live.js";
import { compare } from "./panel/compare.js";
import { faults } from "./panel/faults.js";
import { feedback } from "./panel/feedback.js";
import { giveBack, inputs } from "./panel/inputs.js";
import { choose, neighbour, picker } from "./panel/picker.js";
import { poles } from "./panel/poles.js";
import { download, recordings } from "./panel/recordings.js";
import { timing } from "./panel/timing.js";
import { resetTo, step, toggleRun, transport } from "./panel/transport.js";
import { Plots } from "./plots.js";
import { Recording } from "./recording.js";
import { pushing } from "./scene/push.js";
import { View } from "./scene/view.js";
import { layers, notices, Scrubber, status } from "./stage.js";
import { alone, app, complain, inform, type Subject } from "./state.js";
import { switchTheme, theme } from "./theme.js";

/** Points of a recording's plots. */
const OVERVIEW = 4000;

notices();
const view = makeView();
let recording: Recording | undefined;

const plots = new Plots((time) => {
  if (recording && time !== null) scrubber.to(time);
  else if (!recording) app.held.set(time);
});

const scrubber = new Scrubber(
  (index) => {
    const moment = recording?.moment(index);
    if (!moment) return;
    app.held.set(moment.time);
    app.shown.set(moment);
  },
  () => choose(app.plants.get()[0]?.id ?? ""),
);

layers(view);
status(() => app.held.set(null));
picker();
transport();
inputs();
poles();
feedback();
faults();
timing();
recordings((name, read) => void openRecording(name, read));
compare(view);
tools();
dropping();
films({
  view,
  history: plots.history,
  recorded: () => recording && [recording.time(0), recording.time(recording.length - 1)],
  show: (time) => (recording ? scrubber.to(time) : app.held.set(time)),
});
pushing(view, (text, x, y) => {
  const label = byId("label");
  label.hidden = text === "";
  write(label, text);
  label.style.left = `${x + 14}px`;
  label.style.top = `${y + 12}px`;
});

/** What was shown last: another state of the same keeps camera and plots. */
let before: Subject | null = null;
let again = "";

app.subject.on((subject) => {
  document.title = subject ? `${subject.title} · plantd` : "plantd";
  if (subject && subject.plant !== "" && recording) {
    recording = undefined;
    scrubber.open(undefined);
    plots.whole = false;
  }
  if (!subject) return;
  const isSame = before !== null && before.plant === subject.plant && subject.plant !== "" && before.model.name === subject.model.name;
  if (isSame && again === JSON.stringify(subject.drawing)) {
    // Only the connection was lost.
  } else view.show(subject.drawing, isSame);
  again = JSON.stringify(subject.drawing);
  plots.begin(groups(subject), isSame);
  before = subject;
});

app.latest.on((moment) => {
  if (!moment || recording) {
    if (!recording) app.shown.set(null);
    return;
  }
  plots.history.add(moment);
  plots.stale();
  if (app.held.get() === null) app.shown.set(moment);
});

app.held.on((time) => {
  if (recording) return;
  const moment = time === null ? app.latest.get() : plots.history.nearest(time);
  if (moment) app.shown.set(moment);
});

app.shown.on((moment) => {
  if (moment?.poses) view.update(moment.poses);
});

theme.on(() => {
  const subject = app.subject.get();
  const poses = app.shown.get()?.poses;
  if (subject) view.show(subject.drawing, true);
  if (poses) view.update(poses);
});

app.connection.on((state) => {
  if (state === "none" && !recording) view.show(undefined, false);
});

/** The view, or a word why there is none. */
function makeView(): View {
  try {
    return new View(byId<HTMLCanvasElement>("canvas"));
  } catch (error) {
    complain(`This browser shows no 3D: ${words(error)}`);
    throw error;
  }
}

/** Shows a recording in place of a plant. */
async function openRecording(name: string, read: () => Promise<Uint8Array>): Promise<void> {
  try {
    inform(`Reading ${name}`);
    const opened = new Recording(name.replace(/\.mcap$/, ""), await read());
    show("");
    giveBack();
    before = null;
    recording = opened;
    app.subject.set(opened.subject);
    plots.whole = true;
    plots.history.clear();
    for (const moment of opened.overview(OVERVIEW)) plots.history.add(moment);
    scrubber.open(opened);
    plots.unzoom();
    app.notice.set({ text: `${name}: ${opened.length} steps.`, kind: "info" });
  } catch (error) {
    complain(`Recording ${name}: ${words(error)}`);
  }
}

/** A recording that is dropped on the page is opened. */
function dropping(): void {
  const mark = byId("drop");
  document.addEventListener("dragover", (event) => {
    event.preventDefault();
    mark.hidden = false;
  });
  document.addEventListener("dragleave", (event) => {
    if (event.relatedTarget === null) mark.hidden = true;
  });
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    mark.hidden = true;
    const file = event.dataTransfer?.files[0];
    if (file) void openRecording(file.name, async () => new Uint8Array(await file.arrayBuffer()));
  });
}

/** Theme and help, and the keyboard. */
function tools(): void {
  const help = h("button", { type: "button", class: "icon plain", "aria-label": "Mouse and keyboard", title: "Help (?)" }, "?");
  const dark = h("button", { type: "button", class: "icon plain", id: "theme", "aria-label": "Dark or light", title: "Dark or light (D)" }, icon("theme"));
  help.addEventListener("click", showHelp);
  dark.addEventListener("click", switchTheme);
  fill(byId("page-tools"), dark, help);
  const turn = 0.12;
  keys([
    { label: "Space", does: "Run or pause; play a recording.", keys: [" "], act: () => (recording ? scrubber.toggle() : void toggleRun()) },
    { label: ".  ,", does: "One step; a step of a recording forth or back.", keys: [".", ","], act: ({ key }) => (recording ? scrubber.by(key === "." ? 1 : -1) : key === "." && void step()) },
    { label: "R", does: "Reset to the initial state.", keys: ["r", "R"], act: () => void resetTo("") },
    { label: "[  ]", does: "The plant before, the next one.", keys: ["[", "]"], act: ({ key }) => neighbour(key === "]" ? 1 : -1) },
    { label: "← → ↑ ↓", does: "Turn the view.", keys: ["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"], act: ({ key }) => view.orbit(key === "ArrowLeft" ? -turn : key === "ArrowRight" ? turn : 0, key === "ArrowUp" ? turn : key === "ArrowDown" ? -turn : 0) },
    { label: "+  −", does: "Zoom.", keys: ["+", "=", "-"], act: ({ key }) => view.zoom(key === "-" ? 1 / 1.15 : 1.15) },
    { label: "H", does: "The first view again.", keys: ["h", "H"], act: () => view.home() },
    { label: "F", does: "Follow the next frame.", keys: ["f", "F"], act: () => followNext() },
    { label: "P", does: "Hold the plots still.", keys: ["p", "P"], act: () => plots.pause() },
    { label: "D", does: "Dark or light.", keys: ["d", "D"], act: switchTheme },
    { label: "Esc", does: "Let go of the held cursor; give the lease back.", keys: ["Escape"], act: () => (app.held.get() !== null && !recording ? app.held.set(null) : giveBack()) },
    { label: "?", does: "This panel.", keys: ["?"], act: showHelp },
  ]);
}

function followNext(): void {
  const select = byId<HTMLSelectElement>("follow");
  select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
  select.dispatchEvent(new Event("change"));
}

/** What tests look at: pictures drawn, and where frames are in the scene and in the window. */
Object.defineProperty(window, "plantdView", {
  value: {
    drawn: () => view.drawn,
    isDrawn: () => view.isDrawn,
    shown: () => ({ step: app.shown.get()?.step, q: app.shown.get()?.q, samples: plots.history.moments.length }),
    frames: () => view.figure?.frames.map(({ name, matrixWorld }) => ({ name, matrix: matrixWorld.toArray() })) ?? [],
    pixel: (name: string) => {
      const frame = view.figure?.frame(name);
      const group = frame === undefined ? undefined : view.figure?.frames[frame];
      const part = group?.children[0];
      return part ? view.pixel(part.getWorldPosition(part.position.clone())) : undefined;
    },
    shapes: (name: string) => view.boxes(view.figure?.frame(name) ?? -1).map(({ min, max }) => ({ low: min.toArray(), high: max.toArray() })),
    under: (x: number, y: number) => {
      const hit = view.pick(x, y);
      return hit && view.figure?.drawing.frames[hit.frame]?.name;
    },
  },
});

async function begin(): Promise<void> {
  const asked = new URLSearchParams(location.search);
  const file = asked.get("recording");
  const address = alone;
  if (address !== null) {
    await openRecording(address.slice(address.lastIndexOf("/") + 1), async () => {
      const answer = await fetch(address);
      if (!answer.ok) throw new Error(`${answer.status} ${answer.statusText}`);
      return new Uint8Array(await answer.arrayBuffer());
    });
    return;
  }
  await list();
  follow();
  if (file !== null) {
    await openRecording(file, () => download(file));
    return;
  }
  const plants = app.plants.get();
  const wanted = asked.get("plant") ?? plants[0]?.id ?? "";
  if (current() === "" && wanted !== "") choose(wanted);
  // Plants that are made later: the first one is shown.
  app.plants.on((all) => {
    if (current() === "" && !recording && all.length > 0 && byId("empty").hidden === false && app.subject.get() === null) choose(all[0]!.id);
  });
}

void begin();
