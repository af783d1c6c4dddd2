/*
 * The listener: what peers send to our application entity. Each association has a process of its own, a child of this
 * one: answers of storage commitment become a line {"promise": ...} to the daemon; runs of projections become files,
 * and, once nothing more of a run has come for a while, a scan, by `cbct import`, and where the configuration says so a
 * job, by `cbct submit`. A run whose import fails stays, as failed-RUN.
 *
 * Files of a run are there until its scan is whole; the run's name is the scan's Idempotency-Key, so that a run that is
 * imported again, after a crash or because it was sent twice, is the same scan.
 */
#include <arpa/inet.h>
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "daemon/dicom/dicom.h"
#include "daemon/dicom/dimse.h"
#include "proto/json.h"

enum {
	DAEMON = 3,
	CHILDREN_MOST = 16,      /* associations at a time */
	ADDRESS_MOST = 8,        /* of them from one address, so that none shuts out all others */
	REQUEST_MOST = 5,        /* s that a connection may take until its association begins */
	TELL_EVERY = 10,         /* s between two lines about refusals */
	ASSOCIATION_MOST = 3600, /* s */
	PEERS_MOST = 64,
	ARGUMENTS_MOST = 64,
	IMPORT_LINE = 1024
};

struct listener {
	const cJSON *options;
	int socket;
	const char *callers[PEERS_MOST + 1];
	char directory[900]; /* "": no objects are taken */
	double quiet;        /* s */
	time_t told;         /* of the last refusal */
	int untold;          /* refusals since then */
	struct {
		pid_t pid; /* 0: none */
		int pidfd;
		struct in_addr address; /* of the peer */
		int said;               /* what it says of its association; -1 for an import */
	} children[CHILDREN_MOST + 1];  /* the last one imports */
};

static const cJSON *receive_of(const struct listener *listener)
{
	return cJSON_GetObjectItemCaseSensitive(listener->options, "receive");
}

/* ---- associations ---- */

static void promised(void *context, const struct dimse_promise *promise)
{
	cJSON *line = cJSON_CreateObject(), *told = cJSON_AddObjectToObject(line, "promise");

	(void)context;
	cJSON_AddStringToObject(told, "transaction", promise->transaction);
	cJSON_AddNumberToObject(told, "kept", promise->kept);
	cJSON_AddNumberToObject(told, "refused", promise->refused);
	cJSON_AddNumberToObject(told, "reason", promise->reason);
	tell(line);
}

/* A child's words for the listener, which alone knows how much was told lately. */
struct refusal {
	char title[17], why[80];
};

static void accepted(void *context)
{
	(void)context;
	alarm(ASSOCIATION_MOST);
}

static void refused(void *context, const char *title, const char *why)
{
	const int *said = context;
	struct refusal refusal = {.title = ""};

	snprintf(refusal.title, sizeof(refusal.title), "%s", title);
	snprintf(refusal.why, sizeof(refusal.why), "%s", why);
	/* A listener that is gone needs none. */
	if (write(*said, &refusal, sizeof(refusal)) < 0)
		alarm(1);
}

/* The child: ends with the association, or with the listener. */
static void serve(const struct listener *listener, int connection, int said)
{
	const double most = destination_number(receive_of(listener), "max_bytes", 4294967296.0);
	const struct rlimit files = {(rlim_t)most, (rlim_t)most};
	const struct dimse_serving serving = {.title = destination_text(listener->options, "own_title"),
					      .callers = listener->callers,
					      .directory = listener->directory[0] != '\0' ? listener->directory : NULL,
					      .seconds = (int)destination_patience(listener->options, 0),
					      .promised = promised,
					      .accepted = accepted,
					      .refused = refused,
					      .context = &said};
	struct error err = {0};

	prctl(PR_SET_PDEATHSIG, SIGKILL);
	signal(SIGXFSZ, SIG_IGN);
	signal(SIGALRM, SIG_DFL);
	setrlimit(RLIMIT_FSIZE, &files);
	/* Until the association begins: who only connects, or sends its request a byte at a time, is cut off. */
	alarm(REQUEST_MOST);
	_exit(dimse_serve(&serving, connection, &err) == 0 ? 0 : 1);
}

static void tell_refusal(struct listener *listener, struct in_addr address, const char *title, const char *why)
{
	const time_t now = time(NULL);
	cJSON *line, *told;
	char text[INET_ADDRSTRLEN], more[60] = "";

	/* One line for many: a scanner of ports fills no log. A clock that was set back silences nobody. */
	if (now >= listener->told && now - listener->told < TELL_EVERY) {
		listener->untold++;
		return;
	}
	if (listener->untold > 0)
		snprintf(more, sizeof(more), " (and %d others before it)", listener->untold);
	listener->told = now;
	listener->untold = 0;
	line = cJSON_CreateObject();
	told = cJSON_AddObjectToObject(line, "refused");
	cJSON_AddStringToObject(told, "address", inet_ntop(AF_INET, &address, text, sizeof(text)));
	cJSON_AddStringToObject(told, "title", title);
	cJSON_AddStringToObject(told, "why", why);
	cJSON_AddStringToObject(told, "more", more);
	tell(line);
}

