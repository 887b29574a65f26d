// Asks graspd for grasps in a depth image. A robot needs `connect`, `request` and what `main` does with them.

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

// Asking twice does no harm. A server that is full also says when to come back, and gRPC obeys. Calls have deadlines of
// their own: a "timeout" in here passes up to 2 s early (github.com/grpc/grpc/issues/40633).
constexpr char SERVICE_CONFIG[] = R"(
{"methodConfig": [{"name": [{"service": "grasp.v1.GraspService"}], "retryPolicy": {
  "maxAttempts": 5, "initialBackoff": "0.02s", "maxBackoff": "0.5s", "backoffMultiplier": 2,
  "retryableStatusCodes": ["UNAVAILABLE", "RESOURCE_EXHAUSTED"]}}]}
)";

// Once: the connection is kept for all calls, and made anew when it is lost.
std::unique_ptr<pb::GraspService::Stub> connect(const std::string &server) {
    grpc::ChannelArguments arguments;
    arguments.SetServiceConfigJSON(SERVICE_CONFIG);
    // gRPC retries what it has kept: by itself at most 256 KiB, less than most images.
    arguments.SetInt(GRPC_ARG_PER_RPC_RETRY_BUFFER_SIZE, 16 << 20);
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
    auto &turned = *pose.mutable_orientation();
    turned.set_x(numbers[3]), turned.set_y(numbers[4]), turned.set_z(numbers[5]), turned.set_w(numbers[6]);
    return pose;
}

pb::DetectGraspsFromDepthRequest request(Depth depth, const Numbers &k, const Numbers &camera, const Numbers &corner) {
    pb::DetectGraspsFromDepthRequest request;
    auto &view = *request.add_views();
    view.mutable_camera()->set_width(depth.width);
    view.mutable_camera()->set_height(depth.height);
    // Row by row. Eigen keeps columns: of a matrix of its, send the transpose.
    view.mutable_camera()->mutable_k()->Assign(k.begin(), k.end());
    view.set_unit(depth.metres ? pb::DEPTH_UNIT_F32_METRES : pb::DEPTH_UNIT_U16_MILLIMETRES);
    view.set_data(std::move(depth.data));
    *view.mutable_frame_from_camera() = pose(camera);

    // Where to look: a cube of 0.3 m whose axes are the base's.
    request.mutable_workspace()->set_frame_id("base");
    *request.mutable_workspace()->mutable_pose() = pose({corner[0], corner[1], corner[2], 0, 0, 0, 1});

    auto &options = *request.mutable_options();
    options.set_max_grasps(5);
    // From above, at most 1 rad off the vertical, and only where the open hand meets nothing.
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
        const auto &turned = grasp.pose().orientation();
        std::printf("quality %.3f width %.3f at %.3f %.3f %.3f turned %.3f %.3f %.3f %.3f from %.3f %.3f %.3f\n",
                    grasp.quality(), grasp.width(), at.x(), at.y(), at.z(), turned.x(), turned.y(), turned.z(),
                    turned.w(), before.x(), before.y(), before.z());
    }
    // An empty answer says why.
    if (reply.has_dropped()) std::printf("voxels without a grasp: %s\n", reply.dropped().ShortDebugString().c_str());
    const auto &took = reply.latency();
    const std::pair<const char *, double> stages[] = {
        {"queue", took.queue()}, {"preprocessing", took.preprocessing()}, {"fusion", took.fusion()},
        {"inference", took.inference()}, {"postprocessing", took.postprocessing()}, {"total", took.total()},
        {"round trip", round_trip}};
    std::printf("milliseconds:");
    for (const auto &[stage, seconds] : stages) std::printf(" %s %.2f", stage, seconds * 1e3);
    std::printf("\n");
}

// The message begins with the field that is wrong, where one is. gRPC has no names for its codes in C++.
std::string describe(const grpc::Status &status) {
    static const char *const NAMES[] = {
        "OK", "CANCELLED", "UNKNOWN", "INVALID_ARGUMENT", "DEADLINE_EXCEEDED", "NOT_FOUND", "ALREADY_EXISTS",
        "PERMISSION_DENIED", "RESOURCE_EXHAUSTED", "FAILED_PRECONDITION", "ABORTED", "OUT_OF_RANGE", "UNIMPLEMENTED",
        "INTERNAL", "UNAVAILABLE", "DATA_LOSS", "UNAUTHENTICATED"};
    return std::string(NAMES[status.error_code()]) + ": " + status.error_message();
}

Numbers numbers(const std::string &flag, std::string text, std::size_t count) {
    // As ROS prints them, too.
    std::replace_if(text.begin(), text.end(), [](char c) { return std::strchr("[],", c); }, ' ');
    std::istringstream stream(text);
    Numbers numbers;
    for (double number; stream >> number;) numbers.push_back(number);
    if (numbers.size() != count || !stream.eof())
        throw std::runtime_error(flag + " is \"" + text + "\", must be " + std::to_string(count) + " numbers");
    return numbers;
}

constexpr char USAGE[] = R"(detect [--server HOST:PORT] [--depth FILE --k K --camera POSE --corner POINT]
  --depth   a .npy file, height × width, float32 metres or uint16 millimetres; without it, a made-up scene
  --k       fx 0 cx 0 fy cy 0 0 1, pixels
  --camera  where the camera stands in the robot's base: x y z qx qy qz qw
  --corner  of the cube of 0.3 m in which to look, in the base: x y z. A table is 0.05 above it
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
    const bool made_up = flags["--depth"].empty();
    const auto given = [&](const char *flag, std::size_t count, const char *in_the_scene) {
        return numbers(flag, made_up && flags[flag].empty() ? in_the_scene : flags[flag], count);
    };
    auto depth = made_up ? made_up_scene() : read_npy(flags["--depth"]);
    const auto message = request(std::move(depth), given("--k", 9, SCENE_K), given("--camera", 7, SCENE_CAMERA),
                                 given("--corner", 3, SCENE_CORNER));

    const auto grasps = connect(flags["--server"]);
    grpc::ClientContext context;  // of one call
    const auto start = std::chrono::system_clock::now();
    // Of all attempts together.
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
