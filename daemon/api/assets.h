#ifndef CBCT_DAEMON_API_ASSETS_H
#define CBCT_DAEMON_API_ASSETS_H

#include <stddef.h>

/*
 * The web page's files, inside of the program: clients/web/build.mjs writes
 * this table. Empty where npm was not there when the daemon was built.
 */
struct asset {
	const char *name; /* of /assets/NAME, the digest of its content in it; "" is the page itself */
	const char *media_type, *digest;
	const unsigned char *plain;
	size_t plain_size;
	const unsigned char *gzip;
	size_t gzip_size;
};
extern const struct asset assets[]; /* ends with name == NULL */

#endif
