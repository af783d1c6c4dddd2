/* What comes and goes while the arm turns: see breathing.h. */
#include "core/refine/breathing.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* Rows at the edges are those of slices that some views do not show; of fewer views than KNOWN_LEAST of a scan's some
 * frequencies are unknown. */
enum { EDGE = 4, ROWS_LEAST = 8, VIEWS_LEAST = 64, TOP = 3, DRIFT = 4, SMOOTHINGS = 2, EXPLAINED = 3 };
static const double PI = 3.14159265358979323846;
static const double SHOWN = 0.2;        /* of the row that shows most: others have no slice of the object */
static const double KNOWN_LEAST = 0.95; /* of the views */
/* The part of the frequencies from which on they are noise. */
static const double NOISE_FROM = 0.6;
/* From where on it is told (tests/bench/results/refine.txt). */
static const double SHARE = 0.002, TIMES = 1.7, BEYOND_NOISE = 2.5;
/* Of what even and odd columns of a row tell apart: slender bodies at rest reach .2, what breathes 1.5 and more. */
static const double BY_BINS = 0.5;
/* Where only the whole has such a hill. SAME: times in the sweep. */
static const double UNEVEN_SHARE = 0.0005, UNEVEN_PART = 0.05, UNEVEN_TIMES = 1.3, UNEVEN_BEYOND_NOISE = 1.5,
		    SAME = 1.5;

/* Shares of what each row shows, [view][row]. */
struct sums {
	int views, rows;
	double *of_rows; /* what is left, owned */
	/* By how much the even columns exceed the odd ones, of what is measured; owned. */
	double *by_bins;
	/* [EXPLAINED][row], what a constant, a shift along rows and a stretch of them add, orthonormal; owned */
	double *explained;
};

static void sums_clear(struct sums *sums)
{
	free(sums->of_rows);
	free(sums->by_bins);
	free(sums->explained);
}

/*
 * The taper along columns takes what enters and leaves the field of view out gently. ret_by_bins: even columns less odd
 * ones; NULL is fine.
 */
static double row_sum(const float *row, int columns, double *ret_by_bins)
{
	double sums[2] = {0};

	for (int c = 0; c < columns; c++)
		sums[c % 2] += pow(sin(PI * (c + 0.5) / columns), 2) * (double)row[c];
	if (ret_by_bins != NULL)
		*ret_by_bins = sums[0] - sums[1];
	return sums[0] + sums[1];
}

/* Binomial, along rows. */
static void smooth(double *row, int count)
{
	double before = row[0];

	for (int i = 0; i < count; i++) {
		const double here = row[i], behind = i + 1 < count ? row[i + 1] : here;

		row[i] = (before + 2 * here + behind) / 4;
		before = here;
	}
}

/* What a view that is not known would show lies between those beside it, or is that of the one. */
static void fill_in(const struct sums *sums, double *values, const bool *known)
{
	for (int k = 0, last = -1, next; k < sums->views; k++) {
		if (known[k]) {
			last = k;
			continue;
		}
		for (next = k; next < sums->views && !known[next]; next++)
			;
		for (int r = 0; r < sums->rows; r++) {
			const double before = values[(last >= 0 ? last : next) * sums->rows + r];
			const double behind = values[(next < sums->views ? next : last) * sums->rows + r];
			const double share = last < 0 || next == sums->views ? 0 : (double)(k - last) / (next - last);

			values[k * sums->rows + r] = (1 - share) * before + share * behind;
		}
	}
}

