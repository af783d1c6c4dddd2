#ifndef CBCT_PROTO_VERSION_H
#define CBCT_PROTO_VERSION_H

/* The version of all programs together; files, `--version` and /livez show it. */
#define CBCT_VERSION "1.0.0"

/* The commit of the sources that the program was built from, with "-dirty" where they were changed; "": not known. */
extern const char program_commit[];

#endif