static void note_child(struct listener *listener, int place, pid_t pid, struct in_addr address, int said)
{
	if (pid < 0) {
		if (said >= 0)
			close(said);
		return;
	}
	listener->children[place].pid = pid;
	listener->children[place].pidfd = (int)syscall(SYS_pidfd_open, pid, 0);
	listener->children[place].address = address;
	listener->children[place].said = said;
}

/* A free place for a peer of this address; -1: it has its share, or all are taken. */
static int place_for(const struct listener *listener, struct in_addr address)
{
	int place = -1, count = 0;

	for (int i = 0; i < CHILDREN_MOST; i++) {
		if (listener->children[i].pid == 0)
			place = i;
		else
			count += listener->children[i].address.s_addr == address.s_addr;
	}
	return count < ADDRESS_MOST ? place : -1;
}

static void accept_one(struct listener *listener)
{
	struct sockaddr_in peer = {.sin_family = AF_INET};
	socklen_t length = sizeof(peer);
	const int connection = accept4(listener->socket, (struct sockaddr *)&peer, &length, SOCK_CLOEXEC);
	const int place = connection >= 0 ? place_for(listener, peer.sin_addr) : -1;
	int ends[2] = {-1, -1};
	pid_t pid = -1;

	if (connection < 0)
		return;
	if (place < 0)
		tell_refusal(listener, peer.sin_addr, "", "there are too many associations at once");
	else if (pipe2(ends, O_CLOEXEC | O_NONBLOCK) == 0)
		pid = fork();
	if (pid == 0)
		serve(listener, connection, ends[1]);
	close(connection);
	if (ends[1] >= 0)
		close(ends[1]);
	if (place >= 0)
		note_child(listener, place, pid, peer.sin_addr, ends[0]);
}

static void reap(struct listener *listener, int place)
{
	const int said = listener->children[place].said;
	struct refusal refusal;
	int status = 0;

	waitpid(listener->children[place].pid, &status, 0);
	close(listener->children[place].pidfd);
	listener->children[place].pid = 0;
	if (said < 0)
		return;
	if (read(said, &refusal, sizeof(refusal)) == sizeof(refusal))
		tell_refusal(listener, listener->children[place].address, refusal.title, refusal.why);
	else if (WIFSIGNALED(status) && WTERMSIG(status) == SIGALRM)
		tell_refusal(listener, listener->children[place].address, "", "it takes too long");
	close(said);
}

/* ---- runs become scans ---- */

/* The options that say where the daemon is; returns how many arguments there are now. */
static int add_connection(const struct listener *listener, int count, char *arguments[ARGUMENTS_MOST])
{
	static const char *const connections[] = {"url", "token-file", "cacert"};

	for (size_t i = 0; i < sizeof(connections) / sizeof(connections[0]); i++) {
		const char *value = destination_text(receive_of(listener), connections[i]);

		if (value[0] != '\0' && asprintf(&arguments[count], "--%s=%s", connections[i], value) > 0)
			count++;
	}
	return count;
}

/* `cbct import RUN --url ... `: members of "import" are options of the same names. */
static void import_arguments(const struct listener *listener, const char *run, const char *key,
			     char *arguments[ARGUMENTS_MOST])
{
	const cJSON *receive = receive_of(listener), *option;
	int count = 0;

	arguments[count++] = strdup("cbct");
	arguments[count++] = strdup("import");
	arguments[count++] = strdup(run);
	arguments[count++] = strdup("--quiet");
	arguments[count++] = strdup("--key");
	arguments[count++] = strdup(key);
	count = add_connection(listener, count, arguments);
	cJSON_ArrayForEach(option, cJSON_GetObjectItemCaseSensitive(receive, "import"))
	{
		char **next = &arguments[count];

		if (count + 1 < ARGUMENTS_MOST &&
		    (cJSON_IsTrue(option)     ? asprintf(next, "--%s", option->string)
		     : cJSON_IsNumber(option) ? asprintf(next, "--%s=%.17g", option->string, option->valuedouble)
		     : cJSON_IsString(option) ? asprintf(next, "--%s=%s", option->string, option->valuestring)
					      : -1) > 0)
			count++;
	}
	arguments[count] = NULL;
}