/* Of what is left of the views, and of what they show on the mean: shown[row]. */
static void add_up(const struct reduced *reduced, const float *made, double *shown, struct sums *sums)
{
	const int columns = reduced->geometry.columns, rows = reduced->geometry.rows;
	int known = 0;

	for (int k = 0; k < sums->views; k++) {
		double *of_view = sums->of_rows + (size_t)k * (size_t)rows;
		double *by_bins = sums->by_bins + (size_t)k * (size_t)rows;

		for (int r = 0; r < rows && reduced->known[k]; r++) {
			const size_t at = ((size_t)k * (size_t)rows + (size_t)r) * (size_t)columns;
			const double all = row_sum(reduced->projections + at, columns, &by_bins[r]);

			of_view[r] = all - row_sum(made + at, columns, NULL);
			shown[r] += all;
		}
		for (int i = 0; i < SMOOTHINGS && reduced->known[k]; i++) {
			smooth(of_view, rows);
			smooth(by_bins, rows);
		}
		known += reduced->known[k];
	}
	for (int i = 0; i < SMOOTHINGS; i++)
		smooth(shown, rows);
	for (int r = 0; r < rows; r++)
		shown[r] /= known;
}

/* Vectors of `length`, [count][length], become orthonormal, or 0 where one is none by itself. */
static void make_orthonormal(double *vectors, int count, int length)
{
	for (int d = 0; d < count; d++) {
		double *own = vectors + (size_t)d * (size_t)length, before = 0, square = 0;

		for (int i = 0; i < length; i++)
			before += own[i] * own[i];
		for (int e = 0; e < d; e++) {
			const double *other = vectors + (size_t)e * (size_t)length;
			double product = 0;

			for (int i = 0; i < length; i++)
				product += own[i] * other[i];
			for (int i = 0; i < length; i++)
				own[i] -= product * other[i];
		}
		for (int i = 0; i < length; i++)
			square += own[i] * own[i];
		for (int i = 0; i < length; i++)
			own[i] *= square > 1e-12 * before ? 1 / sqrt(square) : 0;
	}
}

/* Only rows that show the object stay, as shares of it. */
static void normalise(struct sums *sums, const double *shown)
{
	const int rows = sums->rows;
	double most = 0;
	int stay = 0, at = 0;

	for (int r = EDGE; r < rows - EDGE; r++)
		most = fmax(most, shown[r]);
	for (int r = EDGE; r < rows - EDGE; r++)
		stay += shown[r] > SHOWN * most;
	for (int r = EDGE; r < rows - EDGE; r++) {
		const double slope = (shown[r + 1] - shown[r - 1]) / 2;

		if (!(shown[r] > SHOWN * most))
			continue;
		sums->explained[at] = 1 / shown[r];
		sums->explained[stay + at] = slope / shown[r];
		sums->explained[2 * stay + at++] = (r - 0.5 * (rows - 1)) * slope / shown[r];
	}
	make_orthonormal(sums->explained, EXPLAINED, stay);
	for (int k = 0, to = 0; k < sums->views; k++)
		for (int r = EDGE; r < rows - EDGE; r++)
			if (shown[r] > SHOWN * most) {
				sums->by_bins[to] = sums->by_bins[k * rows + r] / shown[r];
				sums->of_rows[to++] = sums->of_rows[k * rows + r] / shown[r];
			}
	sums->rows = stay;
}

static int sums_open(struct sums *ret_sums, const struct reduced *reduced, const float *made, struct error *err)
{
	const size_t rows = (size_t)reduced->geometry.rows, views = (size_t)reduced->geometry.count;
	double *shown = calloc(rows, sizeof(*shown));
	struct sums sums = {.views = reduced->geometry.count,
			    .rows = reduced->geometry.rows,
			    .of_rows = calloc(views * rows, sizeof(double)),
			    .by_bins = calloc(views * rows, sizeof(double)),
			    .explained = calloc(EXPLAINED * rows, sizeof(double))};
	int code = 0;

	if (shown == NULL || sums.of_rows == NULL || sums.by_bins == NULL || sums.explained == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for the rows of %zu views", views);
		sums_clear(&sums);
	} else {
		add_up(reduced, made, shown, &sums);
		fill_in(&sums, sums.of_rows, reduced->known);
		fill_in(&sums, sums.by_bins, reduced->known);
		normalise(&sums, shown);
		*ret_sums = sums;
	}
	free(shown);
	return code;
}

