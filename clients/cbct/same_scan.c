/* A scan that was begun is compared with a directory: same_scan.h. */
#include "clients/cbct/same_scan.h"

#include <stdio.h>
#include <string.h>

#include <openssl/evp.h>

#include "proto/digest.h"

/* A member that is absent, null, "" or {} tells nothing. */
static bool is_told(const cJSON *value)
{
	return value != NULL && !cJSON_IsNull(value) && (!cJSON_IsString(value) || value->valuestring[0] != '\0') &&
	       (!cJSON_IsObject(value) || value->child != NULL);
}

static int compare_members(const cJSON *ours, const cJSON *theirs, const char *pointer, const char *id,
			   struct error *err);

/* Each member of `ours`, against that of the same name in `theirs`. */
static int compare_each(const cJSON *ours, const cJSON *theirs, const char *base, const char *id, struct error *err)
{
	const cJSON *member;
	char pointer[200];
	int code = 0;

	cJSON_ArrayForEach(member, ours)
	{
		snprintf(pointer, sizeof(pointer), "%.100s/%.90s", base, member->string);
		code =
		    compare_members(member, cJSON_GetObjectItemCaseSensitive(theirs, member->string), pointer, id, err);
		if (code != 0)
			break;
	}
	return code;
}

static int compare_members(const cJSON *ours, const cJSON *theirs, const char *pointer, const char *id,
			   struct error *err)
{
	if (!is_told(ours) && !is_told(theirs))
		return 0;
	if ((cJSON_IsObject(ours) || !is_told(ours)) && (cJSON_IsObject(theirs) || !is_told(theirs))) {
		const int code = compare_each(ours, theirs, pointer, id, err);

		return code != 0 ? code : compare_each(theirs, ours, pointer, id, err);
	}
	if (!cJSON_Compare(ours, theirs, true))
		return error_set(
		    err, ERR_CONFLICT,
		    "scan %.63s is another scan than the directory's: %s is not the same; nothing was sent", id,
		    pointer);
	return 0;
}

/* The daemon adds members of its own to what was posted, and puts the matrices in place of a calibration's name. */
static int compare_documents(const cJSON *ours, const cJSON *theirs, const char *id, struct error *err)
{
	static const char *const compared[] = {"name", "patient", "study", "detector", "projections", "geometry"};
	const bool calibrated =
	    strcmp(member_text(cJSON_GetObjectItemCaseSensitive(ours, "geometry"), "kind", ""), "calibration") == 0;
	char pointer[100];
	int code = 0;

	for (size_t i = 0; i < sizeof(compared) / sizeof(compared[0]) && code == 0; i++) {
		if (calibrated && strcmp(compared[i], "geometry") == 0)
			continue;
		snprintf(pointer, sizeof(pointer), "/%s", compared[i]);
		code = compare_members(cJSON_GetObjectItemCaseSensitive(ours, compared[i]),
				       cJSON_GetObjectItemCaseSensitive(theirs, compared[i]), pointer, id, err);
	}
	return code;
}

static int compare_projection(struct http *http, const char *id, int index, const void *ours, size_t bytes,
			      struct error *err)
{
	uint8_t sha256[DIGEST_BYTES];
	char path[160], digest[DIGEST_TEXT_MAX];
	const struct http_request request = {.method = "HEAD", .path = path};
	struct http_reply reply;
	int code, attempt = 0;
	bool same;

	if (EVP_Digest(ours, bytes, sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	digest_text(sha256, digest);
	snprintf(path, sizeof(path), "/v1/scans/%.63s/projections/%d", id, index);
	do {
		code = http_send(http, &request, &reply, err);
		same = strcmp(reply.digest, digest) == 0;
		http_reply_clear(&reply);
	} while (http_again(http, code, attempt++));
	/* One that the disk has damaged since is missing again. */
	if (code == ERR_NOT_FOUND)
		return 0;
	if (code == 0 && !same)
		code = error_set(err, ERR_CONFLICT,
				 "scan %.63s is another scan than the directory's: projection %d that it has is not "
				 "the same; nothing was sent",
				 id, index);
	return code;
}

static int compare_projections(struct http *http, const char *id, const cJSON *received, const struct scan *scan,
			       const char *ours, struct error *err)
{
	const size_t bytes = scan_projection_bytes(scan);
	const cJSON *range;
	int code = 0;

	cJSON_ArrayForEach(range, received)
	{
		const cJSON *first = cJSON_GetArrayItem(range, 0), *last = cJSON_GetArrayItem(range, 1);

		if (!cJSON_IsNumber(first) || !cJSON_IsNumber(last) || first->valueint < 0 ||
		    last->valueint >= scan->count)
			return error_set(err, ERR_INVALID, "the daemon's list of received projections is none");
		for (int i = first->valueint; i <= last->valueint && code == 0; i++)
			code = compare_projection(http, id, i, ours + (size_t)i * bytes, bytes, err);
	}
	return code;
}

int scan_check_same(struct http *http, const char *id, const struct scan_files *files, const void *projections,
		    struct error *err)
{
	cJSON *document = NULL;
	char path[100];
	int code;

	snprintf(path, sizeof(path), "/v1/scans/%.63s", id);
	code = http_json(http, "GET", path, &document, err);
	if (code == 0)
		code = compare_documents(files->scan->document, document, id, err);
	if (code == 0)
		code = compare_projections(http, id, cJSON_GetObjectItemCaseSensitive(document, "received"),
					   files->scan, projections, err);
	cJSON_Delete(document);
	return code;
}
