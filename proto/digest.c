/* Digests of what a volume was made from: digest.h. */
#include "proto/digest.h"

#include <openssl/crypto.h>
#include <openssl/evp.h>
#include <stdio.h>
#include <stdlib.h>

#include "proto/json.h"

int digest_prepare(struct error *err)
{
	unsigned char digest[EVP_MAX_MD_SIZE];

	if (OPENSSL_init_crypto(0, NULL) != 1 || OSSL_LIB_CTX_get0_global_default() == NULL ||
	    EVP_Digest("", 0, digest, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for digests");
	return 0;
}

void digest_text(const uint8_t sha256[DIGEST_BYTES], char ret_text[DIGEST_TEXT_MAX])
{
	unsigned char base64[4 * (DIGEST_BYTES + 2) / 3 + 1];

	EVP_EncodeBlock(base64, sha256, DIGEST_BYTES);
	snprintf(ret_text, DIGEST_TEXT_MAX, "sha-256=:%s:", (const char *)base64);
}

static int digest_bytes(const void *bytes, size_t size, char ret_text[DIGEST_TEXT_MAX], struct error *err)
{
	uint8_t sha256[DIGEST_BYTES];

	if (EVP_Digest(bytes, size, sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	digest_text(sha256, ret_text);
	return 0;
}

static int digest_json(const cJSON *value, char ret_text[DIGEST_TEXT_MAX], struct error *err)
{
	size_t length = 0;
	char *text = json_print(value, &length);
	int code = text != NULL ? digest_bytes(text, length, ret_text, err)
				: error_set(err, ERR_NO_MEMORY, "no memory for the digest of a document");

	free(text);
	return code;
}

int digest_scan(const struct scan *scan, char ret_text[DIGEST_TEXT_MAX], struct error *err)
{
	static const char *const of_the_patient[] = {"name", "labels", "patient", "study", "source"};
	cJSON *document = cJSON_Duplicate(scan->document, true);
	int code;

	for (size_t i = 0; i < sizeof(of_the_patient) / sizeof(of_the_patient[0]); i++)
		cJSON_DeleteItemFromObjectCaseSensitive(document, of_the_patient[i]);
	code = digest_json(document, ret_text, err);
	cJSON_Delete(document);
	return code;
}

int digest_projections(const uint8_t *sha256, int count, char ret_text[DIGEST_TEXT_MAX], struct error *err)
{
	return digest_bytes(sha256, (size_t)count * DIGEST_BYTES, ret_text, err);
}

int digest_recipe(const cJSON *recipe, char ret_text[DIGEST_TEXT_MAX], struct error *err)
{
	return digest_json(recipe, ret_text, err);
}
