#ifndef CBCT_PROTO_REGULAR_H
#define CBCT_PROTO_REGULAR_H

/*
 * Opens a file of the state as open(2) does, closed on exec, and never waits for it: what is no regular file, a pipe
 * that somebody has put in its place above all, is refused with EMEDIUMTYPE (where open itself does not). The mode is
 * that of a file that O_CREAT makes. Any thread.
 */
int regular_open(const char *path, int flags, unsigned mode);

#endif
