#ifndef CBCT_CORE_CREW_H
#define CBCT_CORE_CREW_H

#include "core/error.h"

/* A thread for each card but the first, which has the caller's: what is to be done on all cards begins together. */
struct crew;
typedef int crew_work(void *context, int card, struct error *err);

int crew_new(int cards, struct crew **ret_crew, struct error *err);
void crew_free(struct crew *crew); /* NULL is fine */
/* Does the work for each card and waits for all. Fails as the first card, in their order, that does. */
int crew_run(struct crew *crew, crew_work *work, void *context, struct error *err);
/* The card whose work was the first to end in ERR_DEVICE; -1: none. */
int crew_failed(const struct crew *crew);

#endif
