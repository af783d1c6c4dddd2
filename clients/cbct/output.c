/* Files that are written whole: see output.h. */
#include "clients/cbct/output.h"

#include <errno.h>
#include <stdbool.h>
#include <string.h>

int output_open(const char *path, FILE **ret_file, struct error *err)
{
	FILE *file = strcmp(path, "-") == 0 ? stdout : fopen(path, "wbe");

	if (file == NULL)
		return error_set_errno(err, errno, "%.200s", path);
	*ret_file = file;
	return 0;
}

int output_close(FILE *file, const char *path, struct error *err)
{
	bool failed = ferror(file) != 0;

	/* Writing and closing can fail: a full disk may show only when the last buffer goes out. */
	if ((file == stdout ? fflush(file) : fclose(file)) != 0)
		return error_set_errno(err, errno, "%.200s", path);
	return failed ? error_set(err, ERR_IO, "%.200s cannot be written", path) : 0;
}
