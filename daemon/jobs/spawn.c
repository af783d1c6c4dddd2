/* One worker process at its start and at its end: spawn.h. */
#include "daemon/jobs/spawn.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <stdio.h>
#include <string.h>
#include <sys/pidfd.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include "proto/message.h"

enum { CHILD_SOCKET = 3 };

extern char **environ;

void worker_path(char *ret_path, size_t size)
{
	char self[1024];
	ssize_t length = readlink("/proc/self/exe", self, sizeof(self) - 1);
	char *slash;

	if (length > 0) {
		self[length] = '\0';
		slash = strrchr(self, '/');
		if (slash != NULL) {
			*slash = '\0';
			snprintf(ret_path, size, "%s/cbct-worker", self);
			if (access(ret_path, X_OK) == 0)
				return;
		}
	}
	snprintf(ret_path, size, "cbct-worker");
}

/* Sets the descriptors that the child inherits: no input, our output and error, its socket. */
static int set_files(posix_spawn_file_actions_t *files, int socket)
{
	int result = posix_spawn_file_actions_addopen(files, STDIN_FILENO, "/dev/null", O_RDONLY, 0);

	if (result == 0)
		result = posix_spawn_file_actions_adddup2(files, socket, CHILD_SOCKET);
	if (result == 0)
		result = posix_spawn_file_actions_addclosefrom_np(files, CHILD_SOCKET + 1);
	return result;
}

/* A terminal's Ctrl-C is the daemon's to hear; signals that it blocks or ignores are as usual in the child. */
static int set_signals(posix_spawnattr_t *attributes)
{
	sigset_t none, all;
	int result;

	sigemptyset(&none);
	sigfillset(&all);
	result = posix_spawnattr_setsigmask(attributes, &none);
	if (result == 0)
		result = posix_spawnattr_setsigdefault(attributes, &all);
	if (result == 0)
		result = posix_spawnattr_setpgroup(attributes, 0);
	if (result == 0)
		result = posix_spawnattr_setflags(attributes, POSIX_SPAWN_SETSIGMASK | POSIX_SPAWN_SETSIGDEF |
								  POSIX_SPAWN_SETPGROUP);
	return result;
}

static int start_program(const struct spawn_options *options, int socket, pid_t *ret_pid)
{
	posix_spawn_file_actions_t files;
	posix_spawnattr_t attributes;
	char device[16], threads[16], memory[32], descriptor[16];
	char *arguments[] = {"cbct-worker", "--backend", (char *)options->backend, "--device", device,
			     "--threads",   threads,     "--device-memory",        memory,     "--socket",
			     descriptor,    NULL};
	int result;

	snprintf(device, sizeof(device), "%d", options->device);
	snprintf(threads, sizeof(threads), "%d", options->threads);
	snprintf(memory, sizeof(memory), "%zu", options->device_memory);
	snprintf(descriptor, sizeof(descriptor), "%d", CHILD_SOCKET);
	posix_spawn_file_actions_init(&files);
	posix_spawnattr_init(&attributes);
	result = set_files(&files, socket);
	if (result == 0)
		result = set_signals(&attributes);
	if (result == 0)
		result = posix_spawnp(ret_pid, options->worker, &files, &attributes, arguments, environ);
	posix_spawnattr_destroy(&attributes);
	posix_spawn_file_actions_destroy(&files);
	return result;
}

int child_spawn(const struct spawn_options *options, struct child *ret_child, struct error *err)
{
	int room = 2 * MESSAGE_BYTES_MAX; /* so that the longest message never waits for the reader */
	int pair[2], pidfd, result;
	pid_t pid;

	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, pair) < 0)
		return error_set_errno(err, errno, "socket pair for a worker");
	setsockopt(pair[0], SOL_SOCKET, SO_SNDBUF, &room, sizeof(room));
	setsockopt(pair[1], SOL_SOCKET, SO_SNDBUF, &room, sizeof(room));
	result = start_program(options, pair[1], &pid);
	close(pair[1]);
	if (result != 0) {
		close(pair[0]);
		return error_set_errno(err, result, "start of %s", basename(options->worker));
	}
	pidfd = pidfd_open(pid, 0);
	if (pidfd < 0) {
		result = errno;
		kill(pid, SIGKILL);
		waitpid(pid, NULL, 0);
		close(pair[0]);
		return error_set_errno(err, result, "pidfd of a worker");
	}
	*ret_child = (struct child){.pid = pid, .pidfd = pidfd, .socket = pair[0]};
	return 0;
}

void child_reap(struct child *child, char *ret_how, size_t size)
{
	int status = 0;

	while (waitpid(child->pid, &status, 0) < 0 && errno == EINTR)
		;
	if (WIFSIGNALED(status))
		snprintf(ret_how, size, "signal %d (%s)", WTERMSIG(status), strsignal(WTERMSIG(status)));
	else
		snprintf(ret_how, size, "exit status %d", WEXITSTATUS(status));
	close(child->pidfd);
	close(child->socket);
	*child = (struct child){.pidfd = -1, .socket = -1};
}

void child_kill(const struct child *child)
{
	/* The child has not been waited for yet, so the number is still its own. */
	kill(child->pid, SIGKILL);
}
