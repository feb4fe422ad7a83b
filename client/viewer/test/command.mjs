// What `plantctl` shows by a browser: the page of a recording without a server, films and pictures.

import assert from "node:assert/strict";
import { execFile, spawn } from "node:child_process";
import { existsSync, readFileSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { createInterface } from "node:readline";
import { promisify } from "node:util";
import { chromium } from "./browser.mjs";

const execute = promisify(execFile);

/** Width, height and number of pictures of a GIF, and the colours of its palette. */
function gif(file) {
  const bytes = readFileSync(file);
  assert.equal(bytes.toString("latin1", 0, 6), "GIF89a");
  const [width, height] = [bytes.readUInt16LE(6), bytes.readUInt16LE(8)];
  const colors = 2 << (bytes[10] & 7);
  const blocks = (at) => {
    while (bytes[at] !== 0) at += bytes[at] + 1;
    return at + 1;
  };
  let [at, pictures, hundredths, largest] = [13 + 3 * colors, 0, 0, 0];
  for (; bytes[at] !== 0x3b; ) {
    if (bytes[at] === 0x21) {
      if (bytes[at + 1] === 0xf9) hundredths += bytes.readUInt16LE(at + 4);
      at = blocks(at + 2);
    } else {
      assert.equal(bytes[at], 0x2c, "a picture");
      pictures += 1;
      // After the first one, what has changed.
      if (pictures > 1) largest = Math.max(largest, bytes.readUInt16LE(at + 5) * bytes.readUInt16LE(at + 7));
      at = blocks(at + 11);
    }
  }
  return { width, height, pictures, hundredths, largest };
}

export const commandTests = ({ api, browser, server, binary, decoded, plant, run, until, watched }) => {
  const plantctl = join(dirname(binary), "plantctl");
  const folder = server.folder;
  const environment = { ...process.env, CHROME: chromium(), PLANTD_ADDRESS: server.url };
  /** What the command prints as JSON; with `wrong` what it complains of. */
  const call = async (args, env = environment) => JSON.parse((await execute(plantctl, ["--json", ...args], { env })).stdout);
  const refused = async (args, env = environment) => {
    try {
      await execute(plantctl, args, { env });
    } catch (error) {
      return error.stderr;
    }
    throw new Error(`plantctl ${args.join(" ")} went well`);
  };

  /** A recording of a double pendulum as a file, with the states in it. */
  async function recorded(name) {
    const id = await plant("double-pendulum", name);
    await api.recordings.startRecording({ id, name });
    const { states } = await api.plants.step({ id, hold: 120, allStates: true });
    await api.recordings.stopRecording({ name });
    const parts = [];
    for await (const { data } of api.recordings.getRecording({ name })) parts.push(data);
    const file = join(folder, `${name}.mcap`);
    writeFileSync(file, Buffer.concat(parts));
    return { file, states };
  }

  return {
    async "a recording is seen without a server"() {
      const { file, states } = await recorded("alone");
      const viewer = spawn(plantctl, ["--json", "view", file, "--no-open"], { env: { ...process.env, PLANTD_ADDRESS: "http://127.0.0.1:1" }, stdio: ["ignore", "pipe", "inherit"] });
      try {
        const first = await new Promise((resolve, reject) => {
          createInterface({ input: viewer.stdout }).once("line", resolve);
          viewer.once("exit", () => reject(new Error("plantctl view has ended")));
        });
        const { url } = JSON.parse(first);
        const page = await browser.newPage();
        await page.setViewport({ width: 1000, height: 700 });
        watched(page, new URL(url).origin);
        await page.goto(url);
        await until(page, "the recording", () => window.plantdView?.frames().length > 0 && !document.getElementById("scrubber").hidden && window.plantdView.isDrawn());
        for (const index of [119, 0, 60]) {
          await page.evaluate((value) => {
            const range = document.querySelector("#scrubber input");
            range.value = String(value);
            range.dispatchEvent(new Event("input", { bubbles: true }));
          }, index);
          const shown = await page.evaluate(() => window.plantdView.shown());
          assert.deepEqual([shown.step, shown.q], [Number(states[index].step), states[index].q]);
        }
        // Energy is among the plots; that of a pendulum without friction and input stays.
        const energy = await page.evaluate(() => [...document.querySelectorAll(".plot")].find((plot) => /Energy/.test(plot.textContent))?.textContent ?? "");
        assert.match(energy, /total.*−?\d/s);
        await page.close();
      } finally {
        viewer.kill("SIGINT");
        await new Promise((resolve) => viewer.once("exit", resolve));
      }
    },

    async "a recording becomes a film"() {
      const { file, states } = await recorded("filmed");
      const seconds = states.at(-1).timeS;
      const out = join(folder, "film.gif");
      const told = await call(["render", file, "--out", out, "--size", "240x160", "--fps", "10", "--dark"], { ...environment, PLANTD_ADDRESS: "http://127.0.0.1:1" });
      const film = gif(out);
      assert.deepEqual([film.width, film.height, film.pictures], [240, 160, told.pictures]);
      assert.ok(Math.abs(film.pictures - 10 * seconds) <= 1, `${film.pictures} pictures of ${seconds} s`);
      assert.equal(film.hundredths, 10 * film.pictures);
      // The pendulum moves from one picture to the next, and the ground does not.
      assert.ok(film.largest > 100 && film.largest < 240 * 160, `${film.largest} pixels change`);
    },

    async "a plant becomes a film, and a picture"() {
      const id = await plant("double-pendulum", "filmed-live");
      const still = join(folder, "still.png");
      const shoot = (...args) => call(["render", id, "--out", still, "--size", "200x150", ...args]);
      assert.equal((await shoot()).pictures, 1);
      const page = await browser.newPage();
      const colors = async () => {
        const { width, height, pixels } = await decoded(page, readFileSync(still).toString("base64"));
        assert.deepEqual([width, height], [200, 150]);
        return new Uint32Array(pixels.buffer, pixels.byteOffset, pixels.length / 4);
      };
      const first = await colors();
      assert.ok(new Set(first).size > 30, "the picture is empty");
      // From another side it looks another way; and with the page around it again.
      const differ = (a, b) => a.reduce((count, value, index) => count + Number(value !== b[index]), 0);
      await shoot("--turn", "60,20");
      assert.ok(differ(first, await colors()) > 200, "the camera has not turned");
      await shoot();
      assert.ok(differ(first, await colors()) < 20, "a plant that stands still looks the same again");
      await page.close();
      assert.match(await refused(["render", id, "--out", join(folder, "live.gif")]), /stands still: `plantctl run filmed-live`/);
      await run(id);
      const live = join(folder, "live.gif");
      await call(["render", id, "--out", live, "--size", "320x240", "--duration", "1", "--fps", "8", "--view", "page"]);
      const film = gif(live);
      assert.deepEqual([film.width, film.height, film.pictures], [320, 240, 8]);
      const animated = join(folder, "animated.png");
      assert.equal((await call(["render", id, "--out", animated, "--size", "100x80", "--duration", "0.5", "--fps", "10"])).pictures, 5);
      assert.ok(readFileSync(animated).includes("acTL"), "an animated PNG");
      await api.plants.deletePlant({ id });
    },

    async "what cannot be drawn is told"() {
      const { file } = await recorded("untold");
      const out = join(folder, "none.gif");
      assert.match(await refused(["render", file, "--out", join(folder, "film.mp4")]), /written as .gif or .png/);
      assert.match(await refused(["render", file, "--out", out, "--from", "1000"]), /--from is 1000 s; from [0-9.]+ to/);
      assert.match(await refused(["render", file, "--out", out, "--size", "4096x4096", "--duration", "60"]), /fewer by --duration or --fps/);
      assert.match(await refused(["render", "nobody", "--out", out]), /nobody/);
      assert.match(await refused(["render", file, "--out", out, "--browser", "/nowhere/chrome"]), /no browser \/nowhere\/chrome/);
      const { CHROME, ...without } = environment;
      assert.match(await refused(["render", file, "--out", out], { ...without, PATH: folder }), /apt install chromium/);
      assert.match(await refused(["render", file, "--out", out, "--browser", "/bin/true"]), /browser has ended/);
      assert.ok(!existsSync(out), "a film that was refused");
    },
  };
};
