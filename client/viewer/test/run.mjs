// Tests of the page in a real browser against a real server.
//
//   npm test -- --server PATH [--pictures FOLDER] [--only WORDS] [--measures only|none]
//
// `plantctl` lies beside the server.
//
// `--measures` leaves out what takes all of the processors to measure how fluent things are, or all else.
//
// Without Chromium it says so and ends with 77.

import assert from "node:assert/strict";
import { mkdirSync, writeFileSync } from "node:fs";
import { createServer, request } from "node:http";
import { parseArgs } from "node:util";
import { connect, Pace } from "./api.mjs";
import { chromium, launch, Server } from "./browser.mjs";
import { commandTests } from "./command.mjs";
import { small } from "./png.mjs";
import { robotTests } from "./robots.mjs";
import { tokenTests } from "./token.mjs";
import { windowTests } from "./windows.mjs";

const SKIPPED = 77;
/** Tests that measure how fluent things are. */
const MEASURES = /fluently|ten windows/;
const string = { type: "string" };
const { values: options } = parseArgs({ options: { server: string, pictures: string, only: string, measures: string } });
if (!options.server) {
  console.error("usage: npm test -- --server PATH [--pictures FOLDER]");
  process.exit(2);
}
if (!chromium()) {
  console.log("skipped: there is no Chromium (Debian's package chromium)");
  process.exit(SKIPPED);
}

const server = await Server.start(options.server);
const api = connect(server.url);
const browser = await launch();
const troubles = [];
let expectsTrouble = false;

/** Notes every error of a page and every request to somebody else. */
function watched(page, own = server.url) {
  const trouble = (text) => expectsTrouble || troubles.push(text);
  page.on("console", (message) => message.type() === "error" && trouble(`console: ${message.text()}`));
  page.on("pageerror", (error) => trouble(`page: ${error.message}`));
  page.on("request", (request) => {
    const { origin, protocol } = new URL(request.url());
    if (protocol !== "data:" && protocol !== "blob:" && origin !== own) troubles.push(`request to ${request.url()}`);
  });
}

/** A page that tells of every error and of every request to somebody else. */
async function open(query, width = 1280, height = 800) {
  const page = await browser.newPage();
  await page.setViewport({ width, height });
  watched(page);
  await page.goto(`${server.url}/${query}`);
  return page;
}

/** Waits until something holds in the page; says what was waited for. */
async function until(page, what, condition, ...args) {
  await page.waitForFunction(condition, { timeout: 60_000, polling: 50 }, ...args).catch((error) => {
    throw new Error(`waited for ${what}: ${error.message}`);
  });
}

/** Waits until something holds here. */
async function eventually(what, condition) {
  for (let attempt = 0; attempt < 600; attempt++) {
    const value = await condition();
    if (value) return value;
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  throw new Error(`waited for ${what}`);
}

async function plant(model, id = model) {
  await api.plants.createPlant({ id, model });
  return id;
}

async function run(id, speed = 1) {
  await api.plants.run({ id, settings: { pace: Pace.PACED, speed } });
}

/** The pixels of a picture, which a browser decodes. */
async function decoded(page, picture) {
  const { width, height, data } = await page.evaluate(async (base64) => {
    const image = new Image();
    image.src = `data:image/png;base64,${base64}`;
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.width, image.height];
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    const bytes = context.getImageData(0, 0, image.width, image.height).data;
    let data = "";
    for (let at = 0; at < bytes.length; at += 0x8000) data += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
    return { width: image.width, height: image.height, data: btoa(data) };
  }, picture);
  return { width, height, pixels: new Uint8Array(Buffer.from(data, "base64")) };
}

const shows = (page, id) => until(page, `${id} to be seen`, () => window.plantdView?.frames().length > 0 && window.plantdView.shown().step !== undefined && window.plantdView.isDrawn());

/** The frames of a page are where the kinematics of its plant has them. */
async function posed(page, id, model) {
  const frames = await page.evaluate(() => window.plantdView.frames());
  const { frames: truth } = await api.control.kinematics({ state: { plant: id } });
  const known = new Map(truth.map((each) => [each.frame, each]));
  assert.ok(frames.length > 0);
  for (const { name, matrix } of frames) {
    const { position, orientation } = known.get(name);
    const [w, x, y, z] = orientation;
    const expected = [
      1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
      2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
      2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
      ...position, 1,
    ];
    const apart = Math.max(...expected.map((value, index) => Math.abs(value - matrix[index])));
    assert.ok(apart < 1e-6, `${model}, ${name}: off by ${apart}`);
  }
}

