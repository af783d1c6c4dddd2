/* Which host has what: homes.h. */
#include "daemon/fleet/homes.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/lock.h"

enum {
	HOSTS_MOST = 256,
	PAGE = 256,                /* jobs or scans of a list */
	KIND_MOST = HOMES_MOST / 2 /* jobs, and scans, that others are told of: the newest */
};

struct host {
	struct fleet_host facts;
	char (*ids)[ID_SIZE]; /* [count], in their order; owned */
	int count;
};

struct homes {
	/* The fleet's thread's own. */
	char told[HOMES_MOST][ID_SIZE], own[HOMES_MOST][ID_SIZE]; /* in their order */
	int told_count, own_count;
	bool known; /* what was told is in the ledger */

	pthread_mutex_t lock; /* guards what follows */
	struct host hosts[HOSTS_MOST];
	int count;
};

int homes_new(struct homes **ret_homes, struct error *err)
{
	struct homes *homes = calloc(1, sizeof(*homes));

	if (homes == NULL)
		return error_set_errno(err, ENOMEM, "list of hosts");
	lock_init(&homes->lock, LOCK_HOMES);
	*ret_homes = homes;
	return 0;
}

void homes_free(struct homes *homes)
{
	if (homes == NULL)
		return;
	for (int i = 0; i < homes->count; i++)
		free(homes->hosts[i].ids);
	pthread_mutex_destroy(&homes->lock);
	free(homes);
}

static int compare_ids(const void *a, const void *b)
{
	return strcmp(a, b);
}

bool homes_find(struct homes *homes, const char *id, struct fleet_host *ret_host)
{
	char key[ID_SIZE] = "";
	bool found = false;

	if (strlen(id) >= sizeof(key))
		return false;
	memcpy(key, id, strlen(id));
	pthread_mutex_lock(&homes->lock);
	for (int i = 0; i < homes->count && !found; i++) {
		const struct host *host = &homes->hosts[i];

		found = bsearch(key, host->ids, (size_t)host->count, ID_SIZE, compare_ids) != NULL;
		if (found)
			*ret_host = host->facts;
	}
	pthread_mutex_unlock(&homes->lock);
	return found;
}

bool homes_named(struct homes *homes, const char *name, struct fleet_host *ret_host)
{
	bool found = false;

	pthread_mutex_lock(&homes->lock);
	for (int i = 0; i < homes->count && !found; i++) {
		found = strcmp(homes->hosts[i].facts.name, name) == 0;
		if (found)
			*ret_host = homes->hosts[i].facts;
	}
	pthread_mutex_unlock(&homes->lock);
	return found;
}

void homes_takers(struct homes *homes, const struct where *where, int *ret_takers, int *ret_fit)
{
	*ret_takers = *ret_fit = 0;
	pthread_mutex_lock(&homes->lock);
	for (int i = 0; i < homes->count; i++) {
		const struct fleet_host *host = &homes->hosts[i].facts;

		if (host->away || host->url[0] == '\0')
			continue;
		++*ret_takers;
		*ret_fit += where_fits(where, host->name, host->memory, host->devices);
	}
	pthread_mutex_unlock(&homes->lock);
}

int homes_list_takers(struct homes *homes, struct fleet_host *ret_hosts, int most)
{
	int count = 0;

	pthread_mutex_lock(&homes->lock);
	for (int i = 0; i < homes->count && count < most; i++) {
		if (!homes->hosts[i].facts.away && homes->hosts[i].facts.url[0] != '\0')
			ret_hosts[count++] = homes->hosts[i].facts;
	}
	pthread_mutex_unlock(&homes->lock);
	return count;
}

/* ---- what this host has ---- */

static void add_own(struct homes *homes, const char *id)
{
	memcpy(homes->own[homes->own_count++], id, ID_SIZE);
}

static int collect_jobs(struct homes *homes, struct jobs *jobs, struct error *err)
{
	struct job *page[PAGE];
	char after[ID_SIZE];
	bool more = true;
	int count, code = 0;

	for (int seen = 0; more && seen < KIND_MOST && code == 0; seen += count) {
		code = jobs_list(jobs, seen == 0 ? NULL : after, PAGE, page, &count, &more, err);
		for (int i = 0; i < count && code == 0; i++) {
			struct job_record record;

			job_record(page[i], &record);
			memcpy(after, record.id, sizeof(after));
			if (!job_is_mirror(&record))
				add_own(homes, record.id);
			job_release(page[i]);
		}
	}
	return code;
}

