#ifndef CBCT_TESTS_ANATOMY_H
#define CBCT_TESTS_ANATOMY_H

#include "core/scan/phantom.h"
#include "core/recon/recon.h"

/*
 * Heads, wrists, necks and abdomens of ellipsoids and elliptic cylinders, with
 * shells of bone, trabecular texture, contrasts of 20 to 100 HU, and small spheres of
 * 30 HU in even tissue, scanned by exact line integrals with Poisson noise; and what an image of them is worth.
 * The project's projector takes no part in it. For the tests of noise reduction
 * and for tests/bench/denoise.c. Nothing here ends a test: what fails is returned.
 */
enum anatomy { HEAD, HEAD_AND_NECK, WRIST, ABDOMEN, ANATOMY_COUNT };
extern const char *const anatomy_names[ANATOMY_COUNT];

struct anatomy_spec {
	enum anatomy what;
	double scale; /* of lengths; 1: an adult's */
	double voxel; /* mm, isotropic */
	int size[3];  /* voxels; the object ends within */
	double pixel; /* mm at the isocentre, square */
	int views;
	double arc;     /* degrees; below 360: a short scan */
	double photons; /* in a pixel of the open beam; 0: no noise */
	unsigned seed;  /* of the anatomy's small parts and of the noise */
};

enum { SPHERES_MOST = 24 };

struct anatomy_scan {
	struct geometry geometry;
	struct grid grid;
	float *projections; /* [view][row][column], line integrals */
	float *truth;       /* [z][y][x], 1/mm, each voxel the mean of 27 points */
	float *background;  /* the same without the spheres */
	double edge[3];     /* mm: x, y and radius of a rod along z, about 300 HU above what is around it */
	/* Spheres of four voxels' diameter: x, y, z in mm, and 30 or -30 HU; as many as the tissue has room for. */
	double spheres[SPHERES_MOST][4];
	int sphere_count;
};

int anatomy_scan_make(struct anatomy_scan *ret_scan, const struct anatomy_spec *spec, struct error *err);
void anatomy_scan_clear(struct anatomy_scan *scan);

/* Of the middle half of the slices, in HU. */
struct image_figures {
	double rmse;     /* where the truth is above -500 HU */
	double bone;     /* mean difference to the truth where that is above 500 HU; 0 without bone */
	double fwhm;     /* voxels: width of the rod's edge, from the error function that fits it best */
	double contrast; /* share of the spheres' contrast that the image shows */
};
struct image_figures anatomy_figures(const struct anatomy_scan *scan, const float *volume);

/*
 * Reconstructs the scan; ret_volumes[i] gets the volume of recipe->emit[i], the last one the final volume: free each.
 * alpha found and noise in HU, 0 without TV.
 */
int anatomy_reconstruct(const struct anatomy_scan *scan, const struct backend *backend, struct device *device,
			const struct recipe *recipe, float **ret_volumes, double *ret_noise, double *ret_alpha,
			struct error *err);

#endif
