/* What a refinement has changed as a plot, for those who have no page: refinement.h. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/json.h"
#include "proto/refinement.h"
#include "proto/slice.h"

/*
 * Drawn at twice the picture's size, of which each pixel is then the mean of four: edges that lie between pixels look
 * smooth. Lengths below are those of the drawing.
 */
enum {
	FINE = 2,
	WIDTH = 960 * FINE,
	HEIGHT = 640 * FINE,
	LEFT = 96 * FINE,
	RIGHT = WIDTH - 24 * FINE,
	TOP = 44 * FINE, /* of a panel's plot below the panel's own */
	PANEL = 294 * FINE,
	PLOT = 232 * FINE /* a panel's plot is high */
};

struct drawing {
	unsigned char *pixels; /* [HEIGHT][WIDTH], 255 is paper */
	const cJSON *views;
	int count;
};

/* ---- letters ---- */

enum { LETTER_COLUMNS = 5, LETTER_ROWS = 9, LETTER_STEP = 6, LETTER_DOT = 2 * FINE, BASELINE = 7 };

/* A row's lowest bit is its rightmost dot; letters stand on the seventh row. */
static const struct letter {
	char name;
	unsigned char rows[LETTER_ROWS];
} letters[] = {
    {'0', {0x0e, 0x11, 0x13, 0x15, 0x19, 0x11, 0x0e}},
    {'1', {0x04, 0x0c, 0x04, 0x04, 0x04, 0x04, 0x0e}},
    {'2', {0x0e, 0x11, 0x01, 0x02, 0x04, 0x08, 0x1f}},
    {'3', {0x1f, 0x02, 0x04, 0x02, 0x01, 0x11, 0x0e}},
    {'4', {0x02, 0x06, 0x0a, 0x12, 0x1f, 0x02, 0x02}},
    {'5', {0x1f, 0x10, 0x1e, 0x01, 0x01, 0x11, 0x0e}},
    {'6', {0x06, 0x08, 0x10, 0x1e, 0x11, 0x11, 0x0e}},
    {'7', {0x1f, 0x01, 0x02, 0x04, 0x08, 0x08, 0x08}},
    {'8', {0x0e, 0x11, 0x11, 0x0e, 0x11, 0x11, 0x0e}},
    {'9', {0x0e, 0x11, 0x11, 0x0f, 0x01, 0x02, 0x0c}},
    {'-', {0x00, 0x00, 0x00, 0x0e}},
    {'+', {0x00, 0x04, 0x04, 0x1f, 0x04, 0x04}},
    {'.', {0x00, 0x00, 0x00, 0x00, 0x00, 0x0c, 0x0c}},
    {',', {0x00, 0x00, 0x00, 0x00, 0x00, 0x0c, 0x0c, 0x04, 0x08}},
    {'(', {0x02, 0x04, 0x08, 0x08, 0x08, 0x04, 0x02}},
    {')', {0x08, 0x04, 0x02, 0x02, 0x02, 0x04, 0x08}},
    {'a', {0x00, 0x00, 0x0e, 0x01, 0x0f, 0x11, 0x0f}},
    {'c', {0x00, 0x00, 0x0e, 0x10, 0x10, 0x11, 0x0e}},
    {'d', {0x01, 0x01, 0x0d, 0x13, 0x11, 0x11, 0x0f}},
    {'e', {0x00, 0x00, 0x0e, 0x11, 0x1f, 0x10, 0x0e}},
    {'f', {0x06, 0x09, 0x08, 0x1c, 0x08, 0x08, 0x08}},
    {'g', {0x00, 0x00, 0x0f, 0x11, 0x11, 0x11, 0x0f, 0x01, 0x0e}},
    {'h', {0x10, 0x10, 0x16, 0x19, 0x11, 0x11, 0x11}},
    {'i', {0x04, 0x00, 0x0c, 0x04, 0x04, 0x04, 0x0e}},
    {'j', {0x02, 0x00, 0x06, 0x02, 0x02, 0x02, 0x02, 0x12, 0x0c}},
    {'l', {0x0c, 0x04, 0x04, 0x04, 0x04, 0x04, 0x0e}},
    {'m', {0x00, 0x00, 0x1a, 0x15, 0x15, 0x15, 0x15}},
    {'n', {0x00, 0x00, 0x16, 0x19, 0x11, 0x11, 0x11}},
    {'o', {0x00, 0x00, 0x0e, 0x11, 0x11, 0x11, 0x0e}},
    {'p', {0x00, 0x00, 0x1e, 0x11, 0x11, 0x11, 0x1e, 0x10, 0x10}},
    {'r', {0x00, 0x00, 0x16, 0x19, 0x10, 0x10, 0x10}},
    {'s', {0x00, 0x00, 0x0f, 0x10, 0x0e, 0x01, 0x1e}},
    {'t', {0x08, 0x08, 0x1c, 0x08, 0x08, 0x09, 0x06}},
    {'u', {0x00, 0x00, 0x11, 0x11, 0x11, 0x13, 0x0d}},
    {'w', {0x00, 0x00, 0x11, 0x11, 0x15, 0x15, 0x0a}},
    {'x', {0x00, 0x00, 0x11, 0x0a, 0x04, 0x0a, 0x11}},
    {'y', {0x00, 0x00, 0x11, 0x11, 0x11, 0x11, 0x0f, 0x01, 0x0e}},
    {'z', {0x00, 0x00, 0x1f, 0x02, 0x04, 0x08, 0x1f}},
};

