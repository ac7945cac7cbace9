/* Preloaded library (LD_PRELOAD) that counts the libc calls which change files below one folder. The n-th call kills
   the process, or fails as on a full disk, like all later calls that write. Alternatively the process pauses at each
   call, while another process inspects the files that a kill would leave. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

enum { COUNT = 0, KILL = -1, TEAR = -2 }; /* > 0: an errno */

static char folder[PATH_MAX];
static long target = -1, count;
static int action, record = -1, backwards;
static int report_to = -1, answer_from = -1; /* pipes to and from the watching process */

/* Start counting at 0: apply ACTION at call NUMBER, and write "name path" of each call to RECORD, if >= 0. */
void failing_arm(const char *below, long number, int what, int descriptor) {
    snprintf(folder, sizeof folder, "%s", below);
    target = number, action = what, record = descriptor, count = 0;
}

/* Report each call to TO as "B name path" and wait for a line from FROM. Half of a write is reported as "H". The answer
   "full" lets a copy of the process run to its end with a full disk; its exit status is then reported as "E". */
void failing_watch(const char *below, int to, int from) {
    failing_arm(below, -1, 0, -1);
    report_to = to, answer_from = from;
}

/* Let every reading of the wall clock be an hour earlier than the previous one. */
void failing_clock(void) { backwards = 1; }

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(clock, now);
    if (backwards && clock == CLOCK_REALTIME) now->tv_sec -= 3600L * backwards++;
    return result;
}

static int below(const char *path) {
    size_t length = strlen(folder);
    return length && !strncmp(path, folder, length) && (path[length] == '/' || !path[length]);
}

static const char *full(int at, const char *path, char *buffer) {
    char link[64];
    if (path[0] == '/') return path;
    if (at == AT_FDCWD) {
        if (!getcwd(buffer, PATH_MAX)) return path;
    } else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", at);
        ssize_t size = readlink(link, buffer, PATH_MAX - 1);
        buffer[size < 0 ? 0 : size] = 0;
    }
    if (*path) {
        size_t length = strlen(buffer);
        snprintf(buffer + length, PATH_MAX - length, "/%s", path);
    }
    return buffer;
}

/* Send a line to the watching process; return the first letter of its answer. */
static char ask(const char *line, size_t size) {
    char answer = 0;
    if (syscall(SYS_write, report_to, line, size) < 0 || syscall(SYS_read, answer_from, &answer, 1) != 1) _exit(99);
    return answer;
}

/* Fork: the disk is full for the copy from this call on. The original waits for its end. Returns 1 in the copy. */
static int copied(long here) {
    pid_t child = fork();
    if (!child) {
        report_to = -1, target = here, action = ENOSPC;
        return 1;
    }
    int status = 0, late = child < 0;
    for (long waited = 0; child > 0 && waitpid(child, &status, WNOHANG) == 0; waited++) {
        usleep(1000);
        if (waited > 60000) kill(child, SIGKILL), late = 1;
    }
    char line[64];
    int code = late ? 97 : WIFEXITED(status) ? WEXITSTATUS(status) : -WTERMSIG(status);
    ask(line, (size_t)snprintf(line, sizeof line, "E %d\n", code));
    return 0;
}

/* Return the action for this call: 0 (none), KILL, TEAR or an errno. MAKES: the call needs disk space. */
static int due(const char *name, const char *path, int makes) {
    if (!below(path)) return 0;
    long here = count++;
    if (report_to >= 0) {
        char line[PATH_MAX + 32];
        size_t size = (size_t)snprintf(line, sizeof line, "B %s %s\n", name, path + strlen(folder));
        if (ask(line, size) != 'f' || !copied(here)) return 0;
    }
    if (record >= 0) {
        char line[PATH_MAX + 32];
        int size = snprintf(line, sizeof line, "%s %s\n", name, path + strlen(folder));
        if (syscall(SYS_write, record, line, (size_t)size) < 0) record = -1;
    }
    if (target < 0 || here < target) return 0;
    if (action < 0) return here == target ? action : 0;
    return makes ? action : 0;
}

static void die(void) {
    kill(getpid(), SIGKILL);
    for (;;) pause();
}

