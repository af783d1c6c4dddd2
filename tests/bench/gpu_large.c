/*
 * One large reconstruction on several cards, from projections of an exact phantom that are made on them, checked
 * against the phantom in sampled slices: seconds of its parts, apart from each other.
 *
 *   gpu_large CARDS SIZE VIEWS PIXELS turned|untilted ITERATIONS [PREFIX]
 *
 * SIZE^3 voxels from VIEWS of PIXELS^2: so many SIRT iterations, or FDK (0). The detector is turned by a degree or not
 * at all. With PREFIX each card's slab is written there as int16 in HU, all cards at once; to nowhere if it is
 * /dev/null.
 */
#include <fcntl.h>
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "core/cards/internal.h"
#include "tests/bench/gpu_phantom.h"
#include "tests/bench/gpu_scene.h"

extern const struct backend backend_cuda;

static const double WATER = .02; /* 1/mm, 1000 HU above nothing */

struct large {
	struct scene scene;
	struct phantom phantom;
	struct device *device;
	struct plan *plan;
	struct volume *volume;
	struct stack *projections, *filtered;
	int *views, *slots;
	struct error err;
};

static void large_make(struct large *large, int cards, int size, int views, int pixels, enum bend bend)
{
	const struct scene_options options = {
	    .columns = pixels,
	    .rows = pixels,
	    .views = views,
	    .arc = 2 * M_PI,
	    .pixel = {.2888 * 1024 / pixels, .2888 * 1024 / pixels},
	    .size = {size, size, size},
	    .spacing = {.0931 * 1024 / size, .0931 * 1024 / size, .0931 * 1024 / size},
	    .bend = bend};
	const int indices[CARDS_MOST] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};

	scene_make(&large->scene, "large", &options);
	must(phantom_named(&large->phantom, "head", 48, WATER, &large->err), &large->err, "phantom");
	must(cards_open(&backend_cuda, indices, cards, &(struct device_options){0}, &large->device, &large->err),
	     &large->err, "cards");
	large->views = malloc(sizeof(int) * (size_t)views);
	large->slots = malloc(sizeof(int) * (size_t)views);
	for (int i = 0; i < views; i++)
		large->views[i] = large->slots[i] = i;
}

static void stack_make(struct large *large, int slots, struct stack **ret_stack)
{
	const struct geometry *geometry = &large->scene.geometry;

	must(backend_cards.stack_new(large->device, geometry->columns, geometry->rows, slots, ret_stack, &large->err),
	     &large->err, "stack");
}

static void volume_make(struct large *large)
{
	must(backend_cards.volume_new(large->device, &large->scene.grid, &large->volume, &large->err), &large->err,
	     "volume");
}

static double since(struct large *large, double start)
{
	must(backend_cards.sync(large->device, &large->err), &large->err, "sync");
	return seconds() - start;
}

/* Views first .. first + count - 1 into the first slots of the stack. */
static void see(struct large *large, int first, int count)
{
	struct stack *to = large->projections;

	stack_written(to);
	for (int i = 0; i < count; i++) {
		const int slot = slot_place(large->device, i);

		must(gpu_phantom_project(&large->phantom, &large->scene.geometry, &large->views[first + i], &slot, 1,
					 to->part[slot_card(large->device, i)], &large->err),
		     &large->err, "projections");
	}
}

/* Seconds in which filtered rows of a batch go to the cards whose slabs they see, while nothing else is done. */
static double time_exchange(struct large *large, int batch)
{
	const struct device *device = large->device;
	const struct plan *plan = large->plan;
	const double start = since(large, 0) * 0 + seconds();

	for (int c = 0; c < plan->parts; c++)
		for (int s = 0; s < device->count; s++) {
			const struct card_plan *card = &plan->card[c];
			const struct passage passage = {.from = large->filtered->part[s],
							.to = card->in[0],
							.columns = plan->options.geometry->columns,
							.from_rows = plan->options.geometry->rows,
							.to_rows = card->geometry.rows,
							.from_row = card->row,
							.rows = card->geometry.rows,
							.host = plan->host};
			int count = 0;

			for (int i = 0; i < batch && i < plan->batch; i++)
				if (slot_card(device, i) == s) {
					card->from[count] = slot_place(device, i);
					card->to[count++] = i;
				}
			must(cards_pass(device, &passage, card->from, card->to, count, &large->err), &large->err,
			     "pass");
		}
	return since(large, start);
}

