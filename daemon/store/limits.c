/* How much a client, and all of them together, may have: store.h. */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>

#include "daemon/log.h"
#include "daemon/store/scan.h"
#include "proto/clock.h"

void store_set_limits(struct store *store, const struct store_limits *limits)
{
	store->limits = *limits;
}

const struct store_limits *store_limits(const struct store *store)
{
	return &store->limits;
}

void store_count(struct store *store, const struct store_counter *counter)
{
	store->counters[store->counter_count++] = *counter;
}

static unsigned long long counted_bytes(const struct store *store, const char *client)
{
	unsigned long long sum = 0;

	for (int i = 0; i < store->counter_count; i++)
		sum += store->counters[i].bytes(store->counters[i].context, client);
	return sum;
}

long store_unended(struct store *store, const char *client)
{
	long sum = 0;

	for (int i = 0; i < store->counter_count; i++)
		sum += store->counters[i].unended(store->counters[i].context, client);
	return sum;
}

int store_check_unended(struct store *store, const char *client, struct error *err)
{
	const struct store_limits *limits = &store->limits;
	const long own = store_unended(store, client), all = store_unended(store, NULL);

	if (limits->client_jobs > 0 && own >= limits->client_jobs)
		return error_set(err, ERR_LIMIT, "jobs of %.60s that have not ended: %ld; one client may have %ld",
				 client, own, limits->client_jobs);
	if (limits->jobs > 0 && all >= limits->jobs)
		return error_set(err, ERR_BUSY, "jobs that have not ended: %ld; there may be %ld", all, limits->jobs);
	return 0;
}

unsigned long long store_volumes_most(const struct store_limits *limits)
{
	return (unsigned long long)((double)limits->bytes * (1 - STORE_ACQUISITION_SHARE));
}

static bool is_of(const struct stored_scan *scan, const char *client)
{
	return client == NULL || strcmp(scan->client, client) == 0;
}

static unsigned long long all_projections(const struct stored_scan *scan)
{
	return (unsigned long long)stored_scan_bytes(scan) * (unsigned long long)scan->count;
}

/* Of its flat, dark and defects, and of its scatter, also those that are being written. */
static unsigned long long images_of(struct stored_scan *scan)
{
	unsigned long long sum = 0;

	pthread_mutex_lock(&scan->lock);
	for (int image = 0; image < IMAGE_COUNT; image++)
		sum += scan->image[image] != MISSING ? stored_image_bytes(scan, image) : 0;
	for (int image = 0; image < scan->scatter_count; image++)
		sum += scan->scatter_progress[image] != MISSING ? scatter_image_bytes(&scan->scatter) : 0;
	pthread_mutex_unlock(&scan->lock);
	return sum;
}

/* With store.scans_lock held. */
static unsigned long long room_of(struct stored_scan *scan)
{
	return (scan->has_room ? all_projections(scan) : 0) + images_of(scan);
}

unsigned long long store_bytes(struct store *store, const char *client)
{
	unsigned long long sum = counted_bytes(store, client);

	pthread_mutex_lock(&store->scans_lock);
	for (int i = 0; i < store->scan_count; i++) {
		if (is_of(store->scans[i], client))
			sum += room_of(store->scans[i]);
	}
	pthread_mutex_unlock(&store->scans_lock);
	return sum;
}

long store_scans_of(struct store *store, const char *client)
{
	long count = 0;

	pthread_mutex_lock(&store->scans_lock);
	for (int i = 0; i < store->scan_count; i++)
		count += is_of(store->scans[i], client);
	pthread_mutex_unlock(&store->scans_lock);
	return count;
}

int store_check_scans(struct store *store, const char *client, struct error *err)
{
	const long most = store->limits.client_scans, own = most == 0 ? 0 : store_scans_of(store, client);

	if (most == 0 || own < most)
		return 0;
	return error_set(err, ERR_LIMIT, "scans of %.60s: %ld; one client may have %ld", client, own, most);
}

