/*
 * /, /assets/{}: the page for the clinician, whose files are part of the
 * program (assets.h). Files other than the page itself are named by their
 * content and may be kept for ever; the page is asked for each time.
 */
#include <stdio.h>
#include <string.h>

#include "daemon/api/internal.h"
#include "daemon/api/assets.h"

/*
 * Nothing from elsewhere, no script or style beside the files, nobody may frame
 * it. data: is for pictures alone, which the rendering brings with it.
 */
static const char policy[] = "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; "
			     "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
			     "frame-ancestors 'none'";

static const struct asset *asset_find(const char *name)
{
	for (const struct asset *asset = assets; asset->name != NULL; asset++) {
		if (strcmp(asset->name, name) == 0)
			return asset;
	}
	return NULL;
}

static int reply_asset(struct request *request, const struct asset *asset, const char *caching, struct error *err)
{
	bool gzip = request_prefers_coding(request, "gzip");
	char etag[64];
	struct entity entity = {
	    .etag = etag, .size = UNKNOWN_SIZE, .media_type = asset->media_type, .caching = caching};
	struct selection selection;
	bool done;
	int code;

	snprintf(etag, sizeof(etag), "\"%s%s\"", asset->digest, gzip ? "-gzip" : "");
	code = entity_select(request, &entity, &selection, &done, err);
	if (code == 0 && !done)
		code = request_reply_constant(request, 200, gzip ? asset->gzip : asset->plain,
					      gzip ? asset->gzip_size : asset->plain_size, err);
	if (code != 0)
		return code;
	if (!done) {
		entity_headers(request, &entity, &selection);
		if (gzip)
			request_reply_header(request, "Content-Encoding", "gzip");
	}
	request_reply_header(request, "Content-Security-Policy", "%s", policy);
	request_reply_header(request, "X-Content-Type-Options", "nosniff");
	request_reply_header(request, "Referrer-Policy", "no-referrer");
	return 0;
}

int page_get(void *context, struct request *request, struct error *err)
{
	const struct asset *page = asset_find("");

	if (page == NULL) { /* built without npm: a list of jobs, which is not for anyone */
		int code = request_require(request, ROLE_VIEW, err);

		return code != 0 || request_replied(request) ? code : plain_list(context, request, err);
	}
	return reply_asset(request, page, "no-cache", err);
}

int asset_get(void *context, struct request *request, struct error *err)
{
	const char *name = request_argument(request, 0);
	const struct asset *asset = asset_find(name);

	(void)context;
	if (asset == NULL)
		return error_set(err, ERR_NOT_FOUND, "the page has no file \"%.60s\"", name);
	return reply_asset(request, asset, "public, max-age=31536000, immutable", err);
}
