/* cbct token: the file that says who may ask the daemon for what (proto/tokens.h). */
#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/random.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "clients/cbct/commands.h"
#include "proto/durable.h"
#include "proto/scan_directory.h"
#include "proto/tokens.h"

struct token_options {
	const char *action, *name;
	const char *file, *role, *expires, *output;
	long days;
	bool certificate;
};

/* The file while this process alone changes it. */
struct token_file {
	int lock; /* descriptor of the file as it was; -1: there was none */
	struct stat status;
	char *text;
	size_t length;
	struct tokens tokens;
};

static const char *file_path(const struct token_options *options)
{
	return options->file != NULL ? options->file : getenv("CBCTD_TOKENS");
}

static void file_close(struct token_file *file)
{
	if (file->lock >= 0)
		close(file->lock);
	free(file->text);
	tokens_clear(&file->tokens);
}

/* While this process waited, the locked file may have been replaced by another: the lock is taken once more then. */
static int file_lock(const char *path, struct token_file *file, struct error *err)
{
	struct stat now;

	for (;;) {
		file->lock = open(path, O_RDONLY | O_CREAT | O_CLOEXEC, 0600);
		if (file->lock < 0 || flock(file->lock, LOCK_EX) != 0 || fstat(file->lock, &file->status) != 0)
			return error_set_errno(err, errno, "%s", path);
		if (stat(path, &now) == 0 && now.st_ino == file->status.st_ino && now.st_dev == file->status.st_dev)
			return 0;
		close(file->lock);
		file->lock = -1;
	}
}

static int file_open(const char *path, bool to_change, struct token_file *file, struct error *err)
{
	int code = 0;

	*file = (struct token_file){.lock = -1};
	if (path == NULL || path[0] == '\0')
		return error_set(err, ERR_USAGE, "--file says which file has the tokens");
	if (to_change)
		code = file_lock(path, file, err);
	if (code == 0)
		code = file_read(path, TOKENS_BYTES_MAX, &file->text, &file->length, err);
	if (code == 0)
		code = tokens_parse(file->text, file->length, &file->tokens, err);
	return code;
}

/* Owner and mode stay: the daemon's user must be able to read it still. */
static int file_replace(const char *path, const struct token_file *file, const char *text, size_t length,
			struct error *err)
{
	struct durable d;

	if (durable_open(&d, path, 0, err) != 0)
		return err->code;
	if (fchmod(d.file, 0600) != 0 || fchown(d.file, file->status.st_uid, file->status.st_gid) != 0 ||
	    fchmod(d.file, file->status.st_mode & 0640) != 0)
		error_set_errno(err, errno, "owner and mode of %s", path);
	else if (durable_write(&d, text, length, err) == 0)
		return durable_commit(&d, err);
	durable_abandon(&d);
	return err->code;
}

/* ---- new ---- */

static int token_make(const struct token_options *options, struct token *ret_token, char ret_text[TOKEN_TEXT_SIZE],
		      struct error *err)
{
	struct token token = {.certificate = options->certificate, .role = role_parse(options->role)};
	uint8_t random[TOKEN_DIGEST_BYTES];

