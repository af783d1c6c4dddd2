/* Warnings of scans and jobs on the terminal. */
#include "clients/cbct/warning.h"

#include <stdio.h>

#include "clients/cbct/http.h"
#include "core/warning.h"

static void print(const char *severity, const char *code, const char *summary, const char *detail,
		  const struct warning_views *views)
{
	char list[256];

	warning_views_describe(views, list, sizeof(list));
	fprintf(stderr, "%s: %s: %s (%s%s%s)\n", severity, code, summary, detail, list[0] != 0 ? "; projections " : "",
		list);
}

void warning_print(const char *code, const char *text)
{
	const struct warning_kind *kind = warning_kind(code);
	char detail[WARNING_DETAIL_SIZE];
	struct warning_views views;

	warning_parse(text, detail, &views);
	print(severity_names[kind->severity], code, kind->summary, detail, &views);
}

static struct warning_views views_of(const cJSON *warning)
{
	const cJSON *count = cJSON_GetObjectItemCaseSensitive(warning, "view_count"), *range;
	struct warning_views views = {.count = cJSON_IsNumber(count) ? count->valueint : 0};

	cJSON_ArrayForEach(range, cJSON_GetObjectItemCaseSensitive(warning, "views"))
	{
		const cJSON *first = cJSON_GetArrayItem(range, 0), *last = cJSON_GetArrayItem(range, 1);

		if (views.ranges == WARNING_RANGES_MOST || !cJSON_IsNumber(first) || !cJSON_IsNumber(last))
			break;
		views.range[views.ranges][0] = first->valueint;
		views.range[views.ranges++][1] = last->valueint;
	}
	return views;
}

void warnings_print(const cJSON *list)
{
	const cJSON *warning;

	cJSON_ArrayForEach(warning, list)
	{
		const struct warning_views views = views_of(warning);

		print(member_text(warning, "severity", "caution"), member_text(warning, "code", "?"),
		      member_text(warning, "summary", ""), member_text(warning, "detail", ""), &views);
	}
}

void warnings_print_scan(const struct scan *scan)
{
	cJSON *list = scan_warnings(scan);

	warnings_print(list);
	cJSON_Delete(list);
}
