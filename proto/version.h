#ifndef CBCT_PROTO_VERSION_H
#define CBCT_PROTO_VERSION_H

/* Of all programs together; files, `--version` and /livez tell it. */
#define CBCT_VERSION "1.0.0"

#endif
