// Sources of depth images for the example: a .npy file or a synthetic scene. A robot uses its camera's driver instead.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <limits>
#include <stdexcept>
#include <string>

struct Depth {
    std::uint32_t width, height;
    bool metres;       // f32; otherwise u16, millimetres
    std::string data;  // row by row, little-endian
};

// Reads an array of height × width written by numpy.save, float32 metres or uint16 millimetres.
inline Depth read_npy(const std::string &path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw std::runtime_error("cannot read " + path);
    const std::string bytes{std::istreambuf_iterator<char>(file), {}};
    // Format version 1.0: eight bytes of magic, two bytes with the length of the header, the header, the data.
    char type[4] = "";
    unsigned height = 0, width = 0;
    const char *header = "{'descr': '%3[^']', 'fortran_order': False, 'shape': (%u, %u)";
    if (bytes.size() > 10) std::sscanf(bytes.c_str() + 10, header, type, &height, &width);
    const bool metres = std::string(type) == "<f4";
    if (width == 0 || !(metres || std::string(type) == "<u2"))
        throw std::runtime_error(path + " is not a .npy file with a 2-D array of float32 or uint16 in C order");
    const auto length = static_cast<unsigned char>(bytes[8]) + 256u * static_cast<unsigned char>(bytes[9]);
    return {width, height, metres, bytes.substr(std::min<std::size_t>(10 + length, bytes.size()))};
}

// A block of 4 × 8 × 10 cm in the middle of the workspace, on a table at z = 0.05 m.
constexpr char SCENE_K[] = "135 0 79.5 0 135 59.5 0 0 1";
constexpr char SCENE_CAMERA[] = "0.15 -0.15 0.6 0.9659258 0 0 -0.258819";  // 30° from the vertical
constexpr char SCENE_CORNER[] = "0 0 0";

inline Depth synthetic_scene() {
    constexpr int WIDTH = 160, HEIGHT = 120;
    const double eye[] = {0.15, -0.15, 0.6}, low[] = {0.13, 0.11, 0.05}, high[] = {0.17, 0.19, 0.15};
    const double sine = 0.5, cosine = std::sqrt(0.75);
    Depth depth{WIDTH, HEIGHT, true, {}};
    for (int v = 0; v < HEIGHT; ++v) {
        for (int u = 0; u < WIDTH; ++u) {
            const double x = (u - 79.5) / 135, y = (v - 59.5) / 135;
            const double ray[] = {x, sine - cosine * y, -cosine - sine * y};
            double enter = 0, leave = std::numeric_limits<double>::infinity();
            for (int axis = 0; axis < 3; ++axis) {
                const double a = (low[axis] - eye[axis]) / ray[axis], b = (high[axis] - eye[axis]) / ray[axis];
                enter = std::max(enter, std::min(a, b)), leave = std::min(leave, std::max(a, b));
            }
            const auto metres = static_cast<float>(enter <= leave ? enter : (low[2] - eye[2]) / ray[2]);
            depth.data.append(reinterpret_cast<const char *>(&metres), sizeof metres);
        }
    }
    return depth;
}
