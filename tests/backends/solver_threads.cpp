// Runs the GPU's form of fused_solver/solve.cu with 32 threads of the CPU, for the thread sanitizer: it tells of every place where one
// thread of a warp reads what another has written, or the reverse, without a __syncwarp between them. Shuffles order nothing here,
// as they order no memory on a GPU.
#include <atomic>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <string>
#include <thread>
#include <vector>

#define __CUDA_ARCH__ 900
#define __shared__ static
#define __align__(x) __attribute__((aligned(x)))
#define __shfl_sync(mask, value, lane) shuffle(value, lane)
#define __shfl_xor_sync(mask, value, lane) shuffle(value, threadIdx.x ^ (lane))

struct float4 {
    float x, y, z, w;
};
struct Index {
    int x;
};
static thread_local Index threadIdx;

namespace wp {
template <class T> T min(T a, T b) { return a < b ? a : b; }
template <class T> T max(T a, T b) { return a > b ? a : b; }
}

struct Barrier {
    std::atomic<int> count{0}, turn{0};
    void wait(std::memory_order load, std::memory_order change) {
        const int now = turn.load(load);
        if (count.fetch_add(1, change) == 31) {
            count.store(0, std::memory_order_relaxed);
            turn.fetch_add(1, change);
        } else {
            while (turn.load(load) == now) std::this_thread::yield();
        }
    }
};
static Barrier* ordered;
static Barrier* loose;
static std::atomic<float> slots[32];

static void __syncwarp() { ordered->wait(std::memory_order_acquire, std::memory_order_acq_rel); }
static void meet() { loose->wait(std::memory_order_relaxed, std::memory_order_relaxed); }
static float shuffle(float value, int lane) {
    meet();
    slots[threadIdx.x].store(value, std::memory_order_relaxed);
    meet();
    const float found = slots[lane].load(std::memory_order_relaxed);
    meet();
    return found;
}

template <class T> struct Array {
    T* data;
    int shape[2];
};
struct Five {
    float values[5];
    float operator[](int i) const { return values[i]; }
};

template <class T> static Array<T> load(const std::string& name, int width = 1) {
    std::ifstream file(name + ".bin", std::ios::binary | std::ios::ate);
    const size_t bytes = file.tellg();
    T* data = new T[bytes / sizeof(T)];
    file.seekg(0);
    file.read(reinterpret_cast<char*>(data), bytes);
    return {data, {static_cast<int>(bytes / sizeof(T)) / width, width}};
}

struct Problem {
#define FIELD(type, name, width) Array<type> name = load<type>(#name, width);
#include "problem.inc"
};
struct Solution {
#include "solution.inc"
#undef FIELD
};

static void solve_world(int world, const Problem& problem, const Solution& solution, int most_iterations, int most_trials) {
#include "program.inc"
}

int main(int, char** arguments) {
    const Problem problem;
    Solution solution;
    const int worlds = std::stoi(arguments[1]);
    for (int world = 0; world < worlds; ++world) {
        Barrier one, two;
        ordered = &one;
        loose = &two;
        std::vector<std::thread> warp;
        for (int lane = 0; lane < 32; ++lane)
            warp.emplace_back([&, lane] {
                threadIdx.x = lane;
                solve_world(world, problem, solution, 50, 50);
            });
        for (auto& thread : warp) thread.join();
    }
    const auto& found = solution.acceleration;
    for (int i = 0; i < found.shape[0] * found.shape[1]; ++i) std::printf("%.9g\n", found.data[i]);
}
