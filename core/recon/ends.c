/* The end slices of the iterate, held against the volume that the iterations began with: see ends.h. */
#include "core/recon/ends.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* The first and the last slices of the volume. */
enum { ENDS = 2 };
/* Slices that may be changed at an end: so many times the reach, as far as the volume has them. */
enum { DEEP = 6, REACH_MOST = 4 };
/* Shares of water's density, or of half the object's where that is more: 40 HU and 150 HU. */
static const double LITTLE = 0.04, MUCH = 0.15;
/* Voxels of the body that a slice must have for its means to say something, and at the face for an end to be looked at.
 */
enum { BODY_LEAST = 16, BODY_AT_FACE = 4 };
/* The share of a slice further in that a slice at the face has where a body narrows. */
static const double NARROWER = 0.75;
/* M is over so many times the reach to either side. */
enum { WIDE = 4 };

struct ends {
	int columns, rows, slices; /* of the volume: x, y, z */
	int reach;                 /* n of ends.h */
	int inner, zone;           /* slices at an end that may be changed, and that are looked at */
	size_t pixels;             /* of a slice */
	double mu_water;
	bool nonnegative;

	bool known;   /* B is */
	double level; /* 1/mm: water's density, or half of the object's */
	bool shown[ENDS];
	/* Slices of either end, counted from the face inwards, [end][slice][y][x]. */
	float *start; /* [zone] slices: B */
	float *held;  /* [inner] slices: V, while V' is shown */
	/* Slices of the end at work. */
	float *values;    /* [zone] slices: V, then V' */
	float *smooth;    /* [zone] slices: D */
	float *wide;      /* [zone] slices: means of d over the body around */
	float *alternate; /* [inner] slices: a */
	float *work;      /* [2] slices */
};

/* ---- life ---- */

static int reach_of(const struct grid *grid, const struct orbit *orbit)
{
	const double rows_height = orbit->pixel_at_isocentre[1] / grid->spacing[2];

	return (int)fmin(fmax(round(rows_height), 1), REACH_MOST);
}

/* Slices that may be changed at an end; 0: there are too few, or nothing to tell them apart. */
static int inner_of(const struct grid *grid, const struct geometry *geometry, int reach)
{
	const int part = grid->size[2] / 2 - reach;

	if (geometry->rows == 1 || part < 1)
		return 0;
	return part < DEEP * reach ? part : DEEP * reach;
}

/* Counts the slices of start, held, values, smooth, wide, alternate and work. */
static size_t slices_held(int inner, int reach)
{
	const size_t zone = (size_t)inner + (size_t)reach;

	return ENDS * zone + ENDS * (size_t)inner + 3 * zone + (size_t)inner + 2;
}

size_t ends_bytes(const struct grid *grid, const struct geometry *geometry, const struct orbit *orbit)
{
	const int reach = reach_of(grid, orbit), inner = inner_of(grid, geometry, reach);
	const size_t pixels = (size_t)grid->size[0] * (size_t)grid->size[1];

	return inner > 0 ? slices_held(inner, reach) * pixels * sizeof(float) : 0;
}

