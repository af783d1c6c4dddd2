/* Warnings of scans and jobs on the terminal. */
#include "clients/cbct/warning.h"

#include <stdio.h>

#include "clients/cbct/http.h"
#include "core/warning.h"

void warning_print(const char *code, const char *detail)
{
	const struct warning_kind *kind = warning_kind(code);

	fprintf(stderr, "%s: %s: %s (%s)\n", severity_names[kind->severity], code, kind->summary, detail);
}

void warnings_print(const cJSON *list)
{
	const cJSON *warning;

	cJSON_ArrayForEach(warning, list) fprintf(
	    stderr, "%s: %s: %s (%s)\n", member_text(warning, "severity", "caution"), member_text(warning, "code", "?"),
	    member_text(warning, "summary", ""), member_text(warning, "detail", ""));
}

void warnings_print_scan(const struct scan *scan)
{
	cJSON *list = scan_warnings(scan);

	warnings_print(list);
	cJSON_Delete(list);
}
