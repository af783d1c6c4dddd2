#ifndef CBCT_PROTO_MESSAGE_H
#define CBCT_PROTO_MESSAGE_H

#include "core/recon/recon.h"
#include "proto/scan_directory.h"

/*
 * The messages between the daemon and a worker, over a SOCK_SEQPACKET socket
 * pair: one JSON object a packet, so that a trace of it can be read.
 *
 * The worker speaks first (hello), then waits. One job at a time.
 */
enum message_kind {
	/* daemon -> worker */
	/*
	 * job, scan_directory, job_directory, recipe, iteration (0, or resume from the checkpoint), checkpoint_seconds,
	 * cards, reduced and present, reference and grid: a volume that the recipe's refinement goes by, arriving: the
	 * projections come by MESSAGE_VIEWS; otherwise all that are present are there
	 */
	MESSAGE_START,
	/*
	 * job, count: the first so many projections of those that are present are there. Not before those of the
	 * message before were reconstructed.
	 */
	MESSAGE_VIEWS,
	MESSAGE_CANCEL, /* job */
	/* job: leave it at the next iteration's end; one that still waits for projections is left at once */
	MESSAGE_YIELD,
	MESSAGE_QUIT, /* finish or yield what runs, then exit 0 */
	/* worker -> daemon */
	MESSAGE_HELLO,   /* backend, device, driver, bytes_total, bytes_free */
	MESSAGE_REFUSED, /* in its place, of a place on another host: text, why nothing can be done there */
	/*
	 * steps: that it has finished since its start, whatever they were of; step_seconds: that the one under way may
	 * take by its nature, 0: as any other. Every second (proto/heartbeat.h), also without a job.
	 */
	MESSAGE_ALIVE,
	MESSAGE_OPENED, /* job, memory, plan */
	/*
	 * job, count: projections reconstructed so far; of a place on another host sent there, and how many bytes went
	 * in the last step, in row.seconds
	 */
	MESSAGE_RECONSTRUCTED,
	MESSAGE_PROGRESS,   /* job, stage, iteration, fraction */
	MESSAGE_ROW,        /* job, row */
	MESSAGE_VOLUME,     /* job, name, stage, iteration, bytes, norms, estimate_mm, support, written: the file is
			       there, whole, for everybody */
	MESSAGE_SETTLED,    /* job, name: that file is on the disk; before the job ends, but for what failed */
	MESSAGE_CHECKPOINT, /* job, iteration: a checkpoint of it is on the disk */
	MESSAGE_NOISE,      /* job, noise_hu, alpha: what TV goes by, see recon_hooks.denoising */
	MESSAGE_AGREEMENT,  /* job, agreement: how well the projections agree with the geometry */
	MESSAGE_STOPPED,    /* job, stop: how automatic iterations ended */
	MESSAGE_WARNING,    /* job, code, detail */
	/*
	 * job, code (0, ERR_CANCELLED, ERR_BUSY = yielded at `iteration`, or what failed), text; with ERR_DEVICE card,
	 * the place in `cards` of the device that failed
	 */
	MESSAGE_ENDED,
	MESSAGE_KIND_COUNT
};

struct message {
	enum message_kind kind;
	char job[64];
	char scan_directory[1024], job_directory[1024];
	char reference[1024];       /* path; "": none */
	struct job_request request; /* START; recipe owned by the message: message_clear */
	char cards[64];             /* numbers of the devices that work together, "0,2"; "": the worker's own alone */
	bool arriving, reduced;
	double checkpoint_seconds;
	uint8_t present[(VIEWS_MAX + 7) / 8]; /* START with `reduced`: bit k % 8 of byte k / 8 for projection k */
	int count;
	struct device_info info;
	char backend[16], plan[320];
	struct recon_memory memory;
	enum stage stage;
	int iteration;
	double fraction;
	size_t steps;
	double step_seconds;
	struct history_row row;
	double noise_hu, alpha;
	struct recon_agreement agreement;
	struct recon_stop stop;
	char name[32], volume_stage[16];
	struct grid grid;
	struct volume_norms norms;
	double estimate_mm;
	struct volume_support support;
	size_t bytes;
	size_t written_s, written_ns;  /* the time of change of a volume's file (saver_written) */
	char code_name[64], text[640]; /* WARNING: code and detail; ENDED: text */
	int code, card;
};

enum { MESSAGE_BYTES_MAX = 200000 };

/* Blocking; any thread, one packet each. ERR_IO when the other side is gone. */
int message_send(int socket, const struct message *message, struct error *err);
/* Waits at most timeout_ms (-1: for ever; 0: only looks). *ret_got false when nothing came. ERR_IO at the end of the
 * stream. */
int message_receive(int socket, int timeout_ms, struct message *ret_message, bool *ret_got, struct error *err);
void message_clear(struct message *message);

#endif
