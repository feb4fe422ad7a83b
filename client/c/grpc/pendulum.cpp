// Holds a pendulum where it hangs, over gRPC: pendulum [HOST:PORT [STEPS]]
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <string>

#include <grpcpp/grpcpp.h>

#include "plantd/v1/plant_service.grpc.pb.h"

namespace v1 = plantd::v1;

static void check(const grpc::Status &status) {
    if (!status.ok()) throw std::runtime_error(status.error_message());
}

int main(int argc, char **argv) try {
    const std::string address = argc > 1 ? argv[1] : "127.0.0.1:50051";
    const long steps = argc > 2 ? std::atol(argv[2]) : 100;
    auto plants = v1::PlantService::NewStub(
        grpc::CreateChannel(address, grpc::InsecureChannelCredentials()));

    grpc::ClientContext create;
    v1::CreatePlantRequest request;
    v1::CreatePlantResponse created;
    request.set_model("pendulum");
    check(plants->CreatePlant(&create, request, &created));
    const std::string id = created.plant().id();

    grpc::ClientContext drive;
    auto stream = plants->Drive(&drive);
    v1::DriveRequest ask;
    v1::DriveResponse answer;
    ask.mutable_open()->set_id(id);
    if (!stream->Write(ask) || !stream->Read(&answer)) check(stream->Finish());
    v1::State state = answer.opened().plant().state();
    for (long k = 1; k <= steps; ++k) {
        ask.mutable_input()->set_sequence(k);
        ask.mutable_input()->clear_u();
        ask.mutable_input()->add_u(-3.0 * state.q(0) - state.p(0));
        if (!stream->Write(ask) || !stream->Read(&answer)) check(stream->Finish());
        if (!answer.has_step()) throw std::runtime_error(answer.failure().ShortDebugString());
        state = answer.step().state();
        std::printf("%.17g %.17g %.17g\n", state.q(0), state.p(0), state.velocity(0));
    }
    stream->WritesDone();
    check(stream->Finish());

    grpc::ClientContext remove;
    v1::DeletePlantRequest which;
    v1::DeletePlantResponse nothing;
    which.set_id(id);
    check(plants->DeletePlant(&remove, which, &nothing));
} catch (const std::exception &error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
}
