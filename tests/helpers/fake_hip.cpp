// Stands in for libamdhip64, so that HipDriver can be called without an AMD GPU: it counts devices, keeps what was loaded,
// replays graphs with the arguments that it was given, tells a function of the tests what runs, and writes a line of JSON for
// each call that matters to fake_hip_log. fake_hip_fail("name", code) makes one function fail. Structures and signatures are
// those of hip_runtime_api.h.
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <vector>

struct dim3 {
    uint32_t x, y, z;
};
typedef struct hipKernelNodeParams {
    dim3 blockDim;
    void** extra;
    void* func;
    dim3 gridDim;
    void** kernelParams;
    unsigned int sharedMemBytes;
} hipKernelNodeParams;
typedef void (*Runner)(const char* kernel, unsigned blocks, unsigned threads, const void* argument);

namespace {
constexpr int DEVICES = 3, ARGUMENT = 1024;  // bytes of an argument that are kept, more than any structure has
struct Kernel {
    std::string name;
    int device;
};
struct Module {
    int device;
};
struct Node {
    const Kernel* kernel;
    const Node* after;
    unsigned blocks, threads;
    std::string argument;
};
struct Graph {
    std::vector<Node*> nodes;
};
thread_local int current = 0;
Runner runner = nullptr;
std::string log_text, failing;
int failing_code = 0, version = 60241134;

void say(const char* format, auto... values) {
    char line[512];
    snprintf(line, sizeof line, format, values...);
    log_text += line, log_text += "\n";
}
int fails(const char* name) { return failing == name ? failing_code : 0; }
unsigned long long first_of(const void* argument) {
    unsigned long long first;
    memcpy(&first, argument, 8);
    return first;
}
int take(Node& node, const hipKernelNodeParams& p) {
    if (p.extra || p.sharedMemBytes || p.blockDim.y != 1 || p.gridDim.y != 1 || p.blockDim.z != 1 || p.gridDim.z != 1) return 1;
    node.kernel = static_cast<const Kernel*>(p.func), node.blocks = p.gridDim.x, node.threads = p.blockDim.x;
    node.argument.assign(static_cast<const char*>(p.kernelParams[0]), ARGUMENT);
    return 0;
}
}  // namespace

extern "C" {
void fake_hip_runner(Runner given) { runner = given; }
void fake_hip_fail(const char* name, int code) { failing = name, failing_code = code; }
void fake_hip_version(int number) { version = number; }
const char* fake_hip_log() { return log_text.c_str(); }
void fake_hip_forget() { log_text.clear(), current = 0, failing.clear(), failing_code = 0, version = 60241134; }

const char* hipGetErrorName(int code) {
    switch (code) {
        case 2: return "hipErrorOutOfMemory";
        case 100: return "hipErrorNoDevice";
        case 101: return "hipErrorInvalidDevice";
        case 200: return "hipErrorInvalidImage";
        case 209: return "hipErrorNoBinaryForGpu";
        case 500: return "hipErrorNotFound";
        case 700: return "hipErrorIllegalAddress";
        case 801: return "hipErrorNotSupported";
        default: return "hipErrorUnknown";
    }
}
int hipInit(unsigned) { return fails("hipInit"); }
int hipRuntimeGetVersion(int* out) { return *out = version, fails("hipRuntimeGetVersion"); }
int hipGetDevice(int* device) { return *device = current, fails("hipGetDevice"); }
int hipSetDevice(int device) {
    if (device < 0 || device >= DEVICES) return 101;
    return current = device, fails("hipSetDevice");
}
int hipModuleLoadData(void** module, const void* image) {
    if (memcmp(image, "\x7f" "ELF", 4)) return 200;
    say("{\"call\": \"load\", \"device\": %d}", current);
    return *module = new Module{current}, fails("hipModuleLoadData");
}
int hipModuleGetFunction(void** kernel, void* module, const char* name) {
    return *kernel = new Kernel{name, static_cast<Module*>(module)->device}, fails("hipModuleGetFunction");
}
int hipModuleLaunchKernel(void* f, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                          unsigned shared, void* stream, void** parameters, void** extra) {
    const Kernel& kernel = *static_cast<Kernel*>(f);
    if (extra || gy != 1 || gz != 1 || by != 1 || bz != 1 || kernel.device != current) return 1;
    say("{\"call\": \"launch\", \"kernel\": \"%s\", \"grid\": %u, \"block\": %u, \"shared\": %u, \"stream\": %llu, \"first\": %llu, "
        "\"device\": %d}",
        kernel.name.c_str(), gx, bx, shared, (unsigned long long)(uintptr_t)stream, first_of(parameters[0]), current);
    if (const int code = fails("hipModuleLaunchKernel")) return code;
    if (runner) runner(kernel.name.c_str(), gx, bx, parameters[0]);
    return 0;
}
int hipGraphCreate(void** graph, unsigned) { return *graph = new Graph, fails("hipGraphCreate"); }
int hipGraphAddKernelNode(void** out, void* g, void* const* after, size_t count, const hipKernelNodeParams* p) {
    Graph& graph = *static_cast<Graph*>(g);
    if (count != (graph.nodes.empty() ? 0u : 1u) || (count && after[0] != graph.nodes.back())) return 1;
    Node* const node = new Node{nullptr, count ? static_cast<Node*>(after[0]) : nullptr, 0, 0, ""};
    if (const int code = take(*node, *p)) return code;
    graph.nodes.push_back(node);
    say("{\"call\": \"node\", \"kernel\": \"%s\", \"grid\": %u, \"block\": %u}", node->kernel->name.c_str(), node->blocks, node->threads);
    return *out = node, fails("hipGraphAddKernelNode");
}
int hipGraphInstantiate(void** executable, void* graph, void** node, char* words, size_t size) {
    if (node || words || size) return 1;
    return *executable = graph, fails("hipGraphInstantiate");
}
int hipGraphExecKernelNodeSetParams(void*, void* node, const hipKernelNodeParams* p) {
    say("{\"call\": \"change\"}");
    if (const int code = fails("hipGraphExecKernelNodeSetParams")) return code;
    return take(*static_cast<Node*>(node), *p);
}
int hipGraphLaunch(void* g, void* stream) {
    say("{\"call\": \"replay\", \"stream\": %llu, \"device\": %d}", (unsigned long long)(uintptr_t)stream, current);
    if (const int code = fails("hipGraphLaunch")) return code;
    for (const Node* node : static_cast<Graph*>(g)->nodes)
        if (runner) runner(node->kernel->name.c_str(), node->blocks, node->threads, node->argument.data());
    return 0;
}
}
