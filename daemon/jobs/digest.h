#ifndef CBCT_DAEMON_JOBS_DIGEST_H
#define CBCT_DAEMON_JOBS_DIGEST_H

#include "daemon/jobs/job.h"

/*
 * The SHA-256 of kept volumes, made behind everything else: a volume is announced
 * and its job ends without it. Threads that give way to all others read each
 * file once it is on the disk, most often from the page cache.
 *
 * A digest that fails is tried again, at longer and longer intervals; one that is not
 * made before the stop is made after the next start.
 */
struct digester;

/* Starts the threads with the volumes that the catalogue has without a digest, of jobs whose volumes are on the disk.
 */
int digester_start(struct jobs *jobs, int threads, struct digester **ret_digester, struct error *err);
void digester_stop(struct digester *digester); /* NULL is fine */

/* This volume of the job is on the disk; NULL: all of its volumes are. A job that is deleted meanwhile needs none. */
void digester_add(struct digester *digester, const char *job, const char *name);

#endif
