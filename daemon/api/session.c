/*
 * /v1/session: who asks, and sessions of the page. A browser that has shown a
 * token once gets a cookie, since what it loads by itself (downloads, event
 * streams, pictures) cannot carry an Authorization field.
 */
#include "daemon/api/internal.h"

static cJSON *identity_document(const struct identity *who)
{
	cJSON *document = cJSON_CreateObject();
	char expires[32];

	if (who->name[0] != '\0')
		cJSON_AddStringToObject(document, "name", who->name);
	else
		cJSON_AddNullToObject(document, "name");
	cJSON_AddStringToObject(document, "role", role_names[who->role]);
	cJSON_AddStringToObject(document, "proof", proof_names[who->proof]);
	token_expiry_print(who->expires, expires);
	if (who->expires != TOKEN_NEVER)
		cJSON_AddStringToObject(document, "expires", expires);
	else
		cJSON_AddNullToObject(document, "expires");
	return document;
}

int session_get(void *context, struct request *request, struct error *err)
{
	(void)context;
	return request_reply_json(request, 200, identity_document(request_identity(request)), err);
}

int session_post(void *context, struct request *request, struct error *err)
{
	const struct identity *who = request_identity(request);

	(void)context;
	if (who->proof != PROOF_TOKEN)
		return error_set(err, ERR_CONFLICT,
				 "a session is opened by a token (Authorization: Bearer), this "
				 "request shows: %s",
				 proof_names[who->proof]);
	if (request_reply_json(request, 201, identity_document(who), err) != 0)
		return err->code;
	return request_session_open(request, err);
}

int session_delete(void *context, struct request *request, struct error *err)
{
	(void)context;
	if (request_reply_empty(request, 204, err) != 0)
		return err->code;
	request_session_close(request);
	return 0;
}
