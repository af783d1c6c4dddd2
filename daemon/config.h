#ifndef CBCT_DAEMON_CONFIG_H
#define CBCT_DAEMON_CONFIG_H

#include <stddef.h>
#include <stdio.h>

#include "core/error.h"

/*
 * The daemon's settings: the rows of daemon/settings.def, a member for each. A flag goes before the environment, the
 * environment before the file, the file before the default. Texts are never NULL; seconds are double, numbers of
 * bytes size_t, other numbers long.
 */
#define SETTING_TEXT char *
#define SETTING_ADDRESS char *
#define SETTING_LIST char *
#define SETTING_CHOICE char *
#define SETTING_INDICES char *
#define SETTING_INTEGER long
#define SETTING_BYTES size_t
#define SETTING_SECONDS double
#define SETTING(kind, member, ...) SETTING_##kind member;
struct config {
#include "daemon/settings.def"
};
#undef SETTING

enum config_action { CONFIG_RUN, CONFIG_HELP, CONFIG_PRINT, CONFIG_REBUILD, CONFIG_VERSION };

/* Reads defaults, file, environment and arguments. Free with config_clear. ERR_INVALID names the setting and its
 * source. */
int config_load(int argc, char **argv, struct config *ret_config, enum config_action *ret_action, struct error *err);
void config_clear(struct config *config);

/* The numbers of a list as in `devices`; -1 where it is none, or of more than `most`. ret_indices may be NULL. */
enum { INDICES_MOST = 64 };
int config_indices(const char *text, int *ret_indices, int most);

/* The names of the settings that differ, with ", " between them, as far as there is room; "" where none does. */
void config_compare(const struct config *a, const struct config *b, char *ret_names, size_t size);

void config_help(FILE *out);
/* Every setting as it is now, as a config file. */
/*
 * Visits each variable of the environment that begins as those of settings do and is none. It may be another program's:
 * a cluster gives its services such names.
 */
void config_unknown_variables(void (*visit)(const char *name));
void config_print(const struct config *config, FILE *out);

#endif
