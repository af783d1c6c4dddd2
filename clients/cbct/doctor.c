/*
 * cbct doctor: whether this machine is fit for the daemon, and what to do where it is not. A row for each subject looks
 * and says what it has found. It changes nothing but for a file in the state directory that it writes, syncs and
 * removes.
 */
#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <pwd.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/statfs.h>
#include <sys/sysmacros.h>
#include <sys/timex.h>
#include <time.h>
#include <unistd.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "core/host_memory.h"
#include "proto/clock.h"
#include "proto/nvml.h"

struct doctor_options {
	const char *directory;
	bool json;
	struct http_options http;
};

enum verdict { VERDICT_OK, VERDICT_NOTE, VERDICT_PROBLEM, VERDICT_COUNT };
static const char *const verdict_names[VERDICT_COUNT] = {"ok", "note", "problem"};

struct visit {
	const struct doctor_options *options;
	const char *directory;
	const char *subject; /* of the row that looks just now */
	cJSON *findings;
	int count[VERDICT_COUNT];
};

/* advice: what to do; NULL where nothing is. */
static void __attribute__((format(printf, 4, 5)))
found(struct visit *visit, enum verdict verdict, const char *advice, const char *format, ...)
{
	cJSON *finding = cJSON_CreateObject();
	char text[400];
	va_list args;

	va_start(args, format);
	vsnprintf(text, sizeof(text), format, args);
	va_end(args);
	visit->count[verdict]++;
	cJSON_AddStringToObject(finding, "subject", visit->subject);
	cJSON_AddStringToObject(finding, "verdict", verdict_names[verdict]);
	cJSON_AddStringToObject(finding, "finding", text);
	if (advice != NULL)
		cJSON_AddStringToObject(finding, "advice", advice);
	cJSON_AddItemToArray(visit->findings, finding);
	if (visit->options->json)
		return;
	printf("%-8s %s: %s\n", verdict_names[verdict], visit->subject, text);
	if (advice != NULL)
		printf("         -> %s\n", advice);
}

/* ---- cards ---- */

static void look_at_card(struct visit *visit, struct nvml *nvml, int index)
{
	const unsigned hot = 87; /* degrees, near which cards slow down */
	const unsigned long long MiB = 1 << 20;
	struct nvml_card card;

	nvml_read(nvml, index, &card);
	if (!card.answers) {
		found(visit, VERDICT_PROBLEM,
		      "look for \"NVRM: Xid\" in dmesg; a card that fell off the bus needs a restart of the machine",
		      "card %d does not answer its driver", index);
		return;
	}
	found(visit, VERDICT_OK, NULL, "card %d is %s with %llu of %llu MiB free, %u degrees", index, card.name,
	      (card.bytes_total - card.bytes_used) / MiB, card.bytes_total / MiB, card.celsius);
	if (card.has_temperature && card.celsius > hot)
		found(visit, VERDICT_PROBLEM, "clean fans and filters, give the cart air",
		      "card %d has %u degrees and slows down", index, card.celsius);
	if (card.has_errors && card.errors[1] > 0)
		found(visit, VERDICT_PROBLEM, "take the card out of service; volumes made since are in doubt",
		      "the memory of card %d had %llu errors that could not be corrected", index, card.errors[1]);
	if (card.has_memory && card.bytes_used > card.bytes_total / 2)
		found(visit, VERDICT_NOTE,
		      "nvidia-smi says who has it; large grids go through the card out of core meanwhile",
		      "more than half of the memory of card %d is in use", index);
}

