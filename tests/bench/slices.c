/*
 * Many browsers that scroll through one volume on loopback: how many slices a
 * second?
 *
 * Usage: slices PORT JOB SIZE COUNT SECONDS [AXIS]. Each of COUNT connections
 * asks for a plane of random axis (or AXIS) and index, PNG, and for the next one
 * as soon as it has it. AXIS oblique: SIZE x SIZE pixels of a plane through the
 * volume's middle at a random angle. One thread and one epoll.
 */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { HEAD_MAX = 2048, TIMES_MAX = 1 << 20 };

struct browser {
	int socket;
	double asked;
	char head[HEAD_MAX];
	int head_length; /* -1: it is over, the body comes in */
	long left;
};

static const char *job, *axis;
static int size;
static float *times;
static long count, bytes, refused;

static double now(void)
{
	struct timespec time;

	clock_gettime(CLOCK_MONOTONIC, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static bool ask(struct browser *browser)
{
	static const char *const axes[] = {"x", "y", "z"};
	char plane[128], request[256];
	int length;

	if (axis != NULL && strcmp(axis, "oblique") == 0)
		snprintf(plane, sizeof(plane), "normal=%ld,%ld,%ld&up=0,0,1&size=%d,%d", random() % 199 - 99,
			 100 + random() % 99, random() % 199 - 99, size, size);
	else
		snprintf(plane, sizeof(plane), "axis=%s&index=%ld", axis != NULL ? axis : axes[random() % 3],
			 random() % size);
	length = snprintf(request, sizeof(request),
			  "GET /v1/jobs/%s/volumes/final/slice?%s HTTP/1.1\r\nHost: localhost\r\n\r\n", job, plane);
	browser->asked = now();
	browser->head_length = 0;
	return send(browser->socket, request, (size_t)length, 0) == length;
}

static bool open_browser(struct browser *browser, int port, int epoll)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((unsigned short)port)};
	struct epoll_event wanted = {.events = EPOLLIN, .data.ptr = browser};

	address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	browser->socket = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	return browser->socket >= 0 && connect(browser->socket, (struct sockaddr *)&address, sizeof(address)) == 0 &&
	       ask(browser) && epoll_ctl(epoll, EPOLL_CTL_ADD, browser->socket, &wanted) == 0;
}

/* Behind the end of the head; false: more of it has to come. */
static bool read_head(struct browser *browser)
{
	char *end = strstr(browser->head, "\r\n\r\n"), *length = strstr(browser->head, "Content-Length: ");

	if (end == NULL)
		return false;
	refused += strncmp(browser->head, "HTTP/1.1 200", 12) != 0;
	browser->left = length != NULL ? atol(length + 16) : 0;
	browser->left -= browser->head + browser->head_length - (end + 4);
	browser->head_length = -1;
	return true;
}

static bool take(struct browser *browser)
{
	static char body[256 << 10];
	bool head = browser->head_length >= 0;
	ssize_t got = head ? recv(browser->socket, browser->head + browser->head_length,
				  sizeof(browser->head) - 1 - (size_t)browser->head_length, 0)
			   : recv(browser->socket, body, sizeof(body), 0);

	if (got <= 0)
		return false;
	bytes += got;
	if (head) {
		browser->head_length += (int)got;
		browser->head[browser->head_length] = '\0';
		if (!read_head(browser))
			return browser->head_length < HEAD_MAX - 1;
	} else {
		browser->left -= got;
	}
	if (browser->left > 0)
		return true;
	if (count < TIMES_MAX)
		times[count++] = (float)(now() - browser->asked);
	return ask(browser);
}

static int compare(const void *a, const void *b)
{
	float x = *(const float *)a, y = *(const float *)b;

	return (x > y) - (x < y);
}

int main(int argc, char **argv)
{
	int browsers = argc >= 6 ? atoi(argv[4]) : 0, port = argc >= 6 ? atoi(argv[1]) : 0;
	int epoll = epoll_create1(EPOLL_CLOEXEC);
	struct browser *all = calloc((size_t)browsers + 1, sizeof(*all));
	double begin, end;

	times = malloc(TIMES_MAX * sizeof(*times));
	if (browsers < 1 || epoll < 0 || all == NULL || times == NULL) {
		fprintf(stderr, "usage: slices PORT JOB SIZE COUNT SECONDS [AXIS]\n");
		return 2;
	}
	job = argv[2];
	size = atoi(argv[3]);
	axis = argc > 6 ? argv[6] : NULL;
	begin = now();
	end = begin + atof(argv[5]);
	for (int i = 0; i < browsers; i++) {
		if (!open_browser(&all[i], port, epoll)) {
			perror("browser");
			return 1;
		}
	}
	while (now() < end) {
		struct epoll_event ready[64];
		int many = epoll_wait(epoll, ready, 64, 100);

		for (int i = 0; i < many; i++) {
			if (!take(ready[i].data.ptr)) {
				fprintf(stderr, "slices: a connection broke\n");
				return 1;
			}
		}
	}
	end = now();
	qsort(times, (size_t)count, sizeof(*times), compare);
	printf("%d browsers, axis %s: %.0f slices/s, %.1f kB each, ms median %.0f, 99 %% %.0f, refused %ld\n", browsers,
	       axis != NULL ? axis : "random", (double)count / (end - begin),
	       count > 0 ? 1e-3 * (double)bytes / (double)count : 0, count > 0 ? 1e3 * (double)times[count / 2] : 0,
	       count > 0 ? 1e3 * (double)times[count * 99 / 100] : 0, refused);
	return refused > 0;
}