static void fill(struct drawing *drawing, int x, int y, int width, int height, unsigned char gray)
{
	for (int row = y < 0 ? 0 : y; row < y + height && row < HEIGHT; row++)
		for (int column = x < 0 ? 0 : x; column < x + width && column < WIDTH; column++)
			drawing->pixels[row * WIDTH + column] = gray;
}

static void write_letter(struct drawing *drawing, int x, int y, char name)
{
	const struct letter *letter = NULL;

	for (size_t i = 0; i < sizeof(letters) / sizeof(letters[0]); i++)
		if (letters[i].name == name)
			letter = &letters[i];
	for (int row = 0; row < LETTER_ROWS && letter != NULL; row++)
		for (int column = 0; column < LETTER_COLUMNS; column++)
			if (letter->rows[row] >> (LETTER_COLUMNS - 1 - column) & 1)
				fill(drawing, x + column * LETTER_DOT, y + row * LETTER_DOT, LETTER_DOT, LETTER_DOT, 0);
}

static int text_width(const char *text)
{
	return (int)strlen(text) * LETTER_STEP * LETTER_DOT;
}

/* Letters stand on y. */
static void write_text(struct drawing *drawing, int x, int y, const char *text)
{
	for (; *text != '\0'; text++, x += LETTER_STEP * LETTER_DOT)
		write_letter(drawing, x, y - BASELINE * LETTER_DOT, *text);
}

/* ---- curves ---- */

/* Of the three axes: grays and dashes that are told apart in print, too. Lengths of line and gap; no gap: solid. */
static const struct pen {
	unsigned char gray;
	int width, line, gap;
} pens[3] = {{0, 2 * FINE, 1, 0}, {90, 2 * FINE, 14 * FINE, 7 * FINE}, {60, 3 * FINE, 3 * FINE, 6 * FINE}};

/* A stroke from one point to another; *way is what the pen has gone before, and then with it. */
static void stroke(struct drawing *drawing, const struct pen *pen, const double from[2], const double to[2],
		   double *way)
{
	const double length = hypot(to[0] - from[0], to[1] - from[1]);
	const int steps = (int)ceil(length);

	for (int i = 0; i <= steps; i++) {
		const double share = steps > 0 ? (double)i / steps : 0;
		const double x = from[0] + share * (to[0] - from[0]), y = from[1] + share * (to[1] - from[1]);

		if (fmod(*way + share * length, pen->line + pen->gap) < pen->line)
			fill(drawing, (int)lrint(x) - pen->width / 2, (int)lrint(y) - pen->width / 2, pen->width,
			     pen->width, pen->gray);
	}
	*way += length;
}

static double value_of(const cJSON *view, const char *key, int axis)
{
	const cJSON *value = cJSON_GetArrayItem(cJSON_GetObjectItemCaseSensitive(view, key), axis);

	return cJSON_IsNumber(value) ? value->valuedouble : 0;
}

/* What one panel shows, and the numbers at its foot and its head. */
struct panel {
	const char *key;
	int y;
	double low, high;
};

static struct panel panel_of(const struct drawing *drawing, const char *key, int y)
{
	struct panel panel = {.key = key, .y = y};
	const cJSON *view;
	double room;

	cJSON_ArrayForEach(view, drawing->views) for (int axis = 0; axis < 3; axis++)
	{
		panel.low = fmin(panel.low, value_of(view, key, axis));
		panel.high = fmax(panel.high, value_of(view, key, axis));
	}
	room = fmax(panel.high - panel.low, 1e-6) / 20;
	panel.low -= room;
	panel.high += room;
	return panel;
}

static double y_of(const struct panel *panel, double value)
{
	return panel->y + TOP + PLOT * (panel->high - value) / (panel->high - panel->low);
}

/* 1, 2 or 5 times a power of ten, at most five in the panel. */
static double step_of(const struct panel *panel)
{
	const double least = (panel->high - panel->low) / 5, unit = pow(10, floor(log10(least)));

	return unit * (least <= unit ? 1 : least <= 2 * unit ? 2 : least <= 5 * unit ? 5 : 10);
}

static void draw_grid(struct drawing *drawing, const struct panel *panel)
{
	const double step = step_of(panel);
	char text[32];

	for (double k = ceil(panel->low / step); k * step <= panel->high; k++) {
		const int y = (int)lrint(y_of(panel, k * step));

		fill(drawing, LEFT, y, RIGHT - LEFT, FINE, k == 0 ? 150 : 215);
		snprintf(text, sizeof(text), "%.6g", k == 0 ? 0 : k * step);
		write_text(drawing, LEFT - 8 * FINE - text_width(text), y + BASELINE * LETTER_DOT / 2, text);
	}
}