/* The program beside this one, else by PATH. */
static void execute(char *const *arguments)
{
	char path[1024];
	ssize_t length = readlink("/proc/self/exe", path, sizeof(path) - 8);
	char *slash;

	path[length > 0 ? length : 0] = '\0';
	slash = strrchr(path, '/');
	if (slash != NULL) {
		snprintf(slash + 1, sizeof(path) - (size_t)(slash + 1 - path), "%s", arguments[0]);
		execv(path, arguments);
	}
	execvp(arguments[0], arguments);
	_exit(127);
}

/* What was written to a file, without what stands before its last bytes. */
static void read_end(int file, char ret[IMPORT_LINE])
{
	const off_t size = lseek(file, 0, SEEK_END), most = IMPORT_LINE - 1;
	const ssize_t got = pread(file, ret, (size_t)most, size > most ? size - most : 0);

	ret[got > 0 ? got : 0] = '\0';
}

/* Runs it, and frees the arguments; `said` ends with the id of what was made, or with why there is none. */
static bool run_client(char **arguments, char said[IMPORT_LINE])
{
	const int out = memfd_create("out", MFD_CLOEXEC), errors = memfd_create("errors", MFD_CLOEXEC);
	int status = -1;
	pid_t pid = out >= 0 && errors >= 0 ? fork() : -1;
	bool done;

	if (pid == 0) {
		prctl(PR_SET_PDEATHSIG, SIGKILL);
		dup2(out, 1);
		dup2(errors, 2);
		close(DAEMON);
		execute(arguments);
	}
	done = pid > 0 && waitpid(pid, &status, 0) == pid && WIFEXITED(status) && WEXITSTATUS(status) == 0;
	read_end(done ? out : errors, said);
	close(out);
	close(errors);
	for (int i = 0; arguments[i] != NULL; i++)
		free(arguments[i]);
	return done;
}

/* The last line that is not empty, without its end. */
static const char *last_line(char *text)
{
	char *end = text + strlen(text), *line;

	while (end > text && (end[-1] == '\n' || end[-1] == ' '))
		*--end = '\0';
	line = strrchr(text, '\n');
	return line != NULL ? line + 1 : text;
}

/* Posts the job that runs get here, once however often it is asked for. */
static void submit_job(const struct listener *listener, const char *scan, const char *key, cJSON *told)
{
	const cJSON *job = cJSON_GetObjectItemCaseSensitive(receive_of(listener), "job");
	char *text = json_print(job, NULL), *arguments[ARGUMENTS_MOST] = {NULL};
	/* Not closed by the program that reads it. */
	const int file = text != NULL ? memfd_create("job", 0) : -1;
	char said[IMPORT_LINE] = "no memory for a job";
	int count = 0;
	bool done = false;

	if (job == NULL)
		return;
	if (file >= 0 && write(file, text, strlen(text)) == (ssize_t)strlen(text)) {
		arguments[count++] = strdup("cbct");
		arguments[count++] = strdup("submit");
		arguments[count++] = strdup(scan);
		count += asprintf(&arguments[count], "/proc/self/fd/%d", file) > 0;
		arguments[count++] = strdup("--once");
		arguments[count++] = strdup(key);
		arguments[add_connection(listener, count, arguments)] = NULL;
		done = run_client(arguments, said);
	}
	cJSON_AddStringToObject(told, done ? "job" : "error", last_line(said));
	if (file >= 0)
		close(file);
	free(text);
}

static void remove_run(const char *path)
{
	DIR *directory = opendir(path);
	const struct dirent *entry;

	while (directory != NULL && (entry = readdir(directory)) != NULL)
		unlinkat(dirfd(directory), entry->d_name, 0);
	if (directory != NULL)
		closedir(directory);
	rmdir(path);
}

/* In a process of its own. */
static void import_run(const struct listener *listener, const char *name)
{
	char path[1200], failed[1300], key[80], said[IMPORT_LINE];
	cJSON *line = cJSON_CreateObject(), *told = cJSON_AddObjectToObject(line, "received");
	char *arguments[ARGUMENTS_MOST] = {NULL};
	bool done;

	prctl(PR_SET_PDEATHSIG, SIGKILL);
	snprintf(path, sizeof(path), "%s/%.64s", listener->directory, name);
	snprintf(failed, sizeof(failed), "%s/failed-%.64s", listener->directory, name);
	snprintf(key, sizeof(key), "received-%.64s", name);
	import_arguments(listener, path, key, arguments);
	done = run_client(arguments, said);
	cJSON_AddStringToObject(told, done ? "scan" : "error", last_line(said));
	if (done) {
		/* The run goes after its job: a crash between both has both made again, and they are the same. */
		submit_job(listener, last_line(said), key, told);
		remove_run(path);
	} else {
		/* An older one of the same name was told already. */
		remove_run(failed);
		rename(path, failed);
	}
	tell(line);
	_exit(0);
}

/* Begins to import a run that is quiet; returns the milliseconds until another one may be, -1: none before a child
 * ends. */
