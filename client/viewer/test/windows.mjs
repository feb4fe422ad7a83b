// Ten windows of one browser, more than it has connections to a server, and one of them stopped.

import assert from "node:assert/strict";
import { readFileSync, readdirSync } from "node:fs";
import { setPriority } from "node:os";
import { Pace } from "./api.mjs";
import { launch } from "./browser.mjs";

const WINDOWS = 10;
/** What is compared, ms. */
const SPAN_MS = 2000;
const STEP_S = 0.001;

/** Lowest priority, which is left to whoever has nothing to lose. */
const LOWEST = 19;

/** A process and all that come from it. */
function family(root) {
  const parents = new Map();
  for (const pid of readdirSync("/proc").filter((name) => /^\d+$/.test(name))) {
    try {
      const stat = readFileSync(`/proc/${pid}/stat`, "utf8");
      parents.set(Number(pid), Number(stat.slice(stat.lastIndexOf(")") + 2).split(" ")[1]));
    } catch {
      // It has ended meanwhile.
    }
  }
  const all = [root];
  for (const pid of all) for (const [child, parent] of parents) if (parent === pid) all.push(child);
  return all;
}

/** The process that shows a page: the one that works while the page does. */
async function processOf(browser, page) {
  const session = await browser.target().createCDPSession();
  const renderers = async () => {
    const { processInfo } = await session.send("SystemInfo.getProcessInfo");
    return new Map(processInfo.filter(({ type }) => type === "renderer").map(({ id, cpuTime }) => [id, cpuTime]));
  };
  const before = await renderers();
  await page.evaluate(() => {
    for (const began = performance.now(); performance.now() < began + 1500; );
  });
  const worked = [...(await renderers())].map(([id, time]) => [id, time - (before.get(id) ?? 0)]);
  await session.detach();
  return worked.reduce((best, each) => (each[1] > best[1] ? each : best))[0];
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

export const windowTests = ({ api, server, until, shows, watched }) => ({
  async "ten windows work, and one that is stopped costs no plant a step"() {
    const id = "thousand-hertz";
    await api.plants.createPlant({ id, model: "double-pendulum", settings: { timeStepS: STEP_S } });
    await api.plants.run({ id, settings: { pace: Pace.PACED, speed: 1 } });
    /** What the loop counts in a while. */
    const counted = async () => {
      await api.plants.getTiming({ id, clear: true });
      await pause(SPAN_MS);
      const { steps, overruns, slips } = await api.plants.getTiming({ id });
      return { steps: Number(steps), overruns: Number(overruns), slips: Number(slips) };
    };
    const alone = [await counted()];
    const browser = await launch();
    let first;
    const stopped = [];
    try {
      // What it draws on the same processors must not be what is measured: it gets what others leave.
      for (const pid of family(browser.process().pid)) setPriority(pid, LOWEST);
      const open = async () => {
        const page = await browser.newPage({ type: "window" }); // In a tab behind another one it would sleep.
        watched(page);
        await page.setViewport({ width: 320, height: 240 });
        await page.goto(`${server.url}/?plant=${id}`);
        await shows(page, id);
        return page;
      };
      // Two that have places for sure, and all others at once, in whatever order they come.
      const pages = [await open()];
      first = await processOf(browser, pages[0]);
      pages.push(await open());
      pages.push(...(await Promise.all(Array.from({ length: WINDOWS - 2 }, open))));
      // More windows than connections: all of them see the plant move, and their calls are answered.
      const step = (page) => page.evaluate(() => window.plantdView.shown().step);
      const steps = await Promise.all(pages.map(step));
      await Promise.all(pages.map((page, number) => until(page, `states in window ${number}`, (before) => window.plantdView.shown().step > before, steps[number])));
      const status = await Promise.all(pages.map((page) => page.evaluate(() => document.getElementById("status").textContent)));
      const last = pages[status.findLastIndex((text) => /other windows watch/.test(text))];
      assert.ok(last, `no window waits for a place: ${status.join("; ")}`);
      await last.evaluate(() => document.getElementById("record").click());
      await until(last, "a call of the last window", () => /Recording|Stop/.test(document.getElementById("section-recordings").textContent));
      const beside = [await counted()];
      process.kill(first, "SIGSTOP");
      stopped.push(first);
      const answer = await Promise.race([step(pages[0]), pause(2000).then(() => "none")]);
      assert.equal(answer, "none", "the first window answers");
      beside.push(await counted(), await counted());
      // A place that a window gives back is taken by another.
      const waits = (page) => page.evaluate(() => /other windows/.test(document.getElementById("status").textContent));
      const waiting = async () => (await Promise.all(pages.slice(2).map(waits))).filter(Boolean).length;
      const before = await waiting();
      await pages[1].close();
      for (let attempt = 0; (await waiting()) >= before; attempt++) {
        assert.ok(attempt < 200, "no window takes the place");
        await pause(100);
      }
      for (const pid of stopped.splice(0)) process.kill(pid, "SIGCONT");
      alone.push(await counted());
      const sum = (all, key) => all.reduce((total, each) => total + each[key], 0) / all.length;
      const line = (all) => `${sum(all, "steps").toFixed(0)} steps, ${sum(all, "overruns").toFixed(1)} over time, ${sum(all, "slips").toFixed(1)} slips`;
      console.log(`  in ${SPAN_MS} ms, without windows: ${line(alone)}; with: ${line(beside)}`);
      // The best span beside windows loses no more than the worst one without: others use this machine, too.
      const slips = (all) => all.map((span) => span.slips);
      assert.ok(Math.min(...slips(beside)) <= Math.max(...slips(alone)), `the schedule is given up ${slips(beside)} times beside windows, ${slips(alone)} without`);
    } finally {
      for (const pid of stopped) process.kill(pid, "SIGCONT");
      await browser.close();
      await api.plants.deletePlant({ id });
    }
  },
});
