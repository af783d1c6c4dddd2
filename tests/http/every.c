/*
 * One call that fails, for tests: loaded with LD_PRELOAD into the daemon and its workers. CBCT_EVERY is
 *
 *   PROGRAM CALL N KIND FILE
 *
 * and the N-th CALL (write, pwrite, fsync, fdatasync, rename, link, mmap, fallocate, open, read, pread, accept,
 * malloc, send, recv; each stands for all calls of its kind, open for openat, malloc for calloc and realloc) of a
 * process of PROGRAM ("cbctd", "cbct-worker"; the held ones too) fails, once: KIND is an error number, or "short" for
 * half of the bytes. FILE.fired is made then, with the path of the program or library that called, and while it is
 * there no other process fails; the lines after it are the stack, for addr2line. FILE.count grows by a byte for each
 * call of the program that N would count, where N is 0. FILE.left gets a line of each process that ends with status 0:
 * blocks of memory and descriptors that are left. The C library's own calls (stdio) are not seen.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <execinfo.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

extern void *__libc_malloc(size_t size);
extern void *__libc_calloc(size_t count, size_t size);
extern void *__libc_realloc(void *memory, size_t size);
extern void *__libc_memalign(size_t alignment, size_t size);
extern void __libc_free(void *memory);

static char wanted[32], fired[600], left_path[600];
static long number;
static int error_number; /* 0: short */
static int counter = -1; /* descriptor of FILE.count */
static void *stack[40];
static atomic_long calls;
static atomic_long live; /* blocks that are allocated and not freed */

