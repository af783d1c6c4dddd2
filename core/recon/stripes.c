/* Slices that are too bright and too dark by turns: see stripes.h. */
#include "core/recon/stripes.h"

#include <limits.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Slices of so many rows; and a grid of fewer slices has none that alternate three times. */
static const double ROWS_LEAST = 0.7, ROWS_MOST = 1.5;
enum { SLICES_LEAST = 5 };
/* HU. */
static const float LITTLE = 20, SOFT = 25;
static const double TOLD = 40;
/* So much of what alternates in FDK may alternate in the iterate. */
static const float OF_FDK = 2;
/* Voxels to either side: of a_V, and of a_F. */
enum { NEAR = 1, NEAR_FDK = 2 };
/* FDK's is kept in a byte, in steps of so many HU. */
static const float STEP = 4;
/* A row of three that is no cap goes on by so much of its own; FDK's caps are so high, and on a body of so much, HU. */
static const float GOES_ON = 0.15F;
static const float CAP = 60, BODY = 500;
/* Slices at hand at a time: of V, of its means, and of a. */
enum { VALUES = 6, MEANS = 7, ALTERNATING = 3 };
/* A slice whose body is smaller says nothing. */
enum { BODY_LEAST = 16 };

struct stripes {
	int size[3];
	size_t pixels;
	float hu;           /* 1/mm */
	float *values;      /* [VALUES] slices, owned; slice z is z % VALUES of them */
	float *means;       /* [MEANS] slices of M, behind values */
	float *alternating; /* [ALTERNATING] slices of a, behind means */
	float *changed;     /* a slice, behind that */
	unsigned char *fdk; /* behind that, [z][y][x]: FDK's a, in steps */
	/* behind that, [z][y][x], a bit each: whether FDK has a cap there; the last byte says whether FDK was seen */
	unsigned char *caps;
};

static size_t slices_bytes(const struct grid *grid)
{
	return (size_t)grid->size[0] * (size_t)grid->size[1] * (VALUES + MEANS + ALTERNATING + 1) * sizeof(float);
}

static size_t caps_bytes(size_t voxels)
{
	return (voxels + CHAR_BIT - 1) / CHAR_BIT + 1;
}

size_t stripes_bytes(const struct grid *grid, const struct orbit *orbit)
{
	const double rows = grid->spacing[2] / orbit->pixel_at_isocentre[1];

	if (!(rows >= ROWS_LEAST && rows <= ROWS_MOST) || orbit->lean != 0 || grid->size[2] < SLICES_LEAST)
		return 0;
	return slices_bytes(grid) + grid_voxels(grid) + caps_bytes(grid_voxels(grid));
}

int stripes_new(const struct grid *grid, const struct orbit *orbit, double mu_water, struct stripes **ret_stripes,
		struct error *err)
{
	const size_t bytes = stripes_bytes(grid, orbit);
	struct stripes *stripes;

	*ret_stripes = NULL;
	if (bytes == 0)
		return 0;
	stripes = malloc(sizeof(*stripes));
	if (stripes == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for some slices");
	*stripes = (struct stripes){
	    .size = {grid->size[0], grid->size[1], grid->size[2]},
	    .pixels = (size_t)grid->size[0] * (size_t)grid->size[1],
	    .hu = (float)(mu_water / 1000),
	    .values = calloc(bytes, 1),
	};
	if (stripes->values == NULL) {
		free(stripes);
		return error_set(err, ERR_NO_MEMORY, "no memory for %zu bytes of slices", bytes);
	}
	stripes->means = stripes->values + VALUES * stripes->pixels;
	stripes->alternating = stripes->means + MEANS * stripes->pixels;
	stripes->changed = stripes->alternating + ALTERNATING * stripes->pixels;
	stripes->fdk = (unsigned char *)(stripes->changed + stripes->pixels);
	stripes->caps = stripes->fdk + grid_voxels(grid);
	*ret_stripes = stripes;
	return 0;
}

void stripes_free(struct stripes *stripes)
{
	if (stripes == NULL)
		return;
	free(stripes->values);
	free(stripes);
}

size_t stripes_state_bytes(const struct stripes *stripes)
{
	const size_t voxels = stripes != NULL ? stripes->pixels * (size_t)stripes->size[2] : 0;

	return stripes != NULL ? voxels + caps_bytes(voxels) : 0;
}

const void *stripes_state(const struct stripes *stripes)
{
	return stripes->fdk;
}

void stripes_resume(struct stripes *stripes, const char *bytes)
{
	memcpy(stripes->fdk, bytes, stripes_state_bytes(stripes));
}

static unsigned char *seen(const struct stripes *stripes)
{
	return stripes->fdk + stripes_state_bytes(stripes) - 1;
}

/* ---- slices as they come ---- */

static int held(int i, int count)
{
	return i < 0 ? 0 : i < count ? i : count - 1;
}

/* Beyond the first and the last slice the volume goes on as it is there. */
static const float *values_of(const struct stripes *stripes, int z)
{
	return stripes->values + (size_t)(held(z, stripes->size[2]) % VALUES) * stripes->pixels;
}

static float *means_of(const struct stripes *stripes, int z)
{
	return stripes->means + (size_t)(held(z, stripes->size[2]) % MEANS) * stripes->pixels;
}

static float *alternating_of(const struct stripes *stripes, int z)
{
	return stripes->alternating + (size_t)(z % ALTERNATING) * stripes->pixels;
}

/* A of a voxel, i its place in the slice. */
static float away(const struct stripes *stripes, int z, size_t i)
{
	return (2 * values_of(stripes, z)[i] - values_of(stripes, z - 1)[i] - values_of(stripes, z + 1)[i]) / 4;
}

/* A' of a voxel. */
static float away_in_means(const struct stripes *stripes, int z, size_t i)
{
	return (2 * means_of(stripes, z)[i] - means_of(stripes, z - 1)[i] - means_of(stripes, z + 1)[i]) / 4;
}

/* M of slice z. */
static void take_means(const struct stripes *stripes, int z)
{
	const int columns = stripes->size[0], rows = stripes->size[1];
	const float *values = values_of(stripes, z);
	float *means = means_of(stripes, z);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			float sum = 0;

			for (int j = y - 1; j <= y + 1; j++)
				for (int i = x - 1; i <= x + 1; i++)
					sum += values[(ptrdiff_t)held(j, rows) * columns + held(i, columns)];
			means[(ptrdiff_t)y * columns + x] = sum / 9;
		}
}

