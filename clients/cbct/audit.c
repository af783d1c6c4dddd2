/* cbct audit: whether the daemon's audit log is whole (proto/audit.h). */
#include <errno.h>
#include <glob.h>
#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "clients/cbct/commands.h"
#include "proto/audit.h"

struct audit_options {
	const char *action, *path, *mark;
};

struct audit_check {
	struct audit_mark mark; /* of the line before */
	bool begun;
	uint64_t first; /* line that is there */
	struct audit_mark wanted;
	bool found; /* wanted is there */
};

static int check_line(const char *path, long number, const char *line, size_t length, struct audit_check *check,
		      struct error *err)
{
	struct audit_mark mark;

	if (!audit_line_mark(line, length, &mark))
		return error_set(err, ERR_DAMAGED, "%s:%ld is no line of an audit log", path, number);
	/* Older lines may have been removed for their age: the chain then begins with the first line that is there. */
	if (!check->begun && mark.number > 1) {
		check->first = mark.number;
	} else if (!audit_line_fits(line, length, &check->mark)) {
		return error_set(err, ERR_DAMAGED,
				 "%s:%ld: line %" PRIu64 " does not follow line %" PRIu64
				 ": a line was changed, removed or added",
				 path, number, mark.number, check->mark.number);
	}
	check->begun = true;
	check->mark = mark;
	if (mark.number == check->wanted.number)
		check->found = strcmp(mark.chain, check->wanted.chain) == 0;
	return 0;
}

static int check_file(const char *path, struct audit_check *check, struct error *err)
{
	FILE *file = fopen(path, "re");
	char *line = NULL;
	size_t room = 0;
	long number = 0;
	ssize_t length;
	int code = 0;

	if (file == NULL)
		return error_set_errno(err, errno, "%s", path);
	while (code == 0 && (length = getline(&line, &room, file)) > 0) {
		number++;
		if (line[length - 1] != '\n')
			code = error_set(err, ERR_DAMAGED, "%s:%ld is cut short", path, number);
		else
			code = check_line(path, number, line, (size_t)length - 1, check, err);
	}
	if (code == 0 && ferror(file))
		code = error_set(err, ERR_IO, "%s cannot be read", path);
	free(line);
	fclose(file);
	return code;
}

/* "17:9f86..." as the daemon's log has it. */
static int mark_parse(const char *text, struct audit_mark *ret_mark, struct error *err)
{
	char *end;

	ret_mark->number = strtoull(text, &end, 10);
	if (end == text || *end != ':' || strlen(end + 1) != AUDIT_CHAIN_SIZE - 1)
		return error_set(err, ERR_USAGE, "--mark is NUMBER:CHAIN, 64 hexadecimal digits behind the colon");
	memcpy(ret_mark->chain, end + 1, AUDIT_CHAIN_SIZE);
	return 0;
}

static int verify(const struct audit_options *options, struct error *err)
{
	struct audit_check check = {.mark = {.chain = AUDIT_FIRST_CHAIN}, .first = 1};
	char pattern[4096];
	glob_t files = {0};
	int code = 0;

	if (options->mark != NULL && mark_parse(options->mark, &check.wanted, err) != 0)
		return err->code;
	snprintf(pattern, sizeof(pattern), "%s.[0-9][0-9][0-9][0-9][0-9][0-9][0-9][0-9][0-9][0-9][0-9][0-9]",
		 options->path);
	if (glob(pattern, 0, NULL, &files) != 0)
		files.gl_pathc = 0;
	for (size_t i = 0; code == 0 && i < files.gl_pathc; i++)
		code = check_file(files.gl_pathv[i], &check, err);
	globfree(&files);
	if (code == 0)
		code = check_file(options->path, &check, err);
	if (code == 0 && !check.begun)
		code = error_set(err, ERR_DAMAGED, "%s has no line; the daemon writes one when it makes the file",
				 options->path);
	if (code == 0 && check.wanted.number > 0 && !check.found)
		code = error_set(err, ERR_DAMAGED,
				 "there is no line %" PRIu64 " with that chain: the log was cut or made anew",
				 check.wanted.number);
	if (code == 0 && check.first > 1)
		printf("caution: lines 1 to %" PRIu64 " are not here: removed for their age (--audit-files), or by "
		       "somebody\n",
		       check.first - 1);
	if (code == 0)
		printf("lines %" PRIu64 " to %" PRIu64 " are whole; the last has the chain %s\n", check.first,
		       check.mark.number, check.mark.chain);
	return code;
}

static int audit_run(const void *values, struct error *err)
{
	const struct audit_options *options = values;

	if (strcmp(options->action, "verify") != 0)
		return error_set(err, ERR_USAGE, "the action is verify, not %s", options->action);
	return verify(options, err);
}

static const struct option rows[] = {
    {"mark", 0, OPTION_TEXT, offsetof(struct audit_options, mark), "NUMBER:CHAIN",
     "a line that must be there, as the daemon's log had it: shows a log that was cut at its end, or made anew", 0, 0,
     0, NULL},
    {0},
};
static const struct option_group groups[] = {{"options", rows, 0}, {0}};
static const struct positional positionals[] = {
    {"ACTION", "verify", offsetof(struct audit_options, action), true},
    {"FILE", "the daemon's audit.jsonl; what was renamed beside it is read, too", offsetof(struct audit_options, path),
     true},
    {0},
};
static const struct audit_options defaults;

const struct command command_audit = {
    "audit",     "checks that no line of the daemon's audit log was changed or removed",
    positionals, groups,
    &defaults,   sizeof(defaults),
    audit_run};
