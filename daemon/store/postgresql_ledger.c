/* The ledger of a fleet: store/ledger.h. Every call but the opening is one statement, and so one transaction. */
#include "daemon/store/ledger.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/store/postgresql_session.h"
#include "proto/json.h"

enum { FLEET_NAME_MAX = 32 };

struct ledger {
	struct pg_session session;
	char schema[PG_SCHEMA_SIZE];
	char host[LEDGER_NAME_SIZE], url[LEDGER_URL_SIZE];
	double lease;
};

/* ---- opening ---- */

static int check_name(const char *name, const char *what, size_t most, const char *letters, struct error *err)
{
	size_t length = strlen(name);

	if (length >= 1 && length <= most && strspn(name, letters) == length)
		return 0;
	return error_set(err, ERR_INVALID, "\"%.80s\" is no name of a %s: 1 to %zu of %s", name, what, most, letters);
}

int ledger_check(const struct ledger_options *options, struct error *err)
{
	int code = check_name(options->fleet, "fleet", FLEET_NAME_MAX, "abcdefghijklmnopqrstuvwxyz0123456789_", err);

	if (code == 0)
		code = check_name(options->host, "host", LEDGER_NAME_SIZE - 1,
				  "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_.-", err);
	if (code == 0 && strlen(options->url) >= LEDGER_URL_SIZE)
		code = error_set(err, ERR_INVALID, "an address of this daemon has at most %d characters",
				 LEDGER_URL_SIZE - 1);
	if (code == 0 && strncmp(options->database, "postgresql://", 13) != 0)
		code = error_set(err, ERR_INVALID, "a fleet's database is postgresql://...");
	return code == 0 ? session_check(options->database, err) : code;
}

/* One daemon at a time makes what is missing: CREATE ... IF NOT EXISTS of two sessions may collide. */
static int make_tables(struct ledger *ledger, struct error *err)
{
	char sql[2000];
	struct error ignored;
	int code;

	snprintf(sql, sizeof(sql),
		 "BEGIN; SELECT pg_advisory_xact_lock(hashtextextended('%s', 1));"
		 "CREATE SCHEMA IF NOT EXISTS %s;"
		 "CREATE SEQUENCE IF NOT EXISTS claims;"
		 "CREATE TABLE IF NOT EXISTS hosts (name text PRIMARY KEY, url text NOT NULL,"
		 " seen timestamptz NOT NULL);"
		 "CREATE TABLE IF NOT EXISTS offers (owner text NOT NULL, job text NOT NULL, priority bigint NOT NULL,"
		 " rank bigint NOT NULL, since timestamptz NOT NULL DEFAULT now(), taker text, number bigint,"
		 " until timestamptz, PRIMARY KEY (owner, job));"
		 /* Of a ledger that was made before jobs said where they may run. */
		 "ALTER TABLE offers ADD COLUMN IF NOT EXISTS host text NOT NULL DEFAULT '',"
		 " ADD COLUMN IF NOT EXISTS memory double precision NOT NULL DEFAULT 0,"
		 " ADD COLUMN IF NOT EXISTS devices bigint NOT NULL DEFAULT 0;"
		 "ALTER TABLE hosts ADD COLUMN IF NOT EXISTS changes bigint NOT NULL DEFAULT 0,"
		 " ADD COLUMN IF NOT EXISTS memory text NOT NULL DEFAULT '{}',"
		 " ADD COLUMN IF NOT EXISTS rates text NOT NULL DEFAULT '';"
		 "CREATE TABLE IF NOT EXISTS homes (id text COLLATE \"C\" PRIMARY KEY, owner text NOT NULL);"
		 "CREATE INDEX IF NOT EXISTS homes_of ON homes (owner);"
		 "COMMIT",
		 ledger->schema, ledger->schema);
	code = session_execute(&ledger->session, sql, NULL, err);
	if (code != 0)
		session_execute(&ledger->session, "ROLLBACK", NULL, &ignored);
	return code;
}

static int note_truth(void *context, const struct value *values, struct error *err)
{
	(void)err;
	*(bool *)context = values[0].integer != 0;
	return 0;
}

static struct value text_value(const char *text)
{
	return (struct value){.type = VALUE_TEXT, .bytes = text, .size = strlen(text)};
}

static struct value integer_value(long long integer)
{
	return (struct value){.type = VALUE_INTEGER, .integer = integer};
}