static void look_at_cards(struct visit *visit)
{
	static const char *const nodes[] = {"/dev/nvidiactl", "/dev/nvidia-uvm"};
	const double least_driver = 525; /* of CUDA 12 */
	struct nvml *nvml = NULL;
	struct error err;
	char version[80];
	int code = nvml_open(&nvml, &err);

	if (code != 0) {
		found(visit, code == ERR_NOT_FOUND ? VERDICT_NOTE : VERDICT_PROBLEM,
		      code == ERR_NOT_FOUND
			  ? "without a card the processor reconstructs, some ten times slower"
			  : "load the driver (modprobe nvidia), restart the machine after an upgrade of it",
		      "%s", err.text);
		return;
	}
	nvml_driver(nvml, version, sizeof(version));
	if (strtod(version, NULL) < least_driver)
		found(visit, VERDICT_PROBLEM, "install a driver of at least that version",
		      "NVIDIA's driver %s is older than %.0f", version, least_driver);
	else
		found(visit, VERDICT_OK, NULL, "NVIDIA's driver %s", version);
	for (int i = 0; i < nvml_count(nvml); i++)
		look_at_card(visit, nvml, i);
	for (size_t i = 0; i < sizeof(nodes) / sizeof(*nodes); i++) {
		if (access(nodes[i], F_OK) != 0)
			found(visit, VERDICT_PROBLEM,
			      "nvidia-modprobe -u -c=0 makes it; nvidia-persistenced does so at each start",
			      "%s is not there, and a sandboxed service cannot make it", nodes[i]);
		else if (access(nodes[i], R_OK | W_OK) != 0)
			found(visit, VERDICT_PROBLEM, "the service's user must be in the group that owns it", "%s: %s",
			      nodes[i], strerror(errno));
	}
	nvml_close(nvml);
}

/* ---- the disk ---- */

static void look_at_space(struct visit *visit)
{
	struct statfs disk;
	double free_bytes, share;

	if (statfs(visit->directory, &disk) != 0) {
		found(visit, VERDICT_PROBLEM, "name the state directory: cbct doctor DIR", "%s: %s", visit->directory,
		      strerror(errno));
		return;
	}
	free_bytes = (double)disk.f_bavail * (double)disk.f_bsize;
	share = disk.f_blocks > 0 ? (double)disk.f_bavail / (double)disk.f_blocks : 0;
	found(visit,
	      share < 0.05   ? VERDICT_PROBLEM
	      : share < 0.15 ? VERDICT_NOTE
			     : VERDICT_OK,
	      share < 0.15 ? "delete jobs and scans that are archived (cbct rm)" : NULL,
	      "%.1f GB of %s are free (%.0f %%)", 1e-9 * free_bytes, visit->directory, 100 * share);
}

/* statfs(2): file systems that keep nothing, or whose syncs another machine answers for. */
static void look_at_kind(struct visit *visit)
{
	static const struct {
		long type;
		enum verdict verdict;
		const char *text, *advice;
	} kinds[] = {
	    {0x01021994, VERDICT_PROBLEM, "tmpfs: a power cut loses all of it", "put the state directory on a disk"},
	    {0x6969, VERDICT_NOTE, "NFS: a sync is as good as its server's",
	     "a disk of this machine is safer and faster"},
	    {(long)0xff534d42, VERDICT_NOTE, "CIFS: a sync is as good as its server's",
	     "a disk of this machine is safer and faster"},
	    {(long)0xfe534d42, VERDICT_NOTE, "SMB: a sync is as good as its server's",
	     "a disk of this machine is safer and faster"},
	    {0x65735546, VERDICT_NOTE, "FUSE: a sync is as good as its program",
	     "a file system of the kernel is safer and faster"},
	    {0x794c7630, VERDICT_NOTE, "overlayfs, of a container: it goes with the container",
	     "give the state directory a volume of its own"},
	};
	struct statfs disk;

	if (statfs(visit->directory, &disk) != 0)
		return;
	for (size_t i = 0; i < sizeof(kinds) / sizeof(*kinds); i++) {
		if (disk.f_type == kinds[i].type)
			found(visit, kinds[i].verdict, kinds[i].advice, "%s is on %s", visit->directory, kinds[i].text);
	}
}

