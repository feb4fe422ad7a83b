// The plant that is shown: its description, one Watch stream for all that is seen of it, and how it is run.

import { place } from "./connections.js";
import { complain, app, type Moment, type Subject } from "./state.js";
import { channels, isAway, isCanceled, isNotFound, models, plants, words } from "./api.js";
import { WatchField, type WatchResponse } from "./gen/plantd/v1/plant_service_pb.js";

/** States a second that are asked for: what a screen shows. */
const STATES_HZ = 60;
/** From one look at the plant to the next, ms. */
const LOOK_MS = 1000;
/** Between two attempts to reach a server that does not answer, ms. */
const RETRY_MS = [300, 600, 1000, 2000];
/** From one look at the states to the next, while other windows have the streams, ms. */
const TURN_MS = 250;

const FIELDS = [
  WatchField.STATE,
  WatchField.ENERGY,
  WatchField.INPUT,
  WatchField.OUTPUTS,
  WatchField.TIMING,
  WatchField.POSES,
];

/** What a plant is: asked once, and again when its parameters have changed. */
export async function describe(plant: string, signal?: AbortSignal): Promise<Subject & { generation: bigint }> {
  const call = signal ? { signal } : {};
  const { plant: info } = await plants.getPlant({ id: plant }, call);
  if (!info) throw new Error("the server describes no plant");
  const [{ model }, drawing, { info: sensors }] = await Promise.all([
    models.getModel({ name: info.model }, call),
    models.getDrawing({ of: { case: "plant", value: plant } }, call),
    channels.getChannels({ id: plant }, call),
  ]);
  if (!model || !drawing.drawing) throw new Error(`the server describes no model \`${info.model}\``);
  return {
    title: plant,
    plant,
    model,
    drawing: drawing.drawing,
    outputs: sensors?.names ?? [],
    timeStep: info.settings?.timeStepS ?? model.timeStepS,
    generation: drawing.generation,
  };
}

/**
 * One Watch stream of a plant, opened again whenever it breaks, closed while nobody looks. While other windows of the
 * browser have all the places for streams, it is opened for one state at a time.
 */
export class Watcher {
  #ending = new AbortController();
  #renewing = new AbortController();
  #before: Moment | undefined;

  constructor(
    readonly plant: string,
    private readonly told: {
      /** What the plant is, before its first state and whenever it has changed. */
      subject(subject: Subject): void;
      state(moment: Moment): void;
      /** How it stands. */
      connection(state: "connecting" | "live" | "turns" | "lost" | "hidden"): void;
      /** There is no such plant any more. */
      gone(): void;
      wantsPoles(): boolean;
    },
  ) {
    // Not before whoever makes it knows it.
    queueMicrotask(() => void this.#run());
  }

  /** Opens the stream anew: what is wanted, or what is computed for it, has changed. */
  renew(): void {
    this.#renewing.abort();
  }

  /** Ends it for good. */
  end(): void {
    this.#ending.abort();
  }

  async #run(): Promise<void> {
    let failures = 0;
    while (!this.#ending.signal.aborted) {
      if (document.hidden) {
        this.told.connection("hidden");
        await visible(this.#ending.signal);
        continue;
      }
      const stream = new AbortController();
      const stop = (): void => stream.abort();
      const hide = (): void => {
        if (document.hidden) stop();
      };
      this.#ending.signal.addEventListener("abort", stop);
      document.addEventListener("visibilitychange", hide);
      try {
        this.told.connection("connecting");
        await this.#stream(stream.signal, () => (failures = 0));
        // It was ended to be opened anew: the parameters have changed, or other fields are wanted.
      } catch (error) {
        if (this.#ending.signal.aborted) break;
        if (isNotFound(error)) {
          this.told.gone();
          break;
        }
        if (!isCanceled(error)) {
          if (!isAway(error) && failures === 0) complain(`${this.plant}: ${words(error)}`);
          this.told.connection("lost");
          await pause(RETRY_MS[Math.min(failures++, RETRY_MS.length - 1)] ?? 0, this.#ending.signal);
        }
      } finally {
        this.#ending.signal.removeEventListener("abort", stop);
        document.removeEventListener("visibilitychange", hide);
      }
    }
  }

  /** Reads states until the stream ends or has to be opened anew. */
  async #stream(signal: AbortSignal, arrived: () => void): Promise<void> {
    const subject = await describe(this.plant, signal);
    this.told.subject(subject);
    this.#before = undefined;
    const withPoles = this.told.wantsPoles();
    const fields = withPoles ? [...FIELDS, WatchField.POLES] : FIELDS;
    const request = { id: this.plant, fields, atMostHz: STATES_HZ };
    const inner = new AbortController();
    this.#renewing = inner;
    signal.addEventListener("abort", () => inner.abort());
    while (!inner.signal.aborted) {
      const giveBack = await place("watch");
      const turn = new AbortController();
      const stop = (): void => turn.abort();
      inner.signal.addEventListener("abort", stop);
      try {
        for await (const message of plants.watch(request, { signal: turn.signal })) {
          arrived();
          this.told.connection(giveBack ? "live" : "turns");
          if (message.generation !== subject.generation) return;
          const moment = read(message, this.#before);
          if (moment) {
            this.#before = moment;
            this.told.state(moment);
          }
          if (!giveBack) break;
        }
      } finally {
        stop();
        inner.signal.removeEventListener("abort", stop);
        giveBack?.();
      }
      if (!giveBack) await pause(TURN_MS, inner.signal);
      else if (!signal.aborted) throw new TypeError("the stream has ended");
    }
  }
}

/** A message as a state; what it leaves out is as in the one before. */
function read(message: WatchResponse, before: Moment | undefined): Moment | undefined {
  const { state } = message;
  if (!state && !before) return undefined;
  return {
    step: Number(message.step),
    time: state?.timeS ?? message.clocks?.plantS ?? before?.time ?? 0,
    q: state?.q ?? before?.q ?? [],
    velocity: state?.velocity ?? before?.velocity ?? [],
    u: state ? message.u : (before?.u ?? []),
    outputs: message.outputs?.y ?? before?.outputs ?? [],
    kinetic: message.energy?.kineticJ ?? before?.kinetic ?? NaN,
    potential: message.energy?.potentialJ ?? before?.potential ?? NaN,
    poses: message.poses ?? before?.poses,
    poles: message.poles ?? before?.poles,
    timing: message.timing ?? before?.timing,
  };
}

/** Waits until the page can be seen. */
function visible(signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const look = (): void => {
      if (document.hidden && !signal.aborted) return;
      document.removeEventListener("visibilitychange", look);
      resolve();
    };
    document.addEventListener("visibilitychange", look);
    signal.addEventListener("abort", look);
  });
}

function pause(ms: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    setTimeout(resolve, ms);
    signal.addEventListener("abort", () => resolve());
  });
}