static struct value seconds_value(double seconds)
{
	return (struct value){.type = VALUE_REAL, .real = seconds};
}

/* Held as long as the session lives: a name stands for one daemon. */
static int lock_host(struct ledger *ledger, struct error *err)
{
	const struct value values[] = {text_value(ledger->schema), text_value(ledger->host)};
	bool locked = false;
	int code = session_run(&ledger->session,
			       "SELECT pg_try_advisory_lock(hashtextextended($1::text || ' ' || $2::text, 2))", values,
			       2, note_truth, &locked, err);

	return code == 0 && !locked
		   ? error_set(err, ERR_CONFLICT, "another daemon is host \"%s\" of the fleet", ledger->host)
		   : code;
}

static int join(struct ledger *ledger, struct error *err)
{
	char sql[PG_SCHEMA_SIZE + 16];
	int code = make_tables(ledger, err);

	if (code == 0)
		code = lock_host(ledger, err);
	snprintf(sql, sizeof(sql), "LISTEN %s", ledger->schema);
	if (code == 0)
		code = session_execute(&ledger->session, sql, NULL, err);
	return code == 0 ? ledger_seen(ledger, NULL, 0, "", err) : code;
}

int ledger_open(const struct ledger_options *options, struct ledger **ret_ledger, struct error *err)
{
	char name[LEDGER_NAME_SIZE + 16];
	struct ledger *ledger;
	int code = ledger_check(options, err);

	if (code != 0)
		return code;
	ledger = calloc(1, sizeof(*ledger));
	if (ledger == NULL)
		return error_set_errno(err, ENOMEM, "ledger");
	snprintf(ledger->schema, sizeof(ledger->schema), "cbctd_fleet_%s", options->fleet);
	snprintf(ledger->host, sizeof(ledger->host), "%s", options->host);
	snprintf(ledger->url, sizeof(ledger->url), "%s", options->url);
	ledger->lease = options->lease;
	ledger->session.timeout = options->timeout;
	snprintf(ledger->session.listener, sizeof(ledger->session.listener), "%s", options->host);
	snprintf(name, sizeof(name), "cbctd host %s", ledger->host);
	code = session_open(&ledger->session, options->database, name, ledger->schema, err);
	if (code == 0)
		code = join(ledger, err);
	if (code != 0) {
		ledger_close(ledger);
		return code;
	}
	*ret_ledger = ledger;
	return 0;
}

void ledger_close(struct ledger *ledger)
{
	if (ledger == NULL)
		return;
	session_close(&ledger->session);
	free(ledger);
}

enum { ARRAY_SIZE = WHERE_DEVICES_MOST * 24 + 3 };

/* As PostgreSQL writes an array. */
static void print_array(const double *numbers, int count, char ret_text[ARRAY_SIZE])
{
	size_t length = (size_t)snprintf(ret_text, ARRAY_SIZE, "{");

	for (int i = 0; i < count && i < WHERE_DEVICES_MOST; i++)
		length +=
		    (size_t)snprintf(ret_text + length, ARRAY_SIZE - length, "%s%.0f", i > 0 ? "," : "", numbers[i]);
	snprintf(ret_text + length, ARRAY_SIZE - length, "}");
}

static int read_array(const char *text, double ret_numbers[WHERE_DEVICES_MOST])
{
	int count = 0;
	char *end;

	for (const char *at = text; (*at == '{' || *at == ',') && count < WHERE_DEVICES_MOST; at = end) {
		const double number = strtod(at + 1, &end);

		if (end == at + 1)
			break;
		ret_numbers[count++] = number;
	}
	return count;
}

int ledger_seen(struct ledger *ledger, const double *memory, int count, const char *rates, struct error *err)
{
	struct value values[] = {text_value(ledger->host), text_value(ledger->url), text_value(""), text_value(rates)};
	char array[ARRAY_SIZE];

	print_array(memory, count, array);
	values[2] = text_value(array);
	return session_run(&ledger->session,
			   "INSERT INTO hosts (name, url, seen, memory, rates)"
			   " VALUES ($1::text, $2::text, now(), $3::text, $4::text)"
			   " ON CONFLICT (name) DO UPDATE SET url = excluded.url, seen = excluded.seen,"
			   " memory = excluded.memory,"
			   " rates = CASE WHEN excluded.rates = '' THEN hosts.rates ELSE excluded.rates END",
			   values, 4, NULL, NULL, err);
}