int ends_new(const struct grid *grid, const struct geometry *geometry, const struct orbit *orbit, double mu_water,
	     bool nonnegative, struct ends **ret_ends, struct error *err)
{
	const size_t bytes = ends_bytes(grid, geometry, orbit);
	const int reach = reach_of(grid, orbit), inner = inner_of(grid, geometry, reach), zone = inner + reach;
	struct ends *ends;

	if (bytes == 0)
		return 0;
	ends = malloc(sizeof(*ends));
	if (ends == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for the end slices");
	*ends = (struct ends){
	    .columns = grid->size[0],
	    .rows = grid->size[1],
	    .slices = grid->size[2],
	    .reach = reach,
	    .inner = inner,
	    .zone = zone,
	    .pixels = (size_t)grid->size[0] * (size_t)grid->size[1],
	    .mu_water = mu_water,
	    .nonnegative = nonnegative,
	    .start = calloc(bytes, 1),
	};
	if (ends->start == NULL) {
		free(ends);
		return error_set(err, ERR_NO_MEMORY, "no memory for %d end slices", ENDS * zone);
	}
	ends->held = ends->start + (size_t)(ENDS * zone) * ends->pixels;
	ends->values = ends->held + (size_t)(ENDS * inner) * ends->pixels;
	ends->smooth = ends->values + (size_t)zone * ends->pixels;
	ends->wide = ends->smooth + (size_t)zone * ends->pixels;
	ends->alternate = ends->wide + (size_t)zone * ends->pixels;
	ends->work = ends->alternate + (size_t)inner * ends->pixels;
	*ret_ends = ends;
	return 0;
}

void ends_free(struct ends *ends)
{
	if (ends == NULL)
		return;
	free(ends->start);
	free(ends);
}

/* ---- slices in and out ---- */

/* The volume's z of a slice counted from the face. */
static int z_of(const struct ends *ends, int end, int slice)
{
	return end == 0 ? slice : ends->slices - 1 - slice;
}

static int read_slices(const struct ends *ends, const struct backend *backend, struct volume *volume, int end,
		       float *ret_slices, struct error *err)
{
	int code = 0;

	for (int i = 0; i < ends->zone && code == 0; i++)
		code =
		    backend->volume_download(volume, z_of(ends, end, i), 1, ret_slices + (size_t)i * ends->pixels, err);
	return code;
}

static int write_slices(const struct ends *ends, const struct backend *backend, struct volume *volume, int end,
			const float *slices, struct error *err)
{
	int code = 0;

	for (int i = 0; i < ends->inner && code == 0; i++)
		code = backend->volume_put(volume, z_of(ends, end, i), 1, slices + (size_t)i * ends->pixels, err);
	return code;
}

/* The object's density is the mean of its voxels, each weighted by its own value: air counts for nothing. */
static void know_start(struct ends *ends)
{
	const size_t count = (size_t)(ENDS * ends->zone) * ends->pixels;
	double sum = 0, squares = 0;

	for (size_t i = 0; i < count; i++) {
		const double value = fmax((double)ends->start[i], 0);

		sum += value;
		squares += value * value;
	}
	ends->level = fmax(ends->mu_water, sum > 0 ? 0.5 * squares / sum : 0);
	ends->known = true;
}

int ends_begin(struct ends *ends, const struct backend *backend, struct volume *volume, struct error *err)
{
	int code = 0;

	for (int end = 0; end < ENDS && code == 0; end++)
		code = read_slices(ends, backend, volume, end, ends->start + (size_t)(end * ends->zone) * ends->pixels,
				   err);
	if (code == 0)
		know_start(ends);
	return code;
}

size_t ends_state_bytes(const struct ends *ends)
{
	return ends != NULL ? (size_t)(ENDS * ends->zone) * ends->pixels * sizeof(float) : 0;
}

const float *ends_state(const struct ends *ends)
{
	return ends->start;
}

void ends_resume(struct ends *ends, const char *bytes)
{
	memcpy(ends->start, bytes, ends_state_bytes(ends));
	know_start(ends);
}

/* ---- one end ---- */

static int clamp(int at, int count)
{
	return at < 0 ? 0 : at >= count ? count - 1 : at;
}

/* D of one slice from V and B; what lies beyond the slice's edges is as at them. */
static void smooth_slice(struct ends *ends, const float *start, const float *values, float *ret_smooth)
{
	const int columns = ends->columns, rows = ends->rows, n = ends->reach, side = 2 * n + 1;
	const float share = 1 / (float)(side * side);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t row = (size_t)y * (size_t)columns;
			float sum = 0;

			for (int k = -n; k <= n; k++) {
				const size_t at = row + (size_t)clamp(x + k, columns);

				sum += values[at] - start[at];
			}
			ends->work[row + (size_t)x] = sum;
		}
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			float sum = 0;

			for (int k = -n; k <= n; k++)
				sum += ends->work[(size_t)clamp(y + k, rows) * (size_t)columns + (size_t)x];
			ret_smooth[(size_t)y * (size_t)columns + (size_t)x] = share * sum;
		}
}