/** Processor time that the browser has used, s. */
async function cpuSeconds() {
  const session = await browser.target().createCDPSession();
  const { processInfo } = await session.send("SystemInfo.getProcessInfo");
  await session.detach();
  return processInfo.reduce((sum, { cpuTime }) => sum + cpuTime, 0);
}

const context = { binary: options.server, api, browser, server, posed, cpuSeconds, decoded, eventually, open, plant, run, shows, until, watched };

const tests = {
  async "the canvas shows something"() {
    const page = await open(`?plant=${await plant("double-pendulum")}`);
    await shows(page, "double-pendulum");
    const canvas = await page.$("#canvas");
    const picture = await canvas.screenshot({ encoding: "base64" });
    const { pixels } = await decoded(page, picture);
    const colors = new Set(new Uint32Array(pixels.buffer, pixels.byteOffset, pixels.length / 4)).size;
    assert.ok(colors > 50, `${colors} colours on the canvas`);
    await page.close();
  },

  async "frames are where the kinematics has them"() {
    for (const model of ["marionette", "four-bar", "spherical-pendulum"]) {
      const id = await plant(model, `at-${model}`);
      const page = await open(`?plant=${id}`);
      await shows(page, id);
      await api.plants.step({ id, hold: 37 });
      await until(page, "step 37", () => window.plantdView.shown().step === 37);
      await until(page, "the picture of it", () => window.plantdView.isDrawn());
      await posed(page, id, model);
      await page.close();
    }
  },

  async "plots follow, hold and let go"() {
    const id = await plant("pendulum", "plotted");
    await run(id);
    const page = await open(`?plant=${id}`);
    await shows(page, id);
    const samples = () => page.evaluate(() => window.plantdView.shown().samples);
    const before = await samples();
    await until(page, "more samples", (least) => window.plantdView.shown().samples > least, before + 20);
    const plot = await page.$(".plot .u-over");
    const { x, y, width, height } = await plot.boundingBox();
    await page.mouse.click(x + 0.95 * width, y + height / 2);
    await until(page, "the cursor to be held", () => /^Held at/.test(document.getElementById("status").textContent));
    const held = await page.evaluate(() => window.plantdView.shown().step);
    await new Promise((resolve) => setTimeout(resolve, 600));
    assert.equal(await page.evaluate(() => window.plantdView.shown().step), held);
    await page.keyboard.press("Escape");
    await until(page, "newer states", (step) => window.plantdView.shown().step > step + 2, held);
    await page.close();
  },

  async "dragging pushes the body under the pointer"() {
    // At rest, so that the body is still there when the pointer comes.
    const id = await plant("cart-pole", "pushed");
    await api.plants.reset({ id, initial: { form: { case: "operatingPoint", value: "hanging" } } });
    await run(id);
    const page = await open(`?plant=${id}`);
    await shows(page, id);
    const name = await page.evaluate(() => window.plantdView.frames().at(-1).name);
    const { x, y } = await page.evaluate((frame) => window.plantdView.pixel(frame), name);
    assert.equal(await page.evaluate((a, b) => window.plantdView.under(a, b), x, y), name);
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(x + 90, y, { steps: 5 });
    const push = await eventually("a push", async () => (await api.channels.listFaults({ id })).faults.find(({ fault }) => fault.kind.case === "push" && Math.abs(fault.kind.value.force[0]) + Math.abs(fault.kind.value.force[1]) > 0.1));
    assert.equal(push.fault.kind.value.point.frame, name);
    assert.ok(push.fault.durationS > 0, "a push ends by itself");
    await eventually("the plant to move", async () => (await api.plants.getPlant({ id })).plant.state.q.some((value) => Math.abs(value) > 0.02));
    await page.mouse.up();
    await eventually("no push", async () => (await api.channels.listFaults({ id })).faults.every(({ phase }) => phase !== 2));
    await page.close();
  },

  async "a slider drives under a lease, which is given back"() {
    const id = await plant("cart-pole", "driven");
    await run(id);
    const page = await open(`?plant=${id}`);
    await shows(page, id);
    const driver = async () => (await api.plants.getPlant({ id })).plant.driver;
    assert.equal(await driver(), "");
    await page.focus('#sliders input[type="range"]');
    await page.evaluate(() => {
      const slider = document.querySelector('#sliders input[type="range"]');
      slider.value = "6";
      slider.dispatchEvent(new Event("input", { bubbles: true }));
    });
    await eventually("the lease", async () => (await driver()) === "drive");
    await until(page, "it to be said", () => /you drive/.test(document.getElementById("section-inputs").textContent));
    await eventually("the input to act", async () => {
      const stream = new AbortController();
      for await (const message of api.plants.watch({ id, fields: [6] }, { signal: stream.signal })) {
        stream.abort();
        return message.u[0] === 6;
      }
    }).catch((error) => {
      if (error.name !== "ConnectError") throw error;
    });
    await assert.rejects(api.plants.setInput({ id, leaseToken: "0", u: [1] }), /lease .* has ended/);
    await page.click("#lease");
    await eventually("the lease to be free", async () => (await driver()) === "");
    // Whoever closes the page gives it back, too.
    await until(page, "it to be offered", () => /Take/.test(document.getElementById("lease").textContent) && !document.getElementById("lease").disabled);
    await page.click("#lease");
    await eventually("the lease", async () => (await driver()) === "drive");
    await page.close();
    await eventually("the lease to be free", async () => (await driver()) === "");
  },

  async "run, pause, step and reset"() {
    const id = await plant("four-bar", "run");
    const page = await open(`?plant=${id}`);
    await shows(page, id);
    await page.click("#step");
    await until(page, "one step", () => window.plantdView.shown().step === 1);
    await page.focus("#canvas");
    await page.keyboard.press(" ");
    await until(page, "it to run", () => window.plantdView.shown().step > 20);
    await page.keyboard.press(" ");
    await eventually("a pause", async () => !(await api.plants.getPlant({ id })).plant.run.running);
    await page.keyboard.press("r");
    await until(page, "the start", () => window.plantdView.shown().step === 0);
    await page.close();
  },

  async "poles are seen, and those of the closed loop with a regulator"() {
    const id = await plant("cart-pole", "poles");
    const page = await open(`?plant=${id}`);
    await shows(page, id);
    await until(page, "poles", () => /Open loop/.test(document.getElementById("pole-list").textContent));
    await page.evaluate(() => {
      const section = document.getElementById("section-feedback");
      section.open = true;
      section.querySelector("select").value = "upright";
    });
    await api.plants.reset({ id, initial: { form: { case: "operatingPoint", value: "upright" } } });
    await page.evaluate(() => document.getElementById("regulate").click());
    await eventually("the regulator", async () => (await api.plants.getPlant({ id })).plant.feedback);
    // The plant stands still: nothing but the new loop brings poles.
    await until(page, "the closed loop", () => /Closed loop ○none outside/.test(document.getElementById("pole-list").textContent));
    await until(page, "gains", () => /Gain K/.test(document.getElementById("section-feedback").textContent));
    await page.close();
  },

  async "a recording shows the state of the step it is at"() {
    const id = await plant("pendulum", "recorded");
    await api.recordings.startRecording({ id, name: "trial" });
    const { states } = await api.plants.step({ id, hold: 200, allStates: true });
    await api.recordings.stopRecording({ name: "trial" });
    const page = await open("?recording=trial");
    await until(page, "the recording", () => window.plantdView?.frames().length > 0 && !document.getElementById("scrubber").hidden);
    for (const index of [0, 57, 199]) {
      await page.evaluate((value) => {
        const range = document.querySelector("#scrubber input");
        range.value = String(value);
        range.dispatchEvent(new Event("input", { bubbles: true }));
      }, index);
      const shown = await page.evaluate(() => window.plantdView.shown());
      assert.equal(shown.step, Number(states[index].step));
      assert.deepEqual(shown.q, states[index].q);
    }
    await page.close();
  },

  async "two plants are compared, in dark, on a narrow screen"() {
    const [id, other] = [await plant("pendulum", "one"), await plant("pendulum", "two")];
    await run(other);
    const page = await open(`?plant=${id}&compare=${other}&theme=dark`, 400, 800);
    await shows(page, id);
    const width = await page.evaluate(() => document.documentElement.scrollWidth);
    assert.ok(width <= 400, `the page is ${width} pixels wide`);
    await until(page, "the ghost to be drawn", () => window.plantdView.drawn() > 10);
    await page.close();
  },

  async "strangers are refused"() {
    const status = (headers, method = "POST", path = "/plantd.v1.PlantService/ListPlants") =>
      new Promise((resolve, reject) => {
        const call = request(`${server.url}${path}`, { method, headers: { "content-type": "application/grpc-web+proto", ...headers } }, (answer) => {
          answer.resume();
          resolve(answer.statusCode);
        });
        call.on("error", reject);
        call.end(Buffer.from([0, 0, 0, 0, 0]));
      });
    assert.equal(await status({}), 200);
    assert.ok((await status({ host: "evil.example" })) >= 400, "a foreign name");
    assert.ok((await status({ host: "evil.example" }, "GET", "/")) >= 400, "a foreign name");
    assert.ok((await status({ origin: "http://evil.example" })) >= 400, "a foreign page");
    const foreign = createServer((_, answer) => answer.writeHead(200, { "content-type": "text/html" }).end("<!doctype html>"));
    await new Promise((resolve) => foreign.listen(0, "127.0.0.1", resolve));
    const page = await browser.newPage();
    await page.goto(`http://127.0.0.1:${foreign.address().port}/`);
    const outcome = await page.evaluate(async (url) => {
      try {
        const answer = await fetch(url, { method: "POST", headers: { "content-type": "application/grpc-web+proto" }, body: new Uint8Array(5) });
        return `answered ${answer.status}`;
      } catch (error) {
        return error.name;
      }
    }, `${server.url}/plantd.v1.PlantService/ListPlants`);
    assert.equal(outcome, "TypeError");
    await page.close();
    foreign.close();
  },

  ...commandTests(context),
  ...robotTests(context),
  ...tokenTests(context),
  ...windowTests(context),

  // The last one: the plants of the others end with the server.
  async "it goes on after the server has restarted"() {
    await plant("pendulum", "again");
    const page = await open("?plant=again");
    await shows(page, "again");
    expectsTrouble = true; // The browser's console tells of connections that fail.
    await server.stop();
    await until(page, "the loss to be told", () => /does not answer/.test(document.getElementById("status").textContent));
    await server.again();
    await plant("pendulum", "again").catch(() => undefined);
    await until(page, "the page to go on", () => window.plantdView.shown().step !== undefined && document.getElementById("status").hidden);
    const moved = await page.evaluate(() => window.plantdView.shown().step);
    await api.plants.step({ id: "again", hold: 5 });
    await until(page, "a step", (before) => window.plantdView.shown().step !== before, moved);
    expectsTrouble = false;
    await page.close();
  },
};

