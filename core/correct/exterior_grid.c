/* The coarse grid of the exterior: see exterior_volume.h. */
#include <math.h>

#include "core/correct/exterior_volume.h"

static int voxels_a_side(const struct exterior_volume_options *options)
{
	const struct geometry *geometry = options->geometry;
	const double pixels = (double)geometry->columns * geometry->rows * geometry->count;
	const double voxels = fmax((double)grid_voxels(options->grid), pixels / 4);
	/* The fit takes several volumes. */
	const double most = cbrt(options->inside_only ? voxels : voxels / 2);

	return (int)fmin(fmax(most, EXTERIOR_VOLUME_LEAST), EXTERIOR_VOLUME_MOST);
}

/* Voxels in all that a model with finer slices may have: as many as a cube, or an eighth of the recipe's grid. */
static size_t voxels_of_fine(const struct exterior_volume_options *options, int most)
{
	return (size_t)fmax(pow(most, 3), (double)grid_voxels(options->grid) / 8);
}

struct box {
	double low[3], high[3];
};

static struct box box_of(const struct grid *grid)
{
	struct box box;

	for (int i = 0; i < 3; i++) {
		box.low[i] = grid->origin[i] - 0.5 * grid->spacing[i];
		box.high[i] = grid->origin[i] + (grid->size[i] - 0.5) * grid->spacing[i];
	}
	return box;
}

static void box_add(struct box *box, const struct box *other)
{
	for (int i = 0; i < 3; i++) {
		box->low[i] = fmin(box->low[i], other->low[i]);
		box->high[i] = fmax(box->high[i], other->high[i]);
	}
}

/* The two places where a ray meets a cylinder around the orbit's axis. */
static void box_add_ray(struct box *box, const struct orbit *orbit, double radius, const double from[3],
			const double way[3])
{
	double a = 0, b = 0, c = -radius * radius, start[3];

	orbit_from_centre(orbit, from, start);
	for (int i = 0; i < 2; i++) {
		const double along = vec_dot(orbit->frame[i], way);

		a += along * along;
		b += start[i] * along;
		c += start[i] * start[i];
	}
	for (int side = -1; side <= 1 && a > 0 && b * b > a * c; side += 2) {
		const double part = (-b + side * sqrt(b * b - a * c)) / a;
		struct box place;

		for (int i = 0; i < 3; i++)
			place.low[i] = place.high[i] = from[i] + part * way[i];
		box_add(box, &place);
	}
}

/* Around what the rays to the first and the last row meet of that cylinder. */
static void box_add_rays(struct box *box, const struct orbit *orbit, double radius, const struct geometry *geometry)
{
	enum { ALONG = 9 };

	for (int k = 0; k < geometry->count; k++)
		for (int i = 0; i < 2 * ALONG; i++) {
			const struct view *view = &geometry->views[k];
			const double column = (geometry->columns - 1.) * (i / 2) / (ALONG - 1);
			const double row = i % 2 ? geometry->rows - 0.5 : -0.5;
			double way[3];

			for (int a = 0; a < 3; a++)
				way[a] = view->pixel0[a] + column * view->column_step[a] + row * view->row_step[a] -
					 view->source[a];
			box_add_ray(box, orbit, radius, view->source, way);
		}
}

/* No side has more voxels than `most`. */
static void grid_of_box(const struct box *box, double spacing, int most, struct grid *ret)
{
	for (int i = 0; i < 3; i++)
		spacing = fmax(spacing, (box->high[i] - box->low[i]) / most);
	for (int i = 0; i < 3; i++) {
		const double side = box->high[i] - box->low[i];

		/* A part of a millionth is rounding, not another voxel. */
		ret->size[i] = (int)fmax(1, ceil(side / spacing - 1e-6));
		ret->spacing[i] = side / ret->size[i];
		ret->origin[i] = box->low[i] + 0.5 * ret->spacing[i];
	}
}

static void box_widen(struct box *box, double by)
{
	for (int i = 0; i < 2; i++) {
		box->low[i] -= by;
		box->high[i] += by;
	}
}

/* Slices become as high as a part of a row, as far as `most` voxels go. */
static void divide_slices(const struct exterior_volume_options *options, size_t most, struct grid *grid)
{
	const double side = grid->size[2] * grid->spacing[2], low = grid->origin[2] - 0.5 * grid->spacing[2];
	const double wanted = ceil(EXTERIOR_SLICES_OF_A_ROW * side / options->orbit->pixel_at_isocentre[1] - 1e-6);
	const size_t room = most / ((size_t)grid->size[0] * (size_t)grid->size[1]);
	const int slices = (int)fmin(wanted, (double)room);

	/* Where the axis leans or there is one row, no slice is that row's. */
	if (!options->fine_slices || options->orbit->lean != 0 || options->geometry->rows == 1 ||
	    slices <= grid->size[2])
		return;
	grid->size[2] = slices;
	grid->spacing[2] = side / slices;
	grid->origin[2] = low + 0.5 * grid->spacing[2];
}

void exterior_volume_grid(const struct exterior_volume_options *options, struct grid *ret)
{
	const int most = voxels_a_side(options);
	struct grid wide;
	struct error err;

	orbit_covering_grid(options->orbit, options->geometry, most, &wide);
	for (int reach = options->inside_only ? 0 : options->truncated ? 3 : 2; reach >= 0; reach--) {
		const double radius = options->orbit->field_of_view / 2,
			     margin = reach > 2 ? EXTERIOR_MARGIN * radius : 0;
		struct box view = box_of(&wide), box = box_of(options->grid);

		box_widen(&view, margin);
		if (reach > 0)
			box_add(&box, &view);
		if (reach > 1)
			box_add_rays(&box, options->orbit, radius + margin, options->geometry);
		grid_of_box(&box, wide.spacing[0], most, ret);
		divide_slices(options, voxels_of_fine(options, most), ret);
		if (grid_check_geometry(ret, options->geometry, &err) == 0)
			return;
	}
}
