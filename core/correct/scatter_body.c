/* Scattered radiation in one view from a body of water: see scatter_body.h. */
#include "core/correct/scatter_body.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { DEPTHS = 3, STEPS = 3, NODES = 8 }; /* places along a ray, parts of a way out, places on the detector */
static const double WATER = 0.0192;        /* 1/mm, in a beam for imaging */
/* Standard deviation of the means that light scattered more than once goes by: two ways between collisions, mm. */
static const double SPREAD = 120;
static const float THIN = 0.02f;     /* a line integral that scatters next to nothing */
static const double ROUNDING = 1e-9; /* of lengths that come out of a matrix */
static const double PI = 3.14159265358979323846;

/* Cells along one axis of the detector, and the places among them for which scatter is worked out. */
struct line {
	int cells, nodes;
	float first, width; /* of the cells' centres, mm from the beam's centre */
	float per_mm;       /* cells */
	float *at;          /* [nodes], mm */
	int *before;        /* [cells]: the node before each cell, */
	float *share;       /* and the next one's share in what is interpolated there */
};

/* A place at which light is scattered: how much of it in all directions, mm from the source. */
struct place {
	float x, y, z, light;
};

struct scatter_field {
	struct scatter_beam beam;
	struct line lines[2];
	float *half, *blurred, *between; /* [cell]: half of the body's thickness along the normal, mm; the mean of p */
	float *nodes;                    /* [node row][node column] */
	struct place *places;
	int count;
	float outermost; /* most of half */
};

struct scatter_beam scatter_beam_of(const struct view *view, bool turned)
{
	const double *steps[2] = {view->column_step, view->row_step};
	struct scatter_beam beam;
	double normal[3], away[3], length;

	vec_cross(view->column_step, view->row_step, normal);
	for (int i = 0; i < 3; i++)
		away[i] = view->pixel0[i] - view->source[i];
	length = copysign(vec_norm(normal), vec_dot(away, normal));
	beam.detector_mm = vec_dot(away, normal) / length;
	beam.body_mm = -vec_dot(view->source, normal) / length;
	for (int axis = 0; axis < 2; axis++) {
		const double *step = steps[turned ? 1 - axis : axis];

		beam.pixel_mm[axis] = vec_norm(step);
		beam.centre[axis] = -vec_dot(away, step) / vec_dot(step, step);
	}
	return beam;
}

int scatter_body_check(const struct geometry *geometry, struct error *err)
{
	for (int view = 0; view < geometry->count; view++) {
		const struct scatter_beam beam = scatter_beam_of(&geometry->views[view], false);

		/* A detector through the origin is there whether views or matrices say so. */
		if (!(beam.body_mm > 0 && beam.body_mm < (1 - ROUNDING) * beam.detector_mm))
			return error_set(err, ERR_IMPOSSIBLE,
					 "a body that scatters is expected about the origin, between source and "
					 "detector: in view %d it is %.4g mm from the source, the detector %.4g mm",
					 view, beam.body_mm, beam.detector_mm);
	}
	return 0;
}

static int line_open(struct line *line, const struct scatter_beam *beam, int axis, int pixels, int cells)
{
	const double width = beam->pixel_mm[axis] * pixels / cells;

	line->cells = cells;
	line->nodes = cells < NODES ? cells : NODES;
	line->width = (float)width;
	line->per_mm = (float)(1 / width);
	line->first = (float)(beam->pixel_mm[axis] * (-0.5 - beam->centre[axis]) + 0.5 * width);
	line->at = malloc((size_t)line->nodes * sizeof(*line->at));
	line->before = malloc((size_t)cells * sizeof(*line->before));
	line->share = malloc((size_t)cells * sizeof(*line->share));
	if (line->at == NULL || line->before == NULL || line->share == NULL)
		return -1;
	for (int node = 0; node < line->nodes; node++)
		line->at[node] =
		    line->first +
		    line->width * (float)(line->nodes > 1 ? (double)node * (cells - 1) / (line->nodes - 1) : 0);
	for (int cell = 0; cell < cells; cell++) {
		const double at = cells > 1 ? (double)cell * (line->nodes - 1) / (cells - 1) : 0;

		line->before[cell] = (int)at < line->nodes - 2 ? (int)at : line->nodes > 1 ? line->nodes - 2 : 0;
		line->share[cell] = (float)(at - line->before[cell]);
	}
	return 0;
}