let watcher: Watcher | undefined;

/** Shows a plant, or none. */
export function show(plant: string): void {
  watcher?.end();
  watcher = undefined;
  app.subject.set(null);
  app.latest.set(null);
  app.held.set(null);
  app.info.set(app.plants.get().find((info) => info.id === plant) ?? null);
  if (plant === "") {
    app.connection.set("none");
    return;
  }
  const mine: Watcher = new Watcher(plant, {
    subject: (subject) => watcher === mine && app.subject.set(subject),
    state: (moment) => watcher === mine && app.latest.set(moment),
    connection: (state) => {
      if (watcher === mine && app.connection.get() !== state) app.connection.set(state);
    },
    gone: () => {
      if (watcher !== mine) return;
      complain(`There is no plant ${plant} any more.`);
      app.info.set(null);
      show(app.plants.get().find((info) => info.id !== plant)?.id ?? "");
    },
    wantsPoles: () => app.wantsPoles.get(),
  });
  watcher = mine;
  void look();
}

// A stream has what was wanted when it was opened.
let hadPoles = app.wantsPoles.get();
app.wantsPoles.on((wants) => {
  if (wants !== hadPoles) watcher?.renew();
  hadPoles = wants;
});

/** Id of the plant that is shown. */
export function current(): string {
  return watcher?.plant ?? "";
}

/** Asks how the plant is being run. */
export async function look(): Promise<void> {
  const plant = current();
  if (plant === "") return;
  try {
    const { plant: info } = await plants.getPlant({ id: plant });
    if (info && current() === plant) app.info.set(info);
  } catch (error) {
    // The Watch stream tells what is wrong with the connection or the plant.
    if (!isAway(error) && !isNotFound(error)) complain(words(error));
  }
}

/** All plants by id. */
export async function list(): Promise<void> {
  try {
    const all = [];
    let pageToken = "";
    do {
      const page = await plants.listPlants({ pageSize: 1000, pageToken });
      all.push(...page.plants);
      pageToken = page.nextPageToken;
    } while (pageToken !== "");
    app.plants.set(all);
    if (app.connection.get() === "connecting" && !watcher) app.connection.set("none");
  } catch (error) {
    if (!isAway(error)) complain(words(error));
    else if (!watcher) app.connection.set("lost");
  }
}

/** Keeps the list of plants and the run of the one that is shown up to date. */
export function follow(): void {
  let turn = 0;
  setInterval(() => {
    if (document.hidden) return;
    void look();
    if (++turn % 3 === 0 || !watcher) void list();
  }, LOOK_MS);
}
