/*
 * Any bytes as the list of a backup (backup.json), whose other files are what the seeds name: refused with a reason,
 * and then nothing is there, or restored with nothing outside of the new directory.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "clients/cbct/options.h"
#include "clients/cbct/commands.h"
#include "tests/fuzz/fuzz.h"

static char root[64], from[96], to[96];

static void write_file(const char *folder, const char *name, const void *data, size_t size)
{
	char path[256];
	FILE *file;

	snprintf(path, sizeof(path), "%s/%s", folder, name);
	file = fopen(path, "wb");
	PROMISE(file != NULL && fwrite(data, 1, size, file) == size && fclose(file) == 0);
}

static void prepare(void)
{
	char path[128];

	snprintf(root, sizeof(root), "/dev/shm/fuzz-backup.XXXXXX");
	PROMISE(mkdtemp(root) != NULL);
	snprintf(from, sizeof(from), "%s/from", root);
	snprintf(to, sizeof(to), "%s/to", root);
	PROMISE(mkdir(from, 0700) == 0);
	snprintf(path, sizeof(path), "%s/jobs", from);
	PROMISE(mkdir(path, 0700) == 0);
	write_file(root, "outside", "x", 1);
	write_file(from, "deleted", "", 0);
	write_file(from, "jobs/a", "a", 1);
	PROMISE(freopen("/dev/null", "w", stdout) != NULL);
}

/* The entries of a folder, "." and ".." among them. */
static int entries(const char *folder)
{
	DIR *directory = opendir(folder);
	int count = 0;

	PROMISE(directory != NULL);
	while (readdir(directory) != NULL)
		count++;
	closedir(directory);
	return count;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static const char *const left[] = {"jobs/a", "jobs", "deleted", "restored", ""};
	struct error err = {0};
	char *values;
	int code;

	if (root[0] == '\0')
		prepare();
	write_file(from, "backup.json", data, size);
	values = calloc(1, command_restore.size);
	PROMISE(values != NULL);
	*(const char **)(void *)(values + command_restore.positionals[0].offset) = from;
	*(const char **)(void *)(values + command_restore.positionals[1].offset) = to;
	code = command_restore.run(values, &err);
	free(values);
	if (code != 0)
		PROMISE(code < 0 && err.text[0] != '\0' && access(to, F_OK) != 0);
	for (size_t i = 0; code == 0 && i < sizeof(left) / sizeof(*left); i++) {
		char path[256];

		snprintf(path, sizeof(path), "%s/%s", to, left[i]);
		PROMISE(remove(path) == 0 || errno == ENOENT);
	}
	PROMISE(access(to, F_OK) != 0 && entries(root) == 4 && entries(from) == 5);
	return 0;
}
