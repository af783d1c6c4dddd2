#ifndef CBCT_DAEMON_DICOM_DIMSE_H
#define CBCT_DAEMON_DICOM_DIMSE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif
#include "core/error.h"
#ifdef __cplusplus
}
#endif
#include <cjson/cJSON.h>

/*
 * DICOM's own protocol (PS3.7 DIMSE over PS3.8), by DCMTK, which is used in dimse_*.cc alone. They are built where
 * libdcmtk-dev is; elsewhere these functions are NULL (dimse_built).
 *
 * Errors: ERR_BUSY: the peer cannot be reached, or does not prove who it is (TLS); ERR_IO: it answers otherwise than it
 * should; ERR_NO_MEMORY.
 * Texts never contain a peer's own words, which may name a patient.
 */
struct dimse_peer {
	const char *host;
	int port;
	const char *title; /* of the peer's application entity (called) */
	const char *own;   /* of ours (calling) */
	int seconds;       /* for a connection, and for each answer */
	/* Files of PEM. authority "": no TLS. certificate and key are ours, "": we show none. */
	const char *authority, *certificate, *key;
};

/* An association; one thread at a time. */
struct dimse;

enum dimse_service {
	DIMSE_ECHO,
	DIMSE_FIND,     /* Study Root Query/Retrieve */
	DIMSE_STORE,    /* of one SOP class */
	DIMSE_COMMIT,   /* Storage Commitment Push */
	DIMSE_WORKLIST, /* Modality Worklist */
	DIMSE_STEP      /* Modality Performed Procedure Step */
};

#ifdef __cplusplus
extern "C" {
#endif
#define DIMSE_WEAK __attribute__((weak))
#define dimse_built() (dimse_open != NULL)

/*
 * ERR_NOT_FOUND: the peer answers, and does not know that service; ERR_INVALID: the files for TLS. class_uid: what is
 * to be stored, else NULL.
 */
int dimse_open(const struct dimse_peer *peer, enum dimse_service service, const char *class_uid,
	       struct dimse **ret_dimse, struct error *err) DIMSE_WEAK;
/* NULL is fine. */
void dimse_close(struct dimse *dimse) DIMSE_WEAK;
int dimse_echo(struct dimse *dimse, struct error *err) DIMSE_WEAK;

/* The SOP Instance UIDs of a series, `most` at most. */
int dimse_find(struct dimse *dimse, const char *study, const char *series, int most,
	       void (*found)(void *context, const char *instance), void *context, struct error *err) DIMSE_WEAK;
/* A file of DICOM (PS3.10) in explicit little endian. sent: so many bytes of it have gone out. */
int dimse_store(struct dimse *dimse, const uint8_t *bytes, size_t size, void (*sent)(const void *context, size_t bytes),
		const void *context, struct error *err) DIMSE_WEAK;

/* ---- storage commitment (PS3.4 annex J) ---- */
/* What became of a request. */
struct dimse_promise {
	char transaction[65];
	int kept, refused; /* instances */
	int reason;        /* of the first that was refused (0008,1197) */
};
/*
 * Asks the peer to keep these instances of one class, then listens for `seconds` whether it answers on this
 * association; *ret_answered false: it has not, and may connect to us later.
 */
int dimse_commit(struct dimse *dimse, const char *class_uid, const char *const *instances, int count,
		 const char *transaction, int seconds, bool *ret_answered, struct dimse_promise *ret_promise,
		 struct error *err) DIMSE_WEAK;

/* ---- modality worklist (PS3.4 annex K) ---- */
enum { STEP_FIELDS = 8, STEP_SUBJECT_MOST = 16 };
/* A scheduled procedure step; values as the peer has sent them, in UTF-8 where DCMTK could convert them. */
struct dimse_step {
	const char *field[STEP_FIELDS];         /* proto/worklist.h's */
	const char *subject[STEP_SUBJECT_MOST]; /* in the order of the query's tags */
};
struct dimse_query {
	const char *from, *to;        /* YYYYMMDD */
	const char *modality;         /* "": any */
	const char *station;          /* AE title; "": any */
	const uint16_t (*subject)[2]; /* tags of patient and study */
	int subject_count;            /* at most STEP_SUBJECT_MOST */
	int most;                     /* entries; more are not read, which is no error */
};
int dimse_worklist(struct dimse *dimse, const struct dimse_query *query,
		   void (*found)(void *context, const struct dimse_step *step), void *context,
		   struct error *err) DIMSE_WEAK;

/* ---- modality performed procedure steps (PS3.4 annex F) ---- */
/*
 * N-CREATE and N-SET of the step of this UID. attributes: an object with a member for each, named by its tag in eight
 * hexadecimal digits; a text is its value, a list of such objects its items. A step that is there already, and one
 * that has ended already, are no errors: an earlier attempt was heard. ERR_NOT_FOUND of N-SET: the peer knows no such
 * step.
 */
int dimse_step_create(struct dimse *dimse, const char *uid, const cJSON *attributes, struct error *err) DIMSE_WEAK;
int dimse_step_set(struct dimse *dimse, const char *uid, const cJSON *attributes, struct error *err) DIMSE_WEAK;

/* ---- what peers send us ---- */
struct dimse_serving {
	const char *title;          /* ours */
	const char *const *callers; /* their titles; NULL ends it */
	/*
	 * For objects, NULL: none are taken. Each is DIRECTORY/RUN/NUMBER-INSTANCE.dcm; the run is the object itself
	 * where it has several frames, else its series.
	 */
	const char *directory;
	int seconds; /* for each message */
	void (*promised)(void *context, const struct dimse_promise *promise);
	void (*accepted)(void *context); /* the association begins */
	/* There is none; the title that called, printable ASCII, "" where none came. */
	void (*refused)(void *context, const char *title, const char *why);
	void *context;
};
/*
 * Serves one association of a connection, to its end. What is acknowledged is on the disk. In a process of its own,
 * which RLIMIT_FSIZE may bound.
 */
int dimse_serve(const struct dimse_serving *serving, int connection, struct error *err) DIMSE_WEAK;

#ifdef __cplusplus
}
#endif
#endif