static bool is_body(const struct ends *ends, float start, float value)
{
	return fmax((double)start, (double)value) > 0.5 * ends->level;
}

/* Means of d over the voxels of the body around; 0 where they are too few to say something. */
static void widen_slice(struct ends *ends, const float *start, const float *values, float *ret_wide)
{
	const int columns = ends->columns, rows = ends->rows, far = WIDE * ends->reach;
	float *sums = ends->work, *counts = ends->work + ends->pixels;

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t row = (size_t)y * (size_t)columns;
			const int last = x + far < columns ? x + far : columns - 1;
			float sum = 0, count = 0;

			for (int i = x > far ? x - far : 0; i <= last; i++) {
				const size_t at = row + (size_t)i;

				if (is_body(ends, start[at], values[at])) {
					sum += values[at] - start[at];
					count++;
				}
			}
			sums[row + (size_t)x] = sum;
			counts[row + (size_t)x] = count;
		}
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const int last = y + far < rows ? y + far : rows - 1;
			float sum = 0, count = 0;

			for (int i = y > far ? y - far : 0; i <= last; i++) {
				sum += sums[(size_t)i * (size_t)columns + (size_t)x];
				count += counts[(size_t)i * (size_t)columns + (size_t)x];
			}
			ret_wide[(size_t)y * (size_t)columns + (size_t)x] = count >= BODY_LEAST ? sum / count : 0;
		}
}

/* a of a voxel of these slices, before the largest nearby is taken. */
static float alternates(const struct ends *ends, const float *slices, int slice, size_t i)
{
	const float here = slices[(size_t)slice * ends->pixels + i];
	float most = 0;

	for (int k = -ends->reach; k <= ends->reach; k++) {
		const float there = slice + k >= 0 ? slices[(size_t)(slice + k) * ends->pixels + i] : here;

		if (here * there < 0)
			most = fmaxf(most, fminf(fabsf(here), fabsf(there)));
	}
	return most;
}

static void alternate_slice(const struct ends *ends, int slice, float *ret_alternate)
{
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < ends->pixels; i++)
		ret_alternate[i] = alternates(ends, ends->smooth, slice, i);
}

/* Weighted along z by (n + 1 - |k|) / (n + 1)^2; beyond the face it goes on as there. */
static double along_axis(const struct ends *ends, const float *slices, int slice, size_t i)
{
	const int n = ends->reach, whole = (n + 1) * (n + 1);
	double sum = 0;

	for (int k = -n; k <= n; k++) {
		const int there = slice + k < 0 ? 0 : slice + k;

		sum += (double)(n + 1 - abs(k)) / whole * (double)slices[(size_t)there * ends->pixels + i];
	}
	return sum;
}

/* The largest within 2n voxels along x and y, in place. */
static void spread_slice(struct ends *ends, float *alternate)
{
	const int columns = ends->columns, rows = ends->rows, far = 2 * ends->reach;

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t row = (size_t)y * (size_t)columns;
			float most = 0;

			for (int k = -far; k <= far; k++)
				most = fmaxf(most, alternate[row + (size_t)clamp(x + k, columns)]);
			ends->work[row + (size_t)x] = most;
		}
#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			float most = 0;

			for (int k = -far; k <= far; k++)
				most =
				    fmaxf(most, ends->work[(size_t)clamp(y + k, rows) * (size_t)columns + (size_t)x]);
			alternate[(size_t)y * (size_t)columns + (size_t)x] = most;
		}
}

/* Voxels of a slice that the iterate has above half. */
static int count_of(const struct ends *ends, const float *slice)
{
	int count = 0;

	for (size_t i = 0; i < ends->pixels; i++)
		count += (double)slice[i] > 0.5 * ends->level;
	return count;
}

/* True if the body comes as near to the face as the reach. The iterate tells: FDK blurs a body's end across slices. */
static bool is_at_face(const struct ends *ends, const float *values)
{
	for (int slice = 0; slice < ends->reach; slice++) {
		const size_t at = (size_t)slice * ends->pixels;

		if (count_of(ends, values + at) >= BODY_AT_FACE)
			return true;
	}
	return false;
}