/** Pictures for the documents. */
async function pictures(folder) {
  mkdirSync(folder, { recursive: true });
  const scenes = { pendulum: "dark", "cart-pole": "light", marionette: "light", "four-bar": "dark", "scissor-8": "light", "chain-32": "dark" };
  for (const [model, theme] of Object.entries(scenes)) {
    const id = await plant(model, `picture-${model}`);
    await run(id);
    const page = await open(`?plant=${id}&theme=${theme}&quality=best`, 1120, 700);
    await shows(page, id);
    await new Promise((resolve) => setTimeout(resolve, 6000));
    const { width, height, pixels } = await decoded(page, await page.screenshot({ encoding: "base64" }));
    writeFileSync(`${folder}/view-${model}.png`, small(width, height, pixels));
    await page.close();
    await api.plants.deletePlant({ id });
  }
}

let failed = 0;
try {
  if (options.pictures) await pictures(options.pictures);
  for (const [name, test] of Object.entries(tests)) {
    if (options.only && !name.includes(options.only)) continue;
    if (options.measures && MEASURES.test(name) !== (options.measures === "only")) continue;
    try {
      await test();
      if (troubles.length > 0) throw new Error(troubles.splice(0).join("; "));
      console.log(`passed  ${name}`);
    } catch (error) {
      failed += 1;
      troubles.length = 0;
      expectsTrouble = false;
      console.log(`FAILED  ${name}\n        ${error.message}`);
      for (const page of (await browser.pages()).slice(1)) {
        const told = await page.evaluate(() => document.getElementById("notice")?.textContent ?? "").catch(() => "");
        if (told !== "") console.log(`        the page says: ${told}`);
        await page.close();
      }
    }
  }
} finally {
  await browser.close();
  await server.end();
}
console.log(failed === 0 ? "all passed" : `${failed} failed`);
process.exitCode = failed === 0 ? 0 : 1;
