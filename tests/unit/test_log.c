/* The log's forms: what a line is about comes out as fields of it. */
#include <check.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "daemon/log.h"
#include "proto/json.h"

static const char id[] = "1m83nrmzxmkcz7m6";

/* Standard error goes into `file` until it is given back. */
static int divert(const char *path)
{
	int saved = dup(STDERR_FILENO), file = open(path, O_WRONLY | O_CREAT | O_TRUNC, 0600);

	ck_assert(saved >= 0 && file >= 0);
	dup2(file, STDERR_FILENO);
	close(file);
	return saved;
}

static void restore(int saved, const char *path, char *ret_text, size_t size)
{
	FILE *file = fopen(path, "r");
	size_t length;

	dup2(saved, STDERR_FILENO);
	close(saved);
	ck_assert_ptr_nonnull(file);
	length = fread(ret_text, 1, size - 1, file);
	ret_text[length] = '\0';
	fclose(file);
	unlink(path);
}

static void check_member(const cJSON *line, const char *name, const char *expected)
{
	const char *text = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(line, name));

	if (expected == NULL)
		ck_assert_ptr_null(text);
	else
		ck_assert_str_eq(text, expected);
}

START_TEST(test_json_has_an_object_a_line_with_what_it_is_about)
{
	static const struct {
		const char *text, *member, *value;
	} lines[] = {{"job 1m83nrmzxmkcz7m6: queued -> running", "job", id},
		     {"scan 1m83nrmzxmkcz7m6 removed", "scan", id},
		     {"worker 3 (pid 17): cpu, \"quoted\" \\ name", "worker", "3"},
		     {"calibration 1m83nrmzxmkcz7m6 has failed", "calibration", id},
		     {"job cannot be queued", "job", NULL},
		     {"worker none", "worker", NULL},
		     {"a line\nof \x01 control, and \xff which is no UTF-8", "job", NULL}};
	enum { COUNT = sizeof(lines) / sizeof(*lines) };
	char path[] = "/tmp/cbct-log-XXXXXX", text[8192], *next = text, *one;
	int count = 0, saved;
	struct error err;

	close(mkstemp(path));
	log_set_format(LOG_JSON, NULL);
	saved = divert(path);
	for (int i = 0; i < COUNT; i++) {
		if (i == 1)
			log_set_request("r-1", "4bf92f3577b34da6a3ce929d0e0e4736");
		log_line(LEVEL_WARNING, "%s", lines[i].text);
		log_set_request(NULL, NULL);
	}
	log_line(LEVEL_DEBUG, "below the level");
	restore(saved, path, text, sizeof(text));
	while ((one = strsep(&next, "\n")) != NULL && one[0] != '\0') {
		cJSON *line = NULL;

		ck_assert_int_lt(count, COUNT);
		ck_assert_int_eq(json_parse(one, strlen(one), &line, &err), 0);
		check_member(line, "level", "warning");
		check_member(line, lines[count].member, lines[count].value);
		check_member(line, "request", count == 1 ? "r-1" : NULL);
		check_member(line, "trace", count == 1 ? "4bf92f3577b34da6a3ce929d0e0e4736" : NULL);
		if (count == 2)
			check_member(line, "message", lines[2].text);
		cJSON_Delete(line);
		count++;
	}
	ck_assert_int_eq(count, COUNT);
}
END_TEST

START_TEST(test_text_names_the_request_behind_the_line)
{
	char path[] = "/tmp/cbct-log-XXXXXX", text[2048];
	int saved;

	close(mkstemp(path));
	log_set_format(LOG_TEXT, NULL);
	saved = divert(path);
	log_set_request("r-1", "");
	log_line(LEVEL_INFO, "scan %s removed", id);
	log_line(LEVEL_INFO, "request id=r-1 status=200");
	log_set_request(NULL, NULL);
	log_line(LEVEL_ERROR, "job %s: %03000d", id, 1);
	restore(saved, path, text, sizeof(text));
	ck_assert_ptr_nonnull(strstr(text, " info: scan 1m83nrmzxmkcz7m6 removed request=r-1\n"));
	ck_assert_ptr_nonnull(strstr(text, " info: request id=r-1 status=200\n"));
	ck_assert_ptr_nonnull(strstr(text, " error: job 1m83nrmzxmkcz7m6: 000"));
	ck_assert_int_eq(text[strlen(text) - 1], '\n'); /* of a line that was too long, too */
}
END_TEST

START_TEST(test_the_journal_gets_fields_and_standard_error_what_it_does_not_take)
{
	char path[] = "/tmp/cbct-log-XXXXXX", got[4096], text[2048];
	struct sockaddr_un address = {.sun_family = AF_UNIX};
	int journal = socket(AF_UNIX, SOCK_DGRAM, 0), saved;
	ssize_t length;

	close(mkstemp(path));
	snprintf(address.sun_path, sizeof(address.sun_path), "%s.journal", path);
	ck_assert_int_eq(bind(journal, (struct sockaddr *)&address, sizeof(address)), 0);
	log_set_format(LOG_JOURNAL, address.sun_path);
	saved = divert(path);
	log_set_request("r-1", "4bf92f3577b34da6a3ce929d0e0e4736");
	log_line(LEVEL_ERROR, "job %s: it\nfailed", id);
	log_set_request(NULL, NULL);
	length = recv(journal, got, sizeof(got) - 1, MSG_DONTWAIT);
	close(journal);
	unlink(address.sun_path);
	log_line(LEVEL_INFO, "nobody reads the journal");
	restore(saved, path, text, sizeof(text));
	log_set_format(LOG_TEXT, NULL);
	ck_assert_int_gt(length, 0);
	got[length] = '\0';
	ck_assert_str_eq(got, "MESSAGE=job 1m83nrmzxmkcz7m6: it?failed\nPRIORITY=3\nSYSLOG_IDENTIFIER=cbctd\n"
			      "CBCT_REQUEST=r-1\nCBCT_TRACE=4bf92f3577b34da6a3ce929d0e0e4736\n"
			      "CBCT_JOB=1m83nrmzxmkcz7m6\n");
	ck_assert_ptr_null(strstr(text, "it?failed"));
	ck_assert_ptr_nonnull(strstr(text, " info: nobody reads the journal\n"));
}
END_TEST

Suite *log_suite(void);
Suite *log_suite(void)
{
	Suite *suite = suite_create("log");
	TCase *all = tcase_create("log");

	tcase_add_test(all, test_json_has_an_object_a_line_with_what_it_is_about);
	tcase_add_test(all, test_text_names_the_request_behind_the_line);
	tcase_add_test(all, test_the_journal_gets_fields_and_standard_error_what_it_does_not_take);
	suite_add_tcase(suite, all);
	return suite;
}
