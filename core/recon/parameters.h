#ifndef CBCT_CORE_RECON_PARAMETERS_H
#define CBCT_CORE_RECON_PARAMETERS_H

#include "core/parameter.h"
#include "core/recon/algorithm.h"

/*
 * The parameters of a recipe (struct recipe), in the order in which a job's document has them. `counts` is true where a
 * parameter has an effect in a recipe; what several parameters must fulfil together is checked by recipe_check.
 */
#define OBJECT_ALGORITHM "/ALGORITHM" /* the object of whichever algorithm the recipe has */
extern const struct parameter recipe_parameters[];
extern const int recipe_parameter_count;

/* True if the parameter is one of that algorithm's, be it beside other members alone, or none of an algorithm at all.
 */
bool algorithm_has(const struct algorithm *algorithm, const struct parameter *parameter);
/* Pointer of the object whose member the parameter is in a recipe with that algorithm. */
void recipe_object(const struct parameter *parameter, const struct algorithm *algorithm,
		   char ret_object[PARAMETER_POINTER_MAX]);
/* True if both recipes compute and keep the same; what has no effect does not count. */
bool recipe_same(const struct recipe *a, const struct recipe *b);

#endif
