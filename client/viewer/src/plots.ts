// Plots of signals over time: one axis and one cursor for all.

import uPlot from "uplot";
import { byId, fill, h, write } from "./dom.js";
import { number } from "./format.js";
import { type Group, History } from "./history.js";
import { app, remember, remembered } from "./state.js";
import { color, curve, theme } from "./theme.js";

/** From one drawing to the next, ms. */
const DRAW_MS = 125;
/** Curves of a plot that are shown at first. */
const CURVES_FIRST = 6;
/** Points of a curve; of more, some are left out. */
const POINTS_MAX = 2500;
const HEIGHT_LEAST = 120;

interface Plot {
  group: Group;
  chart: uPlot;
  area: HTMLElement;
  box: HTMLElement;
  shown: boolean[];
  values: HTMLElement[];
}

/** The strip of plots. */
export class Plots {
  readonly history = new History();
  #plots: Plot[] = [];
  #groups: Group[] = [];
  #window = Number(remembered("window", "10"));
  #isPaused = false;
  /** What is shown while the plots are paused or zoomed: from, to. */
  #range: [number, number] | undefined;
  #timer = 0;
  #cursor = uPlot.sync("time");
  #host = byId("plots");
  #choice = byId("plot-choice");
  /** A recording is shown: all of it, unless zoomed. */
  whole = false;

