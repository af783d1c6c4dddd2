/*
 * A worker whose syncs can be held up, linked with --wrap=fdatasync: while the
 * file that CBCT_TEST_HOLD names is there, none of them returns. So a volume
 * stays told of and not settled for as long as a test looks at it.
 */
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

int __real_fdatasync(int file);
int __wrap_fdatasync(int file);

int __wrap_fdatasync(int file)
{
	const struct timespec moment = {.tv_nsec = 10000000};
	const char *hold = getenv("CBCT_TEST_HOLD");

	while (hold != NULL && access(hold, F_OK) == 0)
		nanosleep(&moment, NULL);
	return __real_fdatasync(file);
}
