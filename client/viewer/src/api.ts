// The services of plantd, over gRPC-Web on the address that the page came from.

import { Code, ConnectError, createClient, type Interceptor } from "@connectrpc/connect";
import { createGrpcWebTransport } from "@connectrpc/connect-web";
import { ChannelService } from "./gen/plantd/v1/channel_service_pb.js";
import { ModelService } from "./gen/plantd/v1/model_service_pb.js";
import { PlantService } from "./gen/plantd/v1/plant_service_pb.js";
import { RecordingService } from "./gen/plantd/v1/recording_service_pb.js";
import { complain } from "./state.js";
import { askForToken, known as knownToken } from "./token.js";

/** A call that the server refuses because it does not know who asks is made again when it does. */
const known: Interceptor = (next) => async (request) => {
  for (;;) {
    const used = knownToken();
    try {
      return await next(request);
    } catch (error) {
      const { code, rawMessage } = ConnectError.from(error);
      if (code !== Code.Unauthenticated || request.stream) throw error;
      // Somebody has answered while this call was under way.
      if (knownToken() === used) await askForToken(rawMessage);
    }
  }
};

const transport = createGrpcWebTransport({ baseUrl: location.origin, interceptors: [known], fetch: (input, init) => fetch(input, init) });

export const plants = createClient(PlantService, transport);
export const models = createClient(ModelService, transport);
export const channels = createClient(ChannelService, transport);
export const recordings = createClient(RecordingService, transport);

/** Nobody answers at the server's address: it has ended, or the network has. */
export function isAway(error: unknown): boolean {
  const { code, cause } = ConnectError.from(error);
  return code === Code.Unavailable || cause instanceof TypeError || /fetch|network|stream|missing trailer/i.test(ConnectError.from(error).rawMessage) && code !== Code.InvalidArgument && code !== Code.NotFound;
}

/** The call was ended from here. */
export function isCanceled(error: unknown): boolean {
  return ConnectError.from(error).code === Code.Canceled;
}

/** What it was asked for is not there. */
export function isNotFound(error: unknown): boolean {
  return ConnectError.from(error).code === Code.NotFound;
}

/** An error as a sentence. */
export function words(error: unknown): string {
  if (isAway(error)) return "The server does not answer.";
  const text = ConnectError.from(error).rawMessage;
  const sentence = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(sentence) ? sentence : `${sentence}.`;
}

/** Does something and tells when it fails; the result says whether it went well. */
export async function attempt(what: string, action: () => Promise<unknown>): Promise<boolean> {
  try {
    await action();
    return true;
  } catch (error) {
    if (!isCanceled(error)) complain(`${what}: ${words(error)}`);
    return false;
  }
}
