// Robots: one of thirty joints, and the meshes of a model.

import assert from "node:assert/strict";
import { humanoid } from "./humanoid.mjs";

/** Pictures a second that the page is to draw, on so many processors; on slower ones, in pictures of a single joint. */
const [PICTURES_HZ, PROCESSORS, JOINTS] = [20, 2, 2];

/** The best of so many spans counts: others use this machine, too. */
const [SPANS, SPAN_MS] = [4, 1500];

/** A tetrahedron in STL, 1 m along each axis; in OBJ with a second one beside it. */
const corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]];
const faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];

function stl() {
  const data = Buffer.alloc(84 + 50 * faces.length);
  data.writeUInt32LE(faces.length, 80);
  faces.forEach((face, index) => face.forEach((corner, place) => corners[corner].forEach((value, axis) => data.writeFloatLE(value, 84 + 50 * index + 12 * (place + 1) + 4 * axis))));
  return data;
}

const obj = [...corners.map((corner) => `v ${corner.join(" ")}`), ...faces.map((face) => `f ${face.map((corner) => corner + 1).join(" ")}`)].join("\n");

const scene = `
format = 1
name = "with-meshes"
gravity = [0.0, 0.0, -9.8]
[[frames]]
name = "arm"
joint = { type = "revolute", axis = [0.0, 1.0, 0.0] }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5] }
visuals = [
    { shape = { type = "mesh", file = "meshes/arm.stl", scale = [0.5, 0.5, 0.5] }, color = [1.0, 0.0, 0.0, 1.0] },
    { shape = { type = "mesh", file = "package://arm/hand.obj" }, color = [1.0, 0.0, 0.0, 1.0] },
]
`;

export const robotTests = ({ api, open, until, shows, run, posed, cpuSeconds }) => ({
  async "a robot of thirty joints is drawn fluently, where the kinematics has it"() {
    const { model } = await api.models.createModel({ name: "humanoid", scene: humanoid });
    assert.equal(model.coordinates.length, 30);
    let enough = PROCESSORS / PICTURES_HZ;
    for (const [name, id] of [["pendulum", "one"], ["humanoid", "robot"], ["marionette", "puppet"]]) {
      await api.plants.createPlant({ id, model: name });
      await run(id);
      const page = await open(`?plant=${id}`);
      await shows(page, id);
      // Shadows and pixels that this machine cannot afford are left out within the first seconds.
      await new Promise((resolve) => setTimeout(resolve, 3000));
      const look = async () => ({ drawn: await page.evaluate(() => window.plantdView.drawn()), cpu: await cpuSeconds(), at: performance.now() });
      const spans = [];
      for (let before = await look(); spans.length < SPANS; before = spans.at(-1).after) {
        await new Promise((resolve) => setTimeout(resolve, SPAN_MS));
        const after = await look();
        const pictures = after.drawn - before.drawn;
        spans.push({ after, rate: (1000 * pictures) / (after.at - before.at), each: (after.cpu - before.cpu) / pictures });
      }
      const [rate, each] = [Math.max(...spans.map((span) => span.rate)), Math.min(...spans.map((span) => span.each))];
      console.log(`  ${name}: ${rate.toFixed(1)} pictures a second, ${(1000 * each).toFixed(1)} ms of processor time each`);
      // What else this machine does takes from the rate, and not from the time of a processor.
      if (name === "pendulum") enough = Math.max(enough, JOINTS * each);
      assert.ok(each < enough, `a picture takes ${(1000 * each).toFixed(1)} ms of processor time: more than ${(1000 * enough).toFixed(1)} ms`);
      await api.plants.pause({ id });
      const { plant } = await api.plants.getPlant({ id });
      await until(page, "the last state", (step) => window.plantdView.shown().step === step && window.plantdView.isDrawn(), Number(plant.state.step));
      await posed(page, id, name);
      await page.close();
      await api.plants.deletePlant({ id });
    }
  },

  async "meshes of a model are read and drawn"() {
    await api.models.createModel({ name: "with-meshes", scene });
    const files = [["meshes/arm.stl", stl()], ["package://arm/hand.obj", Buffer.from(obj)]];
    for (const [file, data] of files) await api.models.putModelFile({ model: "with-meshes", file, data });
    await api.plants.createPlant({ id: "with-meshes", model: "with-meshes" });
    const page = await open("?plant=with-meshes");
    await shows(page, "with-meshes");
    await until(page, "the meshes", () => window.plantdView.shapes("arm").length === 2);
    const [arm, hand] = await page.evaluate(() => window.plantdView.shapes("arm"));
    // The box of each in its frame, with the scale of the scene.
    assert.deepEqual(arm, { low: [0, 0, 0], high: [0.5, 0.5, 0.5] });
    assert.deepEqual(hand, { low: [0, 0, 0], high: [1, 1, 1] });
    const notice = await page.evaluate(() => document.getElementById("notice").textContent);
    assert.equal(notice, "");
    // Another file under the name is another mesh for whoever opens the page now.
    const halved = Buffer.from(obj.replaceAll(" 1", " 0.5").replace(/f .*/gs, obj.match(/f .*/s)[0]));
    await api.models.putModelFile({ model: "with-meshes", file: "package://arm/hand.obj", data: halved });
    await page.reload();
    await shows(page, "with-meshes");
    await until(page, "the other mesh", () => window.plantdView.shapes("arm")[1]?.high[0] === 0.5);
    await page.close();
  },
});