/* What is left at the end of a process that ends as it should: blocks of memory, and descriptors. */
static void tell(int status, void *nothing)
{
	char line[64];
	struct stat file;
	int i, files = 0, length, left;

	(void)nothing;
	if (status != 0)
		return;
	for (i = 0; i < 1024; i++)
		files += fstat(i, &file) == 0;
	length = snprintf(line, sizeof(line), "%ld %d\n", atomic_load(&live), files);
	left = (int)syscall(SYS_openat, AT_FDCWD, left_path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
	if (left >= 0)
		syscall(SYS_write, left, line, (size_t)length);
}

__attribute__((constructor)) static void arm(void)
{
	const char *text = getenv("CBCT_EVERY");
	char program[32], kind[16], file[500], count[600];

	if (text == NULL || sscanf(text, "%31s %31s %ld %15s %499s", program, wanted, &number, kind, file) != 5 ||
	    strncmp(program_invocation_short_name, program, strlen(program)) != 0) {
		wanted[0] = '\0';
		return;
	}
	error_number = atoi(kind);
	snprintf(fired, sizeof(fired), "%s.fired", file);
	snprintf(count, sizeof(count), "%s.count", file);
	snprintf(left_path, sizeof(left_path), "%s.left", file);
	counter = (int)syscall(SYS_openat, AT_FDCWD, count, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
	on_exit(tell, NULL);
	backtrace(stack, 1); /* The first one loads what unwinds a stack. */
}

/* Counts a call; true when this is the one. Nothing here goes through what is wrapped. */
static bool is_it_of(const char *call, void *caller)
{
	int saved = errno;
	Dl_info where;
	long file;

	if (wanted[0] == '\0' || strcmp(call, wanted) != 0)
		return false;
	if (number == 0)
		syscall(SYS_write, counter, "x", 1);
	if (atomic_fetch_add(&calls, 1) + 1 != number) {
		errno = saved;
		return false;
	}
	file = syscall(SYS_openat, AT_FDCWD, fired, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
	if (file >= 0) {
		if (dladdr(caller, &where) != 0 && where.dli_fname != NULL)
			syscall(SYS_write, (int)file, where.dli_fname, strlen(where.dli_fname));
		syscall(SYS_write, (int)file, "\n", 1);
		backtrace_symbols_fd(stack, backtrace(stack, 40), (int)file);
		syscall(SYS_close, (int)file);
	}
	errno = saved;
	return file >= 0;
}

#define is_it(call) is_it_of(call, __builtin_return_address(0))

/*
 * A file or a socket. Writes to an eventfd or to a pipe that the same process reads, which wake a thread, do not fail
 * like that in any system.
 */
static bool is_storage(int file)
{
	struct stat status;

	return fstat(file, &status) == 0 && (S_ISREG(status.st_mode) || S_ISSOCK(status.st_mode));
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* With `short`, the real call gets half of the bytes. */
#define FAIL(call)                                                                                                     \
	do {                                                                                                           \
		if (is_it(call)) {                                                                                     \
			errno = error_number;                                                                          \
			return -1;                                                                                     \
		}                                                                                                      \
	} while (0)
#define FAIL_OR_HALVE(call, size)                                                                                      \
	do {                                                                                                           \
		if (is_it(call)) {                                                                                     \
			if (error_number != 0) {                                                                       \
				errno = error_number;                                                                  \
				return -1;                                                                             \
			}                                                                                              \
			size = size > 1 ? size / 2 : size;                                                             \
		}                                                                                                      \
	} while (0)

ssize_t write(int file, const void *from, size_t size)
{
	if (is_storage(file))
		FAIL_OR_HALVE("write", size);
	return REAL(write)(file, from, size);
}

ssize_t pwrite(int file, const void *from, size_t size, off_t offset)
{
	FAIL_OR_HALVE("pwrite", size);
	return REAL(pwrite)(file, from, size, offset);
}

ssize_t pwrite64(int file, const void *from, size_t size, off64_t offset)
{
	FAIL_OR_HALVE("pwrite", size);
	return REAL(pwrite64)(file, from, size, offset);
}

ssize_t read(int file, void *to, size_t size)
{
	if (is_storage(file))
		FAIL_OR_HALVE("read", size);
	return REAL(read)(file, to, size);
}

ssize_t pread(int file, void *to, size_t size, off_t offset)
{
	FAIL_OR_HALVE("pread", size);
	return REAL(pread)(file, to, size, offset);
}

ssize_t pread64(int file, void *to, size_t size, off64_t offset)
{
	FAIL_OR_HALVE("pread", size);
	return REAL(pread64)(file, to, size, offset);
}

int fsync(int file)
{
	FAIL("fsync");
	return REAL(fsync)(file);
}

int fdatasync(int file)
{
	FAIL("fdatasync");
	return REAL(fdatasync)(file);
}

int rename(const char *from, const char *to)
{
	FAIL("rename");
	return REAL(rename)(from, to);
}

int link(const char *from, const char *to)
{
	FAIL("link");
	return REAL(link)(from, to);
}

int fallocate(int file, int mode, off_t offset, off_t length)
{
	FAIL("fallocate");
	return REAL(fallocate)(file, mode, offset, length);
}

int linkat(int from_folder, const char *from, int to_folder, const char *to, int flags)
{
	FAIL("link");
	return REAL(linkat)(from_folder, from, to_folder, to, flags);
}

/* Its result is the number of the error, which it does not retry. */
int posix_fallocate(int file, off_t offset, off_t length)
{
	return is_it("fallocate") ? error_number : REAL(posix_fallocate)(file, offset, length);
}

ssize_t send(int socket, const void *from, size_t size, int flags)
{
	FAIL_OR_HALVE("send", size);
	return REAL(send)(socket, from, size, flags);
}

ssize_t sendmsg(int socket, const struct msghdr *message, int flags)
{
	if (error_number != 0)
		FAIL("send");
	return REAL(sendmsg)(socket, message, flags);
}

ssize_t recv(int socket, void *to, size_t size, int flags)
{
	FAIL_OR_HALVE("recv", size);
	return REAL(recv)(socket, to, size, flags);
}

ssize_t sendto(int socket, const void *from, size_t size, int flags, const struct sockaddr *to, socklen_t length)
{
	FAIL_OR_HALVE("send", size);
	return REAL(sendto)(socket, from, size, flags, to, length);
}

ssize_t sendfile64(int to, int from, off64_t *offset, size_t size)
{
	FAIL_OR_HALVE("send", size);
	return REAL(sendfile64)(to, from, offset, size);
}

ssize_t recvfrom(int socket, void *to, size_t size, int flags, struct sockaddr *from, socklen_t *length)
{
	FAIL_OR_HALVE("recv", size);
	return REAL(recvfrom)(socket, to, size, flags, from, length);
}

ssize_t recvmsg(int socket, struct msghdr *message, int flags)
{
	if (error_number != 0)
		FAIL("recv");
	return REAL(recvmsg)(socket, message, flags);
}

int accept(int socket, struct sockaddr *address, socklen_t *length)
{
	FAIL("accept");
	return REAL(accept)(socket, address, length);
}

int accept4(int socket, struct sockaddr *address, socklen_t *length, int flags)
{
	FAIL("accept");
	return REAL(accept4)(socket, address, length, flags);
}

void *mmap(void *at, size_t size, int protection, int flags, int file, off_t offset)
{
	if (is_it("mmap")) {
		errno = error_number;
		return MAP_FAILED;
	}
	return REAL(mmap)(at, size, protection, flags, file, offset);
}

void *mmap64(void *at, size_t size, int protection, int flags, int file, off64_t offset)
{
	return mmap(at, size, protection, flags, file, offset);
}

static mode_t mode_of(int flags, va_list arguments)
{
	return (flags & (O_CREAT | O_TMPFILE)) != 0 ? va_arg(arguments, mode_t) : 0;
}

int open(const char *path, int flags, ...)
{
	va_list arguments;
	mode_t mode;

	va_start(arguments, flags);
	mode = mode_of(flags, arguments);
	va_end(arguments);
	FAIL("open");
	return REAL(open)(path, flags, mode);
}

int open64(const char *path, int flags, ...)
{
	va_list arguments;
	mode_t mode;

	va_start(arguments, flags);
	mode = mode_of(flags, arguments);
	va_end(arguments);
	FAIL("open");
	return REAL(open64)(path, flags, mode);
}

int openat(int folder, const char *path, int flags, ...)
{
	va_list arguments;
	mode_t mode;

	va_start(arguments, flags);
	mode = mode_of(flags, arguments);
	va_end(arguments);
	FAIL("open");
	return REAL(openat)(folder, path, flags, mode);
}

/* ---- memory ---- */

static void *counted(void *memory)
{
	if (memory != NULL)
		atomic_fetch_add_explicit(&live, 1, memory_order_relaxed);
	return memory;
}

static bool no_memory(void *caller)
{
	if (!is_it_of("malloc", caller))
		return false;
	errno = ENOMEM;
	return true;
}

void *malloc(size_t size)
{
	return no_memory(__builtin_return_address(0)) ? NULL : counted(__libc_malloc(size));
}

void *calloc(size_t count, size_t size)
{
	return no_memory(__builtin_return_address(0)) ? NULL : counted(__libc_calloc(count, size));
}

void free(void *memory)
{
	if (memory != NULL)
		atomic_fetch_sub_explicit(&live, 1, memory_order_relaxed);
	__libc_free(memory);
}

void *realloc(void *memory, size_t size)
{
	void *moved;

	if (no_memory(__builtin_return_address(0)))
		return NULL;
	moved = __libc_realloc(memory, size);
	if (memory == NULL)
		counted(moved);
	else if (moved == NULL && size == 0) /* That freed it. */
		atomic_fetch_sub_explicit(&live, 1, memory_order_relaxed);
	return moved;
}

void *aligned_alloc(size_t alignment, size_t size)
{
	return no_memory(__builtin_return_address(0)) ? NULL : counted(__libc_memalign(alignment, size));
}

void *memalign(size_t alignment, size_t size)
{
	return aligned_alloc(alignment, size);
}

int posix_memalign(void **ret_memory, size_t alignment, size_t size)
{
	void *memory = aligned_alloc(alignment, size);

	if (memory == NULL)
		return ENOMEM;
	*ret_memory = memory;
	return 0;
}
