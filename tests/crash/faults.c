/* Preloaded (LD_PRELOAD) into a process: counts the system calls that write below a folder, and lets them fail.

   faults_begin(folder, point, error, lasting): call number `point` fails with `error`; with `lasting`, so do all later
   ones that need room, as on a full disk. Until it is called nothing is counted. Reading, closing and removing never
   fail. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static char folder[PATH_MAX];
static size_t length;
static long point, calls;
static int error, lasting, active;
static char failed_call[32], failed_path[PATH_MAX];

void faults_begin(const char *below, long at, int number, int stays) {
  length = strlen(strncpy(folder, below, sizeof folder - 1));
  point = at, error = number, lasting = stays, calls = 0, active = 1;
}
long faults_calls(void) { return calls; }
const char *faults_call(void) { return failed_call; }
const char *faults_path(void) { return failed_path; }

static int fails(const char *call, const char *path, int needs_room) {
  if (strncmp(path, folder, length)) return 0;
  calls++;
  if (calls != point && !(lasting && needs_room && calls > point && point)) return 0;
  if (calls == point) {
    strncpy(failed_call, call, sizeof failed_call - 1);
    strncpy(failed_path, path, sizeof failed_path - 1);
  }
  errno = error;
  return 1;
}

static int fails_at(const char *call, int parent, const char *path, int needs_room) {
  char whole[2 * PATH_MAX], link[64];
  if (!active) return 0;
  if (path[0] == '/') return fails(call, path, needs_room);
  if (parent == AT_FDCWD) {
    if (!getcwd(whole, PATH_MAX)) return 0;
  } else {
    snprintf(link, sizeof link, "/proc/self/fd/%d", parent);
    ssize_t size = readlink(link, whole, PATH_MAX - 1);
    if (size < 0) return 0;
    whole[size] = 0;
  }
  strcat(strcat(whole, "/"), path);
  return fails(call, whole, needs_room);
}

static int fails_open(const char *call, int file, int needs_room) {
  char link[64], path[PATH_MAX];
  if (!active) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t size = readlink(link, path, sizeof path - 1);
  if (size < 0) return 0;
  path[size] = 0;
  return fails(call, path, needs_room);
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define WRITES (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC | O_APPEND)

#define OPEN(name, parameters, parent, arguments)                                                                     \
  int name parameters {                                                                                               \
    mode_t mode = 0;                                                                                                  \
    if (flags & (O_CREAT | O_TMPFILE)) {                                                                              \
      va_list rest;                                                                                                   \
      va_start(rest, flags);                                                                                          \
      mode = va_arg(rest, mode_t);                                                                                    \
      va_end(rest);                                                                                                   \
    }                                                                                                                 \
    const char *call = (flags & O_TMPFILE) == O_TMPFILE ? "open unnamed" : "open";                                    \
    if ((flags & WRITES) && fails_at(call, parent, path, flags & O_CREAT)) return -1;                               \
    return REAL(name) arguments;                                                                                      \
  }
OPEN(open, (const char *path, int flags, ...), AT_FDCWD, (path, flags, mode))
OPEN(open64, (const char *path, int flags, ...), AT_FDCWD, (path, flags, mode))
OPEN(openat, (int parent, const char *path, int flags, ...), parent, (parent, path, flags, mode))
OPEN(openat64, (int parent, const char *path, int flags, ...), parent, (parent, path, flags, mode))

#define PATHS(name, parameters, parent, path, room, arguments)                                                        \
  int name parameters { return fails_at(#name, parent, path, room) ? -1 : REAL(name) arguments; }
PATHS(mkdir, (const char *path, mode_t mode), AT_FDCWD, path, 1, (path, mode))
PATHS(mkdirat, (int parent, const char *path, mode_t mode), parent, path, 1, (parent, path, mode))
PATHS(rename, (const char *from, const char *to), AT_FDCWD, to, 0, (from, to))
PATHS(renameat, (int a, const char *from, int b, const char *to), b, to, 0, (a, from, b, to))
PATHS(link, (const char *from, const char *to), AT_FDCWD, to, 1, (from, to))
PATHS(symlink, (const char *from, const char *to), AT_FDCWD, to, 1, (from, to))
PATHS(truncate, (const char *path, off_t size), AT_FDCWD, path, 0, (path, size))

#define FILES(type, name, parameters, room, arguments)                                                                \
  type name parameters { return fails_open(#name, file, room) ? -1 : REAL(name) arguments; }
FILES(ssize_t, write, (int file, const void *content, size_t size), 1, (file, content, size))
FILES(ssize_t, pwrite, (int file, const void *content, size_t size, off_t at), 1, (file, content, size, at))
FILES(ssize_t, pwrite64, (int file, const void *content, size_t size, off64_t at), 1, (file, content, size, at))
FILES(ssize_t, writev, (int file, const struct iovec *parts, int count), 1, (file, parts, count))
FILES(ssize_t, sendfile, (int file, int from, off_t *at, size_t size), 1, (file, from, at, size))
FILES(ssize_t, sendfile64, (int file, int from, off64_t *at, size_t size), 1, (file, from, at, size))
FILES(int, fsync, (int file), 0, (file))
FILES(int, fdatasync, (int file), 0, (file))
FILES(int, ftruncate, (int file, off_t size), 0, (file, size))
FILES(int, ftruncate64, (int file, off64_t size), 0, (file, size))
FILES(int, posix_fallocate, (int file, off_t at, off_t size), 1, (file, at, size))
