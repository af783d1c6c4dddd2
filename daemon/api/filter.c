/* ?state=, ?scan=, ?priority=, ?label= and ?text= of the lists: filter.h. */
#include "daemon/api/filter.h"

#include <stdio.h>
#include <string.h>

#include "proto/json.h"

enum { TEXT_MOST = 200 };
static const char *const scan_states[] = {"receiving", "complete"};

/* Whether the list "a,b" has the name. */
static bool has_name(const char *list, const char *name)
{
	size_t length = strlen(name);

	for (const char *at = list; at != NULL; at = strchr(at, ',')) {
		at += *at == ',';
		if (strncmp(at, name, length) == 0 && (at[length] == ',' || at[length] == '\0'))
			return true;
	}
	return false;
}

/* Each name of the list "a,b" must be one of names[count]. */
static int check_names(const char *what, const char *list, const char *const *names, int count, struct error *err)
{
	char known[160] = "";

	for (int i = 0; i < count; i++) {
		size_t length = strlen(known);

		snprintf(known + length, sizeof(known) - length, "%s%s", i > 0 ? ", " : "", names[i]);
	}
	for (const char *at = list; at != NULL; at = strchr(at, ',')) {
		size_t length;
		int i = 0;

		at += at != list;
		length = strcspn(at, ",");
		while (i < count && (strlen(names[i]) != length || strncmp(at, names[i], length) != 0))
			i++;
		if (i == count)
			return error_set(err, ERR_INVALID,
					 "%s is \"%.60s\", expected one or more of %s with commas between", what, list,
					 known);
	}
	return 0;
}

/* Of UTF-8: bytes that continue a character are none of their own. */
static size_t characters_of(const char *text)
{
	size_t count = 0;

	for (; *text != '\0'; text++)
		count += ((unsigned char)*text & 0xc0) != 0x80;
	return count;
}

static int read_common(struct request *request, struct filter *ret, struct error *err)
{
	ret->state = request_query(request, "state");
	ret->label = request_query(request, "label");
	ret->text = request_query(request, "text");
	if (ret->text != NULL && characters_of(ret->text) > TEXT_MOST)
		return error_set(err, ERR_INVALID, "text has %zu characters, expected at most %d",
				 characters_of(ret->text), TEXT_MOST);
	if (ret->label != NULL && (ret->label[0] == '\0' || ret->label[0] == '='))
		return error_set(err, ERR_INVALID, "label is \"%.60s\", expected a name, or NAME=VALUE", ret->label);
	return 0;
}

int filter_read_jobs(struct request *request, struct filter *ret, struct error *err)
{
	*ret = (struct filter){.scan = request_query(request, "scan"), .priority = request_query(request, "priority")};
	if (read_common(request, ret, err) != 0 ||
	    check_names("state", ret->state, job_state_names, JOB_STATE_COUNT, err) != 0 ||
	    check_names("priority", ret->priority, priority_names, PRIORITY_COUNT, err) != 0)
		return err->code;
	if (ret->scan != NULL && !id_valid(ret->scan))
		return error_set(err, ERR_INVALID, "scan is \"%.40s\", expected an id", ret->scan);
	return 0;
}

int filter_read_scans(struct request *request, struct filter *ret, struct error *err)
{
	*ret = (struct filter){0};
	return read_common(request, ret, err) != 0 || check_names("state", ret->state, scan_states, 2, err) != 0
		   ? err->code
		   : 0;
}

/* A letter of ASCII or, behind its first byte in UTF-8, of Latin-1, as a small one. */
static int small(const char *at, bool latin)
{
	unsigned char byte = (unsigned char)*at;

	if (byte >= 'A' && byte <= 'Z')
		return byte + 32;
	return latin && byte >= 0x80 && byte <= 0x9e && byte != 0x97 ? byte + 32 : byte;
}

static bool begins(const char *at, const char *part)
{
	bool latin = false;

	for (; *part != '\0'; at++, part++) {
		if (*at == '\0' || small(at, latin) != small(part, latin))
			return false;
		latin = (unsigned char)*part == 0xc3;
	}
	return true;
}