static int compare_numbers(const void *a, const void *b)
{
	double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

/* ERR_NO_SPACE on a full disk, which takes a part at last. */
static int write_block(int file, const char *block, size_t size, off_t at, struct error *err)
{
	const ssize_t written = pwrite(file, block, size, at);

	return written == (ssize_t)size
		   ? 0
		   : error_set_errno(err, written < 0 ? errno : ENOSPC, "a file of 32 MiB to write");
}

/* The median of `count` syncs of 4 KiB, and what a block of some MB takes with its sync; s. */
static int measure_syncs(const char *directory, double *ret_sync, double *ret_rate, struct error *err)
{
	enum { SYNCS = 31, SMALL = 4096, BLOCK = 1 << 20, BLOCKS = 32 };
	char path[1024], *block = malloc(BLOCK);
	double seconds[SYNCS], start;
	int file, code = 0;

	snprintf(path, sizeof(path), "%.1000s/.doctor-XXXXXX", directory);
	file = block != NULL ? mkostemp(path, O_CLOEXEC) : -1;
	if (file < 0) {
		code = error_set_errno(err, errno, "a file in %s", directory);
		free(block);
		return code;
	}
	unlink(path);
	memset(block, 0x5a, BLOCK);
	for (int i = 0; i < SYNCS && code == 0; i++) {
		code = write_block(file, block, SMALL, (off_t)i * SMALL, err);
		start = clock_monotonic();
		if (code == 0 && fdatasync(file) != 0)
			code = error_set_errno(err, errno, "fdatasync");
		seconds[i] = clock_monotonic() - start;
	}
	start = clock_monotonic();
	for (int i = 0; i < BLOCKS && code == 0; i++)
		code = write_block(file, block, BLOCK, (off_t)i * BLOCK, err);
	if (code == 0 && fdatasync(file) != 0)
		code = error_set_errno(err, errno, "fdatasync");
	*ret_rate = BLOCKS * (double)BLOCK / (clock_monotonic() - start);
	close(file);
	free(block);
	if (code != 0)
		return code;
	qsort(seconds, SYNCS, sizeof(*seconds), compare_numbers);
	*ret_sync = seconds[SYNCS / 2];
	return 0;
}

/* One line of a file of the kernel's, "" where there is none. */
static void read_line(const char *path, char *ret_line, size_t size)
{
	FILE *file = fopen(path, "re");

	ret_line[0] = '\0';
	if (file != NULL && fgets(ret_line, (int)size, file) == NULL)
		ret_line[0] = '\0';
	if (file != NULL)
		fclose(file);
	ret_line[strcspn(ret_line, "\n")] = '\0';
}

/* Whether the device tells the kernel of a cache that a sync has to empty. A partition has its queue in its disk. */
static void look_at_cache(struct visit *visit)
{
	char path[128], line[80];
	struct stat status;

	if (stat(visit->directory, &status) != 0)
		return;
	snprintf(path, sizeof(path), "/sys/dev/block/%u:%u/queue/write_cache", major(status.st_dev),
		 minor(status.st_dev));
	read_line(path, line, sizeof(line));
	if (line[0] == '\0') {
		snprintf(path, sizeof(path), "/sys/dev/block/%u:%u/../queue/write_cache", major(status.st_dev),
			 minor(status.st_dev));
		read_line(path, line, sizeof(line));
	}
	if (strcmp(line, "write through") == 0)
		found(visit, VERDICT_NOTE,
		      "a virtual disk: ask for cache=none or writethrough on its host; a controller: its cache needs a "
		      "battery",
		      "the device says that it has no volatile cache, so that syncs do not empty one; from here nobody "
		      "can tell whether that is true");
	else if (line[0] != '\0')
		found(visit, VERDICT_OK, NULL, "the device has a volatile cache (%s), which syncs empty", line);
}

static void look_at_syncs(struct visit *visit)
{
	/* The fastest drives with a cache that survives a power cut take 10 us and more: less is a call that does
	 * nothing. */
	const double impossible = 5e-6, slow = 0.05, least_rate = 100e6;
	double sync = 0, rate = 0;
	struct error err;

	if (measure_syncs(visit->directory, &sync, &rate, &err) != 0) {
		found(visit, VERDICT_PROBLEM,
		      err.code == ERR_NO_SPACE ? "make room: delete scans and jobs, or a larger disk"
					       : "run it as the user of the service: sudo -u cbctd cbct doctor",
		      "%s", err.text);
		return;
	}
	if (sync < impossible)
		found(visit, VERDICT_PROBLEM,
		      "look for eatmydata in LD_PRELOAD, for tmpfs, for a virtual disk with cache=unsafe",
		      "a sync takes %.1f us, which no disk can: what is acknowledged is lost by a power cut",
		      1e6 * sync);
	else
		found(visit, sync > slow ? VERDICT_NOTE : VERDICT_OK,
		      sync > slow
			  ? "uploads are acknowledged after a sync; smartctl -a says whether the disk is failing"
			  : NULL,
		      "a sync takes %.2f ms", 1e3 * sync);
	found(visit, rate < least_rate ? VERDICT_NOTE : VERDICT_OK,
	      rate < least_rate ? "30 views of 1 MP a second are 60 MB/s, and kept volumes come on top" : NULL,
	      "%.0f MB/s reach the disk", 1e-6 * rate);
	look_at_cache(visit);
}

/* ---- the machine ---- */

static void look_at_clock(struct visit *visit)
{
	const time_t made = 1735689600; /* 2025-01-01 */
	struct timex state = {.modes = 0};
	char now[CLOCK_TEXT_SIZE];
	struct stat status;

	clock_text(clock_realtime(), now);
	if (time(NULL) < made)
		found(visit, VERDICT_PROBLEM, "timedatectl set-time, or a new battery for the board", "it is %s here",
		      now);
	else if (stat(visit->directory, &status) == 0 && status.st_mtime > time(NULL) + 60)
		found(visit, VERDICT_PROBLEM, "set the clock: images would bear a wrong time",
		      "it is %s here, but %s was changed later than that", now, visit->directory);
	else if (adjtimex(&state) < 0 || (state.status & STA_UNSYNC) != 0)
		found(visit, VERDICT_NOTE, "systemd-timesyncd or chrony, with the hospital's time server",
		      "it is %s by a clock that nothing keeps right", now);
	else
		found(visit, VERDICT_OK, NULL, "it is %s, kept right within %.0f ms", now,
		      1e-3 * (double)state.maxerror);
}

static void look_at_rights(struct visit *visit)
{
	struct stat status;
	const struct passwd *owner;

	if (stat(visit->directory, &status) != 0)
		return;
	owner = getpwuid(status.st_uid);
	if (access(visit->directory, R_OK | W_OK | X_OK) != 0)
		found(visit, VERDICT_PROBLEM, "run it as the user of the service, or chown the directory",
		      "%s belongs to %s, and this user may not write there", visit->directory,
		      owner != NULL ? owner->pw_name : "nobody known");
	else if ((status.st_mode & (S_IRWXO | S_IWGRP)) != 0)
		found(visit, VERDICT_PROBLEM, "chmod 750: patients' names are in it",
		      "%s may be opened by others (mode %03o)", visit->directory, (unsigned)status.st_mode & 0777);
	else
		found(visit, VERDICT_OK, NULL, "%s belongs to %s, mode %03o", visit->directory,
		      owner != NULL ? owner->pw_name : "nobody known", (unsigned)status.st_mode & 0777);
}

static void look_at_limits(struct visit *visit)
{
	const rlim_t enough = 4160; /* two for each of 2048 connections, and the daemon's own */
	struct rlimit files, locked;

	if (getrlimit(RLIMIT_NOFILE, &files) == 0)
		found(visit, files.rlim_max < enough ? VERDICT_NOTE : VERDICT_OK,
		      files.rlim_max < enough ? "LimitNOFILE=65536 in the unit; otherwise fewer connections are taken"
					      : NULL,
		      "at most %llu descriptors (of this shell; the unit has its own)",
		      (unsigned long long)files.rlim_max);
	if (getrlimit(RLIMIT_MEMLOCK, &locked) == 0 && locked.rlim_max != RLIM_INFINITY)
		found(visit, VERDICT_NOTE, "LimitMEMLOCK=infinity in the unit",
		      "at most %llu kB of locked memory (of this shell): copies to the card are slower",
		      (unsigned long long)locked.rlim_max >> 10);
}

static void look_at_memory(struct visit *visit)
{
	const double enough = 8e9; /* 512^3 with seven volumes of float32 and its projections */
	struct host_memory host;

	host_memory(&host);
	found(visit, (double)host.available < enough ? VERDICT_NOTE : VERDICT_OK,
	      (double)host.available < enough
		  ? "a grid of 512^3 on the processor takes about 8 GB; smaller grids take less"
		  : NULL,
	      "%.1f of %.1f GB are available", 1e-9 * (double)host.available, 1e-9 * (double)host.total);
	if (host.limit != SIZE_MAX)
		found(visit, VERDICT_NOTE,
		      "MemoryMax= of the service or the container's limit, where jobs are refused for want of memory",
		      "a control group allows %.1f GB", 1e-9 * (double)host.limit);
}

static void look_at_daemon(struct visit *visit)
{
	struct http_request question = {.method = "GET", .path = "/readyz"};
	struct http_reply reply = {0};
	struct http *http = NULL;
	struct error err;
	int code = http_new(&visit->options->http, &http, &err);

	if (code == 0)
		code = http_send(http, &question, &reply, &err);
	if (code == 0)
		found(visit, VERDICT_OK, NULL, "it answers: %.*s", (int)strcspn(reply.body, "\n"), reply.body);
	else if (http != NULL && reply.status == 0)
		found(visit, VERDICT_NOTE, "systemctl status cbctd; journalctl -u cbctd", "%s", err.text);
	else
		found(visit, VERDICT_PROBLEM, "GET /v1/devices (cbct status) says how its worker ended", "%s",
		      err.text);
	http_reply_clear(&reply);
	http_free(http);
}

/* The clock before the syncs, which change the directory. */
static const struct {
	const char *subject;
	void (*look)(struct visit *visit);
} rows[] = {{"card", look_at_cards},    {"clock", look_at_clock},   {"disk", look_at_space},
	    {"disk", look_at_kind},     {"sync", look_at_syncs},    {"rights", look_at_rights},
	    {"limits", look_at_limits}, {"memory", look_at_memory}, {"daemon", look_at_daemon}};

/* Where the daemon keeps its state when nobody says. */
static const char *state_directory(void)
{
	const char *given = getenv("STATE_DIRECTORY");

	return given != NULL && given[0] != '\0' ? given : "/var/lib/cbctd";
}

static int doctor_run(const void *values, struct error *err)
{
	const struct doctor_options *options = values;
	struct visit visit = {.options = options,
			      .directory = options->directory != NULL ? options->directory : state_directory(),
			      .findings = cJSON_CreateArray()};
	int problems, code = 0;

	for (size_t i = 0; i < sizeof(rows) / sizeof(*rows); i++) {
		visit.subject = rows[i].subject;
		rows[i].look(&visit);
	}
	problems = visit.count[VERDICT_PROBLEM];
	if (options->json)
		code = document_print(visit.findings, err);
	cJSON_Delete(visit.findings);
	if (code != 0 || problems == 0)
		return code;
	return error_set(err, ERR_IMPOSSIBLE, "%d problem%s", problems, problems == 1 ? "" : "s");
}

static const struct option doctor_rows[] = {
    {"json", 0, OPTION_FLAG, offsetof(struct doctor_options, json), NULL,
     "an array of objects: subject, verdict (ok, note, problem), finding, advice", 0, 0, 0, NULL},
    {0},
};
static const struct option_group groups[] = {
    {"options", doctor_rows, 0}, {"", http_option_rows, offsetof(struct doctor_options, http)}, {0}};
static const struct positional positionals[] = {
    {"DIR", "the daemon's state directory (default $STATE_DIRECTORY, else /var/lib/cbctd)",
     offsetof(struct doctor_options, directory), false},
    {0},
};
static const struct doctor_options defaults;

const struct command command_doctor = {
    "doctor",    "looks whether this machine is fit for the daemon, and says what to do",
    positionals, groups,
    &defaults,   sizeof(defaults),
    doctor_run};
