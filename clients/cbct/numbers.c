/* Numbers of text files and NumPy arrays: see numbers.h. */
#include "clients/cbct/numbers.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/npy.h"
#include "core/scan/geometry.h"
#include "proto/scan_directory.h"

enum { FILE_BYTES = 64 << 20 };

struct list {
	double *numbers;
	size_t count, room;
};

static int add(struct list *list, double number, struct error *err)
{
	if (list->count == list->room) {
		size_t room = list->room > 0 ? 2 * list->room : 1024;
		double *grown = realloc(list->numbers, room * sizeof(*grown));

		if (grown == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for %zu numbers", room);
		list->numbers = grown;
		list->room = room;
	}
	list->numbers[list->count++] = number;
	return 0;
}

static int add_line(struct list *list, char *line, const char *path, long at, struct error *err)
{
	static const char blanks[] = " \t\r,;[]()";
	int code = 0;

	line[strcspn(line, "#%")] = '\0';
	while (code == 0) {
		char *end;
		double number;

		line += strspn(line, blanks);
		if (*line == '\0')
			break;
		number = strtod(line, &end);
		if (end == line || (*end != '\0' && strchr(blanks, *end) == NULL) || !isfinite(number))
			return error_set(err, ERR_INVALID, "%.160s, line %ld: \"%.*s\" is no finite number", path, at,
					 (int)(strcspn(line, blanks) < 40 ? strcspn(line, blanks) : 40), line);
		code = add(list, number, err);
		line = end;
	}
	return code;
}

/* `each` (may be NULL) looks at the numbers that a line brought. */
static int read_text(char *text, const char *path, struct list *list,
		     int (*each)(const char *path, long at, size_t before, size_t found, struct error *err),
		     struct error *err)
{
	char *line;
	long at = 0;
	int code = 0;

	while (code == 0 && (line = strsep(&text, "\n")) != NULL) {
		size_t before = list->count;

		code = add_line(list, line, path, ++at, err);
		if (code == 0 && each != NULL && list->count > before)
			code = each(path, at, before, list->count - before, err);
	}
	return code;
}

static int read_npy(const char *text, size_t length, const char *path, struct npy *ret_npy, struct list *list,
		    struct error *err)
{
	size_t count = 1, left;
	int code = npy_parse(text, length, ret_npy, err);

	if (code != 0)
		return code;
	left = (length - ret_npy->start) / pixel_bytes(ret_npy->type);
	for (int i = 0; i < ret_npy->dimensions; i++) {
		if (ret_npy->shape[i] > left / count)
			return error_set(err, ERR_INVALID, "%.200s: the array is cut off", path);
		count *= ret_npy->shape[i];
	}
	for (size_t i = 0; i < count && code == 0; i++) {
		const char *from = text + ret_npy->start + i * pixel_bytes(ret_npy->type);
		double number;
		float single;

		/* Double precision must not pass through single. */
		if (ret_npy->type == PIXEL_FLOAT64) {
			unsigned char bytes[8];

			for (int b = 0; b < 8; b++)
				bytes[b] = (unsigned char)from[ret_npy->big_endian ? 7 - b : b];
			memcpy(&number, bytes, sizeof(number));
		} else {
			pixels_to_float(from, ret_npy->type, ret_npy->big_endian, 1, &single);
			number = (double)single;
		}
		code = isfinite(number) ? add(list, number, err)
					: error_set(err, ERR_INVALID, "%.160s: number %zu is not finite", path, i);
	}
	return code;
}

static int read_any(const char *path, struct list *list, struct npy *ret_npy,
		    int (*each)(const char *path, long at, size_t before, size_t found, struct error *err),
		    struct error *err)
{
	char *text = NULL;
	size_t length = 0;
	int code = file_read(path, FILE_BYTES, &text, &length, err);

	ret_npy->dimensions = 0;
	if (code == 0 && npy_recognise((const unsigned char *)text, length))
		code = read_npy(text, length, path, ret_npy, list, err);
	else if (code == 0)
		code = read_text(text, path, list, each, err);
	if (code == 0 && list->count == 0)
		code = error_set(err, ERR_INVALID, "%.200s has no numbers", path);
	free(text);
	return code;
}

int numbers_read(const char *path, double **ret_numbers, size_t *ret_count, struct error *err)
{
	struct list list = {NULL, 0, 0};
	struct npy npy;
	int code = read_any(path, &list, &npy, NULL, err);

	if (code != 0) {
		free(list.numbers);
		return code;
	}
	*ret_numbers = list.numbers;
	*ret_count = list.count;
	return 0;
}

/* A matrix is one line of twelve, or begins with a line of four at a multiple of twelve. */
static int check_line(const char *path, long at, size_t before, size_t found, struct error *err)
{
	if (found == 4 || (found == 12 && before % 12 == 0))
		return 0;
	return error_set(err, ERR_INVALID, "%.160s, line %ld: %zu numbers, 12 or 4 of a 3x4 matrix are expected", path,
			 at, found);
}

int matrices_read(const char *path, double **ret_matrices, int *ret_count, struct error *err)
{
	struct list list = {NULL, 0, 0};
	struct npy npy;
	int code = read_any(path, &list, &npy, check_line, err);

	if (code == 0 && npy.dimensions > 0 && npy.shape[npy.dimensions - 1] != 12 &&
	    !(npy.dimensions >= 2 && npy.shape[npy.dimensions - 1] == 4 && npy.shape[npy.dimensions - 2] == 3))
		code = error_set(err, ERR_INVALID, "%.200s: an array of 3x4 matrices is expected", path);
	if (code == 0 && list.count % 12 != 0)
		code =
		    error_set(err, ERR_INVALID, "%.160s: %zu numbers, the last matrix is not whole", path, list.count);
	if (code == 0 && list.count / 12 > VIEWS_MAX)
		code = error_set(err, ERR_IMPOSSIBLE, "%.160s: %zu matrices, at most %d are expected", path,
				 list.count / 12, VIEWS_MAX);
	if (code != 0) {
		free(list.numbers);
		return code;
	}
	*ret_matrices = list.numbers;
	*ret_count = (int)(list.count / 12);
	return 0;
}
