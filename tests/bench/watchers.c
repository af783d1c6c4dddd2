/*
 * Many watchers of one job on loopback: does each of them get each event, and when?
 *
 * Usage: watchers PORT JOB COUNT CREATED. One thread and one epoll. An event
 * has come when the kernel had it for the watcher: how soon a crowd in one
 * process on the same machine gets round to reading is not the daemon's doing.
 * CREATED is read when all watchers were let go (a FIFO will do): a line "NUMBER
 * SECONDS" for each event of the job, since 1970, as the catalogue has them.
 * Those that were created after the last watcher was answered must reach all.
 */
#include <arpa/inet.h>
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

enum { EVENTS_MAX = 4096, PATIENCE = 600 /* s */ };
/* Sleeps between two looks, so that the daemon's sending does not pay for waking a crowd that lives elsewhere. */
static const struct timespec nap = {0, 20 * 1000 * 1000};

struct watcher {
	int socket;
	char line[64]; /* the beginning of the line that is coming in */
	int length;
	bool answered;
	long last; /* event */
};

struct arrival {
	long number;
	double time;
};

struct event {
	long number;
	double created;
	int seen;
};

static struct arrival *arrivals;
static size_t arrival_count, arrival_room;
static struct event events[EVENTS_MAX];
static int event_count, answered_count;
static double answered_last;
static long repeats;

static double seconds(const struct timespec *time)
{
	return (double)time->tv_sec + 1e-9 * (double)time->tv_nsec;
}

static double now(void)
{
	struct timespec time;

	clock_gettime(CLOCK_REALTIME, &time);
	return seconds(&time);
}

static void note(struct watcher *watcher, long number, double time)
{
	repeats += number <= watcher->last;
	watcher->last = number;
	if (arrival_count == arrival_room) {
		arrival_room = arrival_room > 0 ? 2 * arrival_room : 1 << 16;
		arrivals = realloc(arrivals, arrival_room * sizeof(*arrivals));
		if (arrivals == NULL)
			exit(1);
	}
	arrivals[arrival_count++] = (struct arrival){number, time};
}

static void take(struct watcher *watcher, const char *data, ssize_t size, double time)
{
	if (!watcher->answered) {
		watcher->answered = true;
		answered_count++;
		answered_last = time;
	}
	for (ssize_t i = 0; i < size; i++) {
		if (data[i] != '\n') {
			if (watcher->length < (int)sizeof(watcher->line) - 1)
				watcher->line[watcher->length++] = data[i];
			continue;
		}
		watcher->line[watcher->length] = '\0';
		if (strncmp(watcher->line, "id: ", 4) == 0)
			note(watcher, atol(watcher->line + 4), time);
		watcher->length = 0;
	}
}

/* What there is, and when the last of it came in; 0 or less at the end. */
static ssize_t receive(int socket, char *data, size_t size, double *ret_time)
{
	union {
		struct cmsghdr align;
		char room[CMSG_SPACE(sizeof(struct timespec))];
	} control;
	struct iovec into = {data, size};
	struct msghdr message = {
	    .msg_iov = &into, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof(control)};
	ssize_t got = recvmsg(socket, &message, 0);
	struct cmsghdr *stamp = got > 0 ? CMSG_FIRSTHDR(&message) : NULL;
	struct timespec time;

	*ret_time = now();
	if (stamp != NULL && stamp->cmsg_level == SOL_SOCKET && stamp->cmsg_type == SCM_TIMESTAMPNS) {
		memcpy(&time, CMSG_DATA(stamp), sizeof(time));
		*ret_time = seconds(&time);
	}
	return got;
}

