/* One worker process at its start and at its end: spawn.h. */
#include "daemon/jobs/spawn.h"

#include <errno.h>
#include <stdio.h>
#include <sys/socket.h>
#include <unistd.h>

#include "proto/message.h"

static int spawn(const char *program, char *const *arguments, struct child *ret_child, struct error *err)
{
	const int room = 2 * MESSAGE_BYTES_MAX; /* so that the longest message never waits for the reader */
	struct child child;
	int pair[2], code;

	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, pair) < 0)
		return error_set_errno(err, errno, "socket pair for a worker");
	setsockopt(pair[0], SOL_SOCKET, SO_SNDBUF, &room, sizeof(room));
	setsockopt(pair[1], SOL_SOCKET, SO_SNDBUF, &room, sizeof(room));
	code = process_start(program, arguments, pair[1], &child.process, err);
	close(pair[1]);
	if (code != 0) {
		close(pair[0]);
		return code;
	}
	child.socket = pair[0];
	*ret_child = child;
	return 0;
}

int child_spawn(const struct spawn_options *options, struct child *ret_child, struct error *err)
{
	char device[16], threads[16], memory[32], descriptor[16];
	char *arguments[] = {"cbct-worker",
			     "--backend",
			     (char *)options->backend,
			     "--device",
			     device,
			     "--threads",
			     threads,
			     "--device-memory",
			     memory,
			     "--socket",
			     descriptor,
			     options->test ? "--self-test" : NULL,
			     NULL};

	snprintf(device, sizeof(device), "%d", options->device);
	snprintf(threads, sizeof(threads), "%d", options->threads);
	snprintf(memory, sizeof(memory), "%zu", options->device_memory);
	snprintf(descriptor, sizeof(descriptor), "%d", PROCESS_DESCRIPTOR);
	return spawn(options->worker, arguments, ret_child, err);
}

int child_spawn_remote(const struct spawn_remote *options, struct child *ret_child, struct error *err)
{
	char lease[32], descriptor[16], *arguments[20];
	const char *const pairs[][2] = {{"--socket", descriptor},          {"--lease", lease},
					{"--host", options->host},         {"--claim", options->claim},
					{"--url", options->url},           {"--token-file", options->token_file},
					{"--cacert", options->authorities}};
	int count = 0;

	snprintf(lease, sizeof(lease), "%.3f", options->lease);
	snprintf(descriptor, sizeof(descriptor), "%d", PROCESS_DESCRIPTOR);
	arguments[count++] = "cbct";
	arguments[count++] = "remote";
	for (size_t i = 0; i < sizeof(pairs) / sizeof(pairs[0]); i++) {
		if (pairs[i][1][0] == '\0')
			continue;
		arguments[count++] = (char *)pairs[i][0];
		arguments[count++] = (char *)pairs[i][1];
	}
	arguments[count] = NULL;
	return spawn(options->program, arguments, ret_child, err);
}

void child_reap(struct child *child, char *ret_how, size_t size)
{
	process_reap(&child->process, ret_how, size);
	close(child->socket);
	child->socket = -1;
}
