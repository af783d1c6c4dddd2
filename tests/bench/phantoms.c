/*
 * Calibrations of random arms from random phantoms that are right, each as it comes: whether it is refused, what its
 * views are worth, and what it is warned of. And of the same pictures with drawings that are wrong by known amounts.
 *
 * Usage: phantoms [FIRST [COUNT]]; a line for each, and a table.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "proto/calibration.h"
#include "tests/unit/arm.h"

struct scene {
	struct arm arm;
	struct target target;
	float *pictures; /* [view][row][column] */
};

static int take_picture(void *context, int view, float *ret_image, struct error *err)
{
	const struct scene *scene = context;
	const size_t pixels = (size_t)scene->arm.columns * (size_t)scene->arm.rows;

	(void)err;
	memcpy(ret_image, scene->pictures + (size_t)view * pixels, pixels * sizeof(*ret_image));
	return 0;
}

static double uniform(uint64_t *state)
{
	*state = *state * 6364136223846793005u + 1442695040888963407u;
	return ((double)(*state >> 33) + .5) / 2147483648.0;
}

static double between(uint64_t *state, double least, double most)
{
	return least + (most - least) * uniform(state);
}

/* RMS distance, pixels, between where found and true views see points of the volume, and the worst view's. */
static double reprojection(const struct arm *arm, const struct calibration *calibration, double *ret_worst)
{
	double squares = 0;

	*ret_worst = 0;
	for (int k = 0; k < calibration->count; k++) {
		const double own = arm_wrong(arm, k, &calibration->views[k].view);

		squares += own * own;
		*ret_worst = fmax(*ret_worst, own);
	}
	return sqrt(squares / fmax(1, calibration->count));
}

/* A panel of 381 x 305 mm with pixels of .95 to 2.54 mm, and a phantom of 2 or 3 circles of 8 to 12 balls. */
static void draw(unsigned seed, struct scene *scene, struct ball_circles *circles)
{
	uint64_t state = (seed + 1) * 0x9e3779b97f4a7c15u;
	const double pixels[] = {.95, 1.27, 1.9, 2.54}, width = 381, height = 305;
	double pixel;

	/* The generator's first numbers of seeds that follow each other are alike: splitmix. */
	state = (state ^ state >> 30) * 0xbf58476d1ce4e5b9u;
	state = (state ^ state >> 27) * 0x94d049bb133111ebu;
	state ^= state >> 31;
	pixel = pixels[(int)(4 * uniform(&state))];
	*circles = (struct ball_circles){.circles = 2 + (int)(1.3 * uniform(&state)),
					 .balls = 8 + (int)(5 * uniform(&state)),
					 .diameter = between(&state, 90, 120),
					 .distance = between(&state, 60, 90),
					 .first = between(&state, 0, 2 * M_PI)};
	circles->shift = M_PI / circles->balls;
	circles->ball = fmin(between(&state, 2, 4.5) * pixel * 620 / 1100, 8);
	circles->ball = fmax(circles->ball, 2.5);
	if (circles->circles == 3)
		circles->distance *= .5;
	scene->arm = (struct arm){.columns = (int)(width / pixel),
				  .rows = (int)(height / pixel),
				  .count = 12 + (int)(20 * uniform(&state)),
				  .pixel = pixel,
				  .first = between(&state, 0, 2 * M_PI),
				  .sag = uniform(&state) < .3 ? 0 : uniform(&state),
				  .jitter = between(&state, 0, .1),
				  .seed = seed};
	scene->arm.step = (uniform(&state) < .5 ? 2 * M_PI : 200 * M_PI / 180) / scene->arm.count;
	scene->target = (struct target){.ball = uniform(&state) < .5 ? .6 : between(&state, .15, .8),
					.photons = uniform(&state) < .2 ? 0 : between(&state, 8000, 60000),
					.rays = 4};
	scene->target.blur = uniform(&state) < .5 ? 0 : uniform(&state);
	if (uniform(&state) < .4) {
		scene->target.body = .02;
		scene->target.radius = 65;
	}
}

/* A drawing by what is wrong in it: factors of its lengths, and what is added. */
static const struct drawing {
	const char *what;
	double diameter, distance, ball, shift;
	int balls;
} drawings[] = {
    {"right", 1, 1, 1, 0, 0},
    {"all but the balls 2 % too large", 1.02, 1.02, 1, 0, 0},
    {"all but the balls 2 % too small", .98, .98, 1, 0, 0},
    {"all 2 % too large", 1.02, 1.02, 1.02, 0, 0},
    {"all 2 % too small", .98, .98, .98, 0, 0},
    {"circles 2 % too large", 1.02, 1, 1, 0, 0},
    {"circles 2 % too small", .98, 1, 1, 0, 0},
    {"circles 2 % too far apart", 1, 1.02, 1, 0, 0},
    {"circles turned by 1 degree", 1, 1, 1, 1, 0},
    {"circles turned by 4 degrees", 1, 1, 1, 4, 0},
    {"balls 5 % too large", 1, 1, 1.05, 0, 0},
    {"a ball more in each circle", 1, 1, 1, 0, 1},
    {"a ball less in each circle", 1, 1, 1, 0, -1},
    {"circles 10 % too far apart", 1, 1.1, 1, 0, 0},
};
enum { DRAWINGS = sizeof(drawings) / sizeof(drawings[0]) };

