/*
 * Projections of a voxel object for `make paper`. This program shares nothing with
 * the project: no header, no library, no geometry code.
 *
 * The object is the trilinear interpolation of its voxels, with a layer of zeros
 * around them. Along a ray that interpolation is a cubic in each cell between eight
 * voxel centres, and two Gauss points integrate a cubic exactly: the sum over the
 * cells that a ray crosses is its line integral, without a step length to choose.
 *
 *   paper-project VOLUME NX NY NZ SX SY SZ VIEWS COLUMNS ROWS OUT
 *
 * VOLUME: float32 [z][y][x] in 1/mm, centred on the origin, spacing SX SY SZ in mm.
 * VIEWS: float64 [view][4][3] in mm: source, centre of pixel 0,0, step from column to
 * column, step from row to row. OUT: float32 [view][row][column]. Host's byte order.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

struct object {
	long nx, ny, nz; /* with the layer of zeros */
	double spacing[3];
	float *voxels;
};

static void *read_file(const char *path, size_t size, size_t *ret_count)
{
	FILE *file = fopen(path, "rb");
	long bytes = -1;
	char *content = NULL;

	if (file && fseek(file, 0, SEEK_END) == 0 && (bytes = ftell(file)) > 0 && (content = malloc((size_t)bytes))) {
		rewind(file);
		*ret_count = fread(content, size, (size_t)bytes / size, file);
	}
	if (file)
		fclose(file);
	if (!content) {
		fprintf(stderr, "paper-project: cannot read %s\n", path);
		exit(1);
	}
	return content;
}

static struct object object_read(const char *path, char *const sides[6])
{
	struct object object = {.nx = atol(sides[0]) + 2, .ny = atol(sides[1]) + 2, .nz = atol(sides[2]) + 2};
	size_t count = 0;
	float *voxels = read_file(path, sizeof(float), &count), *from = voxels;

	for (int i = 0; i < 3; i++)
		object.spacing[i] = atof(sides[3 + i]);
	object.voxels = calloc((size_t)(object.nx * object.ny * object.nz), sizeof(float));
	if (!object.voxels || count != (size_t)((object.nx - 2) * (object.ny - 2) * (object.nz - 2))) {
		fprintf(stderr, "paper-project: %zu voxels in %s\n", count, path);
		exit(1);
	}
	for (long z = 1; z < object.nz - 1; z++)
		for (long y = 1; y < object.ny - 1; y++)
			for (long x = 1; x < object.nx - 1; x++)
				object.voxels[(z * object.ny + y) * object.nx + x] = *from++;
	free(voxels);
	return object;
}

/* At a point in voxels, of the cell whose lowest corner is voxel x y z. */
static double interpolate(const struct object *object, long x, long y, long z, const double at[3])
{
	const float *v = object->voxels + (z * object->ny + y) * object->nx + x;
	const long row = object->nx, slice = object->nx * object->ny;
	const double a = at[0] - (double)x, b = at[1] - (double)y, c = at[2] - (double)z;
	const double near_low = v[0] + a * (v[1] - v[0]), near_high = v[row] + a * (v[row + 1] - v[row]);
	const double far_low = v[slice] + a * (v[slice + 1] - v[slice]);
	const double far_high = v[slice + row] + a * (v[slice + row + 1] - v[slice + row]);
	const double near = near_low + b * (near_high - near_low), far = far_low + b * (far_high - far_low);

	return near + c * (far - near);
}

/* From one point in mm to another, of which t in 0..1 is the way. */
static double line_integral(const struct object *object, const double from[3], const double to[3])
{
	const long sizes[3] = {object->nx, object->ny, object->nz};
	const double gauss = .5 / sqrt(3);
	double origin[3], step[3], next[3], t = 0, end = 1, sum = 0, length = 0;

	for (int i = 0; i < 3; i++) {
		const double last = (double)(sizes[i] - 1);

		origin[i] = from[i] / object->spacing[i] + last / 2;
		step[i] = (to[i] - from[i]) / object->spacing[i];
		length += (to[i] - from[i]) * (to[i] - from[i]);
		if (fabs(step[i]) < 1e-12) {
			if (origin[i] <= 0 || origin[i] >= last)
				return 0;
			continue;
		}
		t = fmax(t, fmin(-origin[i] / step[i], (last - origin[i]) / step[i]));
		end = fmin(end, fmax(-origin[i] / step[i], (last - origin[i]) / step[i]));
	}
	/* next: where the ray meets the next plane of voxel centres along each axis. */
	for (int i = 0; i < 3; i++) {
		const double at = origin[i] + t * step[i];
		const double plane = step[i] > 0 ? floor(at + 1e-9) + 1 : ceil(at - 1e-9) - 1;

		next[i] = fabs(step[i]) < 1e-12 ? INFINITY : (plane - origin[i]) / step[i];
	}
	while (t < end) {
		const double until = fmin(end, fmin(next[0], fmin(next[1], next[2])));
		const double middle = (t + until) / 2, part = until - t;
		long cell[3];

		for (int i = 0; i < 3; i++) {
			cell[i] = lrint(floor(origin[i] + middle * step[i]));
			cell[i] = cell[i] < 0 ? 0 : cell[i] > sizes[i] - 2 ? sizes[i] - 2 : cell[i];
			if (next[i] <= until)
				next[i] += 1 / fabs(step[i]);
		}
		for (int side = -1; side <= 1; side += 2) {
			const double g = middle + side * gauss * part;
			const double at[3] = {origin[0] + g * step[0], origin[1] + g * step[1],
					      origin[2] + g * step[2]};

			sum += part / 2 * interpolate(object, cell[0], cell[1], cell[2], at);
		}
		t = until;
	}
	return sum * sqrt(length);
}

int main(int argc, char **argv)
{
	struct object object;
	size_t numbers = 0;
	double *views;
	float *out;
	long columns, rows, count;
	FILE *file;

	if (argc != 12) {
		fprintf(stderr, "usage: paper-project VOLUME NX NY NZ SX SY SZ VIEWS COLUMNS ROWS OUT\n");
		return 2;
	}
	object = object_read(argv[1], argv + 2);
	views = read_file(argv[8], sizeof(double), &numbers);
	columns = atol(argv[9]), rows = atol(argv[10]), count = (long)numbers / 12;
	out = malloc(sizeof(float) * (size_t)(columns * rows * count));
	if (!out)
		return 1;
#pragma omp parallel for schedule(dynamic)
	for (long line = 0; line < count * rows; line++) {
		const double *source = views + 12 * (line / rows), *pixel0 = source + 3, *u = source + 6,
			     *v = source + 9;

		for (long column = 0; column < columns; column++) {
			double pixel[3];

			for (int i = 0; i < 3; i++)
				pixel[i] = pixel0[i] + (double)column * u[i] + (double)(line % rows) * v[i];
			out[line * columns + column] = (float)line_integral(&object, source, pixel);
		}
	}
	file = fopen(argv[11], "wb");
	if (!file ||
	    fwrite(out, sizeof(float), (size_t)(columns * rows * count), file) != (size_t)(columns * rows * count) ||
	    fclose(file) != 0) {
		perror(argv[11]);
		return 1;
	}
	free(out);
	free(views);
	free(object.voxels);
	return 0;
}
