/*
 * RabbitCT (Rohkohl and others, Medical Physics 36, 2009): backprojection alone, of filtered C-arm views into a cube of
 * 256 mm, by the rules of its file format, in GUPS: voxels times views / 1e9 / s. The real data set is for who has it;
 * `make` writes one of the same form: a head of ellipsoids, exact line integrals through the matrices of an arm that
 * leans, weighted and filtered by this project's ramp (what is timed and compared begins behind the filter).
 *
 *   rabbitct make FILE [VIEWS]
 *   rabbitct run FILE SIZE [cpu|cpu:base|cpu:avx2|cpu:avx512|cuda] [THREADS] [REPEATS] [REFERENCE]
 *
 * SIZE: voxels a side, 128, 256, 512 or 1024. THREADS 0: all. REFERENCE: the data set's volume of that size, uint16
 * [z][y][x]; without it the result is held against the definition in double precision at some 200,000 voxels.
 *
 * The file: uint32 columns, rows, views; float scale and offset to HU; for each view double[12], its 3 x 4 matrix by
 * columns, scaled so that w is 1 at the isocentre, and float[rows][columns]. A voxel at (x, y, z) mm takes from each
 * view the bilinear sample, 0 outside of the image, over w squared. HU are scale v + offset, rounded; 0 for v <= 0, at
 * most 4095.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "core/scan/phantom.h"
#include "tests/bench/gpu_scene.h"

enum { COLUMNS = 1248, ROWS = 960, VIEWS = 496, HU_MOST = 4095, CUBE = 256 /* mm */ };

struct header {
	unsigned int columns, rows, views;
	float scale, offset;
};

static struct error err;

static void *room(size_t count, size_t size)
{
	void *ret = calloc(count, size);

	if (ret == NULL) {
		fprintf(stderr, "rabbitct: no memory for %zu bytes\n", count * size);
		exit(EXIT_FAILURE);
	}
	return ret;
}

static FILE *file_open(const char *path, const char *mode)
{
	FILE *ret = fopen(path, mode);

	if (ret == NULL) {
		perror(path);
		exit(EXIT_FAILURE);
	}
	return ret;
}

static void file_read(FILE *file, const char *path, void *ret, size_t size, size_t count)
{
	if (fread(ret, size, count, file) == count)
		return;
	fprintf(stderr, "%s: ends too early\n", path);
	exit(EXIT_FAILURE);
}

static void file_write(FILE *file, const char *path, const void *from, size_t size, size_t count)
{
	if (fwrite(from, size, count, file) == count)
		return;
	perror(path);
	exit(EXIT_FAILURE);
}

/* ---- a data set ---- */

/* Half a turn and the fan, each view leaning a little in its own way, as an arm's do. */
static void arm_make(int views, struct geometry *ret)
{
	const struct circular circular = {
	    .source_to_isocentre = 785, .source_to_detector = 1200, .pixel = {.308, .308}};
	double *angles = room((size_t)views, sizeof(*angles));

	for (int k = 0; k < views; k++)
		angles[k] = 200 * M_PI / 180 * k / views;
	must(geometry_circular(ret, COLUMNS, ROWS, views, &circular, angles, &err), &err, "geometry");
	for (int k = 0; k < views; k++) {
		struct view *view = &ret->views[k];
		const double angle = (.8 + .6 * sin(.05 * k)) * M_PI / 180, c = cos(angle), s = sin(angle);

		for (int i = 0; i < 3; i++) {
			const double u = view->column_step[i], v = view->row_step[i];
			const double centre = view->pixel0[i] + .5 * (COLUMNS - 1) * u + .5 * (ROWS - 1) * v;

			view->column_step[i] = c * u + s * v;
			view->row_step[i] = c * v - s * u;
			view->row_step[i] += i == 0 ? .01 * view->row_step[2] * sin(.03 * k) : 0;
			view->pixel0[i] = centre + 4 * sin(.04 * k + i) - .5 * (COLUMNS - 1) * view->column_step[i] -
					  .5 * (ROWS - 1) * view->row_step[i];
			view->source[i] += 3 * cos(.03 * k + i);
		}
	}
	free(angles);
}