static struct tally {
	int scenes, refused, warned;
	double wrong, residual;
} tallies[DRAWINGS];

static void try_drawing(int which, struct scene *scene, struct ball_circles circles)
{
	const struct drawing *drawing = &drawings[which];
	struct tally *tally = &tallies[which];
	struct calibration calibration;
	struct error err = {0};
	struct balls balls;
	double worst, all, balls_used = 0;
	cJSON *document, *doubts;

	circles.diameter *= drawing->diameter;
	circles.distance *= drawing->distance;
	circles.ball *= drawing->ball;
	circles.shift += drawing->shift * M_PI / 180;
	circles.balls += drawing->balls;
	if (balls_circles(&balls, &circles, &err) < 0)
		return;
	tally->scenes++;
	if (arm_calibrate(&scene->arm, take_picture, scene, &balls, false, &calibration, &err) < 0) {
		printf("   %-32s refused: %.200s\n", drawing->what, err.text);
		tally->refused++;
		balls_clear(&balls);
		return;
	}
	for (int k = 0; k < calibration.count; k++)
		balls_used += calibration.views[k].used ? calibration.views[k].balls : 0;
	all = reprojection(&scene->arm, &calibration, &worst);
	document = calibration_json(&calibration);
	doubts = calibration_doubts(document);
	printf("   %-32s %2d views, %4.1f of %2d balls, residual %.3f px %.3f mm, views wrong by %.3f, the worst by "
	       "%.3f, diameters "
	       "%.4f +- %.4f, distances %.4f, explained %.3f mm\n",
	       drawing->what, calibration.used, balls_used / calibration.used, balls.count, calibration.rms,
	       calibration.rms_isocentre, all, worst, calibration.diameter_ratio, calibration.diameter_error,
	       calibration.distance_ratio, calibration.explained);
	for (const cJSON *doubt = doubts->child; doubt != NULL; doubt = doubt->next)
		printf("      %s\n", cJSON_GetObjectItem(doubt, "code")->valuestring);
	tally->warned += doubts->child != NULL;
	cJSON_Delete(doubts);
	cJSON_Delete(document);
	tally->wrong = fmax(tally->wrong, all);
	tally->residual = fmax(tally->residual, calibration.rms);
	calibration_clear(&calibration);
	balls_clear(&balls);
}

int main(int argc, char **argv)
{
	const unsigned first = argc > 1 ? (unsigned)atoi(argv[1]) : 1, count = argc > 2 ? (unsigned)atoi(argv[2]) : 60;
	const int wrong = argc > 3 ? atoi(argv[3]) : DRAWINGS;

	for (unsigned seed = first; seed < first + count; seed++) {
		struct ball_circles circles;
		struct scene scene;
		struct balls balls;
		struct error err = {0};
		size_t pixels;

		draw(seed, &scene, &circles);
		pixels = (size_t)scene.arm.columns * (size_t)scene.arm.rows;
		scene.pictures = malloc((size_t)scene.arm.count * pixels * sizeof(float));
		if (scene.pictures == NULL || balls_circles(&balls, &circles, &err) < 0) {
			fprintf(stderr, "phantoms: %s\n", scene.pictures == NULL ? "no memory" : err.text);
			return 1;
		}
		scene.target.balls = &balls;
#pragma omp parallel for schedule(dynamic)
		for (int k = 0; k < scene.arm.count; k++)
			arm_picture(&scene.arm, &scene.target, k, scene.pictures + (size_t)k * pixels);
		printf("%2u: %d views of %d x %d pixels of %.3f mm, %d circles of %d balls of %.2f mm (%.1f pixels), "
		       "%.2f/mm, body %.2f/mm, "
		       "%.0f photons, blur %.2f\n",
		       seed, scene.arm.count, scene.arm.columns, scene.arm.rows, scene.arm.pixel, circles.circles,
		       circles.balls, circles.ball, circles.ball / scene.arm.pixel * 1100 / 620, scene.target.ball,
		       scene.target.body, scene.target.photons, scene.target.blur);
		for (int i = 0; i < wrong && i < DRAWINGS; i++)
			try_drawing(i, &scene, circles);
		fflush(stdout);
		balls_clear(&balls);
		free(scene.pictures);
	}
	for (int i = 0; i < wrong && i < DRAWINGS; i++)
		printf(
		    "%-32s %3d scans, %3d refused, %3d warned; residual up to %.3f, views wrong by up to %.3f pixels\n",
		    drawings[i].what, tallies[i].scenes, tallies[i].refused, tallies[i].warned, tallies[i].residual,
		    tallies[i].wrong);
	return 0;
}
