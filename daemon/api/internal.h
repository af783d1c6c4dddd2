#ifndef CBCT_DAEMON_API_INTERNAL_H
#define CBCT_DAEMON_API_INTERNAL_H

#include "daemon/api/api.h"
#include "daemon/api/document.h"
#include "daemon/calibrations/calibrations.h"
#include "daemon/intake/intake.h"
#include "daemon/jobs/jobs.h"
#include "daemon/sendings/sendings.h"
#include "daemon/store/store.h"
#include "daemon/volumes/volumes.h"

/* Shared by the files of this room. */

struct picture;

/* ---- the handlers, as struct route wants them ---- */
int session_post(void *context, struct request *request, struct error *err);
int session_get(void *context, struct request *request, struct error *err);
int session_delete(void *context, struct request *request, struct error *err);

int scan_post(void *context, struct request *request, struct error *err);
int scan_list(void *context, struct request *request, struct error *err);
int scan_get(void *context, struct request *request, struct error *err);
int scan_complete(void *context, struct request *request, struct error *err);
int scan_delete(void *context, struct request *request, struct error *err);

int projection_get(void *context, struct request *request, struct error *err);
int projections_begin(void *context, struct request *request, struct error *err);
int image_begin(void *context, struct request *request, struct error *err);
int scatter_begin(void *context, struct request *request, struct error *err);
int scatter_get(void *context, struct request *request, struct error *err);
int scatter_delete(void *context, struct request *request, struct error *err);
int scatter_delete_all(void *context, struct request *request, struct error *err);
int image_delete(void *context, struct request *request, struct error *err);
int upload_take(void *context, struct request *request, const void *data, size_t size, size_t *ret_taken,
		struct error *err);
int projections_put(void *context, struct request *request, struct error *err);
int image_put(void *context, struct request *request, struct error *err);

int calibration_post(void *context, struct request *request, struct error *err);
/* Of a body that names a job: what it has refined is kept. */
int refinement_keep(struct api *api, const char *client, const cJSON *body, char ret_id[ID_SIZE], struct error *err);
/* What only the other job tells of a job's reference: ERR_NOT_FOUND, ERR_CONFLICT, ERR_IMPOSSIBLE. */
int reference_check(struct api *api, const struct job_request *wanted, struct error *err);
int refinement_get(void *context, struct request *request, struct error *err);
int calibration_list(void *context, struct request *request, struct error *err);
int calibration_get(void *context, struct request *request, struct error *err);
int calibration_delete(void *context, struct request *request, struct error *err);
int calibration_view_get(void *context, struct request *request, struct error *err);

int job_post(void *context, struct request *request, struct error *err);
int job_list(void *context, struct request *request, struct error *err);
int job_get(void *context, struct request *request, struct error *err);
int job_delete(void *context, struct request *request, struct error *err);

int destination_list(void *context, struct request *request, struct error *err);
int worklist_get(void *context, struct request *request, struct error *err);
int send_post(void *context, struct request *request, struct error *err);
int send_get(void *context, struct request *request, struct error *err);
int send_delete(void *context, struct request *request, struct error *err);
/* What a job that says nothing sends; ERR_IMPOSSIBLE, ERR_CONFLICT: what it says cannot be done. */
int send_resolve(struct api *api, const struct scan *scan, struct job_request *wanted, struct error *err);

int job_events(void *context, struct request *request, struct error *err);
int all_events(void *context, struct request *request, struct error *err);

int volume_list(void *context, struct request *request, struct error *err);
int volume_get(void *context, struct request *request, struct error *err);
int provenance_get(void *context, struct request *request, struct error *err);

int volume_stream(void *context, struct request *request, struct error *err);
int annotations_get(void *context, struct request *request, struct error *err);
int annotations_put(void *context, struct request *request, struct error *err);
int checkpoint_get(void *context, struct request *request, struct error *err);
int checkpoint_begin(void *context, struct request *request, struct error *err);
int checkpoint_data(void *context, struct request *request, const void *data, size_t size, size_t *ret_taken,
		    struct error *err);
int checkpoint_put(void *context, struct request *request, struct error *err);
int slice_get(void *context, struct request *request, struct error *err);

int page_get(void *context, struct request *request, struct error *err);
int asset_get(void *context, struct request *request, struct error *err);
int plain_list(void *context, struct request *request, struct error *err);
int plain_job(void *context, struct request *request, struct error *err);
int plain_style(void *context, struct request *request, struct error *err);

int live_get(void *context, struct request *request, struct error *err);
int ready_get(void *context, struct request *request, struct error *err);
int metrics_get(void *context, struct request *request, struct error *err);
int device_list(void *context, struct request *request, struct error *err);
int device_clear_post(void *context, struct request *request, struct error *err);
int limits_get(void *context, struct request *request, struct error *err);
int job_pin_put(void *context, struct request *request, struct error *err);
int job_pin_delete(void *context, struct request *request, struct error *err);
int scan_pin_put(void *context, struct request *request, struct error *err);
int scan_pin_delete(void *context, struct request *request, struct error *err);
int quarantine_get(void *context, struct request *request, struct error *err);
int schema_get(void *context, struct request *request, struct error *err);

/* ---- parts of several handlers: api/common.c ---- */
enum { PAGE_DEFAULT = 100, PAGE_MAX = 1000 };
struct page {
	int limit;
	const char *after; /* an id or NULL */
};
/* ?limit= and ?after=. */
int page_read(struct request *request, struct page *ret_page, struct error *err);
int page_read_ids(struct request *request, struct page *ret_page, struct error *err); /* `after` is an id */

/* The value of a query parameter among `names` (which ends with NULL); its index, 0 when it is absent. */
int query_choice(struct request *request, const char *name, const char *const *names, int *ret_index,
		 struct error *err);

