/* Any bytes as a config file: refused with a reason, or settings that read as themselves once they are printed. */
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "daemon/config.h"
#include "tests/fuzz/fuzz.h"

enum { PLACE = 64 };

static int load(char path[PLACE], struct config *ret, struct error *err)
{
	char program[] = "cbctd", flag[] = "--config", *argv[] = {program, flag, path, NULL};
	enum config_action action = CONFIG_HELP;
	int code = config_load(3, argv, ret, &action, err);

	PROMISE(code != 0 || action == CONFIG_RUN);
	return code;
}

/* A file in memory; its name goes to ret_path. */
static int file_new(char ret_path[PLACE])
{
	int file = memfd_create("settings", MFD_CLOEXEC);

	PROMISE(file >= 0);
	snprintf(ret_path, PLACE, "/proc/self/fd/%d", file);
	return file;
}

/* Overwrites the file. */
static void check_printed(const struct config *config, char path[PLACE], int file)
{
	struct config again;
	struct error err = {0};
	char names[400];
	char *text = NULL;
	size_t length = 0;
	FILE *out = open_memstream(&text, &length);

	PROMISE(out != NULL);
	config_print(config, out);
	PROMISE(fclose(out) == 0 && ftruncate(file, 0) == 0 && pwrite(file, text, length, 0) == (ssize_t)length);
	PROMISE(load(path, &again, &err) == 0);
	config_compare(config, &again, names, sizeof(names));
	/* A password is not printed. */
	PROMISE(names[0] == '\0' || strstr(text, "***") != NULL);
	config_clear(&again);
	free(text);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static char path[PLACE];
	static int file = -1;
	struct config config;
	struct error err = {0};

	if (file < 0)
		file = file_new(path);
	PROMISE(ftruncate(file, 0) == 0 && pwrite(file, data, size, 0) == (ssize_t)size);
	if (load(path, &config, &err) != 0) {
		PROMISE(err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	check_printed(&config, path, file);
	config_clear(&config);
	return 0;
}
