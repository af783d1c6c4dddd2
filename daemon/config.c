/* The settings of daemon/settings.def: flags, environment, config file, help and --print-config are made from it. */
#include "daemon/config.h"

#include <ctype.h>
#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "proto/scan_directory.h"

enum kind { KIND_TEXT, KIND_ADDRESS, KIND_LIST, KIND_CHOICE, KIND_INDICES, KIND_INTEGER, KIND_BYTES, KIND_SECONDS };

/* The default is read by the same parser as any other value. */
static const struct setting {
	const char *name, *metavar;
	enum kind kind;
	size_t offset;       /* in struct config */
	const char *initial; /* NULL: state_dir_default */
	double least, most;
	const char *const *choices;
	const char *help;
} settings[] = {
#define CHOICES(...)                                                                                                   \
	(const char *const[])                                                                                          \
	{                                                                                                              \
		__VA_ARGS__, NULL                                                                                      \
	}
#define SETTING(kind, member, name, metavar, initial, least, most, choices, help)                                      \
	{name, metavar, KIND_##kind, offsetof(struct config, member), initial, least, most, choices, help},
#include "daemon/settings.def"
#undef SETTING
#undef CHOICES
};
enum { SETTING_COUNT = sizeof(settings) / sizeof(settings[0]) };

static const char variable_prefix[] = "CBCTD_";

static void *field(const struct setting *setting, struct config *config)
{
	return (char *)config + setting->offset;
}

static bool is_text(const struct setting *setting)
{
	return setting->kind == KIND_TEXT || setting->kind == KIND_ADDRESS || setting->kind == KIND_LIST ||
	       setting->kind == KIND_CHOICE || setting->kind == KIND_INDICES;
}

static const struct setting *setting_find(const char *name, size_t length)
{
	for (int i = 0; i < SETTING_COUNT; i++) {
		if (strlen(settings[i].name) == length && memcmp(settings[i].name, name, length) == 0)
			return &settings[i];
	}
	return NULL;
}

/* "CBCTD_STATE_DIR" of "state-dir". */
static void variable_name(const struct setting *setting, char *ret_name, size_t size)
{
	int length = snprintf(ret_name, size, "%s%s", variable_prefix, setting->name);

	for (int i = 0; i < length && (size_t)i < size; i++)
		ret_name[i] = ret_name[i] == '-' ? '_' : (char)toupper((unsigned char)ret_name[i]);
}

static int set_text(char **text, const char *value, bool add, struct error *err)
{
	char *fresh = NULL;

	if (add && value[0] == '\0')
		return 0;
	if (!add || *text == NULL || **text == '\0')
		fresh = strdup(value);
	else if (asprintf(&fresh, "%s, %s", *text, value) < 0)
		fresh = NULL;
	if (fresh == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for settings");
	free(*text);
	*text = fresh;
	return 0;
}

/* A number with an optional K, M, G or T (powers of 1024); NAN for anything else. */
static double parse_amount(const char *value, bool units)
{
	static const char letters[] = "KMGT";
	char *end;
	double number;

	if (!isdigit((unsigned char)value[0]))
		return NAN;
	number = strtod(value, &end);
	if (units && *end != '\0') {
		const char *letter = strchr(letters, toupper((unsigned char)*end));

		if (letter == NULL)
			return NAN;
		number *= exp2(10.0 * (double)(letter - letters + 1));
		end++;
	}
	return *end == '\0' ? number : NAN;
}

int config_indices(const char *text, int *ret_indices, int most)
{
	const long largest = 4095;
	int count = 0;

	while (*text != '\0') {
		char *end;
		long index = strtol(text, &end, 10);

		if (!isdigit((unsigned char)text[0]) || index > largest || count == most ||
		    (*end != '\0' && (*end != ',' || end[1] == '\0')))
			return -1;
		if (ret_indices != NULL)
			ret_indices[count] = (int)index;
		count++;
		text = *end == ',' ? end + 1 : end;
	}
	return count;
}

/* `source` is how the user wrote it, "--threads" or "cbctd.conf:7: threads". */
static int setting_set(const struct setting *setting, struct config *config, const char *value, bool add,
		       const char *source, struct error *err)
{
	double number;

	if (setting->kind == KIND_CHOICE) {
		int i = 0;

		while (setting->choices[i] != NULL && strcmp(setting->choices[i], value) != 0)
			i++;
		if (setting->choices[i] == NULL)
			return error_set(err, ERR_INVALID, "%s: \"%s\" is none of its values: %s", source, value,
					 setting->help);
	}
	if (setting->kind == KIND_INDICES && config_indices(value, NULL, INDICES_MOST) < 0)
		return error_set(err, ERR_INVALID, "%s: \"%s\" is not a list of at most %d numbers, as 0,2", source,
				 value, INDICES_MOST);
	if (is_text(setting))
		return set_text(field(setting, config), value, add, err);

	number = parse_amount(value, setting->kind == KIND_BYTES);
	/* A part of a byte would become 0, which says something else. */
	if (setting->kind == KIND_BYTES && number > 0 && number < 1)
		number = NAN;
	if (!(number >= setting->least && number <= setting->most) ||
	    (setting->kind == KIND_INTEGER && number != floor(number)))
		return error_set(err, ERR_INVALID, "%s: \"%s\" is not a%s from %g to %g%s", source, value,
				 setting->kind == KIND_INTEGER ? " whole number" : " number", setting->least,
				 setting->most, setting->kind == KIND_BYTES ? " (K, M, G, T are known)" : "");
	if (setting->kind == KIND_INTEGER)
		*(long *)field(setting, config) = (long)number;
	else if (setting->kind == KIND_BYTES)
		*(size_t *)field(setting, config) = (size_t)number;
	else
		*(double *)field(setting, config) = number;
	return 0;
}

/* Prints an address without the password in it, scheme://user:PASSWORD@host/...?password=PASSWORD&... */
static void print_hidden(FILE *out, const char *text)
{
	static const char scheme[] = "://", key[] = "password=";
	const char *user = strstr(text, scheme), *last = strrchr(text, '@'), *password, *end;

	/* A password that is not written as it should be may have any character: all up to the last @ is hidden. */
	user = user == NULL ? text : user + strlen(scheme);
	password = last == NULL ? NULL : memchr(user, ':', last > user ? (size_t)(last - user) : 0);
	if (password != NULL) {
		fprintf(out, "%.*s:***", (int)(password - text), text);
		text = last;
	}
	while ((password = strstr(text, key)) != NULL) {
		password += strlen(key);
		end = password + strcspn(password, "&");
		fprintf(out, "%.*s***", (int)(password - text), text);
		text = end;
	}
	fputs(text, out);
}

/* systemd gives several directories separated by colons; the first is ours. */
static int state_dir_default(char **ret_path, struct error *err)
{
	const char *given = getenv("STATE_DIRECTORY"), *xdg = getenv("XDG_STATE_HOME"), *home = getenv("HOME");
	char *path = NULL;
	int wrote;

	if (given != NULL && given[0] != '\0')
		wrote = asprintf(&path, "%.*s", (int)strcspn(given, ":"), given);
	else if (xdg != NULL && xdg[0] == '/')
		wrote = asprintf(&path, "%s/cbctd", xdg);
	else
		wrote = asprintf(&path, "%s/.local/state/cbctd", home != NULL ? home : "");
	if (wrote < 0)
		return error_set(err, ERR_NO_MEMORY, "no memory for settings");
	*ret_path = path;
	return 0;
}

static int load_defaults(struct config *config, struct error *err)
{
	int code = 0;

	for (int i = 0; i < SETTING_COUNT && code == 0; i++) {
		if (settings[i].initial == NULL)
			code = state_dir_default(field(&settings[i], config), err);
		else
			code = setting_set(&settings[i], config, settings[i].initial, false, settings[i].name, err);
	}
	return code;
}

static char *trim(char *text)
{
	size_t length;

	while (isspace((unsigned char)*text))
		text++;
	length = strlen(text);
	while (length > 0 && isspace((unsigned char)text[length - 1]))
		text[--length] = '\0';
	return text;
}

/* One line of a config file; `given` remembers what this file has set already. */
static int load_line(struct config *config, char *line, const char *place, bool given[SETTING_COUNT], struct error *err)
{
	const struct setting *setting;
	char source[256], *value;
	size_t length;

	line = trim(line);
	if (line[0] == '\0' || line[0] == '#')
		return 0;
	value = strchr(line, '=');
	if (value == NULL)
		/* What stands behind the first word may be a password. */
		return error_set(err, ERR_INVALID, "%s: \"%.*s\" is not NAME = VALUE", place,
				 (int)strcspn(line, " \t:"), line);
	*value++ = '\0';
	line = trim(line);
	setting = setting_find(line, strlen(line));
	if (setting == NULL || strcmp(setting->name, "config") == 0)
		return error_set(err, ERR_INVALID, "%s: no setting is called \"%s\"", place, line);
	if (given[setting - settings] && setting->kind != KIND_LIST)
		return error_set(err, ERR_INVALID, "%s: \"%s\" is set a second time", place, line);
	value = trim(value);
	length = strlen(value);
	/* One alone too: a list's first value and its last would be quotes around them all. */
	if (length > 0 && (value[0] == '"' || value[length - 1] == '"'))
		return error_set(err, ERR_INVALID, "%s: %s: values have no quotes around them", place, line);
	snprintf(source, sizeof(source), "%s: %s", place, line);
	if (setting_set(setting, config, value, given[setting - settings], source, err) != 0)
		return err->code;
	given[setting - settings] = true;
	return 0;
}

static int load_file(struct config *config, const char *path, struct error *err)
{
	enum { CONFIG_BYTES_MAX = 1 << 20 };
	bool given[SETTING_COUNT] = {false};
	char *text, *next, *line, place[128];
	size_t length;
	int number = 0, code;

	code = file_read(path, CONFIG_BYTES_MAX, &text, &length, err);
	if (code != 0)
		return code;
	/* Text ends there, and what is behind it would be left out in silence. */
	if (strlen(text) != length)
		code = error_set(err, ERR_INVALID, "%.100s: it has a zero byte", path);
	next = text;
	while (code == 0 && (line = strsep(&next, "\n")) != NULL) {
		snprintf(place, sizeof(place), "%.100s:%d", path, ++number);
		code = load_line(config, line, place, given, err);
	}
	free(text);
	return code;
}

static int load_environment(struct config *config, struct error *err)
{
	char name[96];
	int code = 0;

	for (int i = 0; i < SETTING_COUNT && code == 0; i++) {
		const char *value;

		variable_name(&settings[i], name, sizeof(name));
		value = getenv(name);
		if (value != NULL)
			code = setting_set(&settings[i], config, value, false, name, err);
	}
	return code;
}

void config_unknown_variables(void (*visit)(const char *name))
{
	const size_t prefix = strlen("CBCTD_");
	char known[96], name[96];

	for (char **entry = environ; *entry != NULL; entry++) {
		bool found = strncmp(*entry, "CBCTD_", prefix) != 0;

		snprintf(name, sizeof(name), "%.*s", (int)strcspn(*entry, "="), *entry);
		for (int i = 0; i < SETTING_COUNT && !found; i++) {
			variable_name(&settings[i], known, sizeof(known));
			found = strcmp(known, name) == 0;
		}
		if (!found)
			visit(name);
	}
}

/* only_config: looks for --config alone. */
static int each_flag(int argc, char **argv, struct config *config, enum config_action *action, bool only_config,
		     struct error *err)
{
	bool given[SETTING_COUNT] = {false};

	for (int i = 1; i < argc; i++) {
		const char *name = argv[i], *value;
		const struct setting *setting;
		size_t length;

		if (strcmp(name, "--help") == 0 || strcmp(name, "-h") == 0) {
			*action = CONFIG_HELP;
			continue;
		}
		if (strcmp(name, "--print-config") == 0) {
			*action = CONFIG_PRINT;
			continue;
		}
		if (strcmp(name, "--rebuild-catalogue") == 0) {
			*action = CONFIG_REBUILD;
			continue;
		}
		if (strcmp(name, "--version") == 0) {
			*action = CONFIG_VERSION;
			continue;
		}
		length = strcspn(name, "=");
		setting = strncmp(name, "--", 2) == 0 ? setting_find(name + 2, length - 2) : NULL;
		if (setting == NULL)
			return error_set(err, ERR_INVALID, "%s: there is no such flag; --help shows all", name);
		value = name[length] == '=' ? name + length + 1 : i + 1 < argc ? argv[++i] : NULL;
		if (value == NULL)
			return error_set(err, ERR_INVALID, "%s: its value %s is missing", name, setting->metavar);
		if (only_config && strcmp(setting->name, "config") != 0)
			continue;
		if (setting_set(setting, config, value, given[setting - settings] && setting->kind == KIND_LIST, name,
				err) != 0)
			return err->code;
		given[setting - settings] = true;
	}
	return 0;
}

/* Help and version are printed whatever the settings are. */
static bool is_told(enum config_action action)
{
	return action == CONFIG_HELP || action == CONFIG_VERSION;
}

int config_load(int argc, char **argv, struct config *ret_config, enum config_action *ret_action, struct error *err)
{
	struct config config = {0};
	enum config_action action = CONFIG_RUN;
	const char *variable = getenv("CBCTD_CONFIG");
	int code;

	code = load_defaults(&config, err);
	if (code == 0 && variable != NULL)
		code = set_text(&config.config_file, variable, false, err);
	/* The flags are read twice: first for the name of the file that goes before the other flags. */
	if (code == 0)
		code = each_flag(argc, argv, &config, &action, true, err);
	if (code == 0 && config.config_file[0] != '\0' && !is_told(action))
		code = load_file(&config, config.config_file, err);
	if (code == 0 && !is_told(action))
		code = load_environment(&config, err);
	if (code == 0)
		code = each_flag(argc, argv, &config, &action, false, err);
	if (code != 0) {
		config_clear(&config);
		return code;
	}
	*ret_config = config;
	*ret_action = action;
	return 0;
}

void config_clear(struct config *config)
{
	for (int i = 0; i < SETTING_COUNT; i++) {
		if (is_text(&settings[i])) {
			char **text = field(&settings[i], config);

			free(*text);
			*text = NULL;
		}
	}
}

void config_compare(const struct config *a, const struct config *b, char *ret_names, size_t size)
{
	size_t length = 0;

	ret_names[0] = '\0';
	for (int i = 0; i < SETTING_COUNT && length < size; i++) {
		const struct setting *setting = &settings[i];
		const void *left = (const char *)a + setting->offset, *right = (const char *)b + setting->offset;
		bool same;

		if (is_text(setting))
			same = strcmp(*(char *const *)left, *(char *const *)right) == 0;
		else if (setting->kind == KIND_INTEGER)
			same = *(const long *)left == *(const long *)right;
		else if (setting->kind == KIND_BYTES)
			same = *(const size_t *)left == *(const size_t *)right;
		else
			same = *(const double *)left == *(const double *)right;
		if (!same)
			length += (size_t)snprintf(ret_names + length, size - length, "%s%s", length > 0 ? ", " : "",
						   setting->name);
	}
}

void config_help(FILE *out)
{
	fputs("usage: cbctd [--NAME VALUE ...]\n\n"
	      "Cone-beam reconstruction as a service: projections in over HTTP, volumes out.\n"
	      "Each setting is a flag, a line NAME = VALUE of the config file, or CBCTD_NAME in the\n"
	      "environment (upper case, _ for -); a flag goes first, then the environment, then the file.\n\n",
	      out);
	for (int i = 0; i < SETTING_COUNT; i++) {
		const struct setting *setting = &settings[i];

		fprintf(out, "  --%s %s\n        %s", setting->name, setting->metavar, setting->help);
		if (setting->initial != NULL && setting->initial[0] != '\0')
			fprintf(out, " (%s)", setting->initial);
		fputc('\n', out);
	}
	fputs("  --print-config\n        every setting as it is now, as a config file\n"
	      "  --rebuild-catalogue\n        sets the catalogue aside, makes it again from the directories of scans "
	      "and jobs,\n"
	      "        and ends; no daemon may use the state directory\n"
	      "  --help\n        this list\n",
	      out);
}

/* With as many digits as it takes to read the same number again. */
static void print_number(FILE *out, const char *name, double value)
{
	char text[40];
	int digits = 6;

	do
		snprintf(text, sizeof(text), "%.*g", digits, value);
	while (strtod(text, NULL) != value && digits++ < 17);
	fprintf(out, "%s = %s\n", name, text);
}

void config_print(const struct config *config, FILE *out)
{
	for (int i = 0; i < SETTING_COUNT; i++) {
		const struct setting *setting = &settings[i];
		const void *value = (const char *)config + setting->offset;

		fprintf(out, "# %s\n", setting->help);
		if (strcmp(setting->name, "config") == 0)
			fprintf(out, "# config = %s\n", *(char *const *)value); /* no line of a config file itself */
		else if (setting->kind == KIND_ADDRESS) {
			fprintf(out, "%s = ", setting->name);
			print_hidden(out, *(char *const *)value);
			fputc('\n', out);
		} else if (is_text(setting))
			fprintf(out, "%s = %s\n", setting->name, *(char *const *)value);
		else if (setting->kind == KIND_INTEGER)
			fprintf(out, "%s = %ld\n", setting->name, *(const long *)value);
		else if (setting->kind == KIND_BYTES)
			fprintf(out, "%s = %zu\n", setting->name, *(const size_t *)value);
		else
			print_number(out, setting->name, *(const double *)value);
	}
}
