/*
 * An arm that turns, on loopback: projections are sent at a steady rate, each
 * when it is due, while a job waits for them. How long each PUT took, how late
 * it could be sent, and when the FDK volume was kept after the last 2xx.
 *
 * Usage: acquire PORT SCAN JOB FILE VIEWS BYTES RATE CONNECTIONS. FILE holds
 * VIEWS projections of BYTES bytes. One line of JSON, times in ms.
 */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include <fcntl.h>

enum { CONNECTIONS_MAX = 16, REPLY_MAX = 65536 };

struct acquisition {
	int port, views;
	size_t bytes;
	double rate, begin; /* views a second; seconds of now() */
	const char *scan, *job, *samples;
	double *took, *late; /* [views] seconds */

	pthread_mutex_t lock; /* guards what follows */
	pthread_cond_t changed;
	int next, failed;
	double last;        /* 2xx so far */
	double kept, ended; /* the FDK volume, the job; 0: not yet */
	bool watching, closed;
};

static double now(void)
{
	struct timespec time;

	clock_gettime(CLOCK_MONOTONIC, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static void sleep_until(double time)
{
	struct timespec until = {.tv_sec = (time_t)time};

	until.tv_nsec = (long)((time - (double)until.tv_sec) * 1e9);
	clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
}

static int dial(int port)
{
	struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((unsigned short)port)};
	int to = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0), yes = 1;

	address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	if (to >= 0 && connect(to, (struct sockaddr *)&address, sizeof(address)) != 0) {
		close(to);
		return -1;
	}
	if (to >= 0)
		setsockopt(to, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof(yes));
	return to;
}

static bool send_all(int to, const char *data, size_t size)
{
	for (size_t done = 0; done < size;) {
		ssize_t sent = send(to, data + done, size - done, MSG_NOSIGNAL);

		if (sent <= 0)
			return false;
		done += (size_t)sent;
	}
	return true;
}

/* The status of a reply with its length told, read to its end; 0 when there is none. */
static int read_reply(int from)
{
	char text[REPLY_MAX];
	size_t length = 0, expected = 0;
	const char *end = NULL;

	for (;;) {
		ssize_t got = recv(from, text + length, sizeof(text) - 1 - length, 0);
		const char *field;

		if (got <= 0)
			return 0;
		length += (size_t)got;
		text[length] = '\0';
		if (end == NULL && (end = strstr(text, "\r\n\r\n")) != NULL) {
			field = strcasestr(text, "\r\nContent-Length:");
			expected = (size_t)(end - text) + 4 + (field == NULL ? 0 : (size_t)atol(field + 17));
		}
		if (end != NULL && length >= expected)
			return atoi(text + 9);
	}
}

/* ---- the detector ---- */

static void note(struct acquisition *acquisition, int view, double due, double sent, double replied, int status)
{
	pthread_mutex_lock(&acquisition->lock);
	acquisition->took[view] = replied - sent;
	acquisition->late[view] = sent - due;
	acquisition->failed += status != 201;
	if (replied > acquisition->last)
		acquisition->last = replied;
	pthread_mutex_unlock(&acquisition->lock);
}

static void *detector(void *context)
{
	struct acquisition *acquisition = context;
	int to = dial(acquisition->port);

	for (;;) {
		double due, sent;
		char head[300];
		int view, length, status = 0;

		pthread_mutex_lock(&acquisition->lock);
		view = acquisition->next++;
		pthread_mutex_unlock(&acquisition->lock);
		if (view >= acquisition->views)
			break;
		due = acquisition->begin + view / acquisition->rate;
		sleep_until(due);
		sent = now();
		length = snprintf(head, sizeof(head),
				  "PUT /v1/scans/%s/projections/%d HTTP/1.1\r\nHost: localhost\r\n"
				  "Content-Length: %zu\r\n\r\n",
				  acquisition->scan, view, acquisition->bytes);
		if (send_all(to, head, (size_t)length) &&
		    send_all(to, acquisition->samples + (size_t)view * acquisition->bytes, acquisition->bytes))
			status = read_reply(to);
		note(acquisition, view, due, sent, now(), status);
	}
	close(to);
	return NULL;
}

/* ---- the surgeon ---- */

static void on_line(struct acquisition *acquisition, const char *line, double time)
{
	pthread_mutex_lock(&acquisition->lock);
	acquisition->watching = true;
	if (acquisition->kept == 0 && strncmp(line, "data: ", 6) == 0 && strstr(line, "\"name\":\"fdk\"") != NULL)
		acquisition->kept = time;
	if (acquisition->ended == 0 && strcmp(line, "event: end") == 0)
		acquisition->ended = time;
	pthread_cond_broadcast(&acquisition->changed);
	pthread_mutex_unlock(&acquisition->lock);
}

