// Films: what `plantctl render` asks of a page without a window, picture by picture.

import type { History } from "./history.js";
import type { View } from "./scene/view.js";
import { app } from "./state.js";

/** What is filmed stands still or has stopped when nothing new comes for so long, ms. */
const PATIENCE_MS = 15_000;

/** Times of a film at which it is looked how far the mechanism reaches. */
const PLACES = 60;

/** What a film is made from. */
export interface Source {
  view: View;
  history: History;
  /** First and last time of the recording that is shown, s. */
  recorded(): [number, number] | undefined;
  /** Shows the state at a time. */
  show(time: number): void;
}

/** Waits for a picture of the browser. */
const picture = (): Promise<unknown> => new Promise((resolve) => requestAnimationFrame(resolve));

/** Makes the page ready for films where its address asks for them: `film=scene` leaves nothing but the view. */
export function films({ view, history, recorded, show }: Source): void {
  const kind = new URLSearchParams(location.search).get("film");
  if (kind === null) return;
  document.documentElement.dataset["film"] = kind;
  let trouble = "";
  app.notice.on((notice) => {
    if (notice?.kind === "error") trouble ||= notice.text;
  });
  Object.defineProperty(window, "plantdFilm", {
    value: {
      /** Sees the plant for some seconds of its time, or has the recording; the times of which there are pictures. */
      async gather(seconds: number): Promise<[number, number]> {
        for (let [since, seen] = [performance.now(), 0]; ; await picture()) {
          const span = recorded();
          if (span) return span;
          const { moments } = history;
          const [first, last] = [moments[0], moments.at(-1)];
          if (first && last && view.isPlaced) {
            // What is seen meanwhile need not be drawn.
            if (app.held.get() === null) app.held.set(first.time);
            if (last.time >= first.time + seconds) return [first.time, last.time];
          }
          if (moments.length !== seen) [since, seen] = [performance.now(), moments.length];
          else if (performance.now() - since > PATIENCE_MS) throw new Error(trouble || (first ? "the plant stands still" : "the page shows nothing"));
        }
      },
      /** Puts the camera where all that happens between two times, s, is seen. */
      frame(from: number, until: number): void {
        show(from);
        const box = view.extent;
        for (let place = 1; place <= PLACES; place++) {
          show(from + ((until - from) * place) / PLACES);
          box.union(view.extent);
        }
        view.home(box);
      },
      /** Turns the camera to the right and up, rad, and brings it nearer by a factor. */
      look(right: number, up: number, zoom: number): void {
        view.orbit(right, up);
        view.zoom(zoom);
      },
      /** Shows the state at a time, s, and waits until it is drawn. */
      async at(time: number): Promise<void> {
        show(time);
        do await picture();
        while (!view.isDrawn);
      },
    },
  });
}
