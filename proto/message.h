#ifndef CBCT_PROTO_MESSAGE_H
#define CBCT_PROTO_MESSAGE_H

#include "core/recon.h"
#include "proto/spool.h"

/*
 * What the daemon and a worker say to each other, over a SOCK_SEQPACKET socket
 * pair: one JSON object a packet, so that a trace of it can be read.
 *
 * The worker speaks first (hello), then waits. One job at a time.
 */
enum message_kind {
	/* daemon -> worker */
	MESSAGE_START,  /* job, scan_directory, job_directory, recipe, iteration (0, or resume from the checkpoint) */
	MESSAGE_CANCEL, /* job */
	MESSAGE_YIELD,  /* job: leave it at the next iteration's end */
	MESSAGE_QUIT,   /* finish or yield what runs, then exit 0 */
	/* worker -> daemon */
	MESSAGE_HELLO,    /* backend, device, driver, bytes_total, bytes_free */
	MESSAGE_OPENED,   /* job, memory, plan */
	MESSAGE_PROGRESS, /* job, stage, iteration, fraction */
	MESSAGE_ROW,      /* job, row */
	MESSAGE_VOLUME,   /* job, name, stage, iteration, bytes, sha256, norms: the file is on the disk */
	MESSAGE_WARNING,  /* job, code, detail */
	MESSAGE_ENDED,    /* job, code (0, ERR_CANCELLED, ERR_BUSY = yielded at `iteration`, or what failed), text */
	MESSAGE_KIND_COUNT
};

struct message {
	enum message_kind kind;
	char job[64];
	char scan_directory[1024], job_directory[1024];
	struct job_request request; /* START; recipe owned by the message: message_clear */
	struct device_info info;
	char backend[16], plan[160];
	struct recon_memory memory;
	enum stage stage;
	int iteration;
	double fraction;
	struct history_row row;
	char name[32], volume_stage[16];
	struct grid grid;
	struct volume_norms norms;
	size_t bytes;
	uint8_t sha256[32];
	char code_name[64], text[512]; /* WARNING: code and detail; ENDED: text */
	int code;
};

enum { MESSAGE_BYTES_MAX = 200000 };

/* Blocking; any thread, one packet each. ERR_IO when the other side is gone. */
int message_send(int socket, const struct message *message, struct error *err);
/* Waits at most timeout_ms (-1: for ever; 0: only looks). *ret_got false when nothing came. ERR_IO at the end of the
 * stream. */
int message_receive(int socket, int timeout_ms, struct message *ret_message, bool *ret_got, struct error *err);
void message_clear(struct message *message);

#endif
