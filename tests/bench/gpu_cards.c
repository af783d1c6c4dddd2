/*
 * Several cards in one job beside one of them (core/cards/cards.h): results first, on small scenes of every kind, then
 * times of cases D and E as in gpu_bench.c. Prints one line each; ends with 1 if a result is off.
 *
 *   gpu_cards [--brief | --shares] [--apart] [CARDS ...]   default: 2 and 4, as far as they are there; --brief, for
 *                                       compute-sanitizer: results of three bends, and no times; --shares: times of
 *                                       cases A and B, too, and what one card takes with its share of the views and the
 *                                       whole volume, as it would if views were divided; --apart: the cards pass
 *                                       everything through the host
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/cards/cards.h"
#include "tests/bench/gpu_scene.h"

extern const struct backend backend_cuda;

#define DEGREE (M_PI / 180)

/* One job's worth of a scene on some cards. */
struct bench {
	const struct backend *backend;
	struct device *device;
	const struct scene *scene;
	struct sart_options sart;
	struct plan *plan;
	struct volume *volume, *start;
	struct stack *projections, *filtered;
	int *views;
};

static int failures;
static bool apart;

static void open_cards(struct bench *bench, int cards)
{
	const int indices[CARDS_MOST] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
	const struct device_options options = {.apart = apart};
	struct error err = {0};

	if (cards == 1) {
		bench->backend = &backend_cuda;
		must(backend_cuda.open(0, &options, &bench->device, &err), &err, "device");
	} else {
		bench->backend = &backend_cards;
		must(cards_open(&backend_cuda, indices, cards, &options, &bench->device, &err), &err, "cards");
	}
}

static void end_plan(struct bench *bench)
{
	bench->backend->plan_free(bench->plan);
	subsets_clear(&bench->sart.subsets);
	bench->plan = NULL;
}

static void begin_plan(struct bench *bench, int subsets, bool matched, const struct tv_options *tv)
{
	struct plan_options options;
	struct error err = {0};

	bench->sart = (struct sart_options){.relaxation = 1, .nonnegative = true};
	options = scene_plan(bench->scene, subsets > 0 ? &bench->sart : NULL, subsets, tv, false);
	options.matched = matched;
	must(bench->backend->plan_new(bench->device, &options, &bench->plan, &err), &err, "plan");
}

/* The scene's stacks and volumes on the cards, the start of random numbers and its projections. */
static void begin(struct bench *bench, const struct scene *scene, int cards)
{
	const struct geometry *geometry = &scene->geometry;
	const size_t voxels = grid_voxels(&scene->grid);
	float *values = malloc(voxels * sizeof(float));
	struct error err = {0};

	memset(bench, 0, sizeof(*bench));
	bench->scene = scene;
	open_cards(bench, cards);
	bench->views = malloc(sizeof(int) * (size_t)geometry->count);
	for (int i = 0; i < geometry->count; i++)
		bench->views[i] = i;
	must(bench->backend->volume_new(bench->device, &scene->grid, &bench->volume, &err), &err, "volume");
	must(bench->backend->volume_new(bench->device, &scene->grid, &bench->start, &err), &err, "volume");
	must(bench->backend->stack_new(bench->device, geometry->columns, geometry->rows, geometry->count,
				       &bench->projections, &err),
	     &err, "stack");
	fill_random(values, voxels, 3);
	must(bench->backend->volume_upload(bench->start, values, &err), &err, "upload");
	free(values);
	begin_plan(bench, 0, false, NULL);
	must(bench->backend->stack_new(bench->device, geometry->columns, geometry->rows,
				       bench->backend->plan_batch(bench->plan), &bench->filtered, &err),
	     &err, "stack");
	must(
	    bench->backend->project(bench->plan, bench->start, bench->views, geometry->count, bench->projections, &err),
	    &err, "project");
	must(bench->backend->sync(bench->device, &err), &err, "sync");
}

