/* Parts of several handlers: pages, choices, conditional and partial requests (RFC 9110, 13 and 14). */
#include <inttypes.h>
#include <stdio.h>
#include <string.h>

#include <openssl/evp.h>

#include "daemon/api/internal.h"

int idempotency_read(struct request *request, char ret_text[IDEMPOTENCY_SIZE], struct store_key *ret_key,
		     struct error *err)
{
	const char *client = request_identity(request)->name;
	struct store_key key = {.text = request_header(request, "Idempotency-Key")};
	size_t length;
	const char *body = request_body(request, &length);

	if (key.text != NULL && (key.text[0] == '\0' || strlen(key.text) > IDEMPOTENCY_KEY_MAX))
		return error_set(err, ERR_INVALID, "Idempotency-Key has %zu bytes, expected 1 to %d", strlen(key.text),
				 IDEMPOTENCY_KEY_MAX);
	/* No header has a line break: keys of clients with a name are none of those without. */
	if (key.text != NULL && client[0] != '\0') {
		snprintf(ret_text, IDEMPOTENCY_SIZE, "%s\n%s", client, key.text);
		key.text = ret_text;
	}
	if (EVP_Digest(body, length, key.digest, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "the digest of a request cannot be made");
	*ret_key = key;
	return 0;
}

int page_read(struct request *request, struct page *ret_page, struct error *err)
{
	const char *limit = request_query(request, "limit");
	long number = PAGE_DEFAULT;

	if (limit != NULL && (!index_parse(limit, strlen(limit), PAGE_MAX, &number) || number == 0))
		return error_set(err, ERR_INVALID, "limit is \"%.40s\", expected a whole number from 1 to %d", limit,
				 PAGE_MAX);
	ret_page->limit = (int)number;
	ret_page->after = request_query(request, "after");
	return 0;
}

int page_read_ids(struct request *request, struct page *ret_page, struct error *err)
{
	struct page page;

	if (page_read(request, &page, err) != 0)
		return err->code;
	if (page.after != NULL && !id_valid(page.after))
		return error_set(err, ERR_INVALID, "after is \"%.40s\", expected an id", page.after);
	*ret_page = page;
	return 0;
}

int query_choice(struct request *request, const char *name, const char *const *names, int *ret_index, struct error *err)
{
	const char *value = request_query(request, name);
	char known[160] = "";
	int index = 0;

	for (; value != NULL && names[index] != NULL; index++) {
		size_t length = strlen(known);

		if (strcmp(value, names[index]) == 0)
			break;
		snprintf(known + length, sizeof(known) - length, "%s%s", length > 0 ? ", " : "", names[index]);
	}
	if (value != NULL && names[index] == NULL)
		return error_set(err, ERR_INVALID, "%s is \"%.40s\", expected one of %s", name, value, known);
	*ret_index = index;
	return 0;
}

static ssize_t read_nothing(void *context, uint64_t offset, void *to, size_t size)
{
	(void)context;
	(void)offset;
	(void)to;
	(void)size;
	return 0;
}

static void add_caching(struct request *request, const struct entity *entity)
{
	request_reply_header(request, "ETag", "%s", entity->etag);
	request_reply_header(request, "Vary", "Accept-Encoding");
	request_reply_header(request, "Cache-Control", "%s",
			     entity->caching != NULL ? entity->caching : "private, no-cache");
}

static int reply_not_modified(struct request *request, const struct entity *entity, struct error *err)
{
	/* A 304 has the headers of a 200, the length too, but no body is ever sent. */
	if (request_reply_read(request, 304, entity->size, read_nothing, NULL, NULL, err) != 0)
		return err->code;
	add_caching(request, entity);
	return 0;
}

static int reply_precondition_failed(struct request *request, const struct entity *entity, struct error *err)
{
	return request_reply_problem(request, "precondition-failed", err,
				     "If-Match is \"%.120s\", what is there has %s",
				     request_header(request, "If-Match"), entity->etag);
}

static int reply_range_outside(struct request *request, const struct entity *entity, struct error *err)
{
	if (request_reply_problem(request, "range-outside", err, "Range is \"%.60s\", the body has %" PRIu64 " bytes",
				  request_header(request, "Range"), entity->size) != 0)
		return err->code;
	request_reply_header(request, "Content-Range", "bytes */%" PRIu64, entity->size);
	return 0;
}

int entity_select(struct request *request, const struct entity *entity, struct selection *ret_selection, bool *ret_done,
		  struct error *err)
{
	const char *condition = request_header(request, "If-Range"), *wanted = request_header(request, "If-Match");
	struct selection selection = {200, 0, entity->size};
	bool ranges = entity->size != UNKNOWN_SIZE && !request_is_head(request) &&
		      (condition == NULL || etag_in(condition, entity->etag, false));

	*ret_done = true;
	if (wanted != NULL && !etag_in(wanted, entity->etag, false))
		return reply_precondition_failed(request, entity, err);
	if (etag_in(request_header(request, "If-None-Match"), entity->etag, true))
		return reply_not_modified(request, entity, err);
	if (ranges) {
		switch (
		    range_parse(request_header(request, "Range"), entity->size, &selection.first, &selection.length)) {
		case RANGE_OUTSIDE:
			return reply_range_outside(request, entity, err);
		case RANGE_ONE:
			selection.status = 206;
			break;
		case RANGE_NONE:
			break;
		}
	}
	*ret_done = false;
	*ret_selection = selection;
	return 0;
}

void entity_headers(struct request *request, const struct entity *entity, const struct selection *selection)
{
	request_reply_header(request, "Content-Type", "%s", entity->media_type);
	if (entity->filename != NULL)
		request_reply_header(request, "Content-Disposition", "attachment; filename=\"%s\"", entity->filename);
	add_caching(request, entity);
	if (entity->size != UNKNOWN_SIZE || entity->ranges != NULL)
		request_reply_header(request, "Accept-Ranges", "%s",
				     entity->size != UNKNOWN_SIZE ? "bytes" : entity->ranges);
	if (selection->status == 206)
		request_reply_header(request, "Content-Range", "bytes %" PRIu64 "-%" PRIu64 "/%" PRIu64,
				     selection->first, selection->first + selection->length - 1, entity->size);
}