/* The median over the body of a slice, to a part in BINS of the level. */
static double median_in_body(const struct ends *ends, const float *start, const float *values, const float *of)
{
	enum { BINS = 1024 };
	size_t count[BINS] = {0}, all = 0, below = 0;
	int bin = 0;

	for (size_t i = 0; i < ends->pixels; i++)
		if (is_body(ends, start[i], values[i])) {
			count[(int)fmin(BINS * ((double)of[i] / ends->level), BINS - 1)]++;
			all++;
		}
	while (2 * (below + count[bin]) < all) {
		below += count[bin];
		bin++;
	}
	return bin * ends->level / BINS;
}

/* g of ends.h. */
static double gain(const struct ends *ends, double a)
{
	const double much = MUCH * ends->level;

	return 1 / (1 + a * a / (much * much));
}

/* V' of one slice. */
static void blend_slice(const struct ends *ends, int slice, double doubt, const float *start, float *values)
{
#pragma omp parallel for schedule(static)
	for (size_t i = 0; i < ends->pixels; i++) {
		const double a = (double)ends->alternate[(size_t)slice * ends->pixels + i];
		const double e = fmax(a - doubt / 2, 0), w = e * e / (e * e + doubt * doubt / 4);
		double mean = 0, wanted;

		if (e == 0)
			continue;
		if (is_body(ends, start[i], values[i]))
			mean = gain(ends, 2 * (double)alternates(ends, ends->wide, slice, i)) *
			       along_axis(ends, ends->wide, slice, i);
		wanted = (double)start[i] + mean + gain(ends, a) * (along_axis(ends, ends->smooth, slice, i) - mean);
		if (ends->nonnegative && wanted < 0)
			wanted = 0;
		values[i] = (float)((double)values[i] + w * (wanted - (double)values[i]));
	}
}

/*
 * Change of a slice, means over the body in 1/mm: without its outline, where FDK and iterations differ anywhere, NaN
 * where too little is left to say something; and over all of it.
 */
struct slice_change {
	double corrected; /* of |V' - V| */
	double departure; /* |of V' - B| */
	double outlined;  /* of |V' - V|, over all of it */
};

/* True for a voxel of the body with the body on all four sides in its slice, as far as there are voxels. */
static bool is_within(const struct ends *ends, const float *start, const float *values, int x, int y)
{
	static const int sides[][2] = {{0, 0}, {-1, 0}, {1, 0}, {0, -1}, {0, 1}};

	for (int k = 0; k < (int)(sizeof(sides) / sizeof(*sides)); k++) {
		const size_t at = (size_t)clamp(y + sides[k][1], ends->rows) * (size_t)ends->columns +
				  (size_t)clamp(x + sides[k][0], ends->columns);

		if (!is_body(ends, start[at], values[at]))
			return false;
	}
	return true;
}

/* False where the body is too little in the slice to say something. */
static bool change_of(const struct ends *ends, const float *start, const float *before, const float *after,
		      struct slice_change *ret_change)
{
	double outlined = 0, corrected = 0, departure = 0;
	size_t count = 0, within = 0;

	for (int y = 0; y < ends->rows; y++)
		for (int x = 0; x < ends->columns; x++) {
			const size_t i = (size_t)y * (size_t)ends->columns + (size_t)x;
			const double change = fabs((double)after[i] - (double)before[i]);

			if (!is_body(ends, start[i], before[i]))
				continue;
			outlined += change;
			count++;
			if (!is_within(ends, start, before, x, y))
				continue;
			corrected += change;
			departure += (double)after[i] - (double)start[i];
			within++;
		}
	if (count < BODY_LEAST)
		return false;
	*ret_change = (struct slice_change){
	    .corrected = within >= BODY_LEAST ? corrected / (double)within : NAN,
	    .departure = within >= BODY_LEAST ? fabs(departure) / (double)within : NAN,
	    .outlined = outlined / (double)count,
	};
	return true;
}

/* True where the body has a quarter less in the slice at the face than as far in as the reach. */
static bool narrows(const struct ends *ends, const float *before)
{
	for (int slice = 0; slice < ends->reach && slice + ends->reach < ends->inner; slice++) {
		const float *at = before + (size_t)slice * ends->pixels;
		const int count = count_of(ends, at);

		if (count >= BODY_AT_FACE)
			return count < NARROWER * count_of(ends, at + (size_t)ends->reach * ends->pixels);
	}
	return false;
}

