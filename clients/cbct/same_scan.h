#ifndef CBCT_CLIENTS_SAME_SCAN_H
#define CBCT_CLIENTS_SAME_SCAN_H

#include "clients/cbct/http.h"
#include "proto/scan_directory.h"

/*
 * Whether the daemon's scan `id` is that of an open scan directory, so that an upload may go on with it: every member
 * of the document but the labels (patient, study, name, geometry ...), and every projection that the daemon has, by its
 * digest. projections: the whole of projections.raw. ERR_CONFLICT, with the first difference, where it is another one.
 */
int scan_check_same(struct http *http, const char *id, const struct scan_files *files, const void *projections,
		    struct error *err);

#endif