/* ---- without what is explained otherwise ---- */

/* What vectors of one number for each row, or for each view, explain: value i of one stands `step` from the next. */
static void take_off(double *values, int step, const double *vectors, int count, int length)
{
	for (int d = 0; d < count; d++) {
		const double *own = vectors + (size_t)d * (size_t)length;
		double product = 0;

		for (int i = 0; i < length; i++)
			product += own[i] * values[(size_t)i * (size_t)step];
		for (int i = 0; i < length; i++)
			values[(size_t)i * (size_t)step] -= product * own[i];
	}
}

/*
 * A sweep that does not end where it began has all frequencies by its ends: a polynomial is taken off, and Hann's
 * window lets the rest go to 0 there. polynomials: [DRIFT][view].
 */
static void open_ends(struct sums *sums, double *polynomials)
{
	const int views = sums->views;

	for (int d = 0; d < DRIFT; d++)
		for (int k = 0; k < views; k++)
			polynomials[d * views + k] = pow(2. * k / (views - 1) - 1, d);
	make_orthonormal(polynomials, DRIFT, views);
	for (int r = 0; r < sums->rows; r++)
		take_off(sums->of_rows + r, sums->rows, polynomials, DRIFT, views);
	/* The mean square of the window is 3/8. */
	for (int k = 0; k < views; k++)
		for (int r = 0; r < sums->rows; r++)
			sums->of_rows[k * sums->rows + r] *= pow(sin(PI * (k + 0.5) / views), 2) / sqrt(0.375);
}

/* ---- frequencies ---- */

/* The mean square over the rows of what comes and goes `times` in the sweep. cosine, sine: [view], of once in the
 * sweep. */
static double power(const struct sums *sums, const double *values, int times, const double *cosine, const double *sine)
{
	const int views = sums->views;
	double sum = 0;

	for (int r = 0; r < sums->rows; r++) {
		double real = 0, imaginary = 0;

		for (int k = 0; k < views; k++) {
			const int at = times * k % views;

			real += values[k * sums->rows + r] * cosine[at];
			imaginary += values[k * sums->rows + r] * sine[at];
		}
		sum += 2 * (real * real + imaginary * imaginary) / ((double)views * views);
	}
	return sum / sums->rows;
}

static int compare(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return (x > y) - (x < y);
}

/* Puts those of noise, of the powers of the frequencies 0 .. views / 2, in order. */
static void order_noise(double *powers, int views)
{
	const int from = (int)(NOISE_FROM * (views / 2 + 1));

	qsort(powers + from, (size_t)(views / 2 + 1 - from), sizeof(*powers), compare);
}

/* The highest hill whose middle is less than `within` from `about`, of powers that order_noise has seen. */
static struct hill highest_hill(const double *powers, int views, double about, double within)
{
	const int from = (int)(NOISE_FROM * (views / 2 + 1)), noises = views / 2 + 1 - from;
	const double noise = TOP * powers[from + noises / 2];
	struct hill hill = {.noise = sqrt(noise)};

	for (int h = BREATHING_LEAST; h + TOP - 1 <= BREATHING_MOST && h + TOP <= from; h++) {
		double valley = INFINITY;
		const double top = powers[h] + powers[h + 1] + powers[h + 2];

		for (int below = 2; below <= h - 2; below++)
			valley = fmin(valley, powers[below] + powers[below + 1] + powers[below + 2]);
		valley = fmax(valley, noise);
		if (top - valley <= hill.share * hill.share || fabs(h + 1 - about) >= within)
			continue;
		hill.share = sqrt(top - valley);
		hill.times = sqrt(top / fmax(valley, 1e-30));
		hill.times_in_sweep = (h * powers[h] + (h + 1) * powers[h + 1] + (h + 2) * powers[h + 2]) / top;
	}
	return hill;
}

