#ifndef CBCT_DAEMON_CONFIG_H
#define CBCT_DAEMON_CONFIG_H

#include <stddef.h>
#include <stdio.h>

#include "core/error.h"

/*
 * The daemon's settings. Each is one row of a table in config.c, and from it
 * come the flag --NAME, the environment variable CBCTD_NAME, the line
 * `NAME = VALUE` of a config file, the help and --print-config. A flag goes
 * before the environment, the environment before the file, the file before the
 * default.
 */
struct config {
	char *listen; /* ADDR:PORT and unix:PATH, separated by commas */
	char
	    *server_names; /* that Host may have beside localhost and the addresses, separated by commas; "" for none */
	char *state_dir;   /* where everything is kept */
	char *backend;     /* "auto", "cuda", "cpu" */
	char *config_file; /* "" for none */
	char *worker;      /* path of cbct-worker, "" for the one beside this program */
	long workers;
	char *devices; /* of the workers, "0,2"; "" for 0 .. workers - 1 */
	long threads;
	size_t device_memory; /* bytes, 0 = what is free */
	char *log_level;
	long http_threads;
	long max_connections, max_connections_per_address;
	size_t upload_buffer;                  /* bytes of projections between socket and disk */
	double max_wait;                       /* s */
	double header_timeout, transfer_grace; /* s */
	size_t minimum_rate;                   /* bytes/s */
	double stop_timeout;                   /* s */
};

enum config_action { CONFIG_RUN, CONFIG_HELP, CONFIG_PRINT, CONFIG_REBUILD, CONFIG_VERSION };

/* Reads defaults, file, environment and arguments. Free with config_clear. ERR_INVALID names the setting and its
 * source. */
int config_load(int argc, char **argv, struct config *ret_config, enum config_action *ret_action, struct error *err);
void config_clear(struct config *config);

/* The numbers of a list as in `devices`; -1 where it is none, or of more than `most`. ret_indices may be NULL. */
enum { INDICES_MOST = 64 };
int config_indices(const char *text, int *ret_indices, int most);

void config_help(FILE *out);
/* Every setting as it is now, as a config file. */
void config_print(const struct config *config, FILE *out);

#endif
