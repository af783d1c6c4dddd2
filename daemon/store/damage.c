/* The words for a damaged volume, and the warning that its job has of them: one for each volume, however often. */
#include <stdio.h>
#include <string.h>

#include "daemon/store/internal.h"

const char damage_code[] = "damaged_volume";
static const char words[] = " is damaged on the disk";

void damage_beginning(const char *volume, char ret_text[DAMAGE_SIZE])
{
	snprintf(ret_text, DAMAGE_SIZE, "the volume %.40s%s", volume, words);
}

int store_volume_damaged(const char *volume, const char *why, struct error *err)
{
	char beginning[DAMAGE_SIZE];

	damage_beginning(volume, beginning);
	return error_set(err, ERR_DAMAGED, "%s (%s): it has to be made again", beginning, why);
}

bool damage_told(const struct warning_record *warning, char ret_beginning[DAMAGE_SIZE])
{
	const char *at = strcmp(warning->code, damage_code) == 0 ? strstr(warning->detail, words) : NULL;

	if (at == NULL || at + sizeof(words) - warning->detail > DAMAGE_SIZE)
		return false;
	snprintf(ret_beginning, DAMAGE_SIZE, "%.*s", (int)(at + strlen(words) - warning->detail), warning->detail);
	return true;
}

bool damage_told_of(const struct warning_record *warnings, int count, const char *volume)
{
	char beginning[DAMAGE_SIZE], other[DAMAGE_SIZE];
	bool told = false;

	damage_beginning(volume, beginning);
	for (int i = 0; i < count && !told; i++)
		told = damage_told(&warnings[i], other) && strcmp(other, beginning) == 0;
	return told;
}