/*
 * The request's Idempotency-Key, and the SHA-256 of its body; text is NULL where it has none. A client with a name, of
 * a token or certificate, has keys of its own: the key is then made of both, in ret_text.
 */
enum { IDEMPOTENCY_KEY_MAX = 255, IDEMPOTENCY_SIZE = TOKEN_NAME_SIZE + 1 + IDEMPOTENCY_KEY_MAX + 1 };
int idempotency_read(struct request *request, char ret_text[IDEMPOTENCY_SIZE], struct store_key *ret_key,
		     struct error *err);

/* Bytes that do not change while they bear this tag. */
struct entity {
	const char *etag; /* quoted, strong */
	uint64_t size;    /* UNKNOWN_SIZE: no ranges of this reply */
	const char *media_type;
	const char *filename; /* NULL: none, it is shown where it is asked for */
	const char *caching;  /* Cache-Control; NULL: clients keep it, and ask each time whether it has changed */
	const char *ranges;   /* Accept-Ranges of what has no known size; NULL: nothing is said */
};
/*
 * If-Match, If-None-Match, Range and If-Range. *ret_done: the reply is set (412, 304, 416);
 * otherwise send bytes first .. first + length - 1 with that status, then call entity_headers.
 */
struct selection {
	int status; /* 200 or 206 */
	uint64_t first, length;
};
int entity_select(struct request *request, const struct entity *entity, struct selection *ret_selection, bool *ret_done,
		  struct error *err);
void entity_headers(struct request *request, const struct entity *entity, const struct selection *selection);

/* ---- what other hosts have: api/elsewhere.c ---- */
/* As elsewhere_missing, for what the request names by that id. */
bool elsewhere_reply(struct api *api, struct request *request, const char *id, struct error *err);

/* ---- waiting until something changes: api/wait.c ---- */
/* ?wait=SECONDS, or Prefer: wait=N; `initial` when neither is there, and never more than api->max_wait. */
int wait_read(struct api *api, struct request *request, double initial, double *ret_seconds, struct error *err);
/* Adds a watch to the subject that a request waits for; takes the watch away, and the request's reference with it. */
struct wait_kind {
	void (*watch)(void *subject, struct watch *watch);
	void (*leave)(void *subject, struct watch *watch);
};
/* From now on the request is woken at each change of the subject: look once more after this. ERR_NO_MEMORY. */
int wait_begin(struct request *request, const struct wait_kind *kind, void *subject, double seconds, struct error *err);
/* NULL before the request waits. */
void *wait_subject(struct request *request);
/* True: answer HTTP_WAIT. False: the time is over. */
bool wait_goes_on(struct request *request);
/* The same for a job, whose reference it takes, also on failure: api/job.c. */
int job_wait_begin(struct request *request, struct job *job, double seconds, struct error *err);

/* A removed job's files are forgotten: a descriptor or mapping that is still open would keep their space. */
void job_forget_files(struct api *api, struct job *job);

/* As store_volume_verify; damage is a warning of the job, too, until all of the volume was found whole. */
int volume_verify(struct api *api, const char *job, const struct volume_record *volume, uint64_t first, uint64_t bytes,
		  struct error *err);

/* ---- pictures, drawn apart from the threads that answer: api/picture.c ---- */
struct picture_kind {
	/* A painter's thread, which calls it once; the subject does not change meanwhile. */
	int (*draw)(void *subject, struct picture *picture, char **ret_png, size_t *ret_length, struct error *err);
	void (*headers)(void *subject, struct request *request); /* after the reply was made */
	void (*free)(void *subject);                             /* what it holds, but not itself; NULL: nothing */
};
/*
 * Has the picture drawn: HTTP_WAIT, and then picture_go_on until it has replied. Takes the subject (free), NULL for
 * ERR_NO_MEMORY. ERR_BUSY where too many wait, ERR_CANCELLED where the client has gone before it was drawn.
 */
int picture_begin(struct api *api, struct request *request, const struct picture_kind *kind, void *subject,
		  struct error *err);
int picture_go_on(struct request *request, struct error *err);
/* False: nobody waits for this struct picture any more, and `draw` may return ERR_CANCELLED. The painter's thread. */
bool picture_wanted(void *picture);

enum picture_end { PICTURE_DRAWN, PICTURE_FAILED, PICTURE_REFUSED, PICTURE_GONE, PICTURE_END_COUNT };
extern const char *const picture_end_names[PICTURE_END_COUNT];
struct pictures_statistics {
	int waiting, drawing; /* now */
	unsigned long long ended[PICTURE_END_COUNT];
};
void pictures_statistics(struct pictures *pictures, struct pictures_statistics *ret);

/* ---- volumes in requests and replies: api/volume.c ---- */
enum { VOLUME_FILENAME_MAX = 96 };
int volume_find(struct api *api, const struct job_facts *job, const char *name, struct volume_record *ret_volume,
		struct error *err);
/* Finds the job and the volume that the request's path names. */
int volume_asked(struct api *api, struct request *request, struct job_facts *ret_facts,
		 struct volume_record *ret_volume, struct error *err);
/* ?format=, ?type= and ?scale=; the name is left to the caller. */
int volume_options(struct request *request, const struct job_facts *job, struct content_options *ret_options,
		   struct error *err);
/* Another one for each volume, also of the same name when it is made again: for ETags. */
enum { VOLUME_TAG_MAX = 80 };
void volume_tag(const char *job, const struct volume_record *volume, char ret_tag[VOLUME_TAG_MAX]);
const char *volume_media_type(const struct content_options *options);
void volume_filename(const char *job, const char *name, const struct content_options *options,
		     char ret_name[VOLUME_FILENAME_MAX]);

#endif
