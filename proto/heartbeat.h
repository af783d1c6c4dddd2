#ifndef CBCT_PROTO_HEARTBEAT_H
#define CBCT_PROTO_HEARTBEAT_H

#include "core/error.h"

/*
 * A worker's signs of life: a thread that sends MESSAGE_ALIVE every HEARTBEAT seconds, with the count of steps that the
 * worker has finished (core/pulse.h) and the time that the step under way may take. So the daemon can tell a process
 * that does not run at all, which sends nothing, from one that runs and gets nowhere.
 */
#define HEARTBEAT 1.0

struct heartbeat;
/* The socket is borrowed, and others may send over it meanwhile. */
int heartbeat_start(int socket, struct heartbeat **ret_heartbeat, struct error *err);
void heartbeat_stop(struct heartbeat *heartbeat); /* NULL is fine */
/*
 * A step begins that by its nature may take so many seconds; 0: as long as any other. Any thread.
 */
void heartbeat_step(struct heartbeat *heartbeat, double seconds);

#endif
