/* Scans of other hosts that are kept here: internal.h. */
#include <string.h>

#include "daemon/fleet/internal.h"
#include "daemon/log.h"
#include "proto/clock.h"

enum { PAGE = 256 }; /* scans or jobs of a list */

bool copy_is(const char *name)
{
	return strncmp(name, JOB_MIRROR_KEY, strlen(JOB_MIRROR_KEY)) == 0;
}

/* A scan's name is JOB_MIRROR_KEY, its owner, "/", its id there (clients/cbct/remote.c). */
static bool has_claim(const struct fleet *fleet, const char *name)
{
	const char *owner = name + strlen(JOB_MIRROR_KEY);
	const size_t length = strcspn(owner, "/");

	for (int i = 0; i < fleet->claim_count; i++) {
		if (strncmp(fleet->claims[i].owner, owner, length) == 0 && fleet->claims[i].owner[length] == '\0')
			return true;
	}
	return false;
}

static bool is_gone(const struct fleet *fleet, const char *name)
{
	const char *slash = strrchr(name, '/');
	struct fleet_host ignored;

	return slash == NULL || !homes_find(fleet->homes, slash + 1, &ignored);
}

/* NULL: there is no place for it. */
static struct copy *find_copy(struct fleet *fleet, const char *id)
{
	struct copy *copy;

	for (int i = 0; i < fleet->copy_count; i++) {
		if (strcmp(fleet->copies[i].id, id) == 0)
			return &fleet->copies[i];
	}
	if (fleet->copy_count == COPIES_MOST)
		return NULL;
	copy = &fleet->copies[fleet->copy_count++];
	memcpy(copy->id, id, sizeof(copy->id));
	copy->used = clock_monotonic();
	return copy;
}

/*
 * A job that has not ended needs it; another host's that has goes first: by its scan's name it is known as that. A
 * user's own over such a scan goes on to stand without it.
 */
static bool has_job(struct fleet *fleet, const char *scan)
{
	struct job *page[PAGE];
	struct job_record record;
	struct job_facts facts;
	char after[ID_SIZE];
	bool more = true, found = false;
	struct error ignored;
	int count = 0;

	for (bool first = true; more && !found; first = false) {
		if (jobs_list(fleet->jobs, first ? NULL : after, PAGE, page, &count, &more, &ignored) != 0)
			return true;
		for (int i = 0; i < count; i++) {
			job_facts(page[i], &facts);
			job_record(page[i], &record);
			memcpy(after, facts.id, sizeof(after));
			found |= strcmp(facts.scan, scan) == 0 && (!facts.ended || job_is_mirror(&record));
			job_release(page[i]);
		}
	}
	return found;
}

static void remove_copy(struct fleet *fleet, struct stored_scan *scan)
{
	struct error err;

	if (has_job(fleet, stored_scan_id(scan)))
		return;
	if (jobs_delete_scan(fleet->jobs, scan, &err) != 0) {
		log_line(LEVEL_DEBUG, "scan %s stays: %s", stored_scan_id(scan), err.text);
		return;
	}
	for (int i = 0; i < fleet->copy_count; i++) {
		if (strcmp(fleet->copies[i].id, stored_scan_id(scan)) == 0)
			fleet->copies[i] = fleet->copies[--fleet->copy_count];
	}
}

/* What one look at all scans has found. */
struct look {
	char oldest[ID_SIZE]; /* of the copies that are kept without a claim, "": there is none */
	double used;          /* when that was used */
	double bytes;         /* of all of those */
};

static void look_at(struct fleet *fleet, struct stored_scan *scan, bool all, struct look *look)
{
	struct scan_facts facts;
	struct copy *copy;

	stored_scan_facts(scan, &facts);
	if (!copy_is(facts.name))
		return;
	copy = find_copy(fleet, stored_scan_id(scan));
	if (!all && has_claim(fleet, facts.name)) {
		if (copy != NULL)
			copy->used = clock_monotonic();
		return;
	}
	if (all || copy == NULL || clock_monotonic() >= copy->used + fleet->keep_scans || is_gone(fleet, facts.name)) {
		remove_copy(fleet, scan);
		return;
	}
	look->bytes += (double)facts.columns * facts.rows * facts.received * (double)sample_bytes(facts.sample);
	if (look->oldest[0] != '\0' && look->used <= copy->used)
		return;
	memcpy(look->oldest, copy->id, sizeof(look->oldest));
	look->used = copy->used;
}

void fleet_clear_copies(struct fleet *fleet, bool all)
{
	struct store *store = jobs_store(fleet->jobs);
	struct look look = {.bytes = 0};
	struct stored_scan *page[PAGE], *scan;
	unsigned long long available = 0;
	char after[ID_SIZE];
	struct error err;
	bool more = true;
	int count = 0;

	for (bool first = true; more; first = false) {
		if (store_scan_list(store, first ? NULL : after, PAGE, page, &count, &more, &err) != 0)
			break;
		for (int i = 0; i < count; i++) {
			memcpy(after, stored_scan_id(page[i]), sizeof(after));
			look_at(fleet, page[i], all, &look);
			stored_scan_release(page[i]);
		}
	}
	/* One at a time: the next look finds what is free then. */
	if (look.oldest[0] == '\0' || store_space(store, &available, &err) != 0 || look.bytes <= (double)available ||
	    store_scan_refer(store, look.oldest, &scan, &err) != 0)
		return;
	remove_copy(fleet, scan);
	stored_scan_release(scan);
}