/*
 * The slices whose change is too large to say nothing of it. The innermost one with enough of the body shows what d is
 * without an end. A small body's last slice may be outline alone: it counts where the body narrows, for along a rod
 * that goes on FDK's blur of the outline is no end.
 */
static void report_end(const struct ends *ends, int end, struct ends_report *report)
{
	const float *start = ends->start + (size_t)(end * ends->zone) * ends->pixels;
	const float *before = ends->held + (size_t)(end * ends->inner) * ends->pixels;
	const bool outline = narrows(ends, before);
	const double little = LITTLE * ends->level;
	double usual = NAN;

	for (int i = ends->inner - 1; i >= 0; i--) {
		const size_t at = (size_t)i * ends->pixels;
		struct slice_change change;

		if (!change_of(ends, start + at, before + at, ends->values + at, &change))
			continue;
		if (isnan(usual))
			usual = change.departure;
		if (outline)
			change.corrected = fmax(change.corrected, change.outlined);
		if (!(change.corrected > little) && !(change.departure - usual > little))
			continue;
		report->uncertain = true;
		report->slices[end] = report->slices[end] > i ? report->slices[end] : i + 1;
		report->corrected = fmax(report->corrected, change.corrected);
		report->departure = fmax(report->departure, change.departure);
	}
}

/* V' of an end, whose V is in values. */
static void blend_end(struct ends *ends, int end)
{
	const float *start = ends->start + (size_t)(end * ends->zone) * ends->pixels;
	const size_t innermost = (size_t)(ends->inner - 1) * ends->pixels;
	double doubt;

	for (int i = 0; i < ends->zone; i++) {
		const size_t at = (size_t)i * ends->pixels;

		smooth_slice(ends, start + at, ends->values + at, ends->smooth + at);
		widen_slice(ends, start + at, ends->values + at, ends->wide + at);
	}
	for (int i = 0; i < ends->inner; i++)
		alternate_slice(ends, i, ends->alternate + (size_t)i * ends->pixels);
	doubt = LITTLE * ends->level;
	doubt += 2 * fmin(doubt, median_in_body(ends, start + innermost, ends->values + innermost,
						ends->alternate + innermost));
	for (int i = 0; i < ends->inner; i++) {
		const size_t at = (size_t)i * ends->pixels;

		spread_slice(ends, ends->alternate + at);
		blend_slice(ends, i, doubt, start + at, ends->values + at);
	}
}

/* ---- both ends ---- */

int ends_show(struct ends *ends, const struct backend *backend, struct volume *volume, struct ends_report *ret_report,
	      struct error *err)
{
	const size_t bytes = (size_t)ends->inner * ends->pixels * sizeof(float);
	struct ends_report report = {0};
	int code = 0;

	for (int end = 0; end < ENDS && ends->known && code == 0; end++) {
		float *held = ends->held + (size_t)(end * ends->inner) * ends->pixels;

		code = read_slices(ends, backend, volume, end, ends->values, err);
		if (code < 0)
			break;
		if (!is_at_face(ends, ends->values))
			continue;
		memcpy(held, ends->values, bytes);
		blend_end(ends, end);
		report_end(ends, end, &report);
		ends->shown[end] = memcmp(held, ends->values, bytes) != 0;
		if (ends->shown[end])
			code = write_slices(ends, backend, volume, end, ends->values, err);
		report.changed = report.changed || ends->shown[end];
	}
	if (code == 0)
		*ret_report = report;
	return code;
}

int ends_hide(struct ends *ends, const struct backend *backend, struct volume *volume, struct error *err)
{
	int code = 0;

	for (int end = 0; end < ENDS && code == 0; end++) {
		if (ends->shown[end])
			code = write_slices(ends, backend, volume, end,
					    ends->held + (size_t)(end * ends->inner) * ends->pixels, err);
		ends->shown[end] = false;
	}
	return code;
}