static void data_make(const char *path, int views)
{
	const struct header header = {COLUMNS, ROWS, (unsigned int)views, 1000 / .02f, 0};
	const size_t pixels = (size_t)COLUMNS * ROWS;
	const struct device_options device_options = {0};
	struct grid grid = {.size = {16, 16, 16}, .spacing = {16, 16, 16}}; /* nothing is reconstructed here */
	struct geometry geometry;
	struct orbit orbit;
	struct fdk_weights weights;
	struct phantom head;
	struct device *device;
	struct plan *plan;
	struct stack *raw, *filtered;
	float *view = room(pixels, sizeof(float));
	FILE *file = file_open(path, "wbe");

	arm_make(views, &geometry);
	must(orbit_analyse(&orbit, &geometry, &err), &err, "orbit");
	must(fdk_weights_make(&weights, &orbit, &geometry, WINDOW_RAM_LAK, 1, false, &err), &err, "weights");
	must(phantom_named(&head, "shepp-logan", 90, .02, &err), &err, "phantom");
	grid_centre(&grid);
	const struct plan_options options = {
	    .geometry = &geometry,
	    .grid = &grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .column_weights = weights.columns,
	    .filter_response = weights.response,
	};
	must(backend_cpu.open(0, &device_options, &device, &err), &err, "cpu");
	must(backend_cpu.plan_new(device, &options, &plan, &err), &err, "plan");
	must(backend_cpu.stack_new(device, COLUMNS, ROWS, 1, &raw, &err), &err, "stack");
	must(backend_cpu.stack_new(device, COLUMNS, ROWS, 1, &filtered, &err), &err, "stack");
	file_write(file, path, &header, sizeof(header), 1);
	for (int k = 0; k < views; k++) {
		const int slot = 0;
		double m[12], columns[12];

		phantom_project(&head, &geometry, k, view);
		must(backend_cpu.stack_upload(raw, 0, 1, view, &err), &err, "upload");
		must(backend_cpu.filter(plan, raw, &slot, &k, 1, filtered, &err), &err, "filter");
		must(backend_cpu.stack_download(filtered, 0, 1, view, &err), &err, "download");
		view_matrix(&geometry.views[k], m);
		for (int i = 0; i < 12; i++)
			columns[i] = m[4 * (i % 3) + i / 3] / m[11];
		file_write(file, path, columns, sizeof(columns), 1);
		file_write(file, path, view, sizeof(float), pixels);
	}
	if (fclose(file) != 0) {
		perror(path);
		exit(EXIT_FAILURE);
	}
	backend_cpu.stack_free(filtered);
	backend_cpu.stack_free(raw);
	backend_cpu.plan_free(plan);
	backend_cpu.close(device);
	fdk_weights_clear(&weights);
	orbit_clear(&orbit);
	geometry_clear(&geometry);
	phantom_clear(&head);
	free(view);
}

struct data {
	struct header header;
	struct geometry geometry;
	double *columns; /* [view][12], as in the file */
	float *images;   /* [view][row][column] */
};

static void data_read(const char *path, struct data *ret)
{
	FILE *file = file_open(path, "rbe");
	struct header *header = &ret->header;
	double *rows, pixel[2] = {1, 1}; /* the voxel's place on the detector alone counts, not how large a pixel is */
	size_t pixels;

	file_read(file, path, header, sizeof(*header), 1);
	if (header->columns < 2 || header->rows < 2 || header->views < 2 || header->columns > 8192 ||
	    header->rows > 8192 || header->views > 8192) {
		fprintf(stderr, "%s: %u views of %u x %u pixels?\n", path, header->views, header->columns,
			header->rows);
		exit(EXIT_FAILURE);
	}
	pixels = (size_t)header->columns * header->rows;
	ret->columns = room(12 * (size_t)header->views, sizeof(double));
	ret->images = room(pixels * header->views, sizeof(float));
	rows = room(12 * (size_t)header->views, sizeof(double));
	for (size_t k = 0; k < header->views; k++) {
		double *m = ret->columns + 12 * k;

		file_read(file, path, m, sizeof(double), 12);
		file_read(file, path, ret->images + pixels * k, sizeof(float), pixels);
		/* Any scale is a data set's own to choose; here w is 1 at the isocentre, where the backends' weight is.
		 */
		for (size_t i = 0; i < pixels && m[11] != 1; i++)
			ret->images[pixels * k + i] /= (float)(m[11] * m[11]);
		for (int i = 0; i < 12; i++) {
			m[i] /= i < 11 ? m[11] : 1;
			rows[12 * k + (size_t)(4 * (i % 3) + i / 3)] = i < 11 ? m[i] : 1;
		}
		m[11] = 1;
	}
	fclose(file);
	must(geometry_matrices(&ret->geometry, (int)header->columns, (int)header->rows, (int)header->views, rows, pixel,
			       &err),
	     &err, path);
	free(rows);
}

/* ---- the definition ---- */

static double pixel_at(const struct data *data, const float *image, double column, double row)
{
	if (!(column >= 0 && column < data->header.columns && row >= 0 && row < data->header.rows))
		return 0;
	return image[(size_t)row * data->header.columns + (size_t)column];
}

