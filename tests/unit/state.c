/* A state directory of its own for each test: state.h. */
#include "tests/unit/state.h"

#include <check.h>
#include <fcntl.h>
#include <ftw.h>
#include <openssl/evp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "daemon/log.h"
#include "proto/scan_directory.h"

static void count_failure(void *context, const char *what)
{
	struct state *state = context;

	(void)what;
	state->failures++;
}

struct store_options state_options(struct state *state)
{
	return (struct store_options){
	    .context = state, .failed = count_failure, .catalogue = getenv("CBCT_TEST_CATALOGUE")};
}

const char *state_catalogue(void)
{
	return getenv("CBCT_TEST_CATALOGUE") == NULL ? "catalogue.sqlite" : "catalogue.postgresql";
}

bool state_skips(const char *test)
{
	if (getenv("CBCT_TEST_CATALOGUE") == NULL)
		return false;
	printf("SKIP unit %s: it is about SQLite's own files\n", test);
	return true;
}

static void open_again(struct state *state)
{
	const struct store_options options = state_options(state);
	struct error err = {0};

	ck_assert_msg(store_open(state->directory, &options, &state->store, &err) == 0, "%s", err.text);
	ck_assert_msg(jobs_open(state->store, &state->jobs, &err) == 0, "%s", err.text);
}

void state_open(struct state *state)
{
	const char *where = getenv("TMPDIR");

	*state = (struct state){0};
	log_set_level(LEVEL_ERROR);
	snprintf(state->directory, sizeof(state->directory), "%s/cbct-state-XXXXXX", where != NULL ? where : "/tmp");
	ck_assert_ptr_nonnull(mkdtemp(state->directory));
	open_again(state);
}

void state_close(struct state *state)
{
	jobs_close(state->jobs);
	store_close(state->store);
	state->jobs = NULL;
	state->store = NULL;
}

void state_reopen(struct state *state)
{
	state_close(state);
	open_again(state);
}

static int remove_one(const char *path, const struct stat *status, int kind, struct FTW *where)
{
	(void)status;
	(void)kind;
	(void)where;
	return remove(path);
}

void state_remove(struct state *state)
{
	state_close(state);
	nftw(state->directory, remove_one, 16, FTW_DEPTH | FTW_PHYS);
}

const char *state_path(const struct state *state, const char *format, ...)
{
	static char path[1024];
	size_t length = (size_t)snprintf(path, sizeof(path), "%s/", state->directory);
	va_list args;

	va_start(args, format);
	vsnprintf(path + length, sizeof(path) - length, format, args);
	va_end(args);
	return path;
}

bool path_exists(const char *path)
{
	return access(path, F_OK) == 0;
}

void path_fill(const char *path)
{
	struct error err = {0};

	ck_assert_msg(file_write_durable(path, "something", 9, &err) == 0, "%s", err.text);
}

struct stored_scan *state_scan(struct state *state, int count, bool intensity)
{
	struct stored_scan *stored = NULL;
	struct scan *scan = NULL;
	struct error err = {0};
	char text[512];

	snprintf(text, sizeof(text),
		 "{\"name\": \"a scan\", \"detector\": {\"columns\": 4, \"rows\": 3, \"pixel_mm\": [10, 10]},"
		 " \"projections\": {\"count\": %d, \"sample\": \"float32\", \"quantity\": \"%s\"},"
		 " \"geometry\": {\"kind\": \"circular\", \"source_to_isocentre_mm\": 600,"
		 " \"source_to_detector_mm\": 1100, \"first_angle_deg\": 0, \"angle_step_deg\": %.17g}}",
		 count, intensity ? "intensity" : "line_integral", 360.0 / count);
	ck_assert_msg(scan_parse(text, strlen(text), &scan, &err) == 0, "%s", err.text);
	ck_assert_msg(store_scan_create(state->store, scan, "somebody", NULL, &stored, &err) == 0, "%s", err.text);
	return stored;
}

void state_digest(int mark, uint8_t ret_sha256[32])
{
	float pixels[12] = {(float)mark};

	EVP_Digest(pixels, sizeof(pixels), ret_sha256, NULL, EVP_sha256(), NULL);
}

void state_put(struct state *state, struct stored_scan *scan, int first, int last, int mark)
{
	struct received_projection batch[64];
	struct error err = {0};
	float pixels[12] = {(float)mark};
	enum claim claim;
	int file, sums, count = last - first + 1;

	ck_assert_int_le(count, 64);
	ck_assert_int_eq(stored_scan_open(scan, true, &file, &err), 0);
	ck_assert_int_eq(stored_scan_open_sums(scan, &sums, &err), 0);
	for (int i = 0; i < count; i++) {
		ck_assert_int_eq(stored_scan_claim(scan, first + i, &claim, &err), 0);
		ck_assert_int_eq(claim, CLAIM_GRANTED);
		ck_assert_int_eq(pwrite(file, pixels, sizeof(pixels), (off_t)sizeof(pixels) * (first + i)),
				 (ssize_t)sizeof(pixels));
		batch[i] = (struct received_projection){.scan = scan, .index = first + i};
		batch[i].sum.crc = checksum(0, pixels, sizeof(pixels));
		batch[i].sum.bytes = sizeof(pixels);
		state_digest(mark, batch[i].sum.sha256);
		ck_assert_int_eq(stored_scan_put_sum(&batch[i], sums, (uint64_t)++state->turns, &err), 0);
	}
	ck_assert_int_eq(fdatasync(file), 0);
	ck_assert_int_eq(fdatasync(sums), 0);
	close(file);
	close(sums);
	ck_assert_msg(store_put_projections(state->store, batch, count, &err) == 0, "%s", err.text);
	for (int i = 0; i < count; i++)
		ck_assert(batch[i].stored);
}

struct job *state_post(struct state *state, struct stored_scan *scan, const char *priority)
{
	struct job_request request;
	struct error err = {0};
	struct job *job = NULL;
	char text[512];
	bool new;

	snprintf(text, sizeof(text),
		 "{\"scan\": \"%s\", \"grid\": {\"size\": [4, 4, 4], \"spacing_mm\": [5, 5, 5]}, \"fdk\": {},"
		 " \"sart\": {\"iterations\": 2, \"subsets\": 1}, \"priority\": \"%s\"}",
		 stored_scan_id(scan), priority);
	ck_assert_msg(job_request_parse(text, strlen(text), &request, &err) == 0, "%s", err.text);
	ck_assert_msg(job_request_resolve(&request, stored_scan_parsed(scan), &err) == 0, "%s", err.text);
	ck_assert_msg(jobs_post(state->jobs, &request, scan, NULL, "somebody", NULL, NULL, &job, &new, &err) == 0, "%s",
		      err.text);
	ck_assert(new);
	job_request_clear(&request);
	return job;
}

enum job_state state_of(struct job *job)
{
	struct job_facts facts;

	job_facts(job, &facts);
	return facts.state;
}

void state_set(struct job *job, enum job_state to, const struct job_change *change)
{
	struct error err = {0};

	ck_assert_msg(job_set_state(job, to, change, &err) == 0, "%s", err.text);
}