int store_check_size(struct store *store, unsigned long long bytes, struct error *err)
{
	const struct store_limits *limits = &store->limits;
	unsigned long long most = limits->client_bytes;

	if (most == 0 || (limits->bytes > 0 && limits->bytes < most))
		most = limits->bytes;
	if (most == 0 || bytes <= most)
		return 0;
	return error_set_at(err, ERR_IMPOSSIBLE, "/projections/count",
			    "the projections are %llu bytes, of which one may have %llu", bytes, most);
}

/* used: of what there is without `more`. */
static int check_bytes(const char *whose, unsigned long long used, unsigned long long more, unsigned long long most,
		       struct error *err)
{
	if (most == 0 || (used <= most && more <= most - used))
		return 0;
	return error_set(err, ERR_QUOTA, "%llu bytes more are too many for %.60s: %llu of %llu are taken", more, whose,
			 used, most);
}

int store_check_volumes(struct store *store, const char *client, unsigned long long more, struct error *err)
{
	const struct store_limits *limits = &store->limits;
	const unsigned long long all = store_volumes_most(limits), own = limits->client_bytes;
	unsigned long long used;
	int code = 0;

	/* A client that waits for room would wait for ever. */
	if ((all > 0 && more > all) || (own > 0 && more > own))
		return error_set_at(err, ERR_IMPOSSIBLE, "/grid",
				    "the job's volumes are %llu bytes, of which there may be %llu", more,
				    own > 0 && (all == 0 || own < all) ? own : all);
	if (own > 0)
		code = check_bytes(client, store_bytes(store, client), more, own, err);
	if (code != 0 || all == 0)
		return code;
	used = store_bytes(store, NULL);
	if (used > all || more > all - used)
		code = error_set(err, ERR_QUOTA,
				 "%llu bytes more are too many for volumes: %llu are taken, of the limit of %llu they "
				 "may have %llu; the rest is reserved for what is being acquired",
				 more, used, limits->bytes, all);
	return code;
}

/* Counts the scan's bytes from here on. ERR_QUOTA, and they are not counted: a limit has no room for them. */
static int count_room(struct stored_scan *scan, struct error *err)
{
	struct store *store = scan->store;
	const struct store_limits *limits = &store->limits;
	const unsigned long long more = all_projections(scan);
	unsigned long long own = 0, all = 0;
	bool counted;
	int code = 0;

	if (limits->client_bytes > 0)
		own = counted_bytes(store, scan->client);
	if (limits->bytes > 0)
		all = counted_bytes(store, NULL);
	pthread_mutex_lock(&store->scans_lock);
	counted = scan->has_room;
	for (int i = 0; i < store->scan_count && !counted; i++) {
		const unsigned long long room = room_of(store->scans[i]);

		all += room;
		own += is_of(store->scans[i], scan->client) ? room : 0;
	}
	if (!counted)
		code = check_bytes(scan->client, own, more, limits->client_bytes, err);
	if (!counted && code == 0)
		code = check_bytes("the daemon", all, more, limits->bytes, err);
	if (code == 0)
		scan->has_room = true;
	pthread_mutex_unlock(&store->scans_lock);
	return code;
}

int store_check_bytes(struct store *store, const char *client, unsigned long long more, struct error *err)
{
	const struct store_limits *limits = &store->limits;
	int code = 0;

	if (limits->client_bytes > 0)
		code = check_bytes(client, store_bytes(store, client), more, limits->client_bytes, err);
	if (code == 0 && limits->bytes > 0)
		code = check_bytes("the daemon", store_bytes(store, NULL), more, limits->bytes, err);
	return code;
}