static void *watcher(void *context)
{
	struct acquisition *acquisition = context;
	int from = dial(acquisition->port), length = 0;
	char request[200], line[8192], data[16384];
	ssize_t got = 0;

	snprintf(request, sizeof(request), "GET /v1/jobs/%s/events HTTP/1.1\r\nHost: localhost\r\n\r\n",
		 acquisition->job);
	if (send_all(from, request, strlen(request)))
		got = 1;
	while (got > 0 && acquisition->ended == 0) {
		double time;

		got = recv(from, data, sizeof(data), 0);
		time = now();
		for (ssize_t i = 0; i < got; i++) {
			if (data[i] == '\n') {
				line[length] = '\0';
				on_line(acquisition, line, time);
				length = 0;
			} else if (length < (int)sizeof(line) - 1) {
				line[length++] = data[i];
			}
		}
	}
	close(from);
	pthread_mutex_lock(&acquisition->lock);
	acquisition->closed = acquisition->watching = true;
	pthread_cond_broadcast(&acquisition->changed);
	pthread_mutex_unlock(&acquisition->lock);
	return NULL;
}

/* ---- the run ---- */

static int compare(const void *a, const void *b)
{
	double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

static void report_times(const char *name, double *seconds, int count)
{
	qsort(seconds, (size_t)count, sizeof(*seconds), compare);
	printf("\"%s\": {\"median\": %.2f, \"p99\": %.2f, \"most\": %.2f}, ", name, 1e3 * seconds[count / 2],
	       1e3 * seconds[count * 99 / 100], 1e3 * seconds[count - 1]);
}

static void report(struct acquisition *acquisition)
{
	printf("{\"views\": %d, \"bytes\": %zu, \"rate\": %g, ", acquisition->views, acquisition->bytes,
	       acquisition->rate);
	report_times("put_ms", acquisition->took, acquisition->views);
	report_times("late_ms", acquisition->late, acquisition->views);
	printf("\"not_201\": %d, \"fdk_kept_ms\": %.1f, \"ended_ms\": %.1f}\n", acquisition->failed,
	       1e3 * (acquisition->kept - acquisition->last), 1e3 * (acquisition->ended - acquisition->last));
}

static void run(struct acquisition *acquisition, int connections)
{
	pthread_t detectors[CONNECTIONS_MAX], surgeon;

	pthread_create(&surgeon, NULL, watcher, acquisition);
	pthread_mutex_lock(&acquisition->lock);
	while (!acquisition->watching)
		pthread_cond_wait(&acquisition->changed, &acquisition->lock);
	pthread_mutex_unlock(&acquisition->lock);
	acquisition->begin = now() + 0.5;
	for (int i = 0; i < connections; i++)
		pthread_create(&detectors[i], NULL, detector, acquisition);
	for (int i = 0; i < connections; i++)
		pthread_join(detectors[i], NULL);
	pthread_join(surgeon, NULL);
}

int main(int argc, char **argv)
{
	struct acquisition acquisition = {.lock = PTHREAD_MUTEX_INITIALIZER, .changed = PTHREAD_COND_INITIALIZER};
	int connections, file;

	if (argc != 9) {
		fprintf(stderr, "usage: acquire PORT SCAN JOB FILE VIEWS BYTES RATE CONNECTIONS\n");
		return 2;
	}
	acquisition.port = atoi(argv[1]);
	acquisition.scan = argv[2];
	acquisition.job = argv[3];
	acquisition.views = atoi(argv[5]);
	acquisition.bytes = (size_t)atol(argv[6]);
	acquisition.rate = atof(argv[7]);
	connections = atoi(argv[8]) < CONNECTIONS_MAX ? atoi(argv[8]) : CONNECTIONS_MAX;
	file = open(argv[4], O_RDONLY | O_CLOEXEC);
	acquisition.samples =
	    mmap(NULL, (size_t)acquisition.views * acquisition.bytes, PROT_READ, MAP_SHARED | MAP_POPULATE, file, 0);
	acquisition.took = calloc((size_t)acquisition.views, sizeof(double));
	acquisition.late = calloc((size_t)acquisition.views, sizeof(double));
	if (file < 0 || acquisition.samples == MAP_FAILED || acquisition.took == NULL || acquisition.late == NULL) {
		perror(argv[4]);
		return 1;
	}
	run(&acquisition, connections);
	report(&acquisition);
	return acquisition.failed > 0 || acquisition.kept == 0 || acquisition.ended == 0;
}