struct scatter_field *scatter_field_new(const struct scatter_beam *beam, const int pixels[2], const int cells[2])
{
	struct scatter_field *field = calloc(1, sizeof(*field));
	const size_t count = (size_t)cells[0] * (size_t)cells[1];

	if (field == NULL)
		return NULL;
	field->beam = *beam;
	field->half = malloc(3 * count * sizeof(*field->half));
	field->nodes = malloc((size_t)NODES * NODES * sizeof(*field->nodes));
	field->places = malloc(DEPTHS * count * sizeof(*field->places));
	if (field->half == NULL || field->nodes == NULL || field->places == NULL ||
	    line_open(&field->lines[0], beam, 0, pixels[0], cells[0]) < 0 ||
	    line_open(&field->lines[1], beam, 1, pixels[1], cells[1]) < 0) {
		scatter_field_free(field);
		return NULL;
	}
	field->blurred = field->half + count;
	field->between = field->half + 2 * count;
	return field;
}

void scatter_field_free(struct scatter_field *field)
{
	if (field == NULL)
		return;
	for (int axis = 0; axis < 2; axis++) {
		free(field->lines[axis].at);
		free(field->lines[axis].before);
		free(field->lines[axis].share);
	}
	free(field->half);
	free(field->nodes);
	free(field->places);
	free(field);
}

/* Means about each cell of a line by a Gaussian, over what is on the detector. */
static void blur(const struct line *line, double width_mm, const float *from, int step, float *ret)
{
	float weights[SCATTER_BODY_CELLS];

	for (int i = 0; i < line->cells; i++) {
		const double away = i * (double)line->width / width_mm;

		weights[i] = (float)exp(-0.5 * away * away);
	}
	for (int to = 0; to < line->cells; to++) {
		float sum = 0, all = 0;

		for (int i = 0; i < line->cells; i++) {
			sum += weights[abs(to - i)] * from[i * step];
			all += weights[abs(to - i)];
		}
		ret[to * step] = sum / all;
	}
}

static void take_means(struct scatter_field *field, const float *p)
{
	const double width_mm = SPREAD * field->beam.detector_mm / field->beam.body_mm;
	const struct line *across = &field->lines[0], *along = &field->lines[1];

	for (int j = 0; j < along->cells; j++)
		blur(across, width_mm, p + j * across->cells, 1, field->between + j * across->cells);
	for (int i = 0; i < across->cells; i++)
		blur(along, width_mm, field->between + i, across->cells, field->blurred + i);
}

/* Half of the body's thickness along each ray. */
static void fill_halves(struct scatter_field *field, const float *p)
{
	const struct line *across = &field->lines[0], *along = &field->lines[1];
	const double far = field->beam.detector_mm;
	const double most = 0.9 * fmin(field->beam.body_mm, far - field->beam.body_mm);

	field->outermost = 0;
	for (int cell = 0; cell < across->cells * along->cells; cell++) {
		const double u = (double)(across->first + across->width * (float)(cell % across->cells));
		const double v = (double)(along->first + along->width * (float)(cell / across->cells));

		field->half[cell] =
		    (float)fmin(0.5 * (double)p[cell] / WATER * far / sqrt(u * u + v * v + far * far), most);
		field->outermost = fmaxf(field->outermost, field->half[cell]);
	}
}

/*
 * The middle of a ray's way through the body. Rays diverge: one that passes beside the middle of a round body meets it
 * nearer to the source. Of an ellipsoid about the isocentre, whatever its axes, it is this to the second order of its
 * size against the distance from the source.
 */
static inline float middle_at(const struct scatter_field *field, float half)
{
	const float middle = (float)field->beam.body_mm;

	return middle - (field->outermost * field->outermost - half * half) / middle;
}

