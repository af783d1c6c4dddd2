#ifndef CBCT_CORE_ERROR_H
#define CBCT_CORE_ERROR_H

/*
 * An error (code, guilty field, one sentence) in one value that the caller owns and passes down.
 *
 * A function that can fail returns 0, or a negative enum error_code, and takes
 * a `struct error *` last. It fills the error exactly once, where the cause is
 * known; everybody above only returns the code. `err` is never NULL. Outputs
 * named ret_x stay untouched on failure.
 */

enum error_code {
	ERR_INVALID = -1,    /* malformed: breaks the rules of the format (HTTP 400) */
	ERR_IMPOSSIBLE = -2, /* well-formed, but cannot be done (422) */
	ERR_NOT_FOUND = -3,  /* no such thing (404) */
	ERR_CONFLICT = -4,   /* contradicts what is there (409) */
	ERR_TOO_LARGE = -5,  /* longer than allowed (413) */
	ERR_NO_MEMORY = -6,  /* host or device memory (422 when known beforehand) */
	ERR_NO_SPACE = -7,   /* the disk is full (507) */
	ERR_IO = -8,         /* a file or socket failed (500) */
	ERR_DEVICE = -9,     /* the accelerator failed; the process must end (500) */
	ERR_CANCELLED = -10, /* somebody asked for it */
	ERR_BUSY = -11,      /* later, perhaps (503) */
	ERR_INTERNAL = -12,  /* a promise of our own was broken (500) */
	/*
	 * A sync failed: the kernel may have dropped what it held, and a second sync would succeed without it. Final:
	 * nothing that depends on these bytes may be believed or acknowledged any more (500).
	 */
	ERR_SYNC = -13,
	ERR_DAMAGED = -14, /* what the disk holds is not what was written (500) */
	ERR_LIMIT = -15,   /* who asks has as much as one may have (429) */
	ERR_QUOTA = -16,   /* the same of bytes (507) */
	ERR_AWAY = -17     /* a database cannot be reached: nothing was changed, and that passes (503) */
};

struct error {
	int code;          /* enum error_code, 0 while nothing went wrong */
	char pointer[192]; /* RFC 6901 pointer to the guilty field, "" when there is none */
	char text[320];    /* one sentence with the number found and the one expected */
};

/* Fills err and returns code. */
int error_set(struct error *err, int code, const char *format, ...) __attribute__((format(printf, 3, 4)));

/* error_set with the field that is to blame, e.g. "/grid/size/0". */
int error_set_at(struct error *err, int code, const char *pointer, const char *format, ...)
    __attribute__((format(printf, 4, 5)));

/* Puts a prefix before the pointer: a parser of a part does not know where the part stands. */
void error_nest(struct error *err, const char *prefix);

/* ERR_NO_SPACE for ENOSPC and EDQUOT, ERR_NO_MEMORY for ENOMEM, else ERR_IO; text "what: strerror". */
int error_set_errno(struct error *err, int errno_value, const char *format, ...) __attribute__((format(printf, 3, 4)));

/*
 * The same of a sync that failed: ERR_SYNC, but ERR_NO_SPACE where the disk was full: then the caller writes all of
 * it anew and never syncs the same bytes again.
 */
int error_set_sync(struct error *err, int errno_value, const char *format, ...) __attribute__((format(printf, 3, 4)));

#endif
