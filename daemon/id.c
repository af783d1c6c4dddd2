/* Names that sort by time: id.h. */
#include "daemon/id.h"

#include <errno.h>
#include <pthread.h>
#include <stdint.h>
#include <string.h>
#include <sys/random.h>

#include "proto/clock.h"

/* The digits stand in ASCII order, so that texts sort as the numbers do. */
static const char digits[] = "0123456789abcdefghjkmnpqrstvwxyz";
enum { DIGIT_BITS = 5, TIME_DIGITS = 9, RANDOM_DIGITS = ID_LENGTH - TIME_DIGITS };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static uint64_t newest; /* milliseconds in the last id; guarded by lock */

static void put_digits(char *to, int count, uint64_t value)
{
	for (int i = count - 1; i >= 0; i--) {
		to[i] = digits[value & 31];
		value >>= DIGIT_BITS;
	}
}

int id_make(char ret_id[ID_SIZE], struct error *err)
{
	uint64_t time, random;

	if (getrandom(&random, sizeof(random), 0) != (ssize_t)sizeof(random))
		return error_set_errno(err, errno, "random number for an id");
	time = (uint64_t)(clock_realtime() * 1000);
	pthread_mutex_lock(&lock);
	/* Several in one millisecond borrow from the next ones. */
	if (time <= newest)
		time = newest + 1;
	newest = time;
	pthread_mutex_unlock(&lock);
	put_digits(ret_id, TIME_DIGITS, time);
	put_digits(ret_id + TIME_DIGITS, RANDOM_DIGITS, random);
	ret_id[ID_LENGTH] = '\0';
	return 0;
}

void id_floor(const char *id)
{
	uint64_t time = 0;

	if (!id_valid(id))
		return;
	for (int i = 0; i < TIME_DIGITS; i++)
		time = time << DIGIT_BITS | (uint64_t)(strchr(digits, id[i]) - digits);
	pthread_mutex_lock(&lock);
	if (time > newest)
		newest = time;
	pthread_mutex_unlock(&lock);
}

bool id_valid(const char *id)
{
	return strlen(id) == ID_LENGTH && strspn(id, digits) == ID_LENGTH;
}