/* ---- claims as rows ---- */

#define CLAIM_COLUMNS(offers) offers ".owner, " offers ".taker, " offers ".job, " offers ".priority, " offers ".number"

struct claims {
	struct fleet_claim *claims;
	int most, count;
};

static int note_claim(void *context, const struct value *values, struct error *err)
{
	struct claims *claims = context;
	struct fleet_claim *claim = &claims->claims[claims->count];

	(void)err;
	if (claims->count == claims->most)
		return 0;
	*claim = (struct fleet_claim){.priority = (int)values[3].integer, .number = values[4].integer};
	snprintf(claim->owner, sizeof(claim->owner), "%s", (const char *)values[0].bytes);
	snprintf(claim->taker, sizeof(claim->taker), "%s", (const char *)values[1].bytes);
	snprintf(claim->job, sizeof(claim->job), "%s", (const char *)values[2].bytes);
	snprintf(claim->url, sizeof(claim->url), "%s", (const char *)values[5].bytes);
	claim->lapsed = values[6].integer != 0;
	claims->count++;
	return 0;
}

/* who: the one host that this is news for; "": all of them. */
static int tell(struct ledger *ledger, const char *who, struct error *err)
{
	char sql[PG_SCHEMA_SIZE + LEDGER_NAME_SIZE + 16];

	snprintf(sql, sizeof(sql), "NOTIFY %s, '%s'", ledger->schema, who);
	return session_execute(&ledger->session, sql, NULL, err);
}

/* For whom an offer's change is news. */
struct news {
	char who[LEDGER_NAME_SIZE]; /* with one: that host */
	int count;                  /* hosts; more than one: all */
};

static int note_news(void *context, const struct value *values, struct error *err)
{
	struct news *news = context;
	const char *who = values[0].bytes;

	(void)err;
	news->count += who[0] == '\0' ? 2 : news->count == 0 || strcmp(news->who, who) != 0;
	snprintf(news->who, sizeof(news->who), "%s", who);
	return 0;
}

static int note_change(void *context, const struct value *values, struct error *err)
{
	(void)values;
	(void)err;
	*(bool *)context = true;
	return 0;
}

/* ---- which host has what ---- */

int ledger_tell(struct ledger *ledger, const char (*ids)[ID_SIZE], int count, struct error *err)
{
	struct value values[] = {text_value(ledger->host), text_value("")};
	cJSON *list = cJSON_CreateArray();
	char *text;
	int code;

	for (int i = 0; i < count; i++)
		json_append(list, cJSON_CreateString(ids[i]));
	text = list == NULL || cJSON_GetArraySize(list) != count ? NULL : json_print(list, NULL);
	cJSON_Delete(list);
	if (text == NULL)
		return error_set_errno(err, ENOMEM, "list of %d ids", count);
	values[1] = text_value(text);
	code = session_run(&ledger->session,
			   "WITH mine AS (SELECT value AS id FROM json_array_elements_text($2::json)),"
			   " gone AS (DELETE FROM homes WHERE owner = $1::text AND id NOT IN (SELECT id FROM mine)"
			   " RETURNING id),"
			   " there AS (INSERT INTO homes (id, owner) SELECT id, $1::text FROM mine"
			   " ON CONFLICT (id) DO UPDATE SET owner = excluded.owner"
			   " WHERE homes.owner <> excluded.owner RETURNING id)"
			   " UPDATE hosts SET changes = changes + 1 WHERE name = $1::text"
			   " AND (EXISTS (SELECT 1 FROM gone) OR EXISTS (SELECT 1 FROM there))",
			   values, 2, NULL, NULL, err);
	free(text);
	return code;
}

struct hosts {
	struct fleet_host *hosts;
	int most, count;
};

static int note_host(void *context, const struct value *values, struct error *err)
{
	struct hosts *hosts = context;
	struct fleet_host *host = &hosts->hosts[hosts->count];

	(void)err;
	if (hosts->count == hosts->most)
		return 0;
	*host = (struct fleet_host){.changes = values[2].integer, .away = values[3].integer != 0};
	snprintf(host->name, sizeof(host->name), "%s", (const char *)values[0].bytes);
	snprintf(host->url, sizeof(host->url), "%s", (const char *)values[1].bytes);
	host->unseen = values[4].real;
	host->devices = read_array(values[5].bytes, host->memory);
	snprintf(host->rates, sizeof(host->rates), "%s", (const char *)values[6].bytes);
	hosts->count++;
	return 0;
}