/* The places in the body with their light. */
static void fill_places(struct scatter_field *field, const struct scatter_body *body, const float *p)
{
	const struct line *across = &field->lines[0], *along = &field->lines[1];
	const double far = field->beam.detector_mm, area = (double)across->width * (double)along->width;

	field->count = 0;
	for (int cell = 0; cell < across->cells * along->cells; cell++) {
		const double u = (double)(across->first + across->width * (float)(cell % across->cells));
		const double v = (double)(along->first + along->width * (float)(cell / across->cells));
		const double square = u * u + v * v + far * far, line = (double)p[cell];
		const double half = (double)field->half[cell], middle = (double)middle_at(field, field->half[cell]);
		const double more = 1 + body->multiple * (double)field->blurred[cell];
		const double light = body->amplitude * more * area / square * 2 * half / DEPTHS * WATER * 3 / (16 * PI);

		for (int depth = 0; depth < DEPTHS && p[cell] > THIN; depth++) {
			const double share = (depth + 0.5) / DEPTHS, z = middle + half * (2 * share - 1);

			field->places[field->count++] = (struct place){(float)(u * z / far), (float)(v * z / far),
								       (float)z, (float)(light * exp(-line * share))};
		}
	}
}

/* Ternaries, as calls of fminf and fmaxf take most of the time otherwise. */
static inline float held(float x, float most)
{
	return x > 0 ? (x < most ? x : most) : 0;
}

/* Half of the thickness where a ray meets the detector, beyond the outer cells as theirs. */
static inline float half_at(const struct scatter_field *field, float u, float v)
{
	const struct line *across = &field->lines[0], *along = &field->lines[1];
	const float x = held((u - across->first) * across->per_mm, (float)(across->cells - 1));
	const float y = held((v - along->first) * along->per_mm, (float)(along->cells - 1));
	const int i = (int)x, j = (int)y, right = i + 1 < across->cells,
		  below = j + 1 < along->cells ? across->cells : 0;
	const float *at = field->half + j * across->cells + i;
	const float upper = at[0] + (x - (float)i) * (at[right] - at[0]);
	const float lower = at[below] + (x - (float)i) * (at[below + right] - at[below]);

	return upper + (y - (float)j) * (lower - upper);
}

/* The length within the body from a place towards (u, v) on the detector, along the normal. */
static inline float way_out(const struct scatter_field *field, const struct place *place, float u, float v)
{
	const float far = (float)field->beam.detector_mm, middle = (float)field->beam.body_mm;
	const float step = fmaxf((middle + field->outermost - place->z) / STEPS, 1e-3f), each = 1 / step;
	const float right = (u - place->x) / (far - place->z), down = (v - place->y) / (far - place->z);
	float within = 0;

	for (int k = 0; k < STEPS; k++) {
		const float on = step * ((float)k + 0.5f), z = place->z + on, scale = far / z;
		const float half = half_at(field, (place->x + on * right) * scale, (place->y + on * down) * scale);

		within += held((half - fabsf(z - middle_at(field, half))) * each + 0.5f, 1);
	}
	return within * step;
}

static float node_of(const struct scatter_field *field, float u, float v)
{
	const float far = (float)field->beam.detector_mm, ray = sqrtf(u * u + v * v + far * far);
	float sum = 0;

	for (int n = 0; n < field->count; n++) {
		const struct place *place = &field->places[n];
		const float dx = u - place->x, dy = v - place->y, dz = far - place->z;
		const float way = sqrtf(dx * dx + dy * dy + dz * dz);
		const float from = sqrtf(place->x * place->x + place->y * place->y + place->z * place->z);
		const float cosine = (place->x * dx + place->y * dy + place->z * dz) / (from * way);

		sum += place->light * (1 + cosine * cosine) * dz / (way * way * way) *
		       expf(-(float)WATER * way_out(field, place, u, v) * way / dz);
	}
	return sum * ray * ray * ray / far;
}

void scatter_field_of(struct scatter_field *field, const struct scatter_body *body, const float *p, float *ret)
{
	const struct line *across = &field->lines[0], *along = &field->lines[1];

	take_means(field, p);
	fill_halves(field, p);
	fill_places(field, body, p);
#pragma omp parallel for schedule(dynamic)
	for (int node = 0; node < across->nodes * along->nodes; node++)
		field->nodes[node] = node_of(field, across->at[node % across->nodes], along->at[node / across->nodes]);
	for (int cell = 0; cell < across->cells * along->cells; cell++) {
		const int i = cell % across->cells, j = cell / across->cells;
		const int right = across->nodes > 1, below = along->nodes > 1 ? across->nodes : 0;
		const float *at = field->nodes + along->before[j] * across->nodes + across->before[i];
		const float upper = at[0] + across->share[i] * (at[right] - at[0]);
		const float lower = at[below] + across->share[i] * (at[below + right] - at[below]);

		ret[cell] = upper + along->share[j] * (lower - upper);
	}
}
