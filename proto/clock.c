/* The time: clock.h. */
#include "proto/clock.h"

#include <math.h>
#include <stdio.h>

double clock_realtime(void)
{
	struct timespec now;

	clock_gettime(CLOCK_REALTIME, &now);
	return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

struct timespec clock_timespec(double at)
{
	double whole = floor(at);

	return (struct timespec){.tv_sec = (time_t)whole, .tv_nsec = (long)((at - whole) * 1e9)};
}

void clock_text(double seconds, char ret_text[CLOCK_TEXT_SIZE])
{
	time_t whole = (time_t)floor(seconds);
	int milliseconds = (int)((seconds - (double)whole) * 1000);
	struct tm parts;
	size_t length;

	gmtime_r(&whole, &parts);
	length = strftime(ret_text, CLOCK_TEXT_SIZE, "%Y-%m-%dT%H:%M:%S", &parts);
	snprintf(ret_text + length, CLOCK_TEXT_SIZE - length, ".%03dZ", milliseconds);
}