static double voxel_exact(const struct data *data, const double at[3])
{
	const size_t pixels = (size_t)data->header.columns * data->header.rows;
	double sum = 0;

	for (size_t k = 0; k < data->header.views; k++) {
		const double *m = data->columns + 12 * k;
		const float *image = data->images + pixels * k;
		const double w = m[2] * at[0] + m[5] * at[1] + m[8] * at[2] + m[11];
		const double u = (m[0] * at[0] + m[3] * at[1] + m[6] * at[2] + m[9]) / w;
		const double v = (m[1] * at[0] + m[4] * at[1] + m[7] * at[2] + m[10]) / w;
		const double u0 = floor(u), v0 = floor(v), a = u - u0, b = v - v0;

		sum +=
		    ((1 - a) * (1 - b) * pixel_at(data, image, u0, v0) +
		     a * (1 - b) * pixel_at(data, image, u0 + 1, v0) + (1 - a) * b * pixel_at(data, image, u0, v0 + 1) +
		     a * b * pixel_at(data, image, u0 + 1, v0 + 1)) /
		    (w * w);
	}
	return sum;
}

static double hu_of(const struct header *header, double value)
{
	return value > 0 ? fmin(floor(header->scale * value + header->offset + .5), HU_MOST) : 0;
}

/* Errors in HU at every `stride`th voxel along each axis, of the data set's reference or of the definition. */
static void errors_show(const struct data *data, const float *volume, int size, const char *reference)
{
	const int stride = reference != NULL || size < 64 ? 1 : size / 64 + (size / 64 + 1) % 2; /* odd: all phases */
	const int count = (size + stride - 1) / stride;
	const size_t voxels = (size_t)size * (size_t)size * (size_t)size;
	const double spacing = (double)CUBE / size, first = -.5 * spacing * (size - 1);
	unsigned short *truth = NULL;
	double squares = 0, most = 0;
	size_t beyond = 0;

	if (reference != NULL) {
		FILE *file = file_open(reference, "rbe");

		truth = room(voxels, sizeof(*truth));
		file_read(file, reference, truth, sizeof(*truth), voxels);
		fclose(file);
	}
#pragma omp parallel for reduction(+ : squares, beyond) reduction(max : most) schedule(dynamic)
	for (int z = 0; z < count; z++) {
		for (int i = 0; i < count * count; i++) {
			const int at[3] = {i % count * stride, i / count * stride, z * stride};
			const size_t index =
			    ((size_t)at[2] * (size_t)size + (size_t)at[1]) * (size_t)size + (size_t)at[0];
			const double place[3] = {first + spacing * at[0], first + spacing * at[1],
						 first + spacing * at[2]};
			const double wanted =
			    truth != NULL ? truth[index] : hu_of(&data->header, voxel_exact(data, place));
			const double off = fabs(hu_of(&data->header, volume[index]) - wanted);

			squares += off * off;
			most = fmax(most, off);
			beyond += off > 1;
		}
	}
	printf("errors beside %s: %.4f HU RMS, %g at most, %zu of %d voxels more than 1\n",
	       reference != NULL ? "the reference" : "the definition in double",
	       sqrt(squares / ((double)count * count * count)), most, beyond, count * count * count);
	free(truth);
}

/* ---- the run ---- */