static void end(struct bench *bench)
{
	if (bench->plan != NULL)
		end_plan(bench);
	bench->backend->stack_free(bench->filtered);
	bench->backend->stack_free(bench->projections);
	bench->backend->volume_free(bench->start);
	bench->backend->volume_free(bench->volume);
	bench->backend->close(bench->device);
	free(bench->views);
}

static void run_fdk(struct bench *bench)
{
	const struct backend *backend = bench->backend;
	int batch = backend->plan_batch(bench->plan), all = bench->scene->geometry.count;
	struct error err = {0};

	must(backend->volume_fill(bench->volume, 0, &err), &err, "fill");
	for (int done = 0; done < all; done += batch) {
		int count = all - done < batch ? all - done : batch;

		must(backend->filter(bench->plan, bench->projections, NULL, bench->views + done, count, bench->filtered,
				     &err),
		     &err, "filter");
		must(backend->backproject(bench->plan, bench->filtered, bench->views + done, count, BACKPROJECT_FDK,
					  bench->volume, &err),
		     &err, "backproject");
	}
}

static void run_sart(struct bench *bench)
{
	struct iteration_sums sums;
	struct error err = {0};

	must(bench->backend->sart_iterate(bench->plan, bench->projections, bench->volume, NULL, &sums, &err), &err,
	     "sart");
}

static void run_project(struct bench *bench)
{
	struct error err = {0};

	must(bench->backend->project(bench->plan, bench->start, bench->views, bench->scene->geometry.count,
				     bench->projections, &err),
	     &err, "project");
}

static void run_backproject(struct bench *bench)
{
	struct error err = {0};

	must(bench->backend->volume_fill(bench->volume, 0, &err), &err, "fill");
	must(bench->backend->backproject(bench->plan, bench->projections, bench->views, bench->scene->geometry.count,
					 BACKPROJECT_PLAIN, bench->volume, &err),
	     &err, "backproject");
}

static const struct tv_options tv_options = {
    .method = TV_PROXIMAL, .alpha = .1, .step = .1, .iterations = 100, .unit = 1};

static const struct tv_options gradient_options = {
    .method = TV_GRADIENT, .alpha = .1, .step = .1, .iterations = 20, .unit = 1};

static void smooth(struct bench *bench, const struct tv_options *options)
{
	struct error err = {0};

	must(bench->backend->volume_copy(bench->volume, bench->start, &err), &err, "copy");
	must(bench->backend->tv(bench->plan, bench->volume, options, NULL, &err), &err, "tv");
}

static void run_tv(struct bench *bench)
{
	smooth(bench, &tv_options);
}

static void run_gradient(struct bench *bench)
{
	smooth(bench, &gradient_options);
}

static const struct {
	const char *what;
	int subsets;
	bool matched, small_only;
	const struct tv_options *tv;
	void (*run)(struct bench *bench);
} rows[] = {
    {"forward projection", 0, false, false, NULL, run_project},
    {"plain backprojection", 0, false, false, NULL, run_backproject},
    {"FDK", 0, false, false, NULL, run_fdk},
    {"SIRT iteration", 1, false, false, NULL, run_sart},
    {"OS-SART iteration, 10", 10, false, false, NULL, run_sart},
    {"matched SIRT iteration", 1, true, true, NULL, run_sart},
    {"proximal TV, 100 steps", 0, false, true, &tv_options, run_tv},
    {"explicit TV, 20 steps", 0, false, true, &gradient_options, run_gradient},
};
enum { ROWS = sizeof(rows) / sizeof(rows[0]) };

static void begin_row(struct bench *bench, int row)
{
	struct error err = {0};

	end_plan(bench);
	must(bench->backend->volume_fill(bench->volume, 0, &err), &err, "fill");
	begin_plan(bench, rows[row].subsets, rows[row].matched, rows[row].tv);
}

/* ---- results ---- */

