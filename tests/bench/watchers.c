/*
 * Many watchers of one job on loopback: when does each of them get each event?
 *
 * Usage: watchers PORT JOB COUNT SECONDS. One thread and one epoll; an
 * event's time counts from the moment in which the first watcher has it. Only
 * events that came after all were connected count.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { EVENTS_MAX = 4096, DELAYS_MAX = 8 << 20 };

struct watcher {
	int socket;
	char line[64]; /* the beginning of the line that is coming in */
	int length;
	long last;
};

struct event {
	long number;
	double first;
	int seen;
};

static struct event events[EVENTS_MAX];
static int event_count;
static float *delays;
static long delay_count, repeats;

static double now(void)
{
	struct timespec time;

	clock_gettime(CLOCK_MONOTONIC, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static void note(struct watcher *watcher, long number, double time, bool counts)
{
	int i = event_count - 1;

	repeats += number <= watcher->last;
	watcher->last = number;
	if (!counts)
		return;
	while (i >= 0 && events[i].number != number)
		i--;
	if (i < 0 && event_count < EVENTS_MAX) {
		i = event_count++;
		events[i] = (struct event){.number = number, .first = time};
	}
	if (i < 0 || delay_count == DELAYS_MAX)
		return;
	events[i].seen++;
	delays[delay_count++] = (float)(time - events[i].first);
}

static void take(struct watcher *watcher, const char *data, ssize_t size, double time, bool counts)
{
	for (ssize_t i = 0; i < size; i++) {
		if (data[i] != '\n') {
			if (watcher->length < (int)sizeof(watcher->line) - 1)
				watcher->line[watcher->length++] = data[i];
			continue;
		}
		watcher->line[watcher->length] = '\0';
		if (strncmp(watcher->line, "id: ", 4) == 0)
			note(watcher, atol(watcher->line + 4), time, counts);
		watcher->length = 0;
	}
}

static bool open_watcher(struct watcher *watcher, int port, const char *job, int epoll)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((unsigned short)port)};
	struct epoll_event wanted = {.events = EPOLLIN, .data.ptr = watcher};
	char request[256];
	int length = snprintf(request, sizeof(request),
			      "GET /v1/jobs/%s/events?after=latest HTTP/1.1\r\nHost: localhost\r\n\r\n", job);

	address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	watcher->socket = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	return watcher->socket >= 0 && connect(watcher->socket, (struct sockaddr *)&address, sizeof(address)) == 0 &&
	       send(watcher->socket, request, (size_t)length, 0) == length &&
	       epoll_ctl(epoll, EPOLL_CTL_ADD, watcher->socket, &wanted) == 0;
}

static int compare(const void *a, const void *b)
{
	float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

static void report(int count, int closed)
{
	long missed = 0;

	/* The last ones may still be on their way. */
	for (int i = 0; i < event_count; i++)
		missed += count - events[i].seen;
	qsort(delays, (size_t)delay_count, sizeof(*delays), compare);
	printf("%d watchers, %d events, %ld told, %ld missed, %ld repeated, %d closed\n", count, event_count,
	       delay_count, missed, repeats, closed);
	if (delay_count > 0)
		printf("ms behind the first: median %.2f, 99 %% %.2f, most %.2f\n",
		       1e3 * (double)delays[delay_count / 2], 1e3 * (double)delays[delay_count * 99 / 100],
		       1e3 * (double)delays[delay_count - 1]);
}

int main(int argc, char **argv)
{
	int count = argc == 5 ? atoi(argv[3]) : 0, port = argc == 5 ? atoi(argv[1]) : 0, closed = 0;
	int epoll = epoll_create1(EPOLL_CLOEXEC);
	struct watcher *watchers = calloc((size_t)count + 1, sizeof(*watchers));
	struct rlimit limit;
	double end, counting;

	if (count < 1 || epoll < 0 || watchers == NULL) {
		fprintf(stderr, "usage: watchers PORT JOB COUNT SECONDS\n");
		return 2;
	}
	delays = malloc(DELAYS_MAX * sizeof(*delays));
	if (getrlimit(RLIMIT_NOFILE, &limit) == 0) {
		limit.rlim_cur = limit.rlim_max;
		setrlimit(RLIMIT_NOFILE, &limit);
	}
	for (int i = 0; i < count; i++) {
		if (!open_watcher(&watchers[i], port, argv[2], epoll)) {
			perror("watcher");
			return 1;
		}
	}
	counting = now() + 1;
	end = counting + atof(argv[4]);
	while (now() < end && closed < count) {
		struct epoll_event ready[256];
		int many = epoll_wait(epoll, ready, 256, 100);

		for (int i = 0; i < many; i++) {
			struct watcher *watcher = ready[i].data.ptr;
			char data[16384];
			ssize_t got = recv(watcher->socket, data, sizeof(data), 0);

			if (got > 0) {
				take(watcher, data, got, now(), now() > counting);
			} else {
				close(watcher->socket);
				closed++;
			}
		}
	}
	report(count, closed);
	return 0;
}
