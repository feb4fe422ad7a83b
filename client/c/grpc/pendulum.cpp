// Holds a pendulum where it hangs, over gRPC: pendulum [HOST:PORT [STEPS]]
// PLANTD_CA, a file, is for servers with TLS; PLANTD_TOKEN, and the files PLANTD_CERT and PLANTD_KEY say who calls.
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iterator>
#include <memory>
#include <stdexcept>
#include <string>

#include <grpcpp/grpcpp.h>

#include "plantd/v1/plant_service.grpc.pb.h"

namespace v1 = plantd::v1;

static void check(const grpc::Status &status) {
    if (!status.ok()) throw std::runtime_error(status.error_message());
}

// What is in the file that a variable of the environment names; nothing without one.
static std::string content(const char *variable) {
    const char *path = std::getenv(variable);
    if (!path) return {};
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error(std::string(variable) + ": cannot read " + path);
    return {std::istreambuf_iterator<char>(file), {}};
}

static std::shared_ptr<grpc::ChannelCredentials> credentials() {
    const char *token = std::getenv("PLANTD_TOKEN");
    if (!std::getenv("PLANTD_CA")) {
        if (token) throw std::runtime_error("a token is for TLS: give PLANTD_CA");
        return grpc::InsecureChannelCredentials();
    }
    grpc::SslCredentialsOptions options;
    options.pem_root_certs = content("PLANTD_CA");
    options.pem_cert_chain = content("PLANTD_CERT");
    options.pem_private_key = content("PLANTD_KEY");
    auto tls = grpc::SslCredentials(options);
    return token ? grpc::CompositeChannelCredentials(tls, grpc::AccessTokenCredentials(token)) : tls;
}

int main(int argc, char **argv) try {
    const std::string address = argc > 1 ? argv[1] : "127.0.0.1:50051";
    const long steps = argc > 2 ? std::atol(argv[2]) : 100;
    auto plants = v1::PlantService::NewStub(
        grpc::CreateChannel(address, credentials()));

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
