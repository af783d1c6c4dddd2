#ifndef CBCT_DAEMON_API_FILTER_H
#define CBCT_DAEMON_API_FILTER_H

#include "daemon/api/internal.h"

/*
 * Which jobs or scans of a list are asked for. All that is said must fit:
 *
 *   state, priority   names with commas between, one of which it has
 *   scan              the job's
 *   label             NAME, or NAME=VALUE, of the job or of its scan
 *   text              stands in its id, its scan's id or name, or in a label's value; large and small letters are the
 *                     same
 *
 * The texts are the request's.
 */
struct filter {
	const char *state, *scan, *priority, *label, *text; /* NULL: any */
};
/* ERR_INVALID: a name that nobody knows, or what is no id or label. */
int filter_read_jobs(struct request *request, struct filter *ret, struct error *err);
int filter_read_scans(struct request *request, struct filter *ret, struct error *err);
bool filter_fits_job(struct api *api, const struct filter *filter, struct job *job);
bool filter_fits_scan(struct api *api, const struct filter *filter, struct stored_scan *scan);

#endif
