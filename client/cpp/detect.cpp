// Detects grasps in a depth image with graspd. Robot code needs `connect`, `request` and the call in `main`.

#include <grpcpp/grpcpp.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "depth.hpp"
#include "grasp/v1/grasp.grpc.pb.h"

namespace pb = grasp::v1;
using Numbers = std::vector<double>;

// Detection is idempotent, so it can be retried. gRPC follows the retry hint of a busy server. Deadlines are set per
// call: a "timeout" in this configuration can expire up to 2 s early (github.com/grpc/grpc/issues/40633).
constexpr char SERVICE_CONFIG[] = R"(
{"methodConfig": [{"name": [{"service": "grasp.v1.GraspService"}], "retryPolicy": {
  "maxAttempts": 5, "initialBackoff": "0.02s", "maxBackoff": "0.5s", "backoffMultiplier": 2,
  "retryableStatusCodes": ["UNAVAILABLE", "RESOURCE_EXHAUSTED"]}}]}
)";

// Call this once: the stub keeps the connection for all calls and reconnects when it is lost.
std::unique_ptr<pb::GraspService::Stub> connect(const std::string &server) {
    grpc::ChannelArguments arguments;
    arguments.SetServiceConfigJSON(SERVICE_CONFIG);
    // gRPC retries only requests that fit its retry buffer. The default of 256 KiB is smaller than most images.
    arguments.SetInt(GRPC_ARG_PER_RPC_RETRY_BUFFER_SIZE, 16 << 20);
    // A low threshold can return tens of thousands of grasps.
    arguments.SetMaxReceiveMessageSize(-1);
    // Reconnect soon. By default gRPC waits for up to two minutes after an outage.
    arguments.SetInt(GRPC_ARG_INITIAL_RECONNECT_BACKOFF_MS, 100);
    arguments.SetInt(GRPC_ARG_MAX_RECONNECT_BACKOFF_MS, 500);
    // Detect servers that disappear without closing the connection.
    arguments.SetInt(GRPC_ARG_KEEPALIVE_TIME_MS, 30000);
    arguments.SetInt(GRPC_ARG_KEEPALIVE_TIMEOUT_MS, 10000);
    return pb::GraspService::NewStub(grpc::CreateCustomChannel(server, grpc::InsecureChannelCredentials(), arguments));
}

pb::Vector3 vector(double x, double y, double z) {
    pb::Vector3 vector;
    vector.set_x(x), vector.set_y(y), vector.set_z(z);
    return vector;
}

// x y z, then the quaternion x y z w.
pb::Pose pose(const Numbers &numbers) {
    pb::Pose pose;
    *pose.mutable_position() = vector(numbers[0], numbers[1], numbers[2]);
    auto &rotation = *pose.mutable_orientation();
    rotation.set_x(numbers[3]), rotation.set_y(numbers[4]), rotation.set_z(numbers[5]), rotation.set_w(numbers[6]);
    return pose;
}

pb::DetectGraspsFromDepthRequest request(Depth depth, const Numbers &k, const Numbers &camera, const Numbers &corner) {
    pb::DetectGraspsFromDepthRequest request;
    auto &view = *request.add_views();
    view.mutable_camera()->set_width(depth.width);
    view.mutable_camera()->set_height(depth.height);
    // Row-major order. Eigen's default is column-major: transpose its matrices.
    view.mutable_camera()->mutable_k()->Assign(k.begin(), k.end());
    view.set_unit(depth.metres ? pb::DEPTH_UNIT_F32_METRES : pb::DEPTH_UNIT_U16_MILLIMETRES);
    view.set_data(std::move(depth.data));
    *view.mutable_frame_from_camera() = pose(camera);

    // The workspace: a cube of 0.3 m with the axes of the robot's base.
    request.mutable_workspace()->set_frame_id("base");
    *request.mutable_workspace()->mutable_pose() = pose({corner[0], corner[1], corner[2], 0, 0, 0, 1});

    auto &options = *request.mutable_options();
    options.set_max_grasps(5);
    // Grasps from above, at most 1 rad from the vertical, without collision of the open hand.
    *options.mutable_approach()->mutable_axis() = vector(0, 0, -1);
    options.mutable_approach()->set_angle(1);
    options.mutable_collision()->set_mode(pb::CollisionCheck::MODE_FILTER);
    return request;
}

