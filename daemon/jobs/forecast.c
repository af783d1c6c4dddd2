/*
 * How long jobs still take: job_eta and job_start_in of job.h.
 *
 * A running job is judged by its own iterations. What has not begun is judged by jobs before it: each stage of a job
 * that succeeded gives seconds a unit of work on so many devices of that kind, and a stage of the same kind takes as
 * many. Where a stage was never measured on as many devices, or iterations end by themselves, nobody can know.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "core/recon/algorithm.h"
#include "daemon/jobs/internal.h"
#include "proto/clock.h"

static const double not_queued = 1e-3; /* s between being queued and running: less, and it was attended before */

/* What a stage's time depends on, beside the amount of its work: another rate for each. */
static unsigned variant_of(const struct recipe *recipe, enum stage stage)
{
	/* Rays per voxel are fewer with binning. */
	unsigned precise = recipe->reference_precision | (unsigned)recipe->binning << 8;

	switch (stage) {
	case STAGE_FDK:
		return precise | (recipe->metal.on ? 2u : 0) | (recipe->fdk.extend ? 4u : 0);
	case STAGE_TV:
		return recipe->reference_precision | (unsigned)recipe->tv.options.method << 1;
	case STAGE_SART:
	case STAGE_CGLS:
	case STAGE_FISTA:
		return precise | (unsigned)recipe->projector << 1;
	default:
		return 0;
	}
}

static double tv_passes(const struct recipe *recipe, int iterations)
{
	if (!recipe->tv.on)
		return 0;
	return iterations + (recipe->tv.after_fdk && recipe->fdk.on);
}

/* The amount of work in each stage; 0: the job has no such stage. */
static void work_of(const struct recipe *recipe, const struct job_extent *extent, int iterations,
		    double ret_work[STAGE_COUNT])
{
	const double voxels = (double)recipe->grid.size[0] * recipe->grid.size[1] * recipe->grid.size[2];

	memset(ret_work, 0, STAGE_COUNT * sizeof(ret_work[0]));
	ret_work[STAGE_LOAD] = extent->samples;
	ret_work[STAGE_FDK] = recipe->fdk.on ? voxels * extent->views : 0;
	if (recipe->algorithm != NULL)
		ret_work[recipe->algorithm->stage] = iterations * voxels * extent->views;
	ret_work[STAGE_TV] = voxels * tv_passes(recipe, iterations);
	ret_work[STAGE_SAVE] = voxels * (recipe->emits + 1);
}

/* Its place; -1: there is none. */
static int rate_of(const struct job_rate *rates, int count, const struct recipe *recipe, enum stage stage, int devices)
{
	for (int i = 0; i < count; i++) {
		if (rates[i].stage == stage && rates[i].variant == variant_of(recipe, stage) &&
		    rates[i].devices == devices)
			return i;
	}
	return -1;
}

/* What finding the views' poses takes is no stage's work; the share that is done tells. */
static bool refines(const struct recipe *recipe)
{
	return recipe->refine.geometry || recipe->refine.motion;
}

int job_devices_here(const struct job *job)
{
	const int wanted = job->request.devices, there = job->jobs->devices;

	if (job->record.state == JOB_RUNNING)
		return job_devices(&job->record);
	return (wanted == DEVICES_ALL || wanted > there) && there > 0 ? there : wanted > 1 ? wanted : 1;
}

void job_measure(struct job *job, const struct job_record *record)
{
	const struct recipe *recipe = &job->request.recipe;
	struct jobs *jobs = job->jobs;
	const int devices = job_devices(record);
	double work[STAGE_COUNT];

	/*
	 * Of a lost run, or of one that went along with the acquisition, the times are not those of the work; on
	 * another host not of the work here. A job of another host's goes along with the sending of its scan: what is
	 * left to do behind that is what its owner wants to know, and better than nothing for jobs here.
	 */
	const bool once = record->attempts == 1 && record->ran_on[0] != '\0';
	const bool plain = record->started - record->queued > not_queued;

	if (job->unreadable.code != 0 || record->state != JOB_SUCCEEDED || job->extent.views == 0 || !once ||
	    (!plain && !job_is_mirror(record)) || refines(recipe))
		return;
	work_of(recipe, &job->extent, record->iteration, work);
	for (enum stage stage = 0; stage < STAGE_COUNT; stage++) {
		int at = rate_of(jobs->rate, jobs->rates, recipe, stage, devices);

		if (!(work[stage] > 0) || (at >= 0 && !plain && (stage == STAGE_LOAD || stage == STAGE_FDK)))
			continue;
		if (at < 0)
			at = jobs->rates < JOB_RATES ? jobs->rates++ : jobs->oldest_rate++ % JOB_RATES;
		jobs->rate[at] =
		    (struct job_rate){stage, variant_of(recipe, stage), devices, record->seconds[stage] / work[stage]};
	}
}

double job_whole(struct job *job, const struct job_rate *rates, int count, int devices)
{
	const struct recipe *recipe = &job->request.recipe;
	double work[STAGE_COUNT], seconds = 0;

	if (job->unreadable.code != 0 || job->extent.views == 0 || refines(recipe) ||
	    (recipe->algorithm != NULL && recipe->iterate.automatic))
		return NAN;
	work_of(recipe, &job->extent, recipe->algorithm != NULL ? recipe->iterate.iterations : 0, work);
	for (enum stage stage = 0; stage < STAGE_COUNT; stage++) {
		const int at = rate_of(rates, count, recipe, stage, devices);

		if (work[stage] > 0 && at < 0)
			return NAN;
		if (work[stage] > 0)
			seconds += work[stage] * rates[at].seconds;
	}
	return seconds;
}