int store_check_image_room(struct stored_scan *scan, enum image image, struct error *err)
{
	struct store *store = scan->store;
	/* The image is counted already. */
	int code = store_check_bytes(store, scan->client, 0, err);

	if (code != 0)
		error_set(err, code, "the %s of %zu bytes goes beyond a limit of bytes", image_kinds[image].title,
			  stored_image_bytes(scan, image));
	return code;
}

int stored_scan_take_room(struct stored_scan *scan, int descriptor, struct error *err)
{
	bool there;
	int code, result;

	pthread_mutex_lock(&scan->lock);
	there = scan->room;
	pthread_mutex_unlock(&scan->lock);
	if (there)
		return 0;
	code = count_room(scan, err);
	if (code != 0)
		return code;
	/* The C library's posix_fallocate would write where a file system has no such call, beside other writers. */
	do
		result = fallocate(descriptor, 0, 0, (off_t)all_projections(scan)) == 0 ? 0 : errno;
	while (result == EINTR);
	if (result != 0 && result != EOPNOTSUPP && result != ENOSYS) {
		pthread_mutex_lock(&scan->store->scans_lock);
		scan->has_room = false;
		pthread_mutex_unlock(&scan->store->scans_lock);
		return error_set_errno(err, result, "room for %llu bytes of projections", all_projections(scan));
	}
	pthread_mutex_lock(&scan->lock);
	scan->room = true;
	pthread_mutex_unlock(&scan->lock);
	return 0;
}

bool stored_scan_return_room(struct stored_scan *scan, int descriptor)
{
	bool unused;

	pthread_mutex_lock(&scan->lock);
	unused = scan->room && !scan->returning && scan->received == 0 && scan->lost_count == 0;
	for (int i = 0; i < scan->count && unused; i++)
		unused = scan->progress[i] == MISSING;
	if (unused) {
		scan->returning = true;
		scan->room = false;
	}
	pthread_mutex_unlock(&scan->lock);
	if (!unused)
		return false;
	/* Where a file system cannot do that the blocks stay until the scan goes, and count no more. */
	if (fallocate(descriptor, FALLOC_FL_PUNCH_HOLE | FALLOC_FL_KEEP_SIZE, 0, (off_t)all_projections(scan)) != 0)
		log_line(LEVEL_DEBUG, "scan %s: the room of what was refused is not given back: %s", scan->id,
			 strerror(errno));
	pthread_mutex_lock(&scan->store->scans_lock);
	scan->has_room = false;
	pthread_mutex_unlock(&scan->store->scans_lock);
	pthread_mutex_lock(&scan->lock);
	scan->returning = false;
	pthread_mutex_unlock(&scan->lock);
	return true;
}

/* ---- age ---- */

/* When the last of it came, by its file; or when it was announced. */
static double last_change(const struct stored_scan *scan, const struct scan_facts *facts)
{
	char directory[1024], path[1100];
	double changed = facts->created;
	struct stat status;

	store_scan_directory(scan->store, scan->id, directory);
	snprintf(path, sizeof(path), "%s/projections.sums", directory);
	if (stat(path, &status) == 0)
		changed = fmax(changed, (double)status.st_mtim.tv_sec);
	if (facts->asked > 0)
		changed = fmax(changed, clock_realtime() - (clock_monotonic() - facts->asked));
	return changed;
}

static bool is_unfinished(const struct scan_facts *facts)
{
	bool damaged = facts->lost > 0 || facts->document_damaged || facts->damaged;

	for (int image = 0; image < IMAGE_COUNT; image++)
		damaged |= facts->lost_image[image];
	damaged |= facts->scatter.lost > 0;
	return !facts->complete && !facts->closed && !damaged;
}

double stored_scan_kept_until(struct stored_scan *scan)
{
	const double keep = scan->store->limits.keep;
	struct scan_facts facts;

	if (keep == 0)
		return INFINITY;
	stored_scan_facts(scan, &facts);
	return is_unfinished(&facts) && !facts.pinned && !facts.deleted ? last_change(scan, &facts) + keep : INFINITY;
}