int ledger_hosts(struct ledger *ledger, struct fleet_host *ret_hosts, int most, int *ret_count, struct error *err)
{
	const struct value values[] = {text_value(ledger->host), seconds_value(ledger->lease)};
	struct hosts hosts = {.hosts = ret_hosts, .most = most};
	int code = session_run(&ledger->session,
			       "SELECT name, url, changes, CASE WHEN seen > now() - $2::float8 * interval '1 second'"
			       " THEN 0::bigint ELSE 1 END, extract(epoch FROM now() - seen)::float8, memory, rates"
			       " FROM hosts WHERE name <> $1::text ORDER BY seen DESC",
			       values, 2, note_host, &hosts, err);

	*ret_count = hosts.count;
	return code;
}

struct ids {
	char (*ids)[ID_SIZE];
	int count;
};

static int note_id(void *context, const struct value *values, struct error *err)
{
	struct ids *ids = context;

	(void)err;
	if (ids->count < HOMES_MOST)
		snprintf(ids->ids[ids->count++], ID_SIZE, "%s", (const char *)values[0].bytes);
	return 0;
}

int ledger_homes(struct ledger *ledger, const char *host, char (*ret_ids)[ID_SIZE], int *ret_count, struct error *err)
{
	const struct value values[] = {text_value(host)};
	struct ids ids = {.ids = ret_ids};
	int code = session_run(&ledger->session, "SELECT id FROM homes WHERE owner = $1::text ORDER BY id", values, 1,
			       note_id, &ids, err);

	*ret_count = ids.count;
	return code;
}

/* ---- the calls ---- */

static char *print_offers(const struct offer *offers, int count)
{
	cJSON *list = cJSON_CreateArray();
	char *text;

	for (int i = 0; i < count; i++) {
		cJSON *row = cJSON_CreateObject();

		cJSON_AddStringToObject(row, "job", offers[i].job);
		cJSON_AddNumberToObject(row, "priority", offers[i].priority);
		cJSON_AddNumberToObject(row, "rank", offers[i].rank);
		cJSON_AddStringToObject(row, "host", offers[i].where.host);
		cJSON_AddNumberToObject(row, "memory", offers[i].where.memory);
		cJSON_AddNumberToObject(row, "devices", (double)offers[i].where.devices);
		json_append(list, row);
	}
	text = list == NULL || cJSON_GetArraySize(list) != count ? NULL : json_print(list, NULL);
	cJSON_Delete(list);
	return text;
}

int ledger_offer(struct ledger *ledger, const struct offer *offers, int count, struct error *err)
{
	struct value values[] = {text_value(ledger->host), text_value("")};
	char *text = print_offers(offers, count);
	struct news news = {.count = 0};
	int code;

	if (text == NULL)
		return error_set_errno(err, ENOMEM, "list of %d offers", count);
	values[1] = text_value(text);
	code =
	    session_run(&ledger->session,
			"WITH mine AS (SELECT * FROM json_to_recordset($2::json)"
			" AS row (job text, priority bigint, rank bigint, host text, memory float8, devices bigint)),"
			" gone AS (DELETE FROM offers WHERE owner = $1::text AND job NOT IN (SELECT job FROM mine)"
			" RETURNING taker),"
			" there AS (INSERT INTO offers (owner, job, priority, rank, host, memory, devices)"
			" SELECT $1::text, job, priority, rank, host, memory, devices FROM mine"
			" ON CONFLICT (owner, job) DO UPDATE SET priority = excluded.priority, rank = excluded.rank"
			" WHERE (offers.priority, offers.rank) IS DISTINCT FROM (excluded.priority, excluded.rank)"
			/* A row that was updated has been locked by this statement: it was no new one. */
			" RETURNING xmax) SELECT ''::text FROM there WHERE xmax = 0"
			" UNION SELECT taker FROM gone WHERE taker IS NOT NULL",
			values, 2, note_news, &news, err);
	free(text);
	return code == 0 && news.count > 0 ? tell(ledger, news.count == 1 ? news.who : "", err) : code;
}