static bool open_watcher(struct watcher *watcher, int port, const char *job, int epoll)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((unsigned short)port)};
	struct epoll_event wanted = {.events = EPOLLIN, .data.ptr = watcher};
	char request[256];
	int on = 1, length = snprintf(request, sizeof(request),
				      "GET /v1/jobs/%s/events?after=latest HTTP/1.1\r\nHost: localhost\r\n\r\n", job);

	address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	watcher->socket = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	return watcher->socket >= 0 && setsockopt(watcher->socket, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof(on)) == 0 &&
	       connect(watcher->socket, (struct sockaddr *)&address, sizeof(address)) == 0 &&
	       send(watcher->socket, request, (size_t)length, 0) == length &&
	       epoll_ctl(epoll, EPOLL_CTL_ADD, watcher->socket, &wanted) == 0;
}

static bool read_created(const char *path)
{
	FILE *file = fopen(path, "re");
	struct event event = {0};

	if (file == NULL)
		return false;
	while (event_count < EVENTS_MAX && fscanf(file, "%ld %lf", &event.number, &event.created) == 2) {
		if (event.created > answered_last)
			events[event_count++] = event;
	}
	fclose(file);
	return true;
}

static int by_size(const void *a, const void *b)
{
	float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

static int by_number(const void *a, const void *b)
{
	const struct event *x = a, *y = b;

	return (x->number > y->number) - (x->number < y->number);
}

static void report(int count)
{
	float *delays = malloc((arrival_count + 1) * sizeof(*delays));
	struct rusage used;
	size_t told = 0;
	long missed = 0;

	if (delays == NULL)
		exit(1);
	qsort(events, (size_t)event_count, sizeof(*events), by_number);
	for (size_t i = 0; i < arrival_count; i++) {
		struct event key = {.number = arrivals[i].number};
		struct event *event = bsearch(&key, events, (size_t)event_count, sizeof(*events), by_number);

		if (event == NULL)
			continue;
		event->seen++;
		delays[told++] = (float)(arrivals[i].time - event->created);
	}
	for (int i = 0; i < event_count; i++)
		missed += count - events[i].seen;
	getrusage(RUSAGE_SELF, &used);
	printf("%d watchers, %d events, %zu told, %ld missed, %ld repeated; the watchers took %.2f s of a processor\n",
	       count, event_count, told, missed, repeats,
	       (double)(used.ru_utime.tv_sec + used.ru_stime.tv_sec) +
		   1e-6 * (double)(used.ru_utime.tv_usec + used.ru_stime.tv_usec));
	qsort(delays, told, sizeof(*delays), by_size);
	if (told > 0)
		printf("ms from an event's time in the catalogue to a watcher: median %.1f, 99 %% %.1f, most %.1f\n",
		       1e3 * (double)delays[told / 2], 1e3 * (double)delays[told * 99 / 100],
		       1e3 * (double)delays[told - 1]);
	free(delays);
}

int main(int argc, char **argv)
{
	int count = argc == 5 ? atoi(argv[3]) : 0, port = argc == 5 ? atoi(argv[1]) : 0, closed = 0;
	int epoll = epoll_create1(EPOLL_CLOEXEC);
	struct watcher *watchers = calloc((size_t)count + 1, sizeof(*watchers));
	struct rlimit limit;
	double end = now() + PATIENCE;

	if (count < 1 || epoll < 0 || watchers == NULL) {
		fprintf(stderr, "usage: watchers PORT JOB COUNT CREATED\n");
		return 2;
	}
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
	while (now() < end && closed < count) {
		struct epoll_event ready[256];
		int many = epoll_wait(epoll, ready, 256, 0);

		if (many <= 0)
			nanosleep(&nap, NULL);
		for (int i = 0; i < many; i++) {
			struct watcher *watcher = ready[i].data.ptr;
			char data[16384];
			double time;
			ssize_t got = receive(watcher->socket, data, sizeof(data), &time);

			if (got > 0) {
				take(watcher, data, got, time);
			} else {
				close(watcher->socket);
				closed++;
			}
		}
	}
	if (closed < count || answered_count < count || !read_created(argv[4])) {
		fprintf(stderr, "watchers: %d of %d were answered, %d were let go\n", answered_count, count, closed);
		return 1;
	}
	report(count);
	free(arrivals);
	free(watchers);
	return 0;
}