static int collect_scans(struct homes *homes, struct store *store, struct error *err)
{
	struct stored_scan *page[PAGE];
	char after[ID_SIZE];
	bool more = true;
	int count, code = 0;

	for (int seen = 0; more && seen < KIND_MOST && code == 0; seen += count) {
		code = store_scan_list(store, seen == 0 ? NULL : after, PAGE, page, &count, &more, err);
		for (int i = 0; i < count && code == 0; i++) {
			struct scan_facts facts;

			stored_scan_facts(page[i], &facts);
			memcpy(after, stored_scan_id(page[i]), sizeof(after));
			if (strncmp(facts.name, JOB_MIRROR_KEY, strlen(JOB_MIRROR_KEY)) != 0)
				add_own(homes, stored_scan_id(page[i]));
			stored_scan_release(page[i]);
		}
	}
	return code;
}

int homes_tell(struct homes *homes, struct jobs *jobs, struct ledger *ledger, struct error *err)
{
	int code;

	homes->own_count = 0;
	code = collect_jobs(homes, jobs, err);
	if (code == 0)
		code = collect_scans(homes, jobs_store(jobs), err);
	if (code != 0)
		return code;
	qsort(homes->own, (size_t)homes->own_count, ID_SIZE, compare_ids);
	if (homes->known && homes->own_count == homes->told_count &&
	    memcmp(homes->own, homes->told, (size_t)homes->own_count * ID_SIZE) == 0)
		return 0;
	code = ledger_tell(ledger, (const char(*)[ID_SIZE])homes->own, homes->own_count, err);
	homes->known = code == 0;
	homes->told_count = homes->own_count;
	memcpy(homes->told, homes->own, (size_t)homes->own_count * ID_SIZE);
	return code;
}

void homes_forget(struct homes *homes)
{
	homes->known = false;
}

/* ---- what others have ---- */

static struct host *find_host(struct homes *homes, const char *name)
{
	for (int i = 0; i < homes->count; i++) {
		if (strcmp(homes->hosts[i].facts.name, name) == 0)
			return &homes->hosts[i];
	}
	return NULL;
}

/* Takes the ids. */
static void set_host(struct homes *homes, const struct fleet_host *facts, char (*ids)[ID_SIZE], int count)
{
	struct host *host = find_host(homes, facts->name);

	pthread_mutex_lock(&homes->lock);
	if (host == NULL && homes->count < HOSTS_MOST)
		host = &homes->hosts[homes->count++];
	if (host != NULL) {
		free(host->ids);
		*host = (struct host){*facts, ids, count};
		ids = NULL;
	}
	pthread_mutex_unlock(&homes->lock);
	free(ids);
}

static int read_host(struct homes *homes, struct ledger *ledger, const struct fleet_host *facts, struct error *err)
{
	struct host *host = find_host(homes, facts->name);
	char(*ids)[ID_SIZE];
	int count = 0, code;

	if (host != NULL && host->facts.changes == facts->changes) {
		pthread_mutex_lock(&homes->lock);
		host->facts = *facts;
		pthread_mutex_unlock(&homes->lock);
		return 0;
	}
	ids = calloc(HOMES_MOST, ID_SIZE);
	if (ids == NULL)
		return error_set_errno(err, ENOMEM, "list of what a host has");
	code = ledger_homes(ledger, facts->name, ids, &count, err);
	if (code != 0) {
		free(ids);
		return code;
	}
	set_host(homes, facts, ids, count);
	return 0;
}

int homes_read(struct homes *homes, struct ledger *ledger, struct error *err)
{
	struct fleet_host *hosts = calloc(HOSTS_MOST, sizeof(*hosts));
	int count, code = hosts == NULL ? error_set_errno(err, ENOMEM, "list of hosts")
					: ledger_hosts(ledger, hosts, HOSTS_MOST, &count, err);

	for (int i = 0; code == 0 && i < count; i++)
		code = read_host(homes, ledger, &hosts[i], err);
	free(hosts);
	return code;
}
