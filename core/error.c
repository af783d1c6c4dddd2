/* struct error: see error.h. */
#include "core/error.h"

#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

static int error_fill(struct error *err, int code, const char *pointer, const char *format, va_list args)
{
	err->code = code;
	snprintf(err->pointer, sizeof(err->pointer), "%s", pointer);
	vsnprintf(err->text, sizeof(err->text), format, args);
	return code;
}

int error_set(struct error *err, int code, const char *format, ...)
{
	va_list args;

	va_start(args, format);
	error_fill(err, code, "", format, args);
	va_end(args);
	return code;
}

int error_set_at(struct error *err, int code, const char *pointer, const char *format, ...)
{
	va_list args;

	va_start(args, format);
	error_fill(err, code, pointer, format, args);
	va_end(args);
	return code;
}

void error_nest(struct error *err, const char *prefix)
{
	char pointer[sizeof(err->pointer)];

	if (snprintf(pointer, sizeof(pointer), "%s%s", prefix, err->pointer) >= 0)
		memcpy(err->pointer, pointer, sizeof(pointer));
}

static int code_of_errno(int errno_value)
{
	if (errno_value == ENOSPC || errno_value == EDQUOT)
		return ERR_NO_SPACE;
	return errno_value == ENOMEM ? ERR_NO_MEMORY : ERR_IO;
}

static int error_fill_errno(struct error *err, int code, int errno_value, const char *format, va_list args)
{
	char what[sizeof(err->text)];

	vsnprintf(what, sizeof(what), format, args);
	return error_set(err, code, "%.200s: %s", what, strerror(errno_value));
}

int error_set_errno(struct error *err, int errno_value, const char *format, ...)
{
	int code = code_of_errno(errno_value);
	va_list args;

	va_start(args, format);
	error_fill_errno(err, code, errno_value, format, args);
	va_end(args);
	return code;
}

int error_set_sync(struct error *err, int errno_value, const char *format, ...)
{
	int code = code_of_errno(errno_value) == ERR_NO_SPACE ? ERR_NO_SPACE : ERR_SYNC;
	va_list args;

	va_start(args, format);
	error_fill_errno(err, code, errno_value, format, args);
	va_end(args);
	return code;
}
