/*
 * cbct backup, cbct restore: a copy of the daemon's state directory while the daemon runs, and back.
 *
 * The directories of scans and jobs are the truth and hold their rows of the catalogue (record.json); a daemon that
 * finds no catalogue makes it from them. So the catalogue is not copied, and nothing has to stand still: each directory
 * is copied by itself, and again when its record was written anew meanwhile. Jobs come before scans: a job that was
 * copied has its scan, which cannot go while the job has not ended. Of a scan the list of its projections
 * (projections.sums) is copied before their samples, which are on the disk before they are listed. What was deleted
 * while it was copied is left out.
 *
 * backup.json names each file with its size and SHA-256, and is written last, when all else is on the disk: without it
 * there is no backup. backup.json.sha256 is its own digest, as sha256sum writes one. A backup may have come from
 * anywhere: what is restored are regular files within its directory, never what a link or a pipe in it leads to.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <limits.h>
#include <linux/fs.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include <openssl/evp.h>

#include "clients/cbct/commands.h"
#include "clients/cbct/http.h"
#include "proto/clock.h"
#include "proto/durable.h"
#include "proto/json.h"
#include "proto/scan_directory.h"
#include "proto/version.h"

#define MANIFEST "backup.json"
#define DIGEST MANIFEST ".sha256"
/* Format 1 had no digest of the manifest. */
enum { FORMAT_FIRST = 1, FORMAT = 2, DIGEST_HEX = 65, BLOCK = 1 << 20, TRIES = 5 };
static const size_t manifest_most = 1 << 30;

struct copy {
	const char *from, *to; /* roots */
	cJSON *files;          /* of the manifest */
	char *block;           /* [BLOCK] */
	double bytes;
	int linked;
	bool foreign; /* `from` is a backup, whose links are not followed */
};

static int path_under(char ret_path[PATH_MAX], const char *root, const char *path, struct error *err)
{
	int length = path[0] != '\0' ? snprintf(ret_path, PATH_MAX, "%s/%s", root, path)
				     : snprintf(ret_path, PATH_MAX, "%s", root);

	return length >= PATH_MAX ? error_set(err, ERR_INVALID, "%.200s/...: the path is too long", root) : 0;
}

/* ---- one file ---- */