static void run_fdk(struct large *large)
{
	const int all = large->scene.geometry.count;
	struct plan_options options = scene_plan(&large->scene, NULL, 0, NULL, false);
	double made = 0, filtered = 0, back = 0, exchanged;
	int batch;

	options.no_samples = options.no_projection = true;
	options.resident = fdk_batch_most(all);
	must(backend_cards.plan_new(large->device, &options, &large->plan, &large->err), &large->err, "plan");
	batch = backend_cards.plan_batch(large->plan);
	stack_make(large, batch, &large->projections);
	stack_make(large, batch, &large->filtered);
	volume_make(large);
	printf("%s\n", backend_cards.plan_summary(large->plan));
	for (int done = 0; done < all; done += batch) {
		const int now = all - done < batch ? all - done : batch;
		double start = seconds();

		see(large, done, now);
		made += since(large, start);
		start = seconds();
		must(backend_cards.filter(large->plan, large->projections, large->slots, large->views + done, now,
					  large->filtered, &large->err),
		     &large->err, "filter");
		filtered += since(large, start);
		start = seconds();
		must(backend_cards.backproject(large->plan, large->filtered, large->views + done, now, BACKPROJECT_FDK,
					       large->volume, &large->err),
		     &large->err, "backproject");
		back += since(large, start);
	}
	exchanged = time_exchange(large, batch);
	exchanged = time_exchange(large, batch) * all / batch;
	printf("projections made %.3f s, filter %.3f s, backprojection with exchange %.3f s (exchange alone %.3f s); "
	       "FDK %.3f s\n",
	       made, filtered, back, exchanged, filtered + back);
}

static void run_sirt(struct large *large, int iterations)
{
	struct sart_options sart = {.relaxation = 1, .nonnegative = true};
	struct plan_options options = scene_plan(&large->scene, &sart, 1, NULL, false);
	double start;

	options.column_weights = options.filter_response = NULL;
	options.pad[0] = options.pad[1] = 0;
	options.no_samples = true;
	must(backend_cards.plan_new(large->device, &options, &large->plan, &large->err), &large->err, "plan");
	stack_make(large, large->scene.geometry.count, &large->projections);
	volume_make(large);
	printf("%s\n", backend_cards.plan_summary(large->plan));
	start = seconds();
	see(large, 0, large->scene.geometry.count);
	printf("projections made %.3f s\n", since(large, start));
	for (int i = 0; i < iterations; i++) {
		struct iteration_sums sums;

		start = seconds();
		must(backend_cards.sart_iterate(large->plan, large->projections, large->volume, NULL, &sums,
						&large->err),
		     &large->err, "iteration");
		printf("SIRT iteration %d: %.3f s, residual before it %.5f\n", i + 1, since(large, start),
		       sqrt(sums.residual2 / sums.projection2));
	}
	subsets_clear(&sart.subsets);
}

/* The phantom in one slice, and where it is the same two voxels around. */
static void slice_of_phantom(const struct large *large, int z, float *ret_slice, float *around)
{
	struct grid grid = large->scene.grid;
	const int nx = grid.size[0], ny = grid.size[1];
	const size_t slice = (size_t)nx * (size_t)ny;

	grid.size[2] = 1;
	for (int i = 0; i < 3; i++) {
		struct grid one = grid;

		one.origin[2] += (z + 2 * (i - 1)) * grid.spacing[2];
		phantom_voxelise(&large->phantom, &one, 1, around + (size_t)i * slice);
	}
	for (int y = 0; y < ny; y++)
		for (int x = 0; x < nx; x++) {
			const size_t at = slice + (size_t)y * (size_t)nx + (size_t)x;
			const bool inner = x > 1 && y > 1 && x + 2 < nx && y + 2 < ny;
			const float v = around[at];

			ret_slice[at - slice] = inner && around[at - 2] == v && around[at + 2] == v &&
							around[at - 2 * (size_t)nx] == v &&
							around[at + 2 * (size_t)nx] == v && around[at - slice] == v &&
							around[at + slice] == v
						    ? v
						    : NAN;
		}
}

/* Prints how far sampled slices are from the phantom, HU, away from its edges. */
static void compare_slices(struct large *large)
{
	const int *size = large->scene.grid.size;
	const size_t slice = (size_t)size[0] * (size_t)size[1];
	float *volume = malloc(slice * sizeof(float)), *phantom = malloc(slice * sizeof(float));
	float *around = malloc(3 * slice * sizeof(float));
	const double start = seconds();

	for (int k = 1; k < 8; k++) {
		const int z = size[2] * k / 8 - (k == 4); /* the fourth: the last one of a half */
		double sum = 0, squares = 0;
		size_t count = 0;

		must(backend_cards.volume_download(large->volume, z, 1, volume, &large->err), &large->err, "download");
		slice_of_phantom(large, z, phantom, around);
		for (size_t i = 0; i < slice; i++) {
			const double hu = 1000 * ((double)volume[i] - (double)phantom[i]) / WATER;

			if (isnan(phantom[i]))
				continue;
			sum += hu;
			squares += hu * hu;
			count++;
		}
		printf("slice %d of %d: mean %+.1f HU, root mean square %.1f HU of %zu voxels\n", z, size[2],
		       sum / (double)count, sqrt(squares / (double)count), count);
	}
	printf("%.1f s to look at slices\n", seconds() - start);
	free(around);
	free(phantom);
	free(volume);
}

