/* Other programs: started without a shell, so that no name of a file can be a command. */
#include "clients/cbct/tool.h"

#include <errno.h>
#include <fcntl.h>
#include <spawn.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <unistd.h>

extern char **environ;

enum { OUTPUT_MAX = 256 << 20 };

/* All that comes through a pipe. */
static int read_all(int from, char **ret_text, size_t *ret_length, struct error *err)
{
	size_t length = 0, room = 1 << 16;
	char *text = malloc(room);

	while (text != NULL) {
		ssize_t got = read(from, text + length, room - 1 - length);

		if (got < 0 && errno == EINTR)
			continue;
		if (got <= 0)
			break;
		length += (size_t)got;
		if (length + 1 == room) {
			char *grown = room < OUTPUT_MAX ? realloc(text, 2 * room) : NULL;

			if (grown == NULL) {
				free(text);
				return error_set(err, ERR_TOO_LARGE, "more than %zu bytes came", length);
			}
			text = grown;
			room *= 2;
		}
	}
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for what a program says");
	text[length] = '\0';
	*ret_text = text;
	*ret_length = length;
	return 0;
}

static int spawn(const char *const *arguments, const char *package, int output, pid_t *ret_child, struct error *err)
{
	posix_spawn_file_actions_t actions;
	int status;

	posix_spawn_file_actions_init(&actions);
	posix_spawn_file_actions_addopen(&actions, 0, "/dev/null", O_RDONLY, 0);
	if (output >= 0)
		posix_spawn_file_actions_adddup2(&actions, output, 1);
	else
		posix_spawn_file_actions_addopen(&actions, 1, "/dev/null", O_WRONLY, 0);
	status = posix_spawnp(ret_child, arguments[0], &actions, NULL, (char *const *)arguments, environ);
	posix_spawn_file_actions_destroy(&actions);
	if (status == ENOENT)
		return error_set(err, ERR_NOT_FOUND, "%s is not here: it comes with the package %s", arguments[0],
				 package);
	return status == 0 ? 0 : error_set_errno(err, status, "%s cannot be started", arguments[0]);
}

int tool_run(const char *const *arguments, const char *package, char **ret_text, size_t *ret_length, struct error *err)
{
	int ends[2] = {-1, -1}, status = 0, code;
	char *text = NULL;
	size_t length = 0;
	pid_t child;

	if (ret_text != NULL && pipe2(ends, O_CLOEXEC) != 0)
		return error_set_errno(err, errno, "no pipe");
	code = spawn(arguments, package, ends[1], &child, err);
	if (ends[1] >= 0)
		close(ends[1]);
	if (code != 0) {
		if (ends[0] >= 0)
			close(ends[0]);
		return code;
	}
	if (ret_text != NULL) {
		code = read_all(ends[0], &text, &length, err);
		close(ends[0]); /* a child that still writes ends by it */
	}
	while (waitpid(child, &status, 0) < 0 && errno == EINTR)
		;
	if (code == 0 && (!WIFEXITED(status) || WEXITSTATUS(status) != 0))
		code = error_set(err, ERR_INVALID, "%s failed with status %d", arguments[0],
				 WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status));
	if (code != 0) {
		free(text);
		return code;
	}
	if (ret_text != NULL) {
		*ret_text = text;
		*ret_length = length;
	}
	return 0;
}