/* Of all threads: what others on the same cores disturb less. */
static double processor_seconds(void)
{
	struct timespec time;

	clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
	return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static int ascending(const void *a, const void *b)
{
	const double *x = a, *y = b;

	return (*x > *y) - (*x < *y);
}

static void run(const char *path, int size, const char *name, int threads, int repeats, const char *reference)
{
	const bool isa = strncmp(name, "cpu:", 4) == 0;
	const struct backend *backend = backend_find(isa ? "cpu" : name);
	const struct device_options device_options = {.threads = threads, .isa = isa ? name + 4 : NULL};
	struct grid grid = {.size = {size, size, size},
			    .spacing = {(double)CUBE / size, (double)CUBE / size, (double)CUBE / size}};
	const int threads_used = threads > 0 ? threads : (int)sysconf(_SC_NPROCESSORS_ONLN);
	const char *const rows[] = {"backprojection", "with copies", "processor time of each thread"};
	struct data data;
	struct orbit orbit;
	struct fdk_weights weights;
	struct device *device;
	struct plan *plan;
	struct volume *sum;
	struct stack *stack;
	struct device_info info;
	double taken[3][16] = {{0}};
	float *volume;
	int views, batch, *numbers;

	if (backend == NULL || backend->count() == 0) {
		fprintf(stderr, "rabbitct: no device of \"%s\"\n", name);
		exit(EXIT_FAILURE);
	}
	data_read(path, &data);
	views = (int)data.header.views;
	numbers = room((size_t)views, sizeof(*numbers));
	grid_centre(&grid);
	must(orbit_analyse(&orbit, &data.geometry, &err), &err, "orbit");
	must(fdk_weights_make(&weights, &orbit, &data.geometry, WINDOW_RAM_LAK, 1, false, &err), &err, "weights");
	const struct plan_options options = {
	    .geometry = &data.geometry,
	    .grid = &grid,
	    .linearise = {.sample = SAMPLE_FLOAT32},
	    .column_weights = weights.columns,
	    .filter_response = weights.response,
	};
	must(backend->open(0, &device_options, &device, &err), &err, name);
	must(backend->plan_new(device, &options, &plan, &err), &err, "plan");
	must(backend->volume_new(device, &grid, &sum, &err), &err, "volume");
	batch = backend->plan_batch(plan);
	must(backend->stack_new(device, (int)data.header.columns, (int)data.header.rows, views, &stack, &err), &err,
	     "stack");
	volume = room((size_t)size * (size_t)size * (size_t)size, sizeof(float));
	for (int k = 0; k < views; k++)
		numbers[k] = k;
	for (int r = -1; r < repeats; r++) { /* the first to warm up */
		double begin = seconds(), kernels = 0, processor = 0;

		must(backend->volume_fill(sum, 0, &err), &err, "fill");
		for (int first = 0; first < views; first += batch) {
			const int count = views - first < batch ? views - first : batch;
			const size_t pixels = (size_t)data.header.columns * data.header.rows;
			double before, before_processor;

			must(backend->stack_upload(stack, 0, count, data.images + pixels * (size_t)first, &err), &err,
			     "upload");
			must(backend->sync(device, &err), &err, "sync");
			before = seconds();
			before_processor = processor_seconds();
			must(backend->backproject(plan, stack, numbers + first, count, BACKPROJECT_FDK, sum, &err),
			     &err, "backproject");
			must(backend->sync(device, &err), &err, "sync");
			kernels += seconds() - before;
			processor += processor_seconds() - before_processor;
		}
		must(backend->volume_download(sum, 0, size, volume, &err), &err, "download");
		if (r >= 0) {
			taken[0][r] = kernels;
			taken[2][r] = processor / threads_used;
			taken[1][r] = seconds() - begin;
		}
	}
	backend->describe(device, &info);
	printf("RabbitCT %d: %d views of %u x %u, %s, plan: %s\n", size, views, data.header.columns, data.header.rows,
	       info.name, backend->plan_summary(plan));
	for (int i = 0; i < (strcmp(backend->name, "cpu") == 0 ? 3 : 2); i++) {
		const double updates = (double)size * size * size * views * 1e-9;

		qsort(taken[i], (size_t)repeats, sizeof(double), ascending);
		printf("%s: %.4f s, %.2f GUPS (median of %d, %.4f to %.4f s)\n", rows[i], taken[i][repeats / 2],
		       updates / taken[i][repeats / 2], repeats, taken[i][0], taken[i][repeats - 1]);
	}
	errors_show(&data, volume, size, reference);
	backend->stack_free(stack);
	backend->volume_free(sum);
	backend->plan_free(plan);
	backend->close(device);
	fdk_weights_clear(&weights);
	orbit_clear(&orbit);
	geometry_clear(&data.geometry);
	free(data.columns);
	free(data.images);
	free(numbers);
	free(volume);
}

static int number(const char *text, int least, int most)
{
	char *end;
	const long ret = strtol(text, &end, 10);

	if (*end != '\0' || end == text || ret < least || ret > most) {
		fprintf(stderr, "rabbitct: %s: a number from %d to %d is wanted\n", text, least, most);
		exit(EXIT_FAILURE);
	}
	return (int)ret;
}

int main(int argc, char **argv)
{
	if (argc >= 3 && argc <= 4 && strcmp(argv[1], "make") == 0) {
		data_make(argv[2], argc > 3 ? number(argv[3], 2, VIEWS) : VIEWS);
	} else if (argc >= 4 && argc <= 8 && strcmp(argv[1], "run") == 0) {
		run(argv[2], number(argv[3], 32, 1024), argc > 4 ? argv[4] : "auto",
		    argc > 5 ? number(argv[5], 0, 1024) : 0, argc > 6 ? number(argv[6], 1, 16) : 3,
		    argc > 7 ? argv[7] : NULL);
	} else {
		fprintf(stderr, "usage: rabbitct make FILE [VIEWS]\n"
				"       rabbitct run FILE SIZE [cpu|cpu:base|cpu:avx2|cpu:avx512|cuda] [THREADS] "
				"[REPEATS] [REFERENCE]\n");
		return EXIT_FAILURE;
	}
	return EXIT_SUCCESS;
}
