/* The memory of uploads: buffers within a limit, granted in the order of asking; lists of slots. intake/internal.h */
#include <stdlib.h>
#include <string.h>

#include "daemon/intake/internal.h"

enum { SPARE_BYTES = 64 << 20 }; /* of buffers kept for the next projection */

void slots_init(struct slot_list *list)
{
	list->first = NULL;
	list->end = &list->first;
}

void slots_add(struct slot_list *list, struct slot *slot)
{
	slot->next = NULL;
	*list->end = slot;
	list->end = &slot->next;
}

struct slot *slots_take(struct slot_list *list)
{
	struct slot *slot = list->first;

	if (slot != NULL) {
		list->first = slot->next;
		if (list->first == NULL)
			list->end = &list->first;
		slot->next = NULL;
	}
	return slot;
}

bool pool_fits(const struct uploads *uploads, size_t size)
{
	return uploads->used == 0 || uploads->used + size <= uploads->options.buffer;
}

void pool_feed(struct uploads *uploads)
{
	while (uploads->starved_first != NULL && pool_fits(uploads, uploads->starved_first->slot_bytes)) {
		struct upload *upload = uploads->starved_first;

		uploads->starved_first = upload->starved_next;
		if (uploads->starved_first == NULL)
			uploads->starved_end = &uploads->starved_first;
		uploads->statistics.starved--;
		upload->starved = false;
		upload->granted = true;
		uploads->used += upload->slot_bytes;
		request_wake(upload->request);
	}
}

void pool_starve(struct upload *upload)
{
	struct uploads *uploads = upload->uploads;

	if (upload->starved)
		return;
	upload->starved = true;
	upload->starved_next = NULL;
	*uploads->starved_end = upload;
	uploads->starved_end = &upload->starved_next;
	uploads->statistics.starved++;
}

void pool_leave(struct upload *upload)
{
	struct uploads *uploads = upload->uploads;
	struct upload **at = &uploads->starved_first;

	if (!upload->starved)
		return;
	while (*at != upload)
		at = &(*at)->starved_next;
	*at = upload->starved_next;
	if (*at == NULL)
		uploads->starved_end = at;
	upload->starved = false;
	uploads->statistics.starved--;
}

static void slot_free(struct slot *slot)
{
	if (slot == NULL)
		return;
	free(slot->data);
	free(slot);
}

void pool_free(struct uploads *uploads)
{
	while (uploads->spares != NULL) {
		struct slot *slot = uploads->spares;

		uploads->spares = slot->next;
		slot_free(slot);
	}
	uploads->spare_bytes = 0;
}

struct slot *pool_take(struct uploads *uploads, size_t size)
{
	struct slot *slot = uploads->spares;

	if (slot != NULL && slot->size == size) {
		unsigned char *data = slot->data;

		uploads->spares = slot->next;
		uploads->spare_bytes -= size;
		memset(slot, 0, sizeof(*slot));
		slot->data = data;
		slot->size = size;
		return slot;
	}
	pool_free(uploads);
	slot = calloc(1, sizeof(*slot));
	if (slot == NULL)
		return NULL;
	slot->size = size;
	slot->data = malloc(size);
	if (slot->data == NULL) {
		free(slot);
		return NULL;
	}
	return slot;
}

void pool_give_back(struct uploads *uploads, struct slot *slot)
{
	uploads->used -= slot->size;
	if (slot->data != NULL && uploads->spare_bytes + slot->size <= SPARE_BYTES &&
	    (uploads->spares == NULL || uploads->spares->size == slot->size)) {
		slot->next = uploads->spares;
		uploads->spares = slot;
		uploads->spare_bytes += slot->size;
	} else {
		slot_free(slot);
	}
	pool_feed(uploads);
}