	if (!token_name_valid(options->name))
		return error_set(err, ERR_USAGE, "NAME has letters, digits, . _ @ -, and 1 to %d of them",
				 TOKEN_NAME_SIZE - 1);
	snprintf(token.name, sizeof(token.name), "%s", options->name);
	if (token.role == ROLE_UNSAID)
		return error_set(err, ERR_USAGE, "--role is view, acquire or admin");
	token.expires = time(NULL) + options->days * 86400;
	if (options->expires != NULL && !token_expiry_parse(options->expires, &token.expires))
		return error_set(err, ERR_USAGE, "--expires is a date, a time as 2027-01-31T00:00:00Z, or never");
	if (token.expires <= time(NULL))
		return error_set(err, ERR_USAGE, "--expires %s is over already", options->expires);
	if (getrandom(random, sizeof(random), 0) != (ssize_t)sizeof(random))
		return error_set_errno(err, errno, "random bits");
	token_text(random, ret_text);
	if (EVP_Digest(ret_text, strlen(ret_text), token.sha256, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "the digest of a token cannot be made");
	*ret_token = token;
	return 0;
}

static int token_add(const char *path, struct token_file *file, const struct token *token, struct error *err)
{
	bool ended = file->length == 0 || file->text[file->length - 1] == '\n';
	char line[TOKEN_LINE_MAX], *text = NULL;
	int length, code;

	for (int i = 0; i < file->tokens.count; i++) {
		if (strcmp(file->tokens.list[i].name, token->name) == 0)
			return error_set(err, ERR_CONFLICT,
					 "%s has a token already; revoke it first, or give this one "
					 "another name",
					 token->name);
	}
	token_print(token, line);
	length = asprintf(&text, "%s%s%s", file->text, ended ? "" : "\n", line);
	if (length < 0)
		return error_set(err, ERR_NO_MEMORY, "no memory for tokens");
	code = file_replace(path, file, text, (size_t)length, err);
	free(text);
	return code;
}

static void tell_reload(void)
{
	fputs("cbctd reads the file at its start and at SIGHUP (systemctl reload cbctd)\n", stderr);
}

/* On standard output, or in a new file that others cannot read, as --token-file wants it. */
static int token_show(const char *path, const char *text, struct error *err)
{
	int file;

	if (path == NULL) {
		puts(text);
		return 0;
	}
	file = open(path, O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
	if (file < 0)
		return error_set_errno(err, errno, "%s", path);
	if (dprintf(file, "%s\n", text) < 0)
		error_set_errno(err, errno, "%s", path);
	if (close(file) != 0)
		error_set_errno(err, errno, "%s", path);
	return err->code;
}

static int token_new(const struct token_options *options, struct error *err)
{
	const char *path = file_path(options);
	struct token_file file;
	struct token token;
	char text[TOKEN_TEXT_SIZE];
	int code;

	if (options->name == NULL)
		return error_set(err, ERR_USAGE, "NAME says whose token it is");
	code = token_make(options, &token, text, err);
	if (code == 0 && options->output != NULL && access(options->output, F_OK) == 0)
		code = error_set(err, ERR_CONFLICT, "%s is there already", options->output);
	if (code != 0)
		return code;
	code = file_open(path, true, &file, err);
	if (code == 0)
		code = token_add(path, &file, &token, err);
	file_close(&file);
	if (code != 0)
		return code;
	if (!token.certificate)
		code = token_show(options->output, text, err);
	tell_reload();
	return code;
}

/* ---- revoke ---- */

/* Moves the lines that stay together; comments and order stay. */
static size_t drop_line(char *text, const char *name)
{
	size_t kept = 0, named = strlen(name);

	for (const char *line = text; *line != '\0';) {
		size_t length = strcspn(line, "\n");
		const char *word = line + strspn(line, " \t");

		length += line[length] == '\n';
		if (strncmp(word, name, named) != 0 || (word[named] != ' ' && word[named] != '\t')) {
			memmove(text + kept, line, length);
			kept += length;
		}
		line += length;
	}
	return kept;
}

static int token_revoke(const struct token_options *options, struct error *err)
{
	const char *path = file_path(options);
	struct token_file file;
	size_t kept;
	int code;

	if (options->name == NULL)
		return error_set(err, ERR_USAGE, "NAME says whose token is revoked");
	code = file_open(path, true, &file, err);
	if (code == 0) {
		kept = drop_line(file.text, options->name);
		code = kept < file.length ? file_replace(path, &file, file.text, kept, err)
					  : error_set(err, ERR_NOT_FOUND, "there is no token of %s", options->name);
	}
	file_close(&file);
	if (code == 0)
		tell_reload();
	return code;
}

/* ---- list ---- */

static int token_list(const struct token_options *options, struct error *err)
{
	int64_t now = time(NULL);
	struct token_file file;
	int code = file_open(file_path(options), false, &file, err);

	for (int i = 0; code == 0 && i < file.tokens.count; i++) {
		const struct token *token = &file.tokens.list[i];
		char expires[32];

		token_expiry_print(token->expires, expires);
		printf("%-24s %-8s %-20s %s%s\n", token->name, role_names[token->role], expires,
		       token->certificate ? "certificate" : "token", token_is_valid(token, now) ? "" : ", expired");
	}
	file_close(&file);
	return code;
}

static int token_run(const void *values, struct error *err)
{
	static const struct {
		const char *name;
		int (*run)(const struct token_options *options, struct error *err);
	} actions[] = {{"new", token_new}, {"list", token_list}, {"revoke", token_revoke}};
	const struct token_options *options = values;

	for (size_t i = 0; i < sizeof(actions) / sizeof(*actions); i++) {
		if (strcmp(actions[i].name, options->action) == 0)
			return actions[i].run(options, err);
	}
	return error_set(err, ERR_USAGE, "the action is new, list or revoke, not %s", options->action);
}

#define ROW(name, kind, member, argument, help, least, most)                                                           \
	{                                                                                                              \
		name, 0, kind, offsetof(struct token_options, member), argument, help, least, most, 0, NULL            \
	}
static const struct option rows[] = {
    ROW("file", OPTION_TEXT, file, "FILE", "the file of tokens, as cbctd --tokens has it (default $CBCTD_TOKENS)", 0,
	0),
    ROW("role", OPTION_TEXT, role, "ROLE",
	"of a new one: view reads, acquire makes and removes scans and jobs, too, admin everything", 0, 0),
    ROW("days", OPTION_INTEGER, days, "N", "a new one is valid for so many days", 1, 36500),
    ROW("expires", OPTION_TEXT, expires, "TIME", "or until then: a date, 2027-01-31T00:00:00Z, or never", 0, 0),
    ROW("output", OPTION_TEXT, output, "FILE", "a new file for a new one, in place of standard output", 0, 0),
    ROW("certificate", OPTION_FLAG, certificate, NULL,
	"of a new one: no token, but a client certificate whose common name is NAME", 0, 0),
    {0},
};
static const struct option_group groups[] = {{"options", rows, 0}, {0}};
static const struct positional positionals[] = {
    {"ACTION", "new, list or revoke", offsetof(struct token_options, action), true},
    {"NAME", "whose token; letters, digits, . _ @ -", offsetof(struct token_options, name), false},
    {0},
};
static const struct token_options defaults = {.role = "view", .days = 365};

const struct command command_token = {"token",     "makes, lists and revokes the tokens that the daemon asks for",
				      positionals, groups,
				      &defaults,   sizeof(defaults),
				      token_run};