  constructor(private readonly hold: (time: number | null) => void) {
    const length = byId<HTMLSelectElement>("plot-window");
    length.value = String(this.#window);
    length.addEventListener("change", () => {
      this.#window = Number(length.value);
      remember("window", length.value);
      this.#range = this.#isPaused ? this.#visible() : undefined;
      this.draw();
    });
    byId("plot-pause").addEventListener("click", () => this.pause());
    byId("plot-unzoom").addEventListener("click", () => this.unzoom());
    new ResizeObserver(() => this.#resize()).observe(this.#host);
    theme.on(() => this.#build());
    app.held.on(() => this.draw());
  }

  /** Plots another subject. */
  begin(all: Group[], keeps: boolean): void {
    const same = keeps && all.map(({ key, signals }) => key + signals.map(({ name }) => name).join()).join() === this.#groups.map(({ key, signals }) => key + signals.map(({ name }) => name).join()).join();
    if (!keeps) this.history.clear();
    this.#groups = all;
    if (same && this.#plots.length > 0) return;
    this.#range = undefined;
    this.#isPaused = false;
    this.#choose();
    this.#build();
  }

  /** Holds the plots still, or lets them run. */
  pause(): void {
    this.#isPaused = !this.#isPaused;
    this.#range = this.#isPaused ? this.#visible() : undefined;
    this.draw();
  }

  /** Shows the whole window again. */
  unzoom(): void {
    this.#range = undefined;
    this.#isPaused = false;
    this.draw();
  }

  /** Draws soon. */
  stale(): void {
    if (this.#timer !== 0) return;
    this.#timer = setTimeout(() => {
      this.#timer = 0;
      this.draw();
    }, DRAW_MS);
  }

  #key(group: Group): string {
    return `plot.${group.key}`;
  }

  #isShown(group: Group): boolean {
    const choice = remembered(this.#key(group), "");
    return choice === "" ? group.isShown : choice === "on";
  }

  /** The switches above the plots. */
  #choose(): void {
    fill(
      this.#choice,
      ...this.#groups.map((group) => {
        const button = h("button", { type: "button", class: "chip", "aria-pressed": this.#isShown(group) }, group.title);
        button.addEventListener("click", () => {
          const on = !this.#isShown(group);
          remember(this.#key(group), on ? "on" : "off");
          button.setAttribute("aria-pressed", String(on));
          this.#build();
        });
        return button;
      }),
    );
  }

  #build(): void {
    for (const { chart } of this.#plots) chart.destroy();
    this.#plots = [];
    fill(this.#host);
    for (const group of this.#groups.filter((each) => this.#isShown(each))) this.#plots.push(this.#plot(group));
    byId("plot-none").hidden = this.#plots.length > 0 || this.#groups.length === 0;
    this.#resize();
    this.draw();
  }

  #plot(group: Group): Plot {
    const shown = group.signals.map((_, index) => index < CURVES_FIRST);
    const area = h("div", { class: "plot-area" });
    const values: HTMLElement[] = [];
    const legend = h("div", { class: "legend", role: "group", "aria-label": `Curves of ${group.title}` });
    const unit = group.unit === "" ? "" : ` ${group.unit}`;
    const box = h("section", { class: "plot", "aria-label": `${group.title}${unit}` }, h("h3", {}, group.title, h("span", { class: "unit" }, unit)), area, legend);
    this.#host.appendChild(box);
    const chart = new uPlot(this.#options(group, shown), [[], ...group.signals.map(() => [])], area);
    const plot = { group, chart, area, box, shown, values };
    group.signals.forEach((signal, index) => {
      const value = h("span", { class: "value" });
      const swatch = h("span", { class: "swatch" });
      swatch.style.background = curve(index);
      const button = h("button", { type: "button", "aria-pressed": shown[index], title: `Show or hide ${signal.name}` }, swatch, h("span", { class: "name" }, signal.name), value);
      button.addEventListener("click", () => {
        shown[index] = !shown[index];
        button.setAttribute("aria-pressed", String(shown[index]));
        chart.setSeries(index + 1, { show: shown[index]! });
        this.draw();
      });
      values.push(value);
      legend.appendChild(button);
    });
    return plot;
  }

  #options(group: Group, shown: boolean[]): uPlot.Options {
    const ink = color("muted");
    const line = color("line");
    const font = `11px ${getComputedStyle(document.body).fontFamily}`;
    const axis = { stroke: ink, font, grid: { stroke: line, width: 1 }, ticks: { show: false } };
    return {
      width: 200,
      height: HEIGHT_LEAST,
      padding: [6, 8, 0, 0],
      legend: { show: false },
      cursor: {
        sync: { key: this.#cursor.key },
        drag: { x: true, y: false, setScale: false },
        points: { size: 6 },
      },
      scales: { x: { time: false, auto: false }, y: { auto: true, range: (_, low, high) => padded(low, high) } },
      axes: [
        { ...axis, size: 22, gap: 3, values: (_, ticks) => ticks.map((tick) => String(Number(tick.toPrecision(6)))) },
        { ...axis, size: 50, gap: 4, values: (_, ticks) => ticks.map(tickText) },
      ],
      series: [{}, ...group.signals.map((signal, index) => ({ label: signal.name, stroke: curve(index), width: 1.5, show: shown[index]!, points: { show: false }, spanGaps: false }))],
      hooks: {
        draw: [(chart) => this.#mark(chart)],
        setCursor: [() => this.#values()],
        setSelect: [(chart) => this.#zoom(chart)],
        ready: [(chart) => this.#listen(chart)],
      },
    };
  }

  /** A line where the cursor is held. */
  #mark(chart: uPlot): void {
    const held = app.held.get();
    if (held === null) return;
    const x = chart.valToPos(held, "x", true);
    const { left, width, top, height } = chart.bbox;
    if (x < left || x > left + width) return;
    chart.ctx.save();
    chart.ctx.strokeStyle = color("accent");
    chart.ctx.lineWidth = 1.5 * devicePixelRatio;
    chart.ctx.beginPath();
    chart.ctx.moveTo(x, top);
    chart.ctx.lineTo(x, top + height);
    chart.ctx.stroke();
    chart.ctx.restore();
  }

  /** A click holds the cursor of all plots there; a double click shows the whole window again. */
  #listen(chart: uPlot): void {
    let at: { x: number; y: number } | undefined;
    chart.over.addEventListener("pointerdown", (event) => (at = { x: event.clientX, y: event.clientY }));
    chart.over.addEventListener("pointerup", (event) => {
      const isClick = at && Math.hypot(event.clientX - at.x, event.clientY - at.y) < 4;
      at = undefined;
      if (!isClick) return;
      const left = event.clientX - chart.over.getBoundingClientRect().left;
      const time = this.history.nearest(chart.posToVal(left, "x"))?.time;
      if (time !== undefined) this.hold(time);
    });
    chart.over.addEventListener("dblclick", () => {
      this.unzoom();
      if (!this.whole) this.hold(null);
    });
  }

  #zoom(chart: uPlot): void {
    const { left, width } = chart.select;
    if (width < 4) return;
    this.#range = [chart.posToVal(left, "x"), chart.posToVal(left + width, "x")];
    chart.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.draw();
  }

  /** From when to when is shown while nothing is held still. */
  #visible(): [number, number] {
    const { moments } = this.history;
    const first = moments[0]?.time ?? 0;
    const last = moments.at(-1)?.time ?? 0;
    if (this.whole || this.#window === 0) return [first, Math.max(last, first + 1e-6)];
    return [last - this.#window, last];
  }

  /** Draws all plots. */
  draw(): void {
    const [from, to] = this.#range ?? this.#visible();
    const { moments } = this.history;
    const begin = Math.max(0, this.history.before(from));
    const end = Math.min(moments.length, this.history.before(to) + 2);
    const stride = Math.max(1, Math.ceil((end - begin) / POINTS_MAX));
    const seen: typeof moments = [];
    // Whole strides from the first state on, so that curves stand still while time goes on.
    for (let i = begin - (begin % stride); i < end; i += stride) seen.push(moments[i]!);
    const last = moments[end - 1];
    if (last && seen.at(-1) !== last) seen.push(last);
    const times = seen.map(({ time }) => time);
    for (const { chart, group, shown } of this.#plots) {
      const curves = group.signals.map((signal, index) => (shown[index] ? seen.map((moment) => signal.of(moment)) : []));
      chart.batch(() => {
        chart.setData([times, ...curves], false);
        chart.setScale("x", { min: from, max: to });
      });
    }
    this.#values();
    byId("plot-pause").setAttribute("aria-pressed", String(this.#isPaused));
    byId("plot-unzoom").hidden = this.#range === undefined || this.#isPaused;
  }

  /** The numbers in the legends: where the cursor is, where it is held, or the newest. */
  #values(): void {
    const held = app.held.get();
    const under = this.#plots.find(({ chart }) => (chart.cursor.left ?? -1) >= 0)?.chart;
    const time = under ? under.posToVal(under.cursor.left!, "x") : held;
    const moment = time === null ? this.history.moments.at(-1) : this.history.nearest(time);
    write(byId("plot-time"), moment && time !== null ? `t = ${moment.time.toFixed(3)} s` : "");
    for (const { group, values } of this.#plots) {
      group.signals.forEach((signal, index) => write(values[index]!, moment ? number(signal.of(moment), 3) : ""));
    }
  }

  #resize(): void {
    for (const { chart, area } of this.#plots) {
      const { clientWidth: width, clientHeight: height } = area;
      if (width > 0) chart.setSize({ width, height: Math.max(height, HEIGHT_LEAST) });
    }
  }
}

/** A number beside an axis. */
function tickText(tick: number): string {
  const text = String(Number(tick.toPrecision(4)));
  return (text.length > 7 ? tick.toExponential(0) : text).replace("-", "−").replace("e+", "e");
}

/** A range with some room, which is not empty. */
function padded(low: number | null, high: number | null): [number, number] {
  if (low === null || high === null || !Number.isFinite(low) || !Number.isFinite(high)) return [-1, 1];
  const size = Math.max(Math.abs(low), Math.abs(high));
  // What is still but for round-off is drawn still.
  const room = high - low < 1e-9 * Math.max(1, size) ? Math.max(0.1 * size, 0.5) : 0.08 * (high - low);
  return [low - room, high + room];
}