static bool contains(const char *text, const char *part)
{
	do {
		if (begins(text, part))
			return true;
	} while (*text++ != '\0');
	return false;
}

/* Whether labels has NAME, or NAME with that value. */
static bool has_label(const cJSON *labels, const char *wanted)
{
	const cJSON *label;

	cJSON_ArrayForEach(label, labels)
	{
		size_t length = strlen(label->string);

		if (strcmp(wanted, label->string) == 0)
			return true;
		if (strncmp(wanted, label->string, length) == 0 && wanted[length] == '=' && cJSON_IsString(label) &&
		    strcmp(wanted + length + 1, label->valuestring) == 0)
			return true;
	}
	return false;
}

static bool says(const cJSON *labels, const char *text)
{
	const cJSON *label;

	cJSON_ArrayForEach(label, labels)
	{
		if (cJSON_IsString(label) && contains(label->valuestring, text))
			return true;
	}
	return false;
}

/* The text in a list of texts that ends with NULL, or in the labels. */
static bool found(const char *const *texts, const cJSON *labels, const char *text)
{
	for (; *texts != NULL; texts++) {
		if (contains(*texts, text))
			return true;
	}
	return says(labels, text);
}

/* NULL: the scan has gone, cannot be read, or has none. */
static const cJSON *labels_of(struct stored_scan *scan)
{
	const struct scan *parsed = scan != NULL ? stored_scan_parsed(scan) : NULL;

	return parsed != NULL ? cJSON_GetObjectItemCaseSensitive(parsed->document, "labels") : NULL;
}

/* What only the labels and names tell, of the job or of its scan. */
static bool fits_words(struct api *api, const struct filter *filter, struct job *job, const struct job_facts *facts)
{
	const struct job_request *asked = NULL;
	struct stored_scan *scan = NULL;
	struct scan_facts named = {0};
	struct error err = {0};
	cJSON *own = NULL;
	bool fits;

	if (job_request(job, &asked, &err) == 0 && asked->labels != NULL)
		own = cJSON_Parse(asked->labels);
	json_missing_for(&err);
	if (store_scan_find(api->store, facts->scan, &scan, &err) == 0)
		stored_scan_facts(scan, &named);
	json_missing_for(&err);
	fits = filter->label == NULL || has_label(own, filter->label) || has_label(labels_of(scan), filter->label);
	if (fits && filter->text != NULL)
		fits = found((const char *const[]){facts->id, facts->scan, named.name, NULL}, own, filter->text) ||
		       says(labels_of(scan), filter->text);
	cJSON_Delete(own);
	stored_scan_release(scan);
	return fits;
}

bool filter_fits_job(struct api *api, const struct filter *filter, struct job *job)
{
	struct job_facts facts;

	job_facts(job, &facts);
	if ((filter->state != NULL && !has_name(filter->state, job_state_names[facts.state])) ||
	    (filter->priority != NULL && !has_name(filter->priority, priority_names[facts.priority])) ||
	    (filter->scan != NULL && strcmp(filter->scan, facts.scan) != 0))
		return false;
	return (filter->label == NULL && filter->text == NULL) || fits_words(api, filter, job, &facts);
}

bool filter_fits_scan(struct api *api, const struct filter *filter, struct stored_scan *scan)
{
	struct stored_scan *read = NULL;
	struct scan_facts facts;
	struct error err;
	bool fits;

	stored_scan_facts(scan, &facts);
	if (filter->state != NULL && !has_name(filter->state, scan_states[facts.complete]))
		return false;
	if (filter->label == NULL && filter->text == NULL)
		return true;
	/* A reference of the list may have no document. */
	if (store_scan_find(api->store, stored_scan_id(scan), &read, &err) != 0) {
		json_missing_for(&err);
		read = NULL;
	}
	fits = filter->label == NULL || has_label(labels_of(read), filter->label);
	if (fits && filter->text != NULL)
		fits =
		    found((const char *const[]){stored_scan_id(scan), facts.name, NULL}, labels_of(read), filter->text);
	stored_scan_release(read);
	return fits;
}