/* The row's volume, or projections, on so many cards; owned by the caller. */
static float *result_of(const struct scene *scene, int row, int cards, size_t *ret_count)
{
	const struct geometry *geometry = &scene->geometry;
	const bool stack = rows[row].run == run_project;
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows * (size_t)geometry->count;
	struct bench bench;
	struct error err = {0};
	float *values;

	*ret_count = stack ? pixels : grid_voxels(&scene->grid);
	values = malloc(*ret_count * sizeof(float));
	begin(&bench, scene, cards);
	begin_row(&bench, row);
	rows[row].run(&bench);
	if (rows[row].run == run_sart)
		run_sart(&bench);
	if (stack)
		must(bench.backend->stack_download(bench.projections, 0, geometry->count, values, &err), &err,
		     "download");
	else
		must(bench.backend->volume_download(bench.volume, 0, scene->grid.size[2], values, &err), &err,
		     "download");
	end(&bench);
	return values;
}

static double difference(const float *a, const float *b, size_t count)
{
	double sum = 0, norm = 0;

	for (size_t i = 0; i < count; i++) {
		sum += ((double)a[i] - b[i]) * ((double)a[i] - b[i]);
		norm += (double)b[i] * b[i];
	}
	return sqrt(sum / norm);
}

/* In standard precision slabs may be sampled by other kernels than the whole: gpu_check.c's STANDARD, for which noise
 * is the worst case. */
static void check(enum bend bend, int cards)
{
	const double bound = 2e-3;
	const struct scene_options options = {.columns = 100,
					      .rows = 90,
					      .views = 41,
					      .arc = 2 * M_PI,
					      .pixel = {1.3, 1.3},
					      .size = {70, 66, 61},
					      .spacing = {.8, .8, .8},
					      .bend = bend};
	struct scene scene;

	scene_make(&scene, bend_names[bend], &options);
	for (int row = 0; row < ROWS; row++) {
		size_t count;
		float *one = result_of(&scene, row, 1, &count), *several = result_of(&scene, row, cards, &count);
		float *again = result_of(&scene, row, cards, &count);
		const double error = difference(several, one, count);
		const bool same = memcmp(several, again, count * sizeof(float)) == 0, fine = error <= bound && same;

		printf("%s %-8s %d cards, %-24s off by %.1e, %s\n", fine ? "pass" : "FAIL", bend_names[bend], cards,
		       rows[row].what, error, same ? "the same bits again" : "OTHER BITS");
		failures += !fine;
		free(one);
		free(several);
		free(again);
	}
	scene_clear(&scene);
}

/* ---- times ---- */

static int compare(const void *a, const void *b)
{
	double x = *(const double *)a, y = *(const double *)b;

	return x < y ? -1 : x > y;
}

static double milliseconds_of(struct bench *bench, void (*run)(struct bench *bench))
{
	enum { MOST = 7 };
	double times[MOST], first = seconds();
	struct error err = {0};
	int count = 0;

	run(bench);
	must(bench->backend->sync(bench->device, &err), &err, "sync");
	while (count < 3 || (count < MOST && seconds() - first < 1.5)) {
		double start = seconds();

		run(bench);
		must(bench->backend->sync(bench->device, &err), &err, "sync");
		times[count++] = 1e3 * (seconds() - start);
	}
	qsort(times, (size_t)count, sizeof(times[0]), compare);
	return times[count / 2];
}

static void time_case(char letter, const struct scene_options *options, const int *cards, int cards_count)
{
	double one[ROWS];
	struct scene scene;

	scene_make(&scene, "turned", options);
	for (int i = -1; i < cards_count; i++) {
		const int n = i < 0 ? 1 : cards[i];
		struct bench bench;

		begin(&bench, &scene, n);
		for (int row = 0; row < ROWS; row++) {
			double ms;

			if (letter == 'E' && rows[row].subsets > 1)
				continue;
			if (letter == 'E' && rows[row].small_only)
				continue;
			begin_row(&bench, row);
			if (row == 2)
				printf("%c: %s\n", letter, bench.backend->plan_summary(bench.plan));
			ms = milliseconds_of(&bench, rows[row].run);
			if (n == 1)
				one[row] = ms;
			printf("%c %d %s %-24s %10.2f ms  %5.2f x\n", letter, n, n == 1 ? "card, " : "cards,",
			       rows[row].what, ms, one[row] / ms);
			fflush(stdout);
		}
		end(&bench);
	}
	scene_clear(&scene);
}

