// Holds a pendulum where it hangs, over gRPC: node pendulum.js [HOST:PORT [STEPS]]
import { fileURLToPath } from "node:url";
import { promisify } from "node:util";

import grpc from "@grpc/grpc-js";
import { loadSync } from "@grpc/proto-loader";

const [address = "127.0.0.1:50051", steps = "100"] = process.argv.slice(2);
const proto = process.env.PLANTD_PROTO ?? fileURLToPath(new URL("../../proto", import.meta.url));
const contract = loadSync("plantd/v1/plant_service.proto", { includeDirs: [proto], keepCase: true });
const { plantd } = grpc.loadPackageDefinition(contract);
const plants = new plantd.v1.PlantService(address, grpc.credentials.createInsecure());
const call = (method, request) => promisify(plants[method]).call(plants, request);

const { plant } = await call("CreatePlant", { model: "pendulum" });
const stream = plants.Drive();
const answers = stream[Symbol.asyncIterator]();
const ask = async (request) => {
  stream.write(request);
  const { value } = await answers.next();
  if (value?.failure) throw new Error(value.failure.failure.message);
  return value;
};
let { state } = (await ask({ open: { id: plant.id } })).opened.plant;
for (let sequence = 1; sequence <= Number(steps); sequence++) {
  const u = [-3 * state.q[0] - state.p[0]];
  state = (await ask({ input: { sequence, u } })).step.state;
  console.log(state.q[0], state.p[0], state.velocity[0]);
}
stream.end();
await answers.next();
await call("DeletePlant", { id: plant.id });
plants.close();
