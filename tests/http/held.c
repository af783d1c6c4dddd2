/*
 * What a volume waits for held up, so that tests can look at it meanwhile, and the catalogue made to refuse: linked
 * with --wrap=fdatasync, a worker whose syncs do not return while the file that
 * CBCT_TEST_HOLD names is there; with --wrap=recon_push, a worker that takes no projection while that of
 * CBCT_TEST_HANG is; with --wrap=job_digest_volume, a daemon whose
 * digests do not come while that of CBCT_TEST_HOLD_DIGEST is, and whose slabs and oblique planes are not drawn while
 * that of CBCT_TEST_HOLD_DRAWING is; and with the calls of the store below, a daemon that cannot record what the file
 * of CBCT_TEST_REFUSE names: "running", "digest" or "volume NAME"; and a daemon in which the part hangs that the file
 * of CBCT_TEST_STUCK names: "http", "thread" (one of the server's, the first that is asked), "supervisor" or
 * "catalogue". A worker with CBCT_TEST_CARDS in its environment pretends that the processor is a card, whose calls fail
 * while the file that it names says so: "CALL DEVICES", where CALL is "filter" or "iterate", which end in a device
 * error, or "hang" and "kill", which do that at an iteration. A job on several of them has each as its own card.
 */
#include <signal.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "daemon/http/http.h"
#include "daemon/jobs/job.h"
#include "proto/oblique.h"

/* Weak: a program has one of them. */
int __real_fdatasync(int file) __attribute__((weak));
int __wrap_fdatasync(int file);
int __real_recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err)
    __attribute__((weak));
int __wrap_recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err);
int __real_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
    __attribute__((weak));
int __wrap_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err);

bool __real_oblique_make(const float *voxels, const struct grid *grid, const struct oblique *oblique,
			 bool (*wanted)(void *context), void *context, unsigned char *ret_pixels) __attribute__((weak));
bool __wrap_oblique_make(const float *voxels, const struct grid *grid, const struct oblique *oblique,
			 bool (*wanted)(void *context), void *context, unsigned char *ret_pixels);

int __real_store_job_update(struct store *store, const struct job_record *job, const struct event *event,
			    const struct event *end, enum job_past past, struct error *err) __attribute__((weak));
int __wrap_store_job_update(struct store *store, const struct job_record *job, const struct event *event,
			    const struct event *end, enum job_past past, struct error *err);
int __real_store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
				const struct event *event, struct error *err) __attribute__((weak));
int __wrap_store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
				const struct event *event, struct error *err);
int __real_store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume,
				   struct error *err) __attribute__((weak));
int __wrap_store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume,
				   struct error *err);

int __real_live_get(void *context, struct request *request, struct error *err) __attribute__((weak));
int __wrap_live_get(void *context, struct request *request, struct error *err);
int __real_jobs_promote(struct jobs *jobs, struct error *err) __attribute__((weak));
int __wrap_jobs_promote(struct jobs *jobs, struct error *err);
int __real_store_job_volumes(struct store *store, const char *id, struct volume_record **ret_volumes, int *ret_count,
			     struct error *err) __attribute__((weak));
int __wrap_store_job_volumes(struct store *store, const char *id, struct volume_record **ret_volumes, int *ret_count,
			     struct error *err);

static void hold(const char *variable)
{
	const struct timespec moment = {.tv_nsec = 10000000};
	const char *path = getenv(variable);

	while (path != NULL && access(path, F_OK) == 0)
		nanosleep(&moment, NULL);
}

int __wrap_fdatasync(int file)
{
	hold("CBCT_TEST_HOLD");
	return __real_fdatasync(file);
}

int __wrap_recon_push(struct recon *recon, const void *samples, const int *views, int count, struct error *err)
{
	hold("CBCT_TEST_HANG");
	return __real_recon_push(recon, samples, views, count, err);
}

int __wrap_job_digest_volume(struct job *job, const struct volume_record *volume, struct error *err)
{
	hold("CBCT_TEST_HOLD_DIGEST");
	return __real_job_digest_volume(job, volume, err);
}

bool __wrap_oblique_make(const float *voxels, const struct grid *grid, const struct oblique *oblique,
			 bool (*wanted)(void *context), void *context, unsigned char *ret_pixels)
{
	hold("CBCT_TEST_HOLD_DRAWING");
	return __real_oblique_make(voxels, grid, oblique, wanted, context, ret_pixels);
}

/* ---- cards ---- */

struct backend;
const struct backend *__real_backend_find(const char *name) __attribute__((weak));
const struct backend *__wrap_backend_find(const char *name);

/* Which card each device and each plan is of: the latest of them. */
enum { KNOWN = 512 };
static struct {
	pthread_mutex_t lock;
	int next;
	const void *what[KNOWN];
	int card[KNOWN];
} known = {.lock = PTHREAD_MUTEX_INITIALIZER};

static void note(const void *what, int card)
{
	pthread_mutex_lock(&known.lock);
	known.what[known.next % KNOWN] = what;
	known.card[known.next++ % KNOWN] = card;
	pthread_mutex_unlock(&known.lock);
}

static int card_of(const void *what)
{
	int card = -1;

	pthread_mutex_lock(&known.lock);
	for (int i = known.next - 1; i >= 0 && i >= known.next - KNOWN && card < 0; i--)
		card = known.what[i % KNOWN] == what ? known.card[i % KNOWN] : -1;
	pthread_mutex_unlock(&known.lock);
	return card;
}

