/*
 * Faults of the disk, for tests: loaded with LD_PRELOAD into the daemon and its
 * workers. The file that CBCT_TEST_FAULTS names holds one line,
 *
 *   CALL ERRNO PART TIMES PASS
 *
 * and of the calls of CALL (fsync, fdatasync, fallocate, open, pread) on a path that has PART
 * in it, PASS succeed and the next TIMES fail with that number. CALL may be prctl with PART parent: a process then
 * outlives its parent. The file is read at each call, so that a
 * test may write and remove it while the programs run; the calls of all processes
 * are counted together, in the file CBCT_TEST_FAULTS.count.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

/* The file's own reads must not go through the wrappers. */
static ssize_t read_small(const char *path, char *ret, size_t size)
{
	long file = syscall(SYS_openat, AT_FDCWD, path, O_RDONLY | O_CLOEXEC);
	ssize_t got = file < 0 ? -1 : read((int)file, ret, size - 1);

	if (file >= 0)
		close((int)file);
	ret[got > 0 ? got : 0] = 0;
	return got;
}

/* Counts this call; the size of the file is the number. */
static long count_call(const char *faults)
{
	char path[4096];
	long file, at;

	snprintf(path, sizeof(path), "%s.count", faults);
	file = syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
	if (file < 0)
		return 0;
	if (write((int)file, "x", 1) != 1)
		abort();
	at = lseek((int)file, 0, SEEK_END);
	close((int)file);
	return at;
}

static int fault(const char *call, const char *path)
{
	const char *faults = getenv("CBCT_TEST_FAULTS");
	char line[512], name[32], part[256];
	int number, saved = errno;
	long times, pass, at;
	ssize_t got = faults == NULL ? -1 : read_small(faults, line, sizeof(line));

	errno = saved;
	if (got <= 0 || sscanf(line, "%31s %d %255s %ld %ld", name, &number, part, &times, &pass) != 5)
		return 0;
	at = strcmp(name, call) != 0 || strstr(path, part) == NULL ? 0 : count_call(faults);
	errno = saved;
	if (at <= pass || at > pass + times)
		return 0;
	errno = number;
	return number;
}

static int fault_of(const char *call, int file)
{
	char link[64], path[4096];
	ssize_t length;
	int saved = errno;

	snprintf(link, sizeof(link), "/proc/self/fd/%d", file);
	length = readlink(link, path, sizeof(path) - 1);
	errno = saved;
	if (length < 0)
		return 0;
	path[length] = 0;
	return fault(call, path);
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

int fsync(int file)
{
	return fault_of("fsync", file) != 0 ? -1 : REAL(fsync)(file);
}

int fdatasync(int file)
{
	return fault_of("fdatasync", file) != 0 ? -1 : REAL(fdatasync)(file);
}

int fallocate(int file, int mode, off_t offset, off_t length)
{
	return fault_of("fallocate", file) != 0 ? -1 : REAL(fallocate)(file, mode, offset, length);
}

/* Its result is the number of the error. */
int posix_fallocate(int file, off_t offset, off_t length)
{
	const int saved = errno, number = fault_of("fallocate", file);

	errno = saved;
	return number != 0 ? number : REAL(posix_fallocate)(file, offset, length);
}

ssize_t pread(int file, void *to, size_t size, off_t offset)
{
	return fault_of("pread", file) != 0 ? -1 : REAL(pread)(file, to, size, offset);
}

int open(const char *path, int flags, ...)
{
	mode_t mode = 0;
	va_list args;

	va_start(args, flags);
	if (flags & (O_CREAT | O_TMPFILE))
		mode = va_arg(args, mode_t);
	va_end(args);
	return fault("open", path) != 0 ? -1 : REAL(open)(path, flags, mode);
}

int prctl(int option, ...)
{
	unsigned long value;
	va_list args;

	va_start(args, option);
	value = va_arg(args, unsigned long);
	va_end(args);
	if (option == PR_SET_PDEATHSIG && fault("prctl", "parent") != 0)
		return -1;
	return REAL(prctl)(option, value, 0UL, 0UL, 0UL);
}
