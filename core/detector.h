#ifndef CBCT_CORE_DETECTOR_H
#define CBCT_CORE_DETECTOR_H

/* Parameters of what tube, object and detector add to the counts, as plain data: core/correct/scatter.h and lag.h. */

enum { SCATTER_KERNELS_MOST = 4, LAG_TERMS_MOST = 4 };
#define SCATTER_AMPLITUDE_MOST 100
#define SCATTER_EXPONENT_LEAST (-0.9)
#define SCATTER_EXPONENT_MOST 6
#define SCATTER_POWER_MOST 6
#define SCATTER_ASYMMETRY_MOST 1
#define SCATTER_FRACTION_MOST 10
#define LAG_FRAMES_MOST 10000

/* A Gaussian on the detector that a pencil of the beam makes, see core/correct/scatter.h. */
struct scatter_kernel {
	double amplitude, exponent, power;
	double width_mm; /* standard deviation, on the detector */
	double asymmetry;
};

struct scatter_model {
	double fraction; /* of the primary behind the densest part, the same all over the detector; 0: kernels */
	int count;       /* kernels */
	struct scatter_kernel kernels[SCATTER_KERNELS_MOST];
};

/* A share of each signal that the detector gives in later frames, falling by a factor of e in so many frames. */
struct lag_term {
	double share, frames;
};

struct lag_model {
	int count;
	struct lag_term terms[LAG_TERMS_MOST];
};

#endif
