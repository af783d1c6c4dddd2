/* Some of a scan's projections on the host: see exterior_views.h. */
#include "core/correct/exterior_views.h"

#ifdef _OPENMP
#include <omp.h>
#endif
#include <stdlib.h>

enum { VIEWS_LOOKED_AT = 32, TOGETHER_MOST = 16 };

static const size_t BYTES_MOST = 64 << 20;

int exterior_views_open(struct exterior_views *ret_views, const struct exterior_volume_options *options,
			struct error *err)
{
	const struct geometry *geometry = options->geometry;
	struct exterior_views views = {
	    .options = options,
	    .pixels = (size_t)geometry->columns * (size_t)geometry->rows,
	    .count = geometry->count < VIEWS_LOOKED_AT ? geometry->count : VIEWS_LOOKED_AT,
	    .together = TOGETHER_MOST,
	};

#ifdef _OPENMP
	if (views.together > omp_get_max_threads())
		views.together = omp_get_max_threads();
#endif
	while (views.together > 1 &&
	       (views.together > views.count || (size_t)views.together * views.pixels * sizeof(float) > BYTES_MOST))
		views.together--;
	views.images = malloc((size_t)views.together * views.pixels * sizeof(float));
	if (views.images == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d views of %d x %d pixels", views.together,
				 geometry->columns, geometry->rows);
	*ret_views = views;
	return 0;
}

int exterior_views_index(const struct exterior_views *views, int i)
{
	return (int)((long long)(views->done + i) * views->options->geometry->count / views->count);
}

bool exterior_views_next(struct exterior_views *views, int *ret_code, struct error *err)
{
	const struct exterior_volume_options *options = views->options;
	int here;

	views->done += views->here;
	here = views->count - views->done;
	views->here = here < views->together ? here : views->together;
	*ret_code = 0;
	for (int i = 0; i < views->here && *ret_code == 0; i++)
		*ret_code = options->backend->stack_download(options->projections, exterior_views_index(views, i), 1,
							     views->images + (size_t)i * views->pixels, err);
	return *ret_code == 0 && views->here > 0;
}

void exterior_views_close(struct exterior_views *views)
{
	free(views->images);
	*views = (struct exterior_views){0};
}