/* A descriptor of the path under `root`, by names alone: -1 (ELOOP, ENOTDIR) where one of them is a link. */
static int open_inside(const char *root, const char *path)
{
	int folder = open(root, O_PATH | O_DIRECTORY | O_CLOEXEC), file = -1;

	while (folder >= 0) {
		const char *slash = strchr(path, '/');
		char name[NAME_MAX + 1];
		int next;

		snprintf(name, sizeof(name), "%.*s", slash != NULL ? (int)(slash - path) : NAME_MAX, path);
		if (slash == NULL)
			file = openat(folder, name, O_RDONLY | O_NOFOLLOW | O_NONBLOCK | O_CLOEXEC);
		next = slash == NULL ? -1 : openat(folder, name, O_PATH | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
		close(folder);
		folder = next;
		path = slash != NULL ? slash + 1 : path;
	}
	return file;
}

/* Copies and hashes; writes nothing where `to` is -1. */
static int copy_bytes(struct copy *copy, int from, int to, const char *path, unsigned long long *ret_bytes,
		      char ret_digest[DIGEST_HEX], struct error *err)
{
	unsigned char digest[EVP_MAX_MD_SIZE];
	EVP_MD_CTX *context = EVP_MD_CTX_new();
	unsigned long long bytes = 0;
	int code = context != NULL && EVP_DigestInit_ex(context, EVP_sha256(), NULL) == 1
		       ? 0
		       : error_set(err, ERR_NO_MEMORY, "no memory for a digest");
	ssize_t got = 1;

	while (code == 0 && got > 0) {
		got = read(from, copy->block, BLOCK);
		if (got < 0 && errno == EINTR)
			got = 1;
		else if (got < 0)
			code = error_set_errno(err, errno, "%s", path);
		else if (got > 0)
			EVP_DigestUpdate(context, copy->block, (size_t)got);
		for (ssize_t done = 0; code == 0 && to >= 0 && done < got;) {
			ssize_t wrote = write(to, copy->block + done, (size_t)(got - done));

			if (wrote < 0 && errno != EINTR)
				code = error_set_errno(err, errno, "copy of %s", path);
			done += wrote > 0 ? wrote : 0;
		}
		bytes += got > 0 ? (unsigned long long)got : 0;
	}
	if (code == 0)
		EVP_DigestFinal_ex(context, digest, NULL);
	EVP_MD_CTX_free(context);
	for (int i = 0; code == 0 && i < 32; i++)
		snprintf(ret_digest + 2 * i, 3, "%02x", digest[i]);
	*ret_bytes = bytes;
	return code;
}

/* Owner, mode and times: of a record the last is its stamp. Another owner takes rights that not everybody has. */
static int copy_attributes(int file, const struct stat *status, const char *path, struct error *err)
{
	const struct timespec times[2] = {status->st_atim, status->st_mtim};

	if (fchown(file, status->st_uid, status->st_gid) != 0 && errno != EPERM)
		return error_set_errno(err, errno, "owner of the copy of %s", path);
	if (fchmod(file, status->st_mode & 07777) != 0 || futimens(file, times) != 0)
		return error_set_errno(err, errno, "attributes of the copy of %s", path);
	return 0;
}

/* Volumes are never written again once they have their name: one file under two names is as good as a copy. */
static bool may_link(const char *path)
{
	size_t length = strlen(path);

	return strncmp(path, "jobs/", 5) == 0 && length > 4 && strcmp(path + length - 4, ".nii") == 0;
}

/*
 * One file, under the same name. link: its content may be shared. A file system that shares blocks between files makes
 * the copy without writing; the digest is that of the copy. ERR_NOT_FOUND: the file has gone.
 */
static int copy_file(struct copy *copy, const char *path, bool link, unsigned long long *ret_bytes,
		     char ret_digest[DIGEST_HEX], struct error *err)
{
	char source[PATH_MAX], target[PATH_MAX];
	struct stat status;
	int from = -1, to = -1, code = path_under(source, copy->from, path, err);
	bool linked = false;

	if (code == 0)
		code = path_under(target, copy->to, path, err);
	if (code != 0)
		return code;
	from = copy->foreign ? open_inside(copy->from, path)
			     : open(source, O_RDONLY | O_NOFOLLOW | O_NONBLOCK | O_CLOEXEC);
	if (from < 0)
		return error_set(err, errno == ENOENT ? ERR_NOT_FOUND : ERR_IO, "%s: %s", source, strerror(errno));
	if (fstat(from, &status) != 0) {
		code = error_set_errno(err, errno, "%s", source);
		goto out;
	}
	if (!S_ISREG(status.st_mode)) {
		code = error_set(err, ERR_INVALID, "%.200s is no regular file", source);
		goto out;
	}
	unlink(target); /* of a try before */
	linked = link && linkat(AT_FDCWD, source, AT_FDCWD, target, 0) == 0;
	copy->linked += linked;
	if (!linked) {
		to = open(target, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);
		if (to < 0) {
			code = error_set_errno(err, errno, "%s", target);
			goto out;
		}
	}
	if (linked || ioctl(to, FICLONE, from) == 0)
		code = copy_bytes(copy, linked ? from : to, -1, path, ret_bytes, ret_digest, err);
	else
		code = copy_bytes(copy, from, to, path, ret_bytes, ret_digest, err);
	if (code == 0 && !linked)
		code = copy_attributes(to, &status, path, err);
	if (code == 0 && !linked && fsync(to) != 0)
		code = error_set_errno(err, errno, "sync of %s", target);
out:
	if (to >= 0 && close(to) != 0 && code == 0)
		code = error_set_errno(err, errno, "%s", target);
	close(from);
	return code;
}

static void note_file(cJSON *files, const char *path, unsigned long long bytes, const char *digest)
{
	cJSON *file = cJSON_CreateObject();

	cJSON_AddStringToObject(file, "path", path);
	cJSON_AddNumberToObject(file, "bytes", (double)bytes);
	cJSON_AddStringToObject(file, "sha256", digest);
	cJSON_AddItemToArray(files, file);
}

/* ---- one directory ---- */

/* Files that the daemon makes again or that are only its own: no part of a backup. */
static bool is_left_out(const char *path)
{
	const char *name = strrchr(path, '/') != NULL ? strrchr(path, '/') + 1 : path;

	return strcmp(path, "lock") == 0 || strcmp(path, "reserve") == 0 || strcmp(path, "reserve-start") == 0 ||
	       strcmp(path, "restored") == 0 || strncmp(path, "catalogue.", strlen("catalogue.")) == 0 ||
	       strstr(name, ".tmp") != NULL || strcmp(path, MANIFEST) == 0 || strcmp(path, DIGEST) == 0;
}

/* Records before lists, lists before samples, whatever else first. */
static int place_of(const char *name)
{
	static const char *const last[] = {"projections.sums", "projections.raw", "scatter.sums", "scatter.raw"};

	if (strcmp(name, "record.json") == 0)
		return -1;
	for (int i = 0; i < 4; i++) {
		if (strcmp(name, last[i]) == 0)
			return 1 + i;
	}
	return 0;
}

static int compare_names(const struct dirent **a, const struct dirent **b)
{
	int x = place_of((*a)->d_name), y = place_of((*b)->d_name);

	return x != y ? x - y : strcmp((*a)->d_name, (*b)->d_name);
}

static int make_directory(const char *from, const char *to, struct error *err)
{
	struct stat status;
	int file, code;

	if (stat(from, &status) != 0)
		return error_set(err, errno == ENOENT ? ERR_NOT_FOUND : ERR_IO, "%s: %s", from, strerror(errno));
	if (mkdir(to, 0700) != 0 && errno != EEXIST)
		return error_set_errno(err, errno, "%s", to);
	file = open(to, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
	code = file < 0 ? error_set_errno(err, errno, "%s", to) : copy_attributes(file, &status, to, err);
	if (file >= 0)
		close(file);
	return code;
}

static int copy_directory(struct copy *copy, const char *path, cJSON *files, struct error *err);

static int copy_entry(struct copy *copy, const char *path, cJSON *files, struct error *err)
{
	char source[PATH_MAX], digest[DIGEST_HEX] = "";
	unsigned long long bytes = 0;
	struct stat status;
	int code = path_under(source, copy->from, path, err);

	if (code != 0 || is_left_out(path))
		return code;
	if (lstat(source, &status) != 0)
		return error_set(err, errno == ENOENT ? ERR_NOT_FOUND : ERR_IO, "%s: %s", source, strerror(errno));
	if (S_ISDIR(status.st_mode))
		return copy_directory(copy, path, files, err);
	if (!S_ISREG(status.st_mode)) /* a socket that is listened on */
		return 0;
	code = copy_file(copy, path, may_link(path), &bytes, digest, err);
	if (code == 0) {
		note_file(files, path, bytes, digest);
		copy->bytes += (double)bytes;
	}
	return code;
}

/* Files that go meanwhile are left out; the caller sees whether that matters. */
static int copy_directory(struct copy *copy, const char *path, cJSON *files, struct error *err)
{
	char source[PATH_MAX], target[PATH_MAX], entry[PATH_MAX];
	struct dirent **names = NULL;
	int count, code = path_under(source, copy->from, path, err);

	if (code == 0)
		code = path_under(target, copy->to, path, err);
	if (code == 0)
		code = make_directory(source, target, err);
	if (code != 0)
		return code;
	count = scandir(source, &names, NULL, compare_names);
	if (count < 0)
		return error_set_errno(err, errno, "%s", source);
	for (int i = 0; i < count; i++) {
		const char *name = names[i]->d_name;

		if (code == 0 && strcmp(name, ".") != 0 && strcmp(name, "..") != 0) {
			code = path_under(entry, path, name, err);
			if (code == 0)
				code = copy_entry(copy, path[0] != '\0' ? entry : name, files, err);
			code = code == ERR_NOT_FOUND ? 0 : code;
		}
		free(names[i]);
	}
	free(names);
	return code;
}

static void remove_directory(const char *path)
{
	char entry[PATH_MAX];
	struct error ignored;
	DIR *directory = opendir(path);
	const struct dirent *name;

	while (directory != NULL && (name = readdir(directory)) != NULL) {
		if (strcmp(name->d_name, ".") != 0 && strcmp(name->d_name, "..") != 0 &&
		    path_under(entry, path, name->d_name, &ignored) == 0)
			unlink(entry);
	}
	if (directory != NULL)
		closedir(directory);
	rmdir(path);
}

/* The digest of a directory's record as it is now; "" without one. */
static void record_now(struct copy *copy, const char *path, char ret_digest[DIGEST_HEX])
{
	char record[PATH_MAX + 16];
	unsigned long long bytes;
	struct error ignored;
	int file;

	ret_digest[0] = '\0';
	snprintf(record, sizeof(record), "%s/%s/record.json", copy->from, path);
	file = open(record, O_RDONLY | O_CLOEXEC);
	if (file < 0)
		return;
	if (copy_bytes(copy, file, -1, record, &bytes, ret_digest, &ignored) != 0)
		ret_digest[0] = '\0';
	close(file);
}

/* A scan or a job, all of it as it was at one time. */
static int copy_unit(struct copy *copy, const char *path, struct error *err)
{
	char before[DIGEST_HEX], after[DIGEST_HEX], target[PATH_MAX];
	int code = path_under(target, copy->to, path, err);

	for (int i = 0; code == 0 && i < TRIES; i++) {
		cJSON *files = cJSON_CreateArray();

		record_now(copy, path, before);
		code = copy_directory(copy, path, files, err);
		record_now(copy, path, after);
		if (code == ERR_NOT_FOUND ||
		    (code == 0 && after[0] == '\0' && before[0] != '\0')) { /* it was deleted */
			cJSON_Delete(files);
			remove_directory(target);
			return 0;
		}
		if (code == 0 && (strcmp(before, after) == 0 || i == TRIES - 1)) {
			while (cJSON_GetArraySize(files) > 0)
				cJSON_AddItemToArray(copy->files, cJSON_DetachItemFromArray(files, 0));
			cJSON_Delete(files);
			return 0;
		}
		cJSON_Delete(files);
		remove_directory(target);
	}
	return code;
}

static int copy_units(struct copy *copy, const char *kind, struct error *err)
{
	char source[PATH_MAX], target[PATH_MAX], path[PATH_MAX];
	struct dirent **names = NULL;
	int count, code = path_under(source, copy->from, kind, err);

	if (code == 0)
		code = path_under(target, copy->to, kind, err);
	if (code == 0)
		code = make_directory(source, target, err);
	if (code != 0)
		return code == ERR_NOT_FOUND ? 0 : code;
	count = scandir(source, &names, NULL, alphasort);
	for (int i = 0; i < count; i++) {
		if (code == 0 && names[i]->d_name[0] != '.') {
			code = path_under(path, kind, names[i]->d_name, err);
			if (code == 0)
				code = copy_unit(copy, path, err);
		}
		free(names[i]);
	}
	free(names);
	return count < 0 ? error_set_errno(err, errno, "%s", source) : code;
}

/* ---- a whole backup ---- */

static int sync_all(const char *path, struct error *err)
{
	int file = open(path, O_RDONLY | O_DIRECTORY | O_CLOEXEC), code = 0;

	if (file < 0 || syncfs(file) != 0)
		code = error_set_errno(err, errno, "sync of %s", path);
	if (file >= 0)
		close(file);
	return code;
}

static int digest_text(const char *text, size_t length, char ret_digest[DIGEST_HEX], struct error *err)
{
	unsigned char digest[EVP_MAX_MD_SIZE];

	if (EVP_Digest(text, length, digest, NULL, EVP_sha256(), NULL) != 1)
		return error_set(err, ERR_INTERNAL, "no SHA-256 of " MANIFEST);
	for (int i = 0; i < 32; i++)
		snprintf(ret_digest + 2 * i, 3, "%02x", digest[i]);
	return 0;
}

/* The line that sha256sum -c reads. */
static void digest_line(const char digest[DIGEST_HEX], char ret_line[DIGEST_HEX + 16])
{
	snprintf(ret_line, DIGEST_HEX + 16, "%s  " MANIFEST "\n", digest);
}

static int write_manifest(const struct copy *copy, struct error *err)
{
	cJSON *manifest = cJSON_CreateObject();
	char path[PATH_MAX], now[CLOCK_TEXT_SIZE], digest[DIGEST_HEX] = "", line[DIGEST_HEX + 16], *text;
	size_t length = 0;
	int code;

	clock_text(clock_realtime(), now);
	cJSON_AddNumberToObject(manifest, "format", FORMAT);
	cJSON_AddStringToObject(manifest, "program", "cbct " CBCT_VERSION);
	cJSON_AddStringToObject(manifest, "made", now);
	cJSON_AddItemReferenceToObject(manifest, "files", copy->files);
	text = json_print(manifest, &length);
	cJSON_Delete(manifest);
	if (text == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for " MANIFEST);
	code = digest_text(text, length, digest, err);
	digest_line(digest, line);
	if (code == 0)
		code = path_under(path, copy->to, DIGEST, err);
	if (code == 0)
		code = file_write_durable(path, line, strlen(line), err);
	if (code == 0)
		code = path_under(path, copy->to, MANIFEST, err);
	if (code == 0)
		code = file_write_durable(path, text, length, err);
	free(text);
	return code;
}

/* Files beside scans and jobs: calibrations, quarantine, the audit log, the list of deletions. */
static int copy_rest(struct copy *copy, struct error *err)
{
	struct dirent **names = NULL;
	int count = scandir(copy->from, &names, NULL, alphasort), code = 0;

	if (count < 0)
		return error_set_errno(err, errno, "%s", copy->from);
	for (int i = 0; i < count; i++) {
		const char *name = names[i]->d_name;

		if (code == 0 && strcmp(name, ".") != 0 && strcmp(name, "..") != 0 && strcmp(name, "jobs") != 0 &&
		    strcmp(name, "scans") != 0)
			code = copy_entry(copy, name, copy->files, err);
		code = code == ERR_NOT_FOUND ? 0 : code;
		free(names[i]);
	}
	free(names);
	return code;
}

struct backup_options {
	const char *from, *to;
};

/* A copy within what is copied would be copied, too, and so on. */
static int check_outside(const char *from, const char *to, struct error *err)
{
	char parent[PATH_MAX], root[PATH_MAX], above[PATH_MAX], *slash;
	size_t length;

	snprintf(parent, sizeof(parent), "%s", to);
	for (length = strlen(parent); length > 1 && parent[length - 1] == '/'; length--)
		parent[length - 1] = '\0';
	slash = strrchr(parent, '/');
	if (slash == NULL)
		snprintf(parent, sizeof(parent), ".");
	else
		slash[slash == parent ? 1 : 0] = '\0';
	if (realpath(from, root) == NULL || realpath(parent, above) == NULL)
		return error_set_errno(err, errno, "%s", slash != NULL ? parent : from);
	length = strlen(root);
	if (strncmp(above, root, length) == 0 && (above[length] == '\0' || above[length] == '/'))
		return error_set(err, ERR_INVALID, "%s lies within %s", to, from);
	return 0;
}

static int remove_entry(const char *path, const struct stat *status, int kind, struct FTW *place)
{
	(void)status;
	(void)kind;
	(void)place;
	return remove(path);
}

/* What was made in vain, all of it our own. */
static void remove_target(const char *path)
{
	enum { DESCRIPTORS = 16 };

	nftw(path, remove_entry, DESCRIPTORS, FTW_DEPTH | FTW_PHYS | FTW_MOUNT);
}

/* A directory of its own: nothing of another backup may be taken for a part of this one. */
static int make_target(const char *from, const char *to, struct error *err)
{
	struct stat status;
	int code;

	if (stat(from, &status) != 0 || !S_ISDIR(status.st_mode))
		return error_set(err, ERR_NOT_FOUND, "%s is no directory", from);
	if (check_outside(from, to, err) != 0)
		return err->code;
	if (mkdir(to, 0700) != 0 && (errno != EEXIST || rmdir(to) != 0 || mkdir(to, 0700) != 0))
		return error_set(err, ERR_CONFLICT, "%s: %s", to, strerror(errno));
	code = make_directory(from, to, err);
	/* All of it is for those who may read the daemon's own alone. */
	if (code == 0 && chmod(to, status.st_mode & 0750) != 0)
		code = error_set_errno(err, errno, "%s", to);
	return code;
}

static int backup_run(const void *values, struct error *err)
{
	const struct backup_options *options = values;
	struct copy copy = {
	    .from = options->from, .to = options->to, .files = cJSON_CreateArray(), .block = malloc(BLOCK)};
	char jobs[PATH_MAX], scans[PATH_MAX];
	bool made;
	int code = copy.block != NULL && copy.files != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a copy");

	if (code == 0)
		code = path_under(jobs, copy.from, "jobs", err);
	if (code == 0)
		code = path_under(scans, copy.from, "scans", err);
	if (code == 0 && (access(jobs, F_OK) != 0 || access(scans, F_OK) != 0))
		code = error_set(err, ERR_INVALID, "%s is no state directory of cbctd: it has no jobs and scans",
				 copy.from);
	if (code == 0)
		code = make_target(copy.from, copy.to, err);
	made = code == 0;
	if (code == 0)
		code = copy_rest(&copy, err);
	if (code == 0)
		code = copy_units(&copy, "jobs", err);
	if (code == 0)
		code = copy_units(&copy, "scans", err);
	if (code == 0)
		code = sync_all(copy.to, err);
	if (code == 0)
		code = write_manifest(&copy, err);
	if (code != 0 && made)
		remove_target(copy.to);
	if (code == 0)
		printf("%d files, %.1f MB, %d of them shared\n", cJSON_GetArraySize(copy.files), 1e-6 * copy.bytes,
		       copy.linked);
	cJSON_Delete(copy.files);
	free(copy.block);
	return code;
}

/* ---- back ---- */

/* A path of a manifest that leads out of its directory is no file of it. */
static bool is_inside(const char *path)
{
	if (path[0] == '/' || path[0] == '\0')
		return false;
	for (const char *part = path; part != NULL; part = strchr(part, '/') != NULL ? strchr(part, '/') + 1 : NULL) {
		size_t length = strcspn(part, "/");

		if (length == 0 || (length <= 2 && strspn(part, ".") >= length))
			return false;
	}
	return true;
}

static int make_parents(const struct copy *copy, const char *path, struct error *err)
{
	char part[PATH_MAX], from[PATH_MAX], to[PATH_MAX];
	int code = 0;

	for (const char *slash = strchr(path, '/'); slash != NULL && code == 0; slash = strchr(slash + 1, '/')) {
		snprintf(part, sizeof(part), "%.*s", (int)(slash - path), path);
		code = path_under(from, copy->from, part, err);
		if (code == 0)
			code = path_under(to, copy->to, part, err);
		if (code == 0)
			code = make_directory(from, to, err);
	}
	return code;
}

static int restore_file(struct copy *copy, const cJSON *file, struct error *err)
{
	const char *path = member_text(file, "path", ""), *expected = member_text(file, "sha256", "");
	char digest[DIGEST_HEX] = "";
	unsigned long long bytes = 0;
	int code;

	if (!is_inside(path))
		return error_set(err, ERR_INVALID, MANIFEST " names \"%.200s\", which is no path within the backup",
				 path);
	code = make_parents(copy, path, err);
	if (code == 0)
		code = copy_file(copy, path, false, &bytes, digest, err);
	if (code == 0 && ((double)bytes != member_number(file, "bytes", -1) || strcmp(digest, expected) != 0))
		code = error_set(err, ERR_DAMAGED,
				 "%s is not what was backed up: %llu bytes with SHA-256 %s, expected %.0f with %s",
				 path, bytes, digest, member_number(file, "bytes", -1), expected);
	copy->bytes += (double)bytes;
	return code;
}

/* A file of the backup's own, of which nothing has told the size. */
static int read_own(const char *from, const char *name, char **ret_text, size_t *ret_length, struct error *err)
{
	char path[PATH_MAX];
	struct stat status;
	int code = path_under(path, from, name, err);

	if (code == 0 && lstat(path, &status) == 0 && !S_ISREG(status.st_mode))
		code = error_set(err, ERR_INVALID, "%.200s is no regular file", path);
	return code != 0 ? code : file_read(path, manifest_most, ret_text, ret_length, err);
}

static int check_manifest(const char *from, const char *text, size_t length, struct error *err)
{
	char digest[DIGEST_HEX] = "", line[DIGEST_HEX + 16], *expected = NULL;
	size_t expected_length;
	int code = read_own(from, DIGEST, &expected, &expected_length, err);

	if (code == 0)
		code = digest_text(text, length, digest, err);
	digest_line(digest, line);
	if (code == 0 && strcmp(expected, line) != 0)
		code = error_set(err, ERR_DAMAGED,
				 "%.200s/" MANIFEST " is damaged: its SHA-256 is %s, " DIGEST " has %.64s", from,
				 digest, expected);
	free(expected);
	return code;
}

static int read_manifest(const char *from, cJSON **ret_manifest, struct error *err)
{
	char *text = NULL;
	size_t length;
	double format = 0;
	int code = read_own(from, MANIFEST, &text, &length, err);

	if (code == 0) {
		*ret_manifest = cJSON_ParseWithLength(text, length);
		format = member_number(*ret_manifest, "format", 0);
		if (format != FORMAT && format != FORMAT_FIRST)
			code = error_set(err, ERR_INVALID, "%.200s/" MANIFEST " is no list of a backup", from);
	}
	if (code == 0 && format == FORMAT)
		code = check_manifest(from, text, length, err);
	else if (code == 0)
		fprintf(stderr,
			"this backup was made before lists had digests: whether the list is whole is not known\n");
	free(text);
	return code;
}

/* Tells the daemon why there is no catalogue (store/reconcile.c). */
static int note_restored(const char *to, struct error *err)
{
	char path[PATH_MAX];
	int file, code = path_under(path, to, "restored", err);

	if (code != 0)
		return code;
	file = open(path, O_WRONLY | O_CREAT | O_CLOEXEC, 0600);
	if (file < 0)
		return error_set_errno(err, errno, "%s", path);
	close(file);
	return 0;
}

static int restore_run(const void *values, struct error *err)
{
	const struct backup_options *options = values;
	struct copy copy = {.from = options->from, .block = malloc(BLOCK), .foreign = true};
	char beside[PATH_MAX];
	bool made;
	cJSON *manifest = NULL;
	const cJSON *file;
	int code = copy.block != NULL ? 0 : error_set(err, ERR_NO_MEMORY, "no memory for a copy"), count = 0;

	if (snprintf(beside, sizeof(beside), "%s.restored", options->to) >= (int)sizeof(beside))
		code = error_set(err, ERR_INVALID, "the path is too long");
	copy.to = beside;
	if (code == 0)
		code = read_manifest(copy.from, &manifest, err);
	/* The name is given last: what is there under it is whole. An empty directory makes room for it. */
	if (code == 0 && rmdir(options->to) != 0 && errno != ENOENT)
		code = error_set(err, ERR_CONFLICT, "%s: %s", options->to, strerror(errno));
	if (code == 0)
		code = make_target(copy.from, copy.to, err);
	made = code == 0;
	cJSON_ArrayForEach(file, cJSON_GetObjectItemCaseSensitive(manifest, "files"))
	{
		if (code == 0)
			code = restore_file(&copy, file, err);
		count++;
	}
	if (code == 0)
		code = note_restored(copy.to, err);
	if (code == 0)
		code = sync_all(copy.to, err);
	if (code == 0 && rename(copy.to, options->to) != 0)
		code = error_set_errno(err, errno, "%s", options->to);
	if (code == 0)
		code = durable_sync_names(options->to, err);
	else if (made)
		remove_target(copy.to);
	if (code == 0)
		printf("%d files, %.1f MB, as they were at %s\n", count, 1e-6 * copy.bytes,
		       member_text(manifest, "made", "?"));
	cJSON_Delete(manifest);
	free(copy.block);
	return code;
}

static const struct positional backup_positionals[] = {
    {"STATE", "the daemon's state directory; the daemon may run", offsetof(struct backup_options, from), true},
    {"TO", "a new directory, best on another disk; on the same one volumes are shared, not copied",
     offsetof(struct backup_options, to), true},
    {0},
};
static const struct positional restore_positionals[] = {
    {"FROM", "a directory that cbct backup has made", offsetof(struct backup_options, from), true},
    {"STATE", "the state directory to be, which is empty or not there; every file is held against its digest",
     offsetof(struct backup_options, to), true},
    {0},
};
static const struct option_group groups[] = {{0}};
static const struct backup_options defaults;

const struct command command_backup = {
    "backup",           "copies the daemon's state directory, catalogue and scans, while the daemon runs",
    backup_positionals, groups,
    &defaults,          sizeof(defaults),
    backup_run};
const struct command command_restore = {
    "restore",  "makes a state directory from a backup", restore_positionals, groups, &defaults, sizeof(defaults),
    restore_run};