/* FDK stands out along z, from a body. */
static bool is_cap(const struct stripes *stripes, int z, size_t i)
{
	const float before = fminf(means_of(stripes, z - 1)[i], means_of(stripes, z - 2)[i]);
	const float behind = fminf(means_of(stripes, z + 1)[i], means_of(stripes, z + 2)[i]);
	const float side = fmaxf(before, behind);

	return side > BODY * stripes->hu && means_of(stripes, z)[i] - side > CAP * stripes->hu;
}

/* FDK has a cap within a voxel and a slice. */
static bool near_cap(const struct stripes *stripes, int x, int y, int z)
{
	const int columns = stripes->size[0], rows = stripes->size[1], slices = stripes->size[2];

	for (int k = held(z - NEAR, slices); k <= held(z + NEAR, slices); k++)
		for (int j = held(y - NEAR, rows); j <= held(y + NEAR, rows); j++)
			for (int i = held(x - NEAR, columns); i <= held(x + NEAR, columns); i++) {
				const size_t at = (size_t)k * stripes->pixels + (size_t)((ptrdiff_t)j * columns + i);

				if (stripes->caps[at / CHAR_BIT] >> at % CHAR_BIT & 1)
					return true;
			}
	return false;
}

static float least_of(float before, float here, float behind)
{
	if (!(before * here < 0 && here * behind < 0))
		return 0;
	return fminf(fabsf(here), fminf(fabsf(before), fabsf(behind)));
}

/* Whether the three slices about z are all that alternates there. */
static bool ends_there(const struct stripes *stripes, int z, size_t i, float least)
{
	return fmaxf(fabsf(away_in_means(stripes, z - 2, i)), fabsf(away_in_means(stripes, z + 2, i))) <=
	       GOES_ON * least;
}

/* a of slice z, of FDK or with its caps left out; the grid's first and last slices have none. */
static void take_alternating(const struct stripes *stripes, int z, bool of_fdk)
{
	const int columns = stripes->size[0], rows = stripes->size[1];
	const bool amid = z > 0 && z + 1 < stripes->size[2];
	float *alternating = alternating_of(stripes, z);

#pragma omp parallel for schedule(static)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t i = (size_t)y * (size_t)columns + (size_t)x;
			float least = 0;

			if (amid)
				least = least_of(away_in_means(stripes, z - 1, i), away_in_means(stripes, z, i),
						 away_in_means(stripes, z + 1, i));
			if (least > 0 && !of_fdk && ends_there(stripes, z, i, least) && near_cap(stripes, x, y, z))
				least = 0;
			alternating[i] = least;
		}
}

/* Slice z comes, and a of the third before it. Beyond the last slice none comes any more. */
static int come(const struct stripes *stripes, const struct backend *backend, struct volume *volume, int z, bool of_fdk,
		struct error *err)
{
	const int slices = stripes->size[2];
	int code = 0;

	if (z < slices)
		code = backend->volume_download(volume, z, 1, stripes->values + (size_t)(z % VALUES) * stripes->pixels,
						err);
	if (code == 0 && z < slices)
		take_means(stripes, z);
	if (code == 0 && z >= 3 && z < slices + 3)
		take_alternating(stripes, z - 3, of_fdk);
	return code;
}