#define REAL(type, name, ...)                                                                                          \
    static type (*real)(__VA_ARGS__);                                                                                  \
    if (!real) real = (type(*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

/* An atomic call: KILL acts before it, TEAR directly after it. */
#define GUARDED(name, path, makes, call)                                                                               \
    int what = due(name, path, makes);                                                                                 \
    if (what == KILL) die();                                                                                           \
    if (what > 0) return errno = what, -1;                                                                             \
    int result = (call);                                                                                               \
    if (what == TEAR) die();                                                                                           \
    return result

#define OPENED(symbol)                                                                                                 \
    int symbol(const char *path, int flags, ...) {                                                                     \
        REAL(int, #symbol, const char *, int, ...);                                                                    \
        va_list rest;                                                                                                  \
        va_start(rest, flags);                                                                                         \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;                                        \
        va_end(rest);                                                                                                  \
        char buffer[PATH_MAX];                                                                                         \
        if (!(flags & (O_CREAT | O_TRUNC))) return real(path, flags, mode);                                            \
        GUARDED("open", full(AT_FDCWD, path, buffer), flags &O_CREAT, real(path, flags, mode));                        \
    }
OPENED(open)
OPENED(open64)

#define OPENED_AT(symbol)                                                                                              \
    int symbol(int at, const char *path, int flags, ...) {                                                             \
        REAL(int, #symbol, int, const char *, int, ...);                                                               \
        va_list rest;                                                                                                  \
        va_start(rest, flags);                                                                                         \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(rest, mode_t) : 0;                                        \
        va_end(rest);                                                                                                  \
        char buffer[PATH_MAX];                                                                                         \
        if (!(flags & (O_CREAT | O_TRUNC))) return real(at, path, flags, mode);                                        \
        GUARDED("open", full(at, path, buffer), flags &O_CREAT, real(at, path, flags, mode));                          \
    }
OPENED_AT(openat)
OPENED_AT(openat64)

static const char *of(int descriptor, char *buffer) { return full(descriptor, "", buffer); }

ssize_t write(int descriptor, const void *data, size_t size) {
    REAL(ssize_t, "write", int, const void *, size_t);
    char buffer[PATH_MAX];
    int what = folder[0] ? due("write", of(descriptor, buffer), 1) : 0;
    if (what == KILL) die();
    if (what == TEAR) {
        if (real(descriptor, data, size / 2) >= 0) die();
        die();
    }
    if (what > 0) return errno = what, -1;
    if (report_to < 0 || size < 2 || !folder[0] || !below(of(descriptor, buffer))) return real(descriptor, data, size);
    ssize_t first = real(descriptor, data, size / 2);
    if (first < 0) return first;
    ask("H\n", 2);
    ssize_t second = real(descriptor, (const char *)data + first, size - (size_t)first);
    return second < 0 ? first : first + second;
}

int fsync(int descriptor) {
    REAL(int, "fsync", int);
    char buffer[PATH_MAX];
    GUARDED("fsync", of(descriptor, buffer), 1, real(descriptor));
}

int ftruncate64(int descriptor, off64_t size) {
    REAL(int, "ftruncate64", int, off64_t);
    char buffer[PATH_MAX];
    GUARDED("truncate", of(descriptor, buffer), 0, real(descriptor, size));
}

int rename(const char *from, const char *to) {
    REAL(int, "rename", const char *, const char *);
    char buffer[PATH_MAX];
    GUARDED("rename", full(AT_FDCWD, to, buffer), 1, real(from, to));
}

int unlink(const char *path) {
    REAL(int, "unlink", const char *);
    char buffer[PATH_MAX];
    GUARDED("unlink", full(AT_FDCWD, path, buffer), 0, real(path));
}

int unlinkat(int at, const char *path, int flags) {
    REAL(int, "unlinkat", int, const char *, int);
    char buffer[PATH_MAX];
    GUARDED("unlink", full(at, path, buffer), 0, real(at, path, flags));
}

int rmdir(const char *path) {
    REAL(int, "rmdir", const char *);
    char buffer[PATH_MAX];
    GUARDED("rmdir", full(AT_FDCWD, path, buffer), 0, real(path));
}

int mkdir(const char *path, mode_t mode) {
    REAL(int, "mkdir", const char *, mode_t);
    char buffer[PATH_MAX];
    GUARDED("mkdir", full(AT_FDCWD, path, buffer), 1, real(path, mode));
}
