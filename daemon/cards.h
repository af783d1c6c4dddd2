#ifndef CBCT_DAEMON_CARDS_H
#define CBCT_DAEMON_CARDS_H

#include "proto/nvml.h"

/*
 * Memory, temperature and errors of the machine's NVIDIA cards (proto/nvml.h), read every few seconds in a thread of
 * its own, which ends at once where NVIDIA's driver is not: a driver that hangs holds up nobody who asks.
 *
 * Threads: any for cards_read; cards_start and cards_stop once each.
 */
struct cards;

enum { CARDS_MAX = 64 };

int cards_start(struct cards **ret_cards, struct error *err);
void cards_stop(struct cards *cards); /* NULL is fine */

/*
 * Fills at most CARDS_MAX entries and returns how many. A card does not answer, either, when its reading is old: the
 * driver hangs.
 */
int cards_read(struct cards *cards, struct nvml_card ret_cards[CARDS_MAX]);

#endif