/* Slice z of FDK, whose a and neighbours' means are there. */
static void see_slice(const struct stripes *stripes, int z)
{
	for (size_t i = 0; i < stripes->pixels; i++) {
		const size_t at = (size_t)z * stripes->pixels + i;
		const float steps = ceilf(alternating_of(stripes, z)[i] / (STEP * stripes->hu));
		const unsigned char bit = (unsigned char)(1U << at % CHAR_BIT);

		stripes->fdk[at] = (unsigned char)fminf(steps, UCHAR_MAX);
		if (is_cap(stripes, z, i))
			stripes->caps[at / CHAR_BIT] |= bit;
		else
			stripes->caps[at / CHAR_BIT] &= (unsigned char)~bit;
	}
}

int stripes_see_fdk(struct stripes *stripes, const struct backend *backend, struct volume *fdk, struct error *err)
{
	int code = 0;

	for (int come_now = 0; come_now < stripes->size[2] + 3 && code == 0; come_now++) {
		code = come(stripes, backend, fdk, come_now, true, err);
		if (code == 0 && come_now >= 3)
			see_slice(stripes, come_now - 3);
	}
	*seen(stripes) = code == 0;
	return code;
}

/* ---- a volume that is kept ---- */

/* The most of a about a place: a_V. */
static float most_of_volume(const struct stripes *stripes, int x, int y, int z)
{
	const int columns = stripes->size[0], rows = stripes->size[1], slices = stripes->size[2];
	float most = 0;

	for (int k = held(z - NEAR, slices); k <= held(z + NEAR, slices); k++)
		for (int j = held(y - NEAR, rows); j <= held(y + NEAR, rows); j++)
			for (int i = held(x - NEAR, columns); i <= held(x + NEAR, columns); i++)
				most = fmaxf(most, alternating_of(stripes, k)[(ptrdiff_t)j * columns + i]);
	return most;
}

/* a_F. */
static float most_of_fdk(const struct stripes *stripes, int x, int y, int z)
{
	const int columns = stripes->size[0], rows = stripes->size[1], slices = stripes->size[2];
	int most = 0;

	for (int k = held(z - NEAR_FDK, slices); k <= held(z + NEAR_FDK, slices); k++)
		for (int j = held(y - NEAR_FDK, rows); j <= held(y + NEAR_FDK, rows); j++)
			for (int i = held(x - NEAR_FDK, columns); i <= held(x + NEAR_FDK, columns); i++) {
				const int one =
				    stripes->fdk[(size_t)k * stripes->pixels + (size_t)((ptrdiff_t)j * columns + i)];

				most = one > most ? one : most;
			}
	return (float)most * STEP * stripes->hu;
}

/* g. */
static float share_of(const struct stripes *stripes, int x, int y, int z)
{
	const float little = LITTLE * stripes->hu, soft = SOFT * stripes->hu;
	const float all = most_of_volume(stripes, x, y, z);
	float excess;

	if (!(all > little))
		return 0;
	excess = all - OF_FDK * most_of_fdk(stripes, x, y, z) - little;
	return excess > 0 ? excess / all * excess * excess / (excess * excess + soft * soft) : 0;
}

/* V' of slice z in `changed`; whether it is another one. */
static bool mend(const struct stripes *stripes, int z)
{
	const int columns = stripes->size[0], rows = stripes->size[1];
	const float *values = values_of(stripes, z);
	bool any = false;

#pragma omp parallel for schedule(static) reduction(|| : any)
	for (int y = 0; y < rows; y++)
		for (int x = 0; x < columns; x++) {
			const size_t i = (size_t)y * (size_t)columns + (size_t)x;
			const float share = share_of(stripes, x, y, z);

			stripes->changed[i] = share > 0 ? fmaxf(0, values[i] - share * away(stripes, z, i)) : values[i];
			any = any || share > 0;
		}
	return any;
}

static void note(const struct stripes *stripes, int z, struct stripes_report *report)
{
	const float *values = values_of(stripes, z);
	double sum = 0;
	size_t count = 0;

	for (size_t i = 0; i < stripes->pixels; i++)
		if (stripes->changed[i] > BODY * stripes->hu) {
			sum += fabs((double)(stripes->changed[i] - values[i]));
			count++;
		}
	if (count < BODY_LEAST)
		return;
	report->slices += sum > TOLD * (double)stripes->hu * (double)count;
	report->amplitude = fmax(report->amplitude, sum / (double)count);
}

int stripes_show(struct stripes *stripes, const struct backend *backend, struct volume *volume,
		 struct stripes_report *ret_report, struct error *err)
{
	int code = 0;

	*ret_report = (struct stripes_report){0};
	if (*seen(stripes) == 0)
		return 0;
	/* A slice wants a of both its neighbours, four slices on. */
	for (int come_now = 0; come_now < stripes->size[2] + 4 && code == 0; come_now++) {
		const int z = come_now - 4;

		code = come(stripes, backend, volume, come_now, false, err);
		if (code < 0 || z < 0 || !mend(stripes, z))
			continue;
		note(stripes, z, ret_report);
		ret_report->changed = true;
		code = backend->volume_put(volume, z, 1, stripes->changed, err);
	}
	return code;
}