void print(const pb::DetectGraspsResponse &reply, double round_trip) {
    std::printf("%s %s: grasps in %s: %d\n", reply.model().c_str(), reply.version().c_str(), reply.frame_id().c_str(),
                reply.grasps_size());
    for (const auto &grasp : reply.grasps()) {
        const auto &at = grasp.pose().position(), &before = grasp.pregrasp().position();
        const auto &rotation = grasp.pose().orientation();
        std::printf("quality %.3f width %.3f at %.3f %.3f %.3f turned %.3f %.3f %.3f %.3f from %.3f %.3f %.3f\n",
                    grasp.quality(), grasp.width(), at.x(), at.y(), at.z(), rotation.x(), rotation.y(), rotation.z(),
                    rotation.w(), before.x(), before.y(), before.z());
    }
    // The reasons; set in replies without grasps.
    if (reply.has_dropped()) std::printf("voxels without a grasp: %s\n", reply.dropped().ShortDebugString().c_str());
    const auto &took = reply.latency();
    const std::pair<const char *, double> stages[] = {
        {"queue", took.queue()}, {"preprocessing", took.preprocessing()}, {"fusion", took.fusion()},
        {"inference", took.inference()}, {"evaluation", took.evaluation()}, {"postprocessing", took.postprocessing()},
        {"total", took.total()}, {"round trip", round_trip}};
    std::printf("milliseconds:");
    for (const auto &[stage, seconds] : stages) std::printf(" %s %.2f", stage, seconds * 1e3);
    std::printf("\n");
}

// The server's message begins with the invalid field, if there is one. gRPC has no names for its codes in C++.
std::string describe(const grpc::Status &status) {
    static const char *const NAMES[] = {
        "OK", "CANCELLED", "UNKNOWN", "INVALID_ARGUMENT", "DEADLINE_EXCEEDED", "NOT_FOUND", "ALREADY_EXISTS",
        "PERMISSION_DENIED", "RESOURCE_EXHAUSTED", "FAILED_PRECONDITION", "ABORTED", "OUT_OF_RANGE", "UNIMPLEMENTED",
        "INTERNAL", "UNAVAILABLE", "DATA_LOSS", "UNAUTHENTICATED"};
    return std::string(NAMES[status.error_code()]) + ": " + status.error_message();
}

Numbers numbers(const std::string &flag, std::string text, std::size_t count) {
    // Brackets and commas are ignored, so that arrays printed by ROS can be pasted.
    std::replace_if(text.begin(), text.end(), [](char c) { return std::strchr("[],", c); }, ' ');
    std::istringstream stream(text);
    Numbers numbers;
    for (double number; stream >> number;) numbers.push_back(number);
    if (numbers.size() != count || !stream.eof())
        throw std::runtime_error(flag + " is \"" + text + "\", must be " + std::to_string(count) + " numbers");
    return numbers;
}

constexpr char USAGE[] = R"(detect [--server HOST:PORT] [--depth FILE --k K --camera POSE --corner POINT]
  --server  address of graspd. Default: 127.0.0.1:50051
  --depth   .npy file, height × width, float32 metres or uint16 millimetres. Default: a synthetic scene
  --k       intrinsic matrix, pixels: fx 0 cx 0 fy cy 0 0 1
  --camera  pose of the camera in the robot's base, metres: x y z qx qy qz qw
  --corner  corner of the workspace, a cube of 0.3 m, in the robot's base, metres: x y z. The table is 0.05 m above it
)";

int main(int argc, char **argv) try {
    std::map<std::string, std::string> flags = {
        {"--server", "127.0.0.1:50051"}, {"--depth", ""}, {"--k", ""}, {"--camera", ""}, {"--corner", ""}};
    for (int i = 1; i < argc; i += 2) {
        if (i + 1 == argc || !flags.count(argv[i])) {
            std::fputs(USAGE, stderr);
            return 2;
        }
        flags[argv[i]] = argv[i + 1];
    }
    const bool synthetic = flags["--depth"].empty();
    const auto given = [&](const char *flag, std::size_t count, const char *scene_value) {
        return numbers(flag, synthetic && flags[flag].empty() ? scene_value : flags[flag], count);
    };
    auto depth = synthetic ? synthetic_scene() : read_npy(flags["--depth"]);
    const auto message = request(std::move(depth), given("--k", 9, SCENE_K), given("--camera", 7, SCENE_CAMERA),
                                 given("--corner", 3, SCENE_CORNER));

    const auto grasps = connect(flags["--server"]);
    grpc::ClientContext context;  // one per call
    const auto start = std::chrono::system_clock::now();
    // Deadline for all attempts together.
    context.set_deadline(start + std::chrono::seconds(2));
    pb::DetectGraspsResponse reply;
    const auto status = grasps->DetectGraspsFromDepth(&context, message, &reply);
    if (!status.ok()) throw std::runtime_error(describe(status));
    print(reply, std::chrono::duration<double>(std::chrono::system_clock::now() - start).count());
    return 0;
} catch (const std::exception &error) {
    std::fprintf(stderr, "detect: %s\n", error.what());
    return 1;
}