static int open_card(int index, const struct device_options *options, struct device **ret_device, struct error *err)
{
	int code = backend_cpu.open(0, options, ret_device, err);

	if (code == 0)
		note(*ret_device, index);
	return code;
}

static int plan_on_card(struct device *device, const struct plan_options *options, struct plan **ret_plan,
			struct error *err)
{
	int code = backend_cpu.plan_new(device, options, ret_plan, err);

	if (code == 0)
		note(*ret_plan, card_of(device));
	return code;
}

/* The file says that this call fails on the card of this plan. */
static bool trouble(const struct plan *plan, const char *call)
{
	FILE *file = fopen(getenv("CBCT_TEST_CARDS"), "re");
	char wanted[32] = "", devices[64] = "";
	bool found = file != NULL && fscanf(file, "%31s %63s", wanted, devices) == 2 && strcmp(wanted, call) == 0 &&
		     strchr(devices, '0' + card_of(plan)) != NULL;

	if (file != NULL)
		fclose(file);
	return found;
}

static int filter_or_fail(struct plan *plan, const struct stack *from, const int *slots, const int *views, int count,
			  struct stack *to, struct error *err)
{
	if (trouble(plan, "filter"))
		return error_set(err, ERR_DEVICE, "the card has fallen off the bus");
	return backend_cpu.filter(plan, from, slots, views, count, to, err);
}

static int fail_iterating(const struct plan *plan, struct error *err)
{
	if (trouble(plan, "iterate"))
		return error_set(err, ERR_DEVICE, "the card has counted an error that it cannot correct");
	if (trouble(plan, "kill"))
		raise(SIGKILL);
	while (trouble(plan, "hang"))
		nanosleep(&(struct timespec){.tv_nsec = 10000000}, NULL);
	return 0;
}

static int iterate_or_fail(struct plan *plan, const struct stack *projections, struct volume *volume,
			   const struct cancel *cancel, struct iteration_sums *ret_sums, struct error *err)
{
	int code = backend_cpu.sart_iterate(plan, projections, volume, cancel, ret_sums, err);

	return code == 0 ? fail_iterating(plan, err) : code;
}

/* The same of one card of several. */
static int correct_or_fail(struct plan *plan, const struct geometry *geometry, const struct grid *grid,
			   const struct stack *measured, const int *views, int count, const int left_out[2], int before,
			   struct stack *rays, struct error *err)
{
	int code = backend_cpu.sart_correct(plan, geometry, grid, measured, views, count, left_out, before, rays, err);

	return code == 0 ? fail_iterating(plan, err) : code;
}

const struct backend *__wrap_backend_find(const char *name)
{
	static struct backend card;

	if (getenv("CBCT_TEST_CARDS") == NULL || strcmp(name, "cuda") != 0)
		return __real_backend_find(name);
	card = backend_cpu;
	card.name = "cuda";
	card.own_memory = true;
	card.open = open_card;
	card.plan_new = plan_on_card;
	card.filter = filter_or_fail;
	card.sart_iterate = iterate_or_fail;
	card.sart_correct = correct_or_fail;
	return &card;
}

/* ---- the catalogue ---- */

/* Whether the file that the variable names has that line. */
static bool says(const char *variable, const char *what)
{
	const char *path = getenv(variable);
	FILE *file = path == NULL ? NULL : fopen(path, "re");
	char wanted[64] = "";

	if (file == NULL)
		return false;
	if (fgets(wanted, sizeof(wanted), file) != NULL)
		wanted[strcspn(wanted, "\n")] = '\0';
	fclose(file);
	return strcmp(wanted, what) == 0;
}

static int refuse(const char *what, struct error *err)
{
	return says("CBCT_TEST_REFUSE", what) ? error_set(err, ERR_INTERNAL, "catalogue: refused") : 0;
}

static void hang(const char *part)
{
	const struct timespec moment = {.tv_nsec = 10000000};

	while (says("CBCT_TEST_STUCK", part))
		nanosleep(&moment, NULL);
}

int __wrap_live_get(void *context, struct request *request, struct error *err)
{
	static atomic_flag one = ATOMIC_FLAG_INIT;

	hang("http");
	if (says("CBCT_TEST_STUCK", "thread") && !atomic_flag_test_and_set(&one))
		hang("thread");
	return __real_live_get(context, request, err);
}

int __wrap_jobs_promote(struct jobs *jobs, struct error *err)
{
	hang("supervisor");
	return __real_jobs_promote(jobs, err);
}

int __wrap_store_job_volumes(struct store *store, const char *id, struct volume_record **ret_volumes, int *ret_count,
			     struct error *err)
{
	hang("catalogue");
	return __real_store_job_volumes(store, id, ret_volumes, ret_count, err);
}

int __wrap_store_job_update(struct store *store, const struct job_record *job, const struct event *event,
			    const struct event *end, enum job_past past, struct error *err)
{
	if (job->state == JOB_RUNNING && refuse("running", err) != 0)
		return err->code;
	return __real_store_job_update(store, job, event, end, past, err);
}

int __wrap_store_job_add_volume(struct store *store, const char *id, const struct volume_record *volume,
				const struct event *event, struct error *err)
{
	char what[64];

	snprintf(what, sizeof(what), "volume %s", volume->name);
	if (refuse(what, err) != 0)
		return err->code;
	return __real_store_job_add_volume(store, id, volume, event, err);
}

int __wrap_store_job_digest_volume(struct store *store, const char *id, const struct volume_record *volume,
				   struct error *err)
{
	if (refuse("digest", err) != 0)
		return err->code;
	return __real_store_job_digest_volume(store, id, volume, err);
}
