/* Any bytes through the decoder in pieces of their own choice, and through the encoder and back. */
#include <string.h>

#include "proto/zstream.h"
#include "tests/fuzz/fuzz.h"

enum { OUT_BYTES = 4096, OUT_MOST = 1 << 22 };

/* Decodes until an error, the end of the input or OUT_MOST bytes; gives what was produced, at most `room` of it kept.
 */
static size_t decode(const uint8_t *data, size_t size, size_t piece, uint8_t *ret_bytes, size_t room, bool *ret_ended)
{
	struct zdecoder *decoder;
	struct error err = {0};
	uint8_t out[OUT_BYTES];
	size_t at = 0, made = 0;

	*ret_ended = false;
	PROMISE(zdecoder_new(&decoder, &err) == 0);
	while (made < OUT_MOST) {
		size_t give = size - at < piece ? size - at : piece, consumed = 0, produced = 0;

		if (zdecoder_step(decoder, data + at, give, &consumed, out, sizeof(out), &produced, ret_ended, &err) !=
		    0)
			break;
		PROMISE(consumed <= give && produced <= sizeof(out));
		if (made + produced <= room)
			memcpy(ret_bytes + made, out, produced);
		at += consumed;
		made += produced;
		if (consumed == 0 && produced == 0)
			break;
	}
	zdecoder_free(decoder);
	return made;
}

static size_t encode(const uint8_t *data, size_t size, size_t piece, uint8_t *ret_bytes, size_t room)
{
	struct zencoder *encoder;
	struct error err = {0};
	size_t at = 0, made = 0;
	bool ended = false;

	PROMISE(zencoder_new(1, 0, &encoder, &err) == 0);
	while (!ended) {
		size_t give = size - at < piece ? size - at : piece, consumed = 0, produced = 0;

		PROMISE(made < room);
		PROMISE(zencoder_step(encoder, data + at, give, &consumed, at + give == size, ret_bytes + made,
				      room - made, &produced, &ended, &err) == 0);
		at += consumed;
		made += produced;
	}
	PROMISE(at == size);
	zencoder_free(encoder);
	return made;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	size_t piece = size > 0 ? data[0] + 1u : 1, room = 2 * size + 1024, length;
	uint8_t *packed = malloc(room), *back = malloc(size + 1);
	bool ended;

	PROMISE(packed != NULL && back != NULL);
	decode(data, size, piece, back, size, &ended);
	length = encode(data, size, piece, packed, room);
	PROMISE(decode(packed, length, piece, back, size, &ended) == size && ended);
	PROMISE(memcmp(back, data, size) == 0);
	if (length > 1) /* cut short, it must be seen that the end is missing */
		PROMISE(decode(packed, length - 1, piece, back, size, &ended) <= size && !ended);
	free(packed);
	free(back);
	return 0;
}
