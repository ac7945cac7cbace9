/* A layer under a process (LD_PRELOAD): every call of libc that changes files below one folder is counted, and the
   n-th ends the process as a power switch would, or fails as on a full disk, and so do all that write after it. Or the
   process stands still at each of them in turn, while another looks at what a kill would leave there. */
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
static int told = -1, answered = -1; /* pipes to whoever looks on, and from there */

/* Called by the test: from now on count, from 0; do ACTION at call NUMBER; write "name path" to RECORD, if >= 0. */
void failing_arm(const char *below, long number, int what, int descriptor) {
    snprintf(folder, sizeof folder, "%s", below);
    target = number, action = what, record = descriptor, count = 0;
}

/* Called by the test: tell each call to TO, as "B name path", and wait for a line of FROM. Half of a write is told as
   "H". On "full" a copy of the process goes on with a full disk, to its end: its status is told as "E", and waited. */
void failing_watch(const char *below, int to, int from) {
    failing_arm(below, -1, 0, -1);
    told = to, answered = from;
}

/* Called by the test: from now on each look at the clock on the wall finds it an hour earlier. */
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

/* Say something to whoever looks on; the first letter of the answer. */
static char ask(const char *line, size_t size) {
    char answer = 0;
    if (syscall(SYS_write, told, line, size) < 0 || syscall(SYS_read, answered, &answer, 1) != 1) _exit(99);
    return answer;
}

/* A copy of this process finds the disk full from this call on, and ends: meanwhile this one waits. 1 in the copy. */
static int copied(long here) {
    pid_t child = fork();
    if (!child) {
        told = -1, target = here, action = ENOSPC;
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

/* What is to happen at this call: 0 nothing, KILL, TEAR, or an errno. MAKES: it needs room on the disk. */
static int due(const char *name, const char *path, int makes) {
    if (!below(path)) return 0;
    long here = count++;
    if (told >= 0) {
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

/* A call that is all or nothing: a kill comes before it; TEAR, right after it. */
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
    if (told < 0 || size < 2 || !folder[0] || !below(of(descriptor, buffer))) return real(descriptor, data, size);
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