static void draw_curve(struct drawing *drawing, const struct panel *panel, int axis)
{
	const double across = (double)(RIGHT - LEFT) / (drawing->count > 1 ? drawing->count - 1 : 1);
	double last[2] = {LEFT, y_of(panel, value_of(drawing->views->child, panel->key, axis))}, way = 0;
	const cJSON *view;
	int index = 0;

	cJSON_ArrayForEach(view, drawing->views)
	{
		const double now[2] = {LEFT + across * index++, y_of(panel, value_of(view, panel->key, axis))};

		stroke(drawing, &pens[axis], last, now, &way);
		memcpy(last, now, sizeof(last));
	}
}

/* From the right: each axis's name behind a piece of its line. */
static void draw_names(struct drawing *drawing, const struct panel *panel, const char *const names[3])
{
	enum { SAMPLE = 44 * FINE, GAP = 8 * FINE };
	const int y = panel->y + TOP - 14 * FINE;
	int x = RIGHT;

	for (int axis = 2; axis >= 0; axis--) {
		double from[2], to[2], way = 0;

		x -= text_width(names[axis]);
		write_text(drawing, x, y, names[axis]);
		x -= SAMPLE + GAP;
		from[0] = x;
		to[0] = x + SAMPLE;
		from[1] = to[1] = y - 3 * LETTER_DOT;
		stroke(drawing, &pens[axis], from, to, &way);
		x -= 2 * GAP;
	}
}

static double number_of(const cJSON *document, const char *name)
{
	const cJSON *number = cJSON_GetObjectItemCaseSensitive(document, name);

	return cJSON_IsNumber(number) ? number->valuedouble : 0;
}

static void draw_panels(struct drawing *drawing, const cJSON *document)
{
	static const char *const geometry_names[3] = {"columns", "rows", "across"};
	static const char *const motion_names[3] = {"x", "y", "z"};
	const cJSON *kind = cJSON_GetObjectItemCaseSensitive(document, "kind");
	const bool motion = cJSON_IsString(kind) && strcmp(kind->valuestring, "motion") == 0;
	static const struct {
		const char *key, *name, *rms, *most;
	} panels[] = {{"shift_mm", "shift, mm", "rms_mm", "most_mm"},
		      {"turn_deg", "turn, degrees", "rms_deg", "most_deg"}};
	char text[120];

	for (int i = 0; i < 2; i++) {
		const struct panel panel = panel_of(drawing, panels[i].key, i * PANEL);

		draw_grid(drawing, &panel);
		for (int axis = 0; axis < 3; axis++)
			draw_curve(drawing, &panel, axis);
		snprintf(text, sizeof(text), "%s (rms %.2g, most %.2g)", panels[i].name,
			 number_of(document, panels[i].rms), number_of(document, panels[i].most));
		write_text(drawing, LEFT, panel.y + TOP - 14 * FINE, text);
		draw_names(drawing, &panel, motion ? motion_names : geometry_names);
	}
}

/* The first and the last projection below the panels. */
static void draw_foot(struct drawing *drawing)
{
	static const char what[] = "projection";
	const int y = 2 * PANEL + 22 * FINE;
	const cJSON *last = cJSON_GetArrayItem(drawing->views, drawing->count - 1);
	char text[32];

	snprintf(text, sizeof(text), "%.0f", number_of(drawing->views->child, "projection"));
	write_text(drawing, LEFT, y, text);
	write_text(drawing, (LEFT + RIGHT - text_width(what)) / 2, y, what);
	snprintf(text, sizeof(text), "%.0f", number_of(last, "projection"));
	write_text(drawing, RIGHT - text_width(text), y, text);
}

/* Each pixel becomes the mean of FINE by FINE. */
static void reduce(unsigned char *pixels)
{
	for (int row = 0; row < HEIGHT / FINE; row++)
		for (int column = 0; column < WIDTH / FINE; column++) {
			int sum = 0;

			for (int i = 0; i < FINE * FINE; i++)
				sum += pixels[(row * FINE + i / FINE) * WIDTH + column * FINE + i % FINE];
			pixels[row * (WIDTH / FINE) + column] = (unsigned char)(sum / (FINE * FINE));
		}
}

int refinement_picture(const cJSON *document, char **ret_png, size_t *ret_length, struct error *err)
{
	struct drawing drawing = {.views = cJSON_GetObjectItemCaseSensitive(document, "views")};
	int code;

	drawing.count = cJSON_GetArraySize(drawing.views);
	if (drawing.count == 0)
		return error_set(err, ERR_CONFLICT, "nothing was changed that could be drawn");
	drawing.pixels = malloc((size_t)WIDTH * HEIGHT);
	if (drawing.pixels == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a picture of %d x %d", WIDTH, HEIGHT);
	memset(drawing.pixels, 255, (size_t)WIDTH * HEIGHT);
	draw_panels(&drawing, document);
	draw_foot(&drawing);
	reduce(drawing.pixels);
	code = gray_png(drawing.pixels, WIDTH / FINE, HEIGHT / FINE, NULL, ret_png, ret_length, err);
	free(drawing.pixels);
	return code;
}