/* The same on devices here. */
static double whole(struct job *job, int devices)
{
	return job_whole(job, job->jobs->rate, job->jobs->rates, devices);
}

int jobs_rates(struct jobs *jobs, struct job_rate ret_rates[JOB_RATES])
{
	int count;

	pthread_mutex_lock(&jobs->lock);
	count = jobs->rates;
	memcpy(ret_rates, jobs->rate, (size_t)count * sizeof(*ret_rates));
	pthread_mutex_unlock(&jobs->lock);
	return count;
}

/*
 * Of a job that runs. Between two stages, where a new one has no measure yet, what was told before goes on: who has
 * been told a time is told one until the end.
 */
static double rest(struct job *job, double now)
{
	const struct job_record *record = &job->record;
	const bool automatic = job->unreadable.code == 0 && job->request.recipe.iterate.automatic;
	const double done = record->fraction - job->run_fraction, first = whole(job, job_devices_here(job));
	double left = NAN;

	/* How many iterations end by themselves, the share that is done tells. */
	if (job->row_seconds > 0 && record->iterations > 0 && !automatic)
		left = (record->iterations - record->iteration) * job->row_seconds - (now - job->row_at);
	else if (!isnan(first))
		left = first * (1 - job->run_fraction) - (now - job->run_since);
	else if (done > 0.01)
		left = (now - job->run_since) * (1 - record->fraction) / done;
	if (isnan(left) && job->rest_at > 0) {
		left = job->rest - (now - job->rest_at);
	} else if (!isnan(left)) {
		job->rest = left;
		job->rest_at = now;
	}
	return left < 0 ? 0 : left;
}

/* When the devices here will be free, seconds from now, the soonest first. */
struct course {
	double free[WHERE_DEVICES_MOST];
	int count;
	double turn;  /* nobody begins before those who are before him in the queue */
	bool unknown; /* how long somebody before them takes, nobody can know */
};

static int sooner(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

/*
 * The next job's turn: when the devices that it wants are free, or, with those that are free by then, when the first of
 * them have been kept for it as long as they are. Returns how many it has.
 */
static int course_turn(struct course *course, const struct job *job, double now)
{
	const double kept = job->lacks_devices > 0 ? now - job->lacks_devices : 0;
	int devices = job_devices_here(job);
	double latest;

	devices = devices > course->count ? course->count : devices;
	latest = fmax(course->turn, course->free[0]) + fmax(job->jobs->keep_devices - kept, 0);
	while (devices > 1 && course->free[devices - 1] > latest) {
		course->turn = latest;
		devices--;
	}
	course->turn = fmax(course->turn, course->free[devices - 1]);
	return devices;
}

static void course_take(struct course *course, int devices, double seconds)
{
	for (int i = 0; i < devices; i++)
		course->free[i] = course->turn + seconds;
	course->unknown |= isnan(seconds);
	qsort(course->free, (size_t)course->count, sizeof(course->free[0]), sooner);
}

/* By what runs here now; the newest jobs run, so that old ones are not looked at. */
static void course_begin(const struct jobs *jobs, double now, struct course *ret)
{
	int left = jobs->running, running = 0;

	*ret = (struct course){.count = 0};
	for (int i = jobs->count - 1; i >= 0 && left > 0; i--) {
		struct job *job = jobs->all[i];
		double seconds;

		if (job->record.state != JOB_RUNNING)
			continue;
		left--;
		if (job->record.ran_on[0] == '\0')
			continue; /* another host has it */
		seconds = rest(job, now);
		ret->unknown |= isnan(seconds);
		for (int d = job_devices(&job->record); d > 0 && running < WHERE_DEVICES_MOST; d--)
			ret->free[running++] = seconds;
	}
	ret->count = running > jobs->devices ? running : jobs->devices > 1 ? jobs->devices : 1;
	qsort(ret->free, (size_t)ret->count, sizeof(ret->free[0]), sooner);
}

/* It is queued, and a device here will come to it. */
static bool is_coming(const struct job *job)
{
	return job->record.state == JOB_QUEUED && job->hold.obstacle == JOB_UNHINDERED && !job->entry.elsewhere;
}

double job_turn_in(struct job *job, double now, int *ret_devices)
{
	struct course course;

	course_begin(job->jobs, now, &course);
	/* By priority, then by ticket. */
	for (struct queue_entry *entry = job->jobs->queue.first;
	     entry != NULL && entry != &job->entry && !course.unknown; entry = entry->next) {
		struct job *before = job_of_entry(entry);
		int devices;

		if (entry->elsewhere)
			continue;
		devices = course_turn(&course, before, now);
		course_take(&course, devices, whole(before, devices) * (1 - before->record.fraction));
	}
	if (course.unknown)
		return NAN;
	*ret_devices = course_turn(&course, job, now);
	return course.turn;
}

static double known(double seconds)
{
	return isnan(seconds) ? -1 : seconds;
}

double job_start_in(struct job *job)
{
	double now = clock_monotonic(), seconds = NAN;
	int devices = 1;

	pthread_mutex_lock(&job->jobs->lock);
	if (is_coming(job))
		seconds = job_turn_in(job, now, &devices);
	pthread_mutex_unlock(&job->jobs->lock);
	return known(seconds);
}

double job_eta(struct job *job)
{
	double now = clock_monotonic(), seconds = NAN;
	int devices = 1;

	pthread_mutex_lock(&job->jobs->lock);
	if (job->record.state == JOB_RUNNING) {
		seconds = rest(job, now);
	} else if (is_coming(job)) {
		seconds = job_turn_in(job, now, &devices);
		seconds += whole(job, devices) * (1 - job->record.fraction);
	}
	pthread_mutex_unlock(&job->jobs->lock);
	return known(seconds);
}
