// The services of plantd for tests, by the same generated code as the page.

import { build } from "esbuild";
import { mkdirSync } from "node:fs";
import { pathToFileURL } from "node:url";

const here = new URL("..", import.meta.url).pathname;

const source = `
import { createClient } from "@connectrpc/connect";
import { createGrpcWebTransport } from "@connectrpc/connect-web";
import { ChannelService } from "./src/gen/plantd/v1/channel_service_pb.ts";
import { ControlService } from "./src/gen/plantd/v1/control_service_pb.ts";
import { ModelService } from "./src/gen/plantd/v1/model_service_pb.ts";
import { PlantService } from "./src/gen/plantd/v1/plant_service_pb.ts";
import { RecordingService } from "./src/gen/plantd/v1/recording_service_pb.ts";
export { Pace } from "./src/gen/plantd/v1/realtime_pb.ts";
export function connect(baseUrl) {
  const transport = createGrpcWebTransport({ baseUrl });
  return {
    plants: createClient(PlantService, transport),
    models: createClient(ModelService, transport),
    control: createClient(ControlService, transport),
    channels: createClient(ChannelService, transport),
    recordings: createClient(RecordingService, transport),
  };
}`;

const folder = `${here}node_modules/.cache`;
mkdirSync(folder, { recursive: true });
const outfile = `${folder}/api.mjs`;
await build({ stdin: { contents: source, resolveDir: here, loader: "ts" }, bundle: true, platform: "node", format: "esm", outfile, logLevel: "error" });

export const { connect, Pace } = await import(pathToFileURL(outfile).href);