/* What all frequencies that are none of noise have beyond it, of powers that order_noise has seen. */
static double all_beyond_noise(const double *powers, int views)
{
	const int from = (int)(NOISE_FROM * (views / 2 + 1)), noises = views / 2 + 1 - from;
	double sum = 0;

	for (int h = 1; h < from; h++)
		sum += powers[h] - powers[from + noises / 2];
	return sqrt(fmax(0, sum));
}

/* work: [4 views]; its second half gets the powers. */
static double *find_powers(const struct sums *sums, const double *values, double *work)
{
	double *cosine = work, *sine = work + sums->views, *powers = work + 2 * (size_t)sums->views;

	for (int k = 0; k < sums->views; k++) {
		cosine[k] = cos(2 * PI * k / sums->views);
		sine[k] = sin(2 * PI * k / sums->views);
	}
	for (int h = 0; h <= sums->views / 2; h++)
		powers[h] = power(sums, values, h, cosine, sine);
	order_noise(powers, sums->views);
	return powers;
}

static void find_hills(struct sums *sums, double *work, struct breathing *ret_breathing)
{
	const double *powers = find_powers(sums, sums->by_bins, work);

	ret_breathing->measured = true;
	ret_breathing->by_bins = all_beyond_noise(powers, sums->views);
	powers = find_powers(sums, sums->of_rows, work);
	ret_breathing->all = highest_hill(powers, sums->views, 0, INFINITY);
	for (int k = 0; k < sums->views; k++)
		take_off(sums->of_rows + (size_t)k * (size_t)sums->rows, 1, sums->explained, EXPLAINED, sums->rows);
	powers = find_powers(sums, sums->of_rows, work);
	ret_breathing->uneven = highest_hill(powers, sums->views, 0, INFINITY);
	ret_breathing->there = highest_hill(powers, sums->views, ret_breathing->all.times_in_sweep, SAME);
}

size_t breathing_bytes(const struct reduced *reduced)
{
	const size_t views = (size_t)reduced->geometry.count, rows = (size_t)reduced->geometry.rows;

	return ((2 * views + 1 + EXPLAINED) * rows + DRIFT * views) * sizeof(double);
}

int breathing_measure(const struct reduced *reduced, const float *made, bool is_turn, struct breathing *ret_breathing,
		      struct error *err)
{
	const int views = reduced->geometry.count;
	double *work = malloc(DRIFT * (size_t)views * sizeof(*work));
	struct sums sums = {0};
	int known = 0, code = 0;

	*ret_breathing = (struct breathing){0};
	for (int k = 0; k < views; k++)
		known += reduced->known[k];
	if (work == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for the frequencies of %d views", views);
	if (code == 0 && views >= VIEWS_LEAST && known >= KNOWN_LEAST * views)
		code = sums_open(&sums, reduced, made, err);
	if (code == 0 && sums.rows >= ROWS_LEAST) {
		if (!is_turn)
			open_ends(&sums, work);
		find_hills(&sums, work, ret_breathing);
	}
	sums_clear(&sums);
	free(work);
	return code;
}

static bool is_hill(const struct breathing *breathing, const struct hill *hill)
{
	return hill->share > fmax(SHARE, BY_BINS * breathing->by_bins) && hill->times > TIMES &&
	       hill->share > BEYOND_NOISE * hill->noise;
}

/* True if the whole's hill stands on more than constants, shifts and stretches of the rows. */
static bool is_of_a_body(const struct breathing *breathing)
{
	const struct hill *all = &breathing->all, *there = &breathing->there;

	return there->share > fmax(UNEVEN_SHARE, UNEVEN_PART * all->share) && there->times > UNEVEN_TIMES &&
	       there->share > UNEVEN_BEYOND_NOISE * there->noise;
}

bool breathing_is_told(const struct breathing *breathing)
{
	return is_hill(breathing, &breathing->uneven) ||
	       (is_hill(breathing, &breathing->all) && is_of_a_body(breathing));
}
