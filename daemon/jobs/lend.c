/*
 * Jobs on several devices of this host.
 *
 * Such a job has one worker as any other, which opens the other devices beside its own for as long as the job runs
 * (daemon/worker.c); their workers are lent to it meanwhile. So a job on several devices is cancelled, watched, killed
 * and ended as one on a single device, by one process and one socket, and no process is started for it. A worker that
 * is lent stays idle and has no more of its device's memory than a process must. Another way would have been a process
 * that is started with a list of devices; it would have to come up for each such job, and the others to go before it.
 *
 * A device is lent until the process that has it has said that the job has ended, and has closed the device before
 * that, or has gone.
 */
#include <stdio.h>
#include <string.h>

#include "daemon/jobs/workers.h"
#include "daemon/log.h"

bool worker_is_free(const struct worker *worker)
{
	return worker->state == WORKER_IDLE && worker->job == NULL && worker->lent_to == NULL;
}

/* A device of this host that the job may have, now or soon. */
static bool is_open_to(const struct worker *worker, const struct job_trial *trial)
{
	return !device_is_out(worker) && device_fits(worker, trial);
}

int devices_in_service(const struct supervise *supervise)
{
	int count = 0;

	for (int i = 0; i < supervise->regular; i++)
		count += !device_is_out(&supervise->workers[i]);
	return count;
}

/* How many devices the job is to begin with on this worker: as it asks, or all that are left to it. */
static int devices_wanted(const struct worker *worker, const struct job_trial *trial)
{
	const struct supervise *supervise = worker->supervise;
	const int asked = *trial->devices;
	int most = 0;

	if (worker->remote || worker->fallback || (asked != DEVICES_ALL && asked <= 1))
		return 1;
	for (int i = 0; i < supervise->regular && most < CARDS_MOST; i++)
		most += is_open_to(&supervise->workers[i], trial);
	if (asked != DEVICES_ALL && asked < most)
		most = asked;
	return most > 1 ? most : 1;
}

/* Up to so many that are free, the worker's own first; returns how many. */
static int take_free(struct worker *worker, const struct job_trial *trial, int wanted,
		     struct worker *ret_cards[CARDS_MOST])
{
	struct supervise *supervise = worker->supervise;
	int count = 1;

	ret_cards[0] = worker;
	for (int i = 0; i < supervise->regular && count < wanted; i++) {
		struct worker *other = &supervise->workers[i];

		if (other != worker && worker_is_free(other) && is_open_to(other, trial) &&
		    strcmp(other->backend, worker->backend) == 0)
			ret_cards[count++] = other;
	}
	return count;
}

int devices_choose(struct worker *worker, const struct job_trial *trial, struct worker *ret_cards[CARDS_MOST])
{
	const int wanted = devices_wanted(worker, trial);

	return take_free(worker, trial, wanted, ret_cards) == wanted ? wanted : 0;
}

int devices_choose_free(struct worker *worker, struct job *job, struct worker *ret_cards[CARDS_MOST])
{
	const struct job_trial *trial = job_trial(job);
	const int count = take_free(worker, trial, devices_wanted(worker, trial), ret_cards);

	return devices_have_room(worker, job, count) ? count : 0;
}

void devices_lend(struct supervise *supervise, struct worker *worker, struct worker *const cards[], int count)
{
	worker->card_count = count;
	worker->failed_card = 0;
	for (int i = 0; i < count; i++) {
		worker->cards[i] = cards[i];
		if (cards[i] != worker)
			cards[i]->lent_to = worker;
	}
	for (int i = 1; i < count; i++)
		worker_publish(supervise, cards[i]);
}

void devices_return(struct supervise *supervise)
{
	for (int i = 0; i < supervise->regular; i++) {
		struct worker *worker = &supervise->workers[i];
		const struct worker *holder = worker->lent_to;

		if (holder == NULL || holder->job != NULL || holder->state == WORKER_ENDING)
			continue;
		worker->lent_to = NULL;
		worker_publish(supervise, worker);
	}
}

struct worker *worker_failed_card(struct worker *worker)
{
	return worker->failed_card > 0 && worker->failed_card < worker->card_count ? worker->cards[worker->failed_card]
										   : worker;
}

/* Numbers with commas between them: of the workers, or of their devices among those of the backend. */
static void write_numbers(const struct supervise *supervise, struct worker *const cards[], int count, bool devices,
			  char ret_text[CARDS_TEXT])
{
	int length = 0;

	ret_text[0] = '\0';
	for (int i = 0; i < count && length < CARDS_TEXT - 12; i++)
		length += snprintf(ret_text + length, (size_t)(CARDS_TEXT - length), "%s%d", i > 0 ? "," : "",
				   devices ? supervise->devices[cards[i]->index] : cards[i]->index);
}

void devices_name(const struct worker *worker, struct worker *const cards[], int count, struct device_names *ret)
{
	const struct supervise *supervise = worker->supervise;

	*ret = (struct device_names){.device = ""};
	if (count > 1)
		snprintf(ret->device, sizeof(ret->device), "%d x %.80s", count, worker->info.name);
	else
		snprintf(ret->device, sizeof(ret->device), "%s", worker->info.name);
	if (count > 1)
		write_numbers(supervise, cards, count, true, ret->cards);
	if (!worker->remote)
		write_numbers(supervise, cards, count, false, ret->ran_on);
}

void devices_tell_fewer(struct worker *worker, const struct job_trial *trial, int count, bool waited)
{
	const bool all = *trial->devices == DEVICES_ALL;
	struct error ignored;
	char text[160];

	if (worker->remote || count == 0 || (all ? !waited : *trial->devices <= count))
		return;
	if (waited)
		snprintf(
		    text, sizeof(text),
		    "%d of the devices that it asks for: it has waited %.0f s for the others, which other jobs had",
		    count, worker->supervise->options.keep_devices);
	else
		snprintf(text, sizeof(text),
			 "%d of %d devices that it asks for: the others have failed, or do not answer", count,
			 *trial->devices);
	job_add_warning(worker->job, "fewer_devices", text, &ignored);
}