static int import_quiet(struct listener *listener)
{
	DIR *directory = listener->directory[0] != '\0' ? opendir(listener->directory) : NULL;
	const struct dirent *entry;
	struct timespec now;
	double wait = -1;
	pid_t pid;

	clock_gettime(CLOCK_REALTIME, &now);
	while (directory != NULL && listener->children[CHILDREN_MOST].pid == 0 &&
	       (entry = readdir(directory)) != NULL) {
		struct stat status;
		double age;

		if (strspn(entry->d_name, "0123456789.") != strlen(entry->d_name) || entry->d_name[0] == '.' ||
		    strlen(entry->d_name) > 64 || fstatat(dirfd(directory), entry->d_name, &status, 0) != 0 ||
		    !S_ISDIR(status.st_mode))
			continue;
		age = (double)(now.tv_sec - status.st_mtim.tv_sec) +
		      1e-9 * (double)(now.tv_nsec - status.st_mtim.tv_nsec);
		/* A clock that was set back makes nothing wait for long. */
		if (age >= listener->quiet || age < -1) {
			pid = fork();
			if (pid == 0)
				import_run(listener, entry->d_name);
			note_child(listener, CHILDREN_MOST, pid, (struct in_addr){0}, -1);
		} else if (wait < 0 || listener->quiet - age < wait)
			wait = listener->quiet - age;
	}
	if (directory != NULL)
		closedir(directory);
	return wait < 0 || listener->children[CHILDREN_MOST].pid != 0 ? -1 : (int)(1000 * wait) + 1;
}

/* ---- the listener ---- */

static int open_socket(const cJSON *options, int *ret_socket, struct error *err)
{
	const char *text = destination_text(options, "address");
	struct sockaddr_in address = {.sin_family = AF_INET,
				      .sin_port = htons((uint16_t)destination_number(options, "port", 11112))};
	const int one = 1, fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);

	if (inet_pton(AF_INET, text[0] != '\0' ? text : "0.0.0.0", &address.sin_addr) != 1) {
		close(fd);
		return error_set(err, ERR_INVALID, "\"%.40s\" is no IPv4 address to listen on", text);
	}
	if (fd < 0 || setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &one, sizeof(one)) != 0 ||
	    bind(fd, (struct sockaddr *)&address, sizeof(address)) != 0 || listen(fd, CHILDREN_MOST) != 0) {
		const int code = error_set_errno(err, errno, "port %d", ntohs(address.sin_port));

		if (fd >= 0)
			close(fd);
		return code;
	}
	*ret_socket = fd;
	return 0;
}

static int prepare(struct listener *listener, struct error *err)
{
	const cJSON *peer, *receive = receive_of(listener);
	int count = 0;

	if (!dimse_built())
		return error_set(err, ERR_IMPOSSIBLE,
				 "this cbct-dicom was built without DCMTK (libdcmtk-dev): it cannot listen");
	cJSON_ArrayForEach(peer, cJSON_GetObjectItemCaseSensitive(listener->options, "peers"))
	{
		if (count < PEERS_MOST && cJSON_IsString(peer))
			listener->callers[count++] = peer->valuestring;
	}
	listener->quiet = destination_number(receive, "quiet_s", 5);
	if (receive == NULL)
		return 0;
	snprintf(listener->directory, sizeof(listener->directory), "%s",
		 destination_text(listener->options, "directory"));
	if (mkdir(listener->directory, 0700) != 0 && errno != EEXIST)
		return error_set_errno(err, errno, "%.200s", listener->directory);
	return 0;
}

int listener_run(const cJSON *listening, struct error *err)
{
	struct listener listener = {.options = listening, .socket = -1};
	int code = prepare(&listener, err);

	if (code == 0)
		code = open_socket(listening, &listener.socket, err);
	if (code == 0) {
		cJSON *line = cJSON_CreateObject();

		cJSON_AddBoolToObject(line, "listening", true);
		tell(line);
	}
	while (code == 0) {
		struct pollfd fds[3 + CHILDREN_MOST] = {{.fd = DAEMON, .events = POLLIN},
							{.fd = listener.socket, .events = POLLIN}};

		for (int i = 0; i <= CHILDREN_MOST; i++)
			fds[2 + i] = (struct pollfd){
			    .fd = listener.children[i].pid != 0 ? listener.children[i].pidfd : -1, .events = POLLIN};
		poll(fds, 3 + CHILDREN_MOST, import_quiet(&listener));
		/* The daemon sends nothing more: it has ended. */
		if (fds[0].revents != 0)
			_exit(0);
		if (fds[1].revents != 0)
			accept_one(&listener);
		for (int i = 0; i <= CHILDREN_MOST; i++)
			if (fds[2 + i].revents != 0)
				reap(&listener, i);
	}
	return code;
}
