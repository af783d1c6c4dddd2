/* Programs that the daemon starts: process.h. */
#include "daemon/process.h"

#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdbool.h>
#include <spawn.h>
#include <stdio.h>
#include <string.h>
#include <sys/pidfd.h>
#include <sys/wait.h>
#include <unistd.h>

extern char **environ;

/* True where there is a program of this name beside this one. */
static bool find_beside(const char *name, char *ret_path, size_t size)
{
	char self[1024];
	ssize_t length = readlink("/proc/self/exe", self, sizeof(self) - 1);
	char *slash;

	if (length <= 0)
		return false;
	self[length] = '\0';
	slash = strrchr(self, '/');
	if (slash == NULL)
		return false;
	snprintf(ret_path, size, "%.*s/%s", (int)(slash - self), self, name);
	return access(ret_path, X_OK) == 0;
}

void worker_path(char *ret_path, size_t size)
{
	if (!find_beside("cbct-worker-cuda", ret_path, size))
		program_path("cbct-worker", ret_path, size);
}

void program_path(const char *name, char *ret_path, size_t size)
{
	if (!find_beside(name, ret_path, size))
		snprintf(ret_path, size, "%s", name);
}

/* Sets the descriptors that the child inherits: no input, our output and error, the given one. */
static int set_files(posix_spawn_file_actions_t *files, int descriptor)
{
	int result = posix_spawn_file_actions_addopen(files, STDIN_FILENO, "/dev/null", O_RDONLY, 0);

	if (result == 0 && descriptor >= 0)
		result = posix_spawn_file_actions_adddup2(files, descriptor, PROCESS_DESCRIPTOR);
	if (result == 0)
		result = posix_spawn_file_actions_addclosefrom_np(files, PROCESS_DESCRIPTOR + (descriptor >= 0));
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

int process_start(const char *program, char *const *arguments, int descriptor, struct process *ret_process,
		  struct error *err)
{
	posix_spawn_file_actions_t files;
	posix_spawnattr_t attributes;
	struct process process;
	int result;

	posix_spawn_file_actions_init(&files);
	posix_spawnattr_init(&attributes);
	result = set_files(&files, descriptor);
	if (result == 0)
		result = set_signals(&attributes);
	if (result == 0)
		result = posix_spawnp(&process.pid, program, &files, &attributes, arguments, environ);
	posix_spawnattr_destroy(&attributes);
	posix_spawn_file_actions_destroy(&files);
	if (result != 0)
		return error_set_errno(err, result, "start of %s", basename(program));
	process.pidfd = pidfd_open(process.pid, 0);
	if (process.pidfd < 0) {
		result = errno;
		kill(process.pid, SIGKILL);
		waitpid(process.pid, NULL, 0);
		return error_set_errno(err, result, "pidfd of %s", basename(program));
	}
	*ret_process = process;
	return 0;
}

int process_reap(struct process *process, char *ret_how, size_t size)
{
	int status = 0;

	while (waitpid(process->pid, &status, 0) < 0 && errno == EINTR)
		;
	if (WIFSIGNALED(status))
		snprintf(ret_how, size, "signal %d (%s)", WTERMSIG(status), strsignal(WTERMSIG(status)));
	else
		snprintf(ret_how, size, "exit status %d", WEXITSTATUS(status));
	close(process->pidfd);
	process->pidfd = -1;
	return WIFEXITED(status) ? WEXITSTATUS(status) : -WTERMSIG(status);
}

const char *process_meaning(int end)
{
	switch (-end) {
	case SIGKILL:
		return "something outside ended it, as the kernel does where memory runs out";
	case SIGSEGV:
	case SIGBUS:
	case SIGILL:
	case SIGFPE:
	case SIGABRT:
		return "the program or this machine has a fault";
	default:
		return end < 0 ? "something outside ended it" : "it gave up, and the daemon's log says why";
	}
}

void process_kill(const struct process *process)
{
	/* The child has not been waited for yet, so the number is still its own. */
	kill(process->pid, SIGKILL);
}