int ledger_claimed(struct ledger *ledger, struct fleet_claim *ret_claims, int most, int *ret_count, struct error *err)
{
	const struct value values[] = {text_value(ledger->host)};
	struct claims claims = {.claims = ret_claims, .most = most};
	int code = session_run(&ledger->session,
			       "SELECT " CLAIM_COLUMNS("o") ", h.url, CASE WHEN o.until <= now() THEN 1::bigint ELSE 0 "
							    "END FROM offers o JOIN hosts h ON h.name = o.taker"
							    " WHERE o.owner = $1::text ORDER BY o.number",
			       values, 1, note_claim, &claims, err);

	*ret_count = claims.count;
	return code;
}

int ledger_claim(struct ledger *ledger, int least, double age, const double *memory, int devices,
		 struct fleet_claim *ret_claim, bool *ret_got, struct error *err)
{
	char array[ARRAY_SIZE];
	struct value values[] = {text_value(ledger->host), integer_value(least), seconds_value(ledger->lease),
				 seconds_value(age), text_value("")};
	struct claims claims = {.claims = ret_claim, .most = 1};
	int code;

	print_array(memory, devices, array);
	values[4] = text_value(array);
	code = session_run(
	    &ledger->session,
	    "WITH first AS (SELECT o.owner, o.job FROM offers o JOIN hosts h ON h.name = o.owner"
	    " WHERE (o.until IS NULL OR o.until <= now()) AND o.owner <> $1::text AND o.priority >= $2::bigint"
	    " AND o.since <= now() - $4::float8 * interval '1 second'"
	    " AND h.seen > now() - $3::float8 * interval '1 second'"
	    " AND o.host IN ('', $1::text) AND (o.memory = 0 AND o.devices <= 1 OR (SELECT count(*)"
	    " FROM unnest($5::float8[]) AS bytes WHERE bytes >= o.memory) >= greatest(o.devices, 1))"
	    " ORDER BY o.priority DESC, o.rank, o.since FOR UPDATE OF o SKIP LOCKED LIMIT 1)"
	    " UPDATE offers SET taker = $1::text, number = nextval('claims'),"
	    " until = now() + $3::float8 * interval '1 second'"
	    " FROM first, hosts WHERE offers.owner = first.owner AND offers.job = first.job AND hosts.name = $1::text"
	    " RETURNING " CLAIM_COLUMNS("offers") ", hosts.url, 0::bigint",
	    values, 5, note_claim, &claims, err);

	*ret_got = claims.count > 0;
	return code == 0 && *ret_got ? tell(ledger, ret_claim->owner, err) : code;
}

int ledger_renew(struct ledger *ledger, struct fleet_claim *ret_claims, int most, int *ret_count, struct error *err)
{
	const struct value values[] = {text_value(ledger->host), seconds_value(ledger->lease)};
	struct claims claims = {.claims = ret_claims, .most = most};
	int code = session_run(&ledger->session,
			       "UPDATE offers SET until = now() + $2::float8 * interval '1 second' FROM hosts"
			       " WHERE taker = $1::text AND hosts.name = $1::text"
			       " AND EXISTS (SELECT 1 FROM hosts owners WHERE owners.name = offers.owner"
			       " AND owners.seen > now() - 20 * $2::float8 * interval '1 second')"
			       " RETURNING " CLAIM_COLUMNS("offers") ", hosts.url, 0::bigint",
			       values, 2, note_claim, &claims, err);

	*ret_count = claims.count;
	return code;
}

int ledger_give_back(struct ledger *ledger, const struct fleet_claim *claim, double pause, bool *ret_had,
		     struct error *err)
{
	const struct value values[] = {text_value(claim->owner), text_value(claim->job), integer_value(claim->number),
				       seconds_value(pause)};
	int code;

	*ret_had = false;
	code = session_run(&ledger->session,
			   "UPDATE offers SET taker = NULL, number = NULL,"
			   " until = now() + $4::float8 * interval '1 second' WHERE owner = $1::text"
			   " AND job = $2::text AND number = $3::bigint RETURNING job",
			   values, 4, note_change, ret_had, err);
	return code == 0 && *ret_had ? tell(ledger, "", err) : code;
}

int ledger_wait(struct ledger *ledger, int descriptor, double seconds, struct error *err)
{
	return session_wait(&ledger->session, descriptor, seconds, err);
}
