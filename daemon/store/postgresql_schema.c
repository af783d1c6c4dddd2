/* The schema's name and lock: postgresql_schema.h. */
#include "daemon/store/postgresql_schema.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <time.h>
#include <unistd.h>

#include "proto/clock.h"
#include "proto/scan_directory.h"

static const double OPEN_PATIENCE = 10; /* s that a start waits for the session before it to end */

/* ---- its name ---- */

static void schema_path(const struct catalogue_site *site, char ret_path[1024])
{
	snprintf(ret_path, 1024, "%s/%s", site->directory, SCHEMA_FILE);
}

int schema_read(const struct catalogue_site *site, char ret_schema[PG_SCHEMA_SIZE], struct error *err)
{
	char path[1024], *text = NULL;
	size_t length;
	int code;

	schema_path(site, path);
	code = file_read(path, PG_SCHEMA_SIZE - 1, &text, &length, err);
	if (code != 0)
		return code;
	length = strcspn(text, "\n");
	if (strncmp(text, "cbctd_", 6) == 0 && strspn(text + 6, "0123456789abcdef") == 12 && length == 18)
		snprintf(ret_schema, PG_SCHEMA_SIZE, "%.18s", text);
	else
		code = error_set(err, ERR_DAMAGED, "%.200s does not name a schema", path);
	free(text);
	return code;
}

int schema_random(char *ret_digits, size_t count, struct error *err)
{
	unsigned char bytes[16];

	if (getrandom(bytes, sizeof(bytes), 0) != sizeof(bytes))
		return error_set_errno(err, errno, "random numbers");
	for (size_t i = 0; 2 * i < count; i++)
		snprintf(ret_digits + 2 * i, 3, "%02x", bytes[i]);
	return 0;
}

int schema_name(const struct catalogue_site *site, char ret_schema[PG_SCHEMA_SIZE], struct error *err)
{
	int code = schema_read(site, ret_schema, err);
	char path[1024], line[PG_SCHEMA_SIZE + 1];

	if (code != ERR_NOT_FOUND)
		return code;
	snprintf(ret_schema, PG_SCHEMA_SIZE, "cbctd_");
	code = schema_random(ret_schema + 6, 12, err);
	schema_path(site, path);
	snprintf(line, sizeof(line), "%s\n", ret_schema);
	return code == 0 ? file_write_durable(path, line, strlen(line), err) : code;
}

void schema_forget(const struct catalogue_site *site)
{
	char path[1024];

	schema_path(site, path);
	unlink(path);
}

/* ---- its lock ---- */

static int note_truth(void *context, const struct value *values, struct error *err)
{
	long long *truth = context;

	(void)err;
	*truth = values[0].integer;
	return 0;
}

int schema_try_lock(struct pg_session *session, const char *schema, long long *ret_locked, struct error *err)
{
	char sql[160];

	snprintf(sql, sizeof(sql), "SELECT pg_try_advisory_lock(hashtextextended('%s', 0))", schema);
	return session_ask(session, sql, note_truth, ret_locked, err);
}

int schema_lock(struct pg_session *session, const char *schema, struct error *err)
{
	double until = clock_monotonic() + OPEN_PATIENCE;
	long long locked = 0;
	int code = schema_try_lock(session, schema, &locked, err);

	while (code == 0 && !locked && clock_monotonic() < until) {
		nanosleep(&(const struct timespec){.tv_nsec = 20000000}, NULL);
		code = schema_try_lock(session, schema, &locked, err);
	}
	return code == 0 && !locked
		   ? error_set(err, ERR_CONFLICT, "the catalogue %s is in use by another cbctd", schema)
		   : code;
}
