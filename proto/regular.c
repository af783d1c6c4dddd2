/* Files of the state, and nothing else in their place: regular.h. */
#include "proto/regular.h"

#include <errno.h>
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

int regular_open(const char *path, int flags, unsigned mode)
{
	/* A pipe is opened at once then, also without another end; of a regular file it changes nothing. */
	int file = open(path, flags | O_CLOEXEC | O_NONBLOCK, mode), why = EMEDIUMTYPE;
	struct stat status;

	if (file < 0)
		return file;
	if (fstat(file, &status) != 0)
		why = errno;
	else if (S_ISREG(status.st_mode))
		return file;
	close(file);
	errno = why;
	return -1;
}
