#ifndef CBCT_PROTO_VERSION_H
#define CBCT_PROTO_VERSION_H

/* The version of all programs together; files, `--version` and /livez show it. */
#define CBCT_VERSION "1.0.0"

#endif