/* One card with each number's share of the views: the other division without what it would exchange. */
static void time_shares(char letter, const struct scene_options *options, const int *cards, int cards_count)
{
	for (int i = 0; i < cards_count; i++) {
		struct scene_options share = *options;
		struct scene scene;
		struct bench bench;

		share.views /= cards[i];
		scene_make(&scene, "turned", &share);
		begin(&bench, &scene, 1);
		for (int row = 0; row < ROWS; row++) {
			if (rows[row].subsets == 0 || rows[row].matched || (letter == 'E' && rows[row].subsets > 1))
				continue;
			begin_row(&bench, row);
			printf("%c 1 card, %d of %d views, %-24s %10.2f ms\n", letter, share.views, options->views,
			       rows[row].what, milliseconds_of(&bench, rows[row].run));
			fflush(stdout);
		}
		end(&bench);
		scene_clear(&scene);
	}
}

int main(int argc, char **argv)
{
	const struct scene_options a = {.columns = 559,
					.rows = 559,
					.views = 100,
					.arc = 2 * M_PI,
					.pixel = {.529, .529},
					.size = {256, 256, 256},
					.spacing = {.3725, .3725, .3725},
					.bend = BEND_TURNED};
	const struct scene_options b = {.columns = 339,
					.rows = 339,
					.views = 100,
					.arc = 2 * M_PI,
					.pixel = {.713, .713},
					.size = {256, 256, 33},
					.spacing = {.3725, .3725, .3725},
					.bend = BEND_TURNED};
	const struct scene_options d = {.columns = 1240,
					.rows = 960,
					.views = 496,
					.arc = 200 * DEGREE,
					.pixel = {.308, .308},
					.size = {512, 512, 512},
					.spacing = {.1862, .1862, .1862},
					.bend = BEND_TURNED};
	const struct scene_options e = {.columns = 1024,
					.rows = 1024,
					.views = 720,
					.arc = 2 * M_PI,
					.pixel = {.2888, .2888},
					.size = {1024, 1024, 1024},
					.spacing = {.0931, .0931, .0931},
					.bend = BEND_TURNED};
	const bool brief = argc > 1 && strcmp(argv[1], "--brief") == 0;
	const bool shares = argc > 1 && strcmp(argv[1], "--shares") == 0;
	int cards[CARDS_MOST], count = 0, at = 1 + (brief || shares);

	apart = argc > at && strcmp(argv[at], "--apart") == 0;
	for (int i = at + apart; i < argc && count < CARDS_MOST; i++)
		cards[count++] = atoi(argv[i]);
	if (count == 0)
		for (int n = 2; n <= 4 && n <= backend_cuda.count(); n += 2)
			cards[count++] = n;
	for (int i = 0; i < count; i++)
		for (int bend = 0; bend < BEND_COUNT; bend++)
			if (!brief || bend == BEND_NONE || bend == BEND_TURNED || bend == BEND_STEEP)
				check((enum bend)bend, cards[i]);
	printf("%d results are off\n", failures);
	if (brief)
		return failures > 0;
	time_case('D', &d, cards, count);
	time_case('E', &e, cards, count);
	if (!shares)
		return failures > 0;
	time_case('A', &a, cards, count);
	time_case('B', &b, cards, count);
	time_shares('A', &a, cards, count);
	time_shares('B', &b, cards, count);
	time_shares('D', &d, cards, count);
	time_shares('E', &e, cards, count);
	return failures > 0;
}
