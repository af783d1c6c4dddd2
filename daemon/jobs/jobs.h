#ifndef CBCT_DAEMON_JOBS_JOBS_H
#define CBCT_DAEMON_JOBS_JOBS_H

/* The door of the jobs: their life, the workers that run them, and their rows as JSON. */
#include "daemon/jobs/document.h"
#include "daemon/jobs/job.h"
#include "daemon/jobs/supervise.h"

#endif
