/* Any packet from a worker gone mad: refused, or a message that is sent on and comes back. */
#include <string.h>
#include <sys/socket.h>

#include "proto/message.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static int ends[2] = {-1, -1};
	struct message message, back;
	struct error err = {0};
	bool got = false;

	if (ends[0] < 0)
		PROMISE(socketpair(AF_UNIX, SOCK_SEQPACKET, 0, ends) == 0);
	if (size == 0 || size > MESSAGE_BYTES_MAX / 2)
		return 0; /* an empty packet is the end of the stream */
	PROMISE(send(ends[0], data, size, 0) == (ssize_t)size);
	if (message_receive(ends[1], 0, &message, &got, &err) != 0) {
		PROMISE(err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	PROMISE(got && message.kind < MESSAGE_KIND_COUNT);
	PROMISE(message_send(ends[0], &message, &err) == 0);
	PROMISE(message_receive(ends[1], 0, &back, &got, &err) == 0 && got && back.kind == message.kind);
	PROMISE(strcmp(back.job, message.job) == 0 && job_request_same(&back.request, &message.request));
	message_clear(&message);
	message_clear(&back);
	return 0;
}