/* ---- writing ---- */

enum { CHUNK = 8 }; /* slices on their way */

struct writer {
	struct large *large;
	int card, fd;
	bool wrong;
	pthread_t thread;
};

static void *write_slab(void *argument)
{
	struct writer *writer = argument;
	const struct large *large = writer->large;
	const int *size = large->scene.grid.size, *first = large->volume->first;
	const size_t slice = (size_t)size[0] * (size_t)size[1];
	const int count = first[writer->card + 1] - first[writer->card];
	float *values = malloc(CHUNK * slice * sizeof(float));
	int16_t *units = malloc(CHUNK * slice * sizeof(int16_t));
	struct error err = {0};

	for (int z = 0; z < count; z += CHUNK) {
		const int now = count - z < CHUNK ? count - z : CHUNK;
		const char *left = (const char *)units;
		size_t bytes = (size_t)now * slice * sizeof(int16_t);

		must(backend_cuda.volume_download(large->volume->part[writer->card], z, now, values, &err), &err,
		     "download");
#pragma omp parallel for schedule(static)
		for (size_t i = 0; i < (size_t)now * slice; i++) {
			const float hu = 1000 * values[i] / (float)WATER - 1000;

			units[i] = (int16_t)lrintf(fminf(fmaxf(hu, INT16_MIN), INT16_MAX));
		}
		while (bytes > 0) {
			const ssize_t done = write(writer->fd, left, bytes);

			if (done <= 0) {
				writer->wrong = true;
				goto out;
			}
			left += done;
			bytes -= (size_t)done;
		}
	}
out:
	free(units);
	free(values);
	return NULL;
}

static void write_slabs(struct large *large, const char *prefix)
{
	struct writer writers[CARDS_MOST];
	const double start = seconds();
	bool wrong = false;

	for (int c = 0; c < large->plan->parts; c++) {
		char path[4096];

		snprintf(path, sizeof(path), strcmp(prefix, "/dev/null") == 0 ? "%s" : "%s-%d.int16", prefix, c);
		writers[c] = (struct writer){.large = large, .card = c, .fd = open(path, O_WRONLY | O_CREAT, 0644)};
		if (writers[c].fd < 0 || pthread_create(&writers[c].thread, NULL, write_slab, &writers[c]) != 0) {
			fprintf(stderr, "%s: cannot be written\n", path);
			exit(1);
		}
	}
	for (int c = 0; c < large->plan->parts; c++) {
		pthread_join(writers[c].thread, NULL);
		wrong |= writers[c].wrong | (close(writers[c].fd) != 0);
	}
	printf("slabs written as int16 in %.1f s%s\n", seconds() - start, wrong ? ", NOT WHOLE" : "");
}

int main(int argc, char **argv)
{
	struct large large = {0};
	struct device_info info;
	const double start = seconds();
	const bool turned = argc > 5 && strcmp(argv[5], "turned") == 0;

	if (argc < 7 || (!turned && strcmp(argv[5], "untilted") != 0)) {
		fprintf(stderr, "gpu_large CARDS SIZE VIEWS PIXELS turned|untilted ITERATIONS [PREFIX]\n");
		return 2;
	}
	large_make(&large, atoi(argv[1]), atoi(argv[2]), atoi(argv[3]), atoi(argv[4]),
		   turned ? BEND_TURNED : BEND_NONE);
	backend_cards.describe(large.device, &info);
	printf("%s: %s^3 voxels from %s views of %s^2, %s; opened in %.1f s\n", info.name, argv[2], argv[3], argv[4],
	       argv[5], seconds() - start);
	if (atoi(argv[6]) > 0)
		run_sirt(&large, atoi(argv[6]));
	else
		run_fdk(&large);
	if (argc > 7)
		write_slabs(&large, argv[7]);
	backend_cards.describe(large.device, &info);
	printf("%.1f GiB of each card are taken\n",
	       (double)(info.bytes_total - info.bytes_free) / atoi(argv[1]) / (double)(1 << 30));
	compare_slices(&large);
	printf("%.1f s in all\n", seconds() - start);
	backend_cards.plan_free(large.plan);
	backend_cards.stack_free(large.filtered);
	backend_cards.stack_free(large.projections);
	backend_cards.volume_free(large.volume);
	backend_cards.close(large.device);
	phantom_clear(&large.phantom);
	scene_clear(&large.scene);
	free(large.views);
	free(large.slots);
	return 0;
}
