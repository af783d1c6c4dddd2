#ifndef CBCT_DAEMON_HTTP_FRAMING_H
#define CBCT_DAEMON_HTTP_FRAMING_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/*
 * HTTP/1 requests by the letter of RFC 9112: where each head and each body on
 * a connection begins and ends, and whether two readers could disagree about
 * it. A pure function of the connection's bytes; one thread.
 *
 * A request that is accepted has one reading only: line ends are CRLF, names of fields end
 * at their colon, there is one Host, and one statement about the body's length.
 */
enum {
	HEAD_BYTES_MAX = 24 << 10,
	TARGET_BYTES_MAX = 8 << 10,
	HEAD_FIELDS_MAX = 100,
	HEAD_PARAMETERS_MAX = 64, /* of the query; the library makes a record of each before anybody is asked */
	HEAD_COOKIES_MAX = 200,   /* likewise, of which nothing here takes more than one */
	CHUNK_LINE_MAX = 1 << 10,
	TRAILER_BYTES_MAX = 4 << 10
};

enum framing_state {
	FRAMING_HEAD, /* a request's, or the empty line that may come before it */
	FRAMING_LENGTH,
	FRAMING_CHUNK_LINE,
	FRAMING_CHUNK,
	FRAMING_CHUNK_END,
	FRAMING_TRAILER,
	FRAMING_REFUSED
};

struct framing {
	enum framing_state state;
	uint64_t left;    /* bytes of the body, or of the chunk, that are still to come */
	size_t scanned;   /* bytes of an incomplete head or trailer that were looked at */
	bool line_read;   /* of this head, the first line */
	bool empty_line;  /* came before this head */
	bool is_head;     /* this head's method is HEAD */
	uint64_t heads;   /* that were let through */
	int status;       /* of the refusal; 0: there is none */
	char detail[160]; /* of the refusal, one sentence */
	/* Bytes that end the request for a reader of all that was let through. Before a head: "". */
	const char *ending;
};

/*
 * Looks at the bytes that follow those let through before, and returns how many
 * of these may go on. What is held back (an incomplete head, chunk line or
 * trailer) comes again in the next call, in front of what follows; it is never
 * longer than HEAD_BYTES_MAX. Blanks behind a field's value are moved before it,
 * which means the same and spares readers that forget them; Expect loses its name
 * where there is no body to wait for. After a refusal
 * (framing->status) nothing more goes on. Begins with a struct of zeros.
 */
size_t framing_pass(struct framing *framing, char *data, size_t size);

#endif
