#ifndef CBCT_DAEMON_VOLUMES_VOLUMES_H
#define CBCT_DAEMON_VOLUMES_VOLUMES_H

/* The door of what a job gives: volumes as files of any format, mapped and streamed, and events. */
#include "daemon/volumes/content.h"
#include "daemon/volumes/event_ring.h"
#include "daemon/volumes/mapping.h"
#include "daemon/volumes/encoded.h"

#endif
