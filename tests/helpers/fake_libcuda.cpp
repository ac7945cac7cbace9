// Replaces libcuda.so.1, so that cuda.bindings can be called without a GPU: counts contexts, stores loaded modules, and
// writes one line of JSON per launch to the file named by FAKE_CUDA_LOG.
//
// FAKE_CUDA_FAIL=name:code makes one function fail. A kernel's first argument is logged as its first 8 bytes.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <map>
#include <string>

namespace {

int fails(const char* name) {
    const char* wanted = getenv("FAKE_CUDA_FAIL");
    const size_t n = strlen(name);
    return wanted && !strncmp(wanted, name, n) && wanted[n] == ':' ? atoi(wanted + n + 1) : 0;
}

void say(const std::string& line) {
    if (FILE* f = fopen(getenv("FAKE_CUDA_LOG"), "a")) fprintf(f, "%s\n", line.c_str()), fclose(f);
}

thread_local void* current = nullptr;
thread_local void* before = nullptr;
std::map<std::string, void*> kernels;
char contexts[8], library;

}  // namespace

extern "C" {

int cuDriverGetVersion(int* v) { return *v = 13020, fails("cuDriverGetVersion"); }
int cuInit(unsigned) { return fails("cuInit"); }
int cuDeviceGet(int* device, int ordinal) { return *device = ordinal, fails("cuDeviceGet"); }
int cuDevicePrimaryCtxRetain(void** context, int device) { return *context = contexts + device, fails("cuDevicePrimaryCtxRetain"); }
int cuCtxGetCurrent(void** context) { return *context = current, fails("cuCtxGetCurrent"); }
int cuCtxPushCurrent_v2(void* context) { return before = current, current = context, fails("cuCtxPushCurrent"); }
int cuCtxPopCurrent_v2(void** context) { return *context = current, current = before, fails("cuCtxPopCurrent"); }

int cuLibraryLoadData(void** out, const void* code, void*, void*, unsigned options, void*, void*, unsigned library_options) {
    if (options || library_options || memcmp(code, "\x7f" "ELF", 4)) return 200;
    say("{\"call\": \"load\"}");
    return *out = &library, fails("cuLibraryLoadData");
}

int cuLibraryGetKernel(void** kernel, void* from, const char* name) {
    if (from != &library) return 400;
    void*& found = kernels[name];
    if (!found) found = strdup(name);
    return *kernel = found, fails("cuLibraryGetKernel");
}

int cuLaunchKernel(void* f, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz, unsigned shared,
                   void* stream, void** parameters, void** extra) {
    if (!current) return 201;  // CUDA_ERROR_INVALID_CONTEXT
    if (extra) return 1;
    unsigned long long first;
    memcpy(&first, parameters[0], 8);
    char line[512];
    snprintf(line, sizeof line,
             "{\"call\": \"launch\", \"kernel\": \"%s\", \"grid\": [%u, %u, %u], \"block\": [%u, %u, %u], \"shared\": %u, "
             "\"stream\": %llu, \"first\": %llu, \"device\": %d}",
             static_cast<char*>(f), gx, gy, gz, bx, by, bz, shared, (unsigned long long)(uintptr_t)stream, first,
             int(static_cast<char*>(current) - contexts));
    say(line);
    return fails("cuLaunchKernel");
}

// Graphs: one line for each node that is added or changed, and one for each launch.
struct NodeParameters {  // CUDA_KERNEL_NODE_PARAMS_v2
    void* func;
    unsigned gx, gy, gz, bx, by, bz, shared;
    void **parameters, **extra;
    void *kern, *context;
};
void say_node(const char* call, unsigned long long number, const NodeParameters* p) {
    unsigned long long first;
    memcpy(&first, p->parameters[0], 8);
    char line[256];
    snprintf(line, sizeof line, "{\"call\": \"%s\", \"node\": %llu, \"kernel\": \"%s\", \"grid\": [%u, %u, %u], \"block\": [%u, %u, %u], \"first\": %llu}",
             call, number, static_cast<char*>(p->kern), p->gx, p->gy, p->gz, p->bx, p->by, p->bz, first);
    say(line);
}
unsigned long long nodes;
int cuGraphCreate(void** graph, unsigned) { return *graph = &nodes, fails("cuGraphCreate"); }
int cuGraphAddKernelNode_v2(void** node, void*, void* const* after, size_t count, const NodeParameters* p) {
    if (p->func || p->extra || p->context || p->shared) return 1;
    if (count != (nodes ? 1u : 0u) || (nodes && reinterpret_cast<uintptr_t>(after[0]) != nodes)) return 1;
    *node = reinterpret_cast<void*>(uintptr_t(++nodes));
    say_node("node", nodes, p);
    return fails("cuGraphAddKernelNode");
}
int cuGraphInstantiateWithFlags(void** executable, void* graph, unsigned long long) {
    return *executable = graph, fails("cuGraphInstantiate");
}
int cuGraphExecKernelNodeSetParams_v2(void*, void* node, const NodeParameters* p) {
    say_node("change", reinterpret_cast<uintptr_t>(node), p);
    return fails("cuGraphExecKernelNodeSetParams");
}
int cuGraphLaunch(void*, void* stream) {
    if (!current) return 201;
    say("{\"call\": \"replay\", \"stream\": " + std::to_string(reinterpret_cast<uintptr_t>(stream)) + "}");
    return fails("cuGraphLaunch");
}

// The entry point by which cuda.bindings looks up functions.
#define NAME(shown, real) \
    if (!strcmp(name, #shown)) return *out = reinterpret_cast<void*>(&real), 0
int cuGetProcAddress_v2(const char* name, void** out, int, uint64_t, void* status) {
    if (status) *static_cast<int*>(status) = 0;
    NAME(cuDriverGetVersion, cuDriverGetVersion);
    NAME(cuInit, cuInit);
    NAME(cuDeviceGet, cuDeviceGet);
    NAME(cuDevicePrimaryCtxRetain, cuDevicePrimaryCtxRetain);
    NAME(cuCtxGetCurrent, cuCtxGetCurrent);
    NAME(cuCtxPushCurrent, cuCtxPushCurrent_v2);
    NAME(cuCtxPopCurrent, cuCtxPopCurrent_v2);
    NAME(cuLibraryLoadData, cuLibraryLoadData);
    NAME(cuLibraryGetKernel, cuLibraryGetKernel);
    NAME(cuLaunchKernel, cuLaunchKernel);
    NAME(cuGraphCreate, cuGraphCreate);
    NAME(cuGraphAddKernelNode, cuGraphAddKernelNode_v2);
    NAME(cuGraphInstantiate, cuGraphInstantiateWithFlags);
    NAME(cuGraphInstantiateWithFlags, cuGraphInstantiateWithFlags);
    NAME(cuGraphExecKernelNodeSetParams, cuGraphExecKernelNodeSetParams_v2);
    NAME(cuGraphLaunch, cuGraphLaunch);
    *out = nullptr;
    return 500;
}
}
