/* NumPy's array format, versions 1 to 3: a magic, a length, and a Python dictionary of three entries. */
#include "clients/cbct/npy.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const char magic[] = "\x93NUMPY";
enum { MAGIC_BYTES = 6 };

bool npy_recognise(const unsigned char *head, size_t length)
{
	return length > MAGIC_BYTES && memcmp(head, magic, MAGIC_BYTES) == 0;
}

/* The text behind "'key':", NULL without. */
static const char *value_of(const char *text, const char *key)
{
	char quoted[32];
	const char *at;

	snprintf(quoted, sizeof(quoted), "'%s':", key);
	at = strstr(text, quoted);
	return at != NULL ? at + strlen(quoted) + strspn(at + strlen(quoted), " ") : NULL;
}

static int parse_type(const char *text, struct npy *ret, struct error *err)
{
	static const char *const codes[PIXEL_TYPE_COUNT] = {"u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"};
	const char *descr = value_of(text, "descr");

	if (descr != NULL && descr[0] == '\'' && strchr("<>|", descr[1]) != NULL && descr[1] != '\0')
		for (int i = 0; i < PIXEL_TYPE_COUNT; i++)
			if (strncmp(descr + 2, codes[i], 2) == 0 && descr[4] == '\'') {
				ret->type = (enum pixel_type)i;
				ret->big_endian = descr[1] == '>';
				return 0;
			}
	return error_set(err, ERR_INVALID, "a .npy file of %.20s, plain numbers are expected",
			 descr != NULL ? descr : "no type");
}

static int parse_shape(const char *text, struct npy *ret, struct error *err)
{
	const size_t most = (size_t)1 << 40;
	const char *at = value_of(text, "shape");
	char *end;

	if (at == NULL || *at++ != '(')
		return error_set(err, ERR_INVALID, "a .npy file without a shape");
	for (ret->dimensions = 0; *at != ')'; at = end + strspn(end, " ,")) {
		unsigned long long size = strtoull(at, &end, 10);

		if (end == at || size < 1 || size > most || ret->dimensions == NPY_DIMENSIONS_MAX)
			return error_set(err, ERR_INVALID, "a .npy file of the shape %.40s is not read",
					 value_of(text, "shape"));
		ret->shape[ret->dimensions++] = (size_t)size;
	}
	return ret->dimensions > 0 ? 0 : error_set(err, ERR_INVALID, "a .npy file of one number");
}

int npy_parse(const char *head, size_t length, struct npy *ret_npy, struct error *err)
{
	const unsigned char *bytes = (const unsigned char *)head;
	struct npy npy = {.dimensions = 0};
	const char *order;
	size_t at = MAGIC_BYTES + 4, text_length;
	char *text;
	int code;

	if (length < MAGIC_BYTES + 6 || !npy_recognise(bytes, length))
		return error_set(err, ERR_INVALID, "no .npy file");
	text_length = bytes[8] | (size_t)bytes[9] << 8;
	if (bytes[6] >= 2) {
		text_length |= (size_t)bytes[10] << 16 | (size_t)bytes[11] << 24;
		at += 2;
	}
	npy.start = at + text_length;
	if (npy.start > length)
		return error_set(err, ERR_INVALID, "a .npy file whose header of %zu bytes is not there", text_length);
	text = strndup(head + at, text_length);
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a header");
	order = value_of(text, "fortran_order");
	code = order != NULL && strncmp(order, "False", 5) == 0
		   ? parse_type(text, &npy, err)
		   : error_set(err, ERR_INVALID, "a .npy file in Fortran order is not read");
	if (code == 0)
		code = parse_shape(text, &npy, err);
	free(text);
	if (code == 0)
		*ret_npy = npy;
	return code;
}
