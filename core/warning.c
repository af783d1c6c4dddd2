/* The table of warnings: code, severity and the sentence for a clinician. */
#include "core/warning.h"

#include <assert.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

const char *const severity_names[SEVERITY_COUNT] = {"info", "caution", "serious"};

const struct warning_kind warning_kinds[] = {
    /* ---- of the orbit and the detector ---- */
    {"arc_too_short", SEVERITY_CAUTION,
     "The arm turned less than half a circle and the fan: expect streaks and shading along some directions."},
    {"parker_weights", SEVERITY_INFO, "The scan covers a part of the circle, and is weighted as such."},
    {"displaced_detector", SEVERITY_INFO,
     "The detector was shifted to the side for a wider field of view, and the scan is weighted as such."},
    {"displaced_short_scan", SEVERITY_CAUTION,
     "The detector is shifted to the side, but the arm did not make a full turn: the image is reliable only near the "
     "centre."},
    {"tilted_orbit", SEVERITY_INFO, "The arm turned about an axis that is not the z axis; the image allows for it."},
    {"rotated_detector", SEVERITY_INFO, "The detector is turned about its own centre; the image allows for it."},
    {"no_field_of_view", SEVERITY_SERIOUS, "No place on the rotation axis is seen by all projections."},
    {"duplicate_angles", SEVERITY_CAUTION, "Some projections were taken at the same angle as another."},
    {"uneven_angles", SEVERITY_CAUTION, "There is a gap between the projections: expect streaks."},
    {"single_view", SEVERITY_SERIOUS, "There is only one projection: depth cannot be told from it."},
    {"not_converged", SEVERITY_CAUTION,
     "The reconstruction was ended before it could reach its full quality: dense parts may look too faint."},
    {"few_views", SEVERITY_SERIOUS,
     "There are too few projections, or all are from the same side: the image is not reliable."},
    {"implausible_lengths", SEVERITY_SERIOUS,
     "The distances of the scan are unlike those of any arm: sizes in the image may be wrong."},
    {"other_pitch", SEVERITY_CAUTION,
     "The size of the detector's pixels is given in two ways that differ: sizes in the image may be wrong."},
    {"isocentre_outside", SEVERITY_SERIOUS,
     "The centre of rotation falls outside of the detector: the calibration may be that of another detector."},
    {"mirrored_views", SEVERITY_SERIOUS, "Some projections are mirrored against the others: the image is wrong."},
    {"mirrored_columns", SEVERITY_SERIOUS, "The projections may be mirrored: left and right may be exchanged."},
    /* ---- of the projections against the geometry ---- */
    {"geometry_doubtful", SEVERITY_CAUTION,
     "The projections do not quite fit each other where the arm is said to have stood: fine detail may be blurred or "
     "doubled."},
    {"geometry_wrong", SEVERITY_SERIOUS,
     "The projections do not fit each other: the arm stood elsewhere than the scan says, or the patient moved; the "
     "image may be wrong."},
    {"other_direction", SEVERITY_SERIOUS,
     "The arm turned the other way than the scan says, or the projections are mirrored: left and right are exchanged "
     "in "
     "the image, and shapes are wrong."},
    {"breathing", SEVERITY_CAUTION,
     "Something in the patient moved to and fro while the arm turned, as with breathing: what moved is blurred or "
     "doubled in the image."},
    /* ---- of a calibration, and of a scan that uses one ---- */
    {"calibration_balls", SEVERITY_CAUTION,
     "The drawing of the phantom that the arm was calibrated with may have more or fewer balls than the phantom."},
    {"calibration_height", SEVERITY_CAUTION,
     "The phantom looks the same higher or lower along the arm's axis: images may be shifted along it by that much."},
    {"calibration_interpolated", SEVERITY_INFO,
     "The arm's places in this scan are interpolated between those that were calibrated."},
    {"calibration_old", SEVERITY_CAUTION,
     "The arm's calibration is older than it should be: fine detail may be blurred."},
    {"calibration_other_detector", SEVERITY_CAUTION,
     "The arm was calibrated with another detector: the image may be blurred or shifted."},
    {"calibration_other_sweep", SEVERITY_CAUTION, "The arm was calibrated on another sweep: the image may be blurred."},
    {"calibration_scale", SEVERITY_CAUTION,
     "The phantom may have another size than its drawing: sizes in images may be wrong."},
    {"calibration_shape", SEVERITY_CAUTION,
     "The phantom may be another than its drawing: the arm's places, and sizes in images, may be wrong."},
    {"calibration_turn", SEVERITY_CAUTION,
     "The phantom looks the same when it is turned: the arm's angles may be off by that turn."},
    {"calibration_turned", SEVERITY_SERIOUS,
     "The phantom stood turned on the table when the arm was calibrated: left, right, front and back may be wrong."},
    {"calibration_views", SEVERITY_INFO,
     "Some pictures of the phantom could not be used: the arm's places there are interpolated."},
    /* ---- of the samples ---- */
    {"beam_hardening", SEVERITY_CAUTION, "The correction for beam hardening looks wrong: gray values may be off."},
    {"lag_order", SEVERITY_CAUTION,
     "The projections seem not to be in the order in which they were taken: the correction of the detector's lag may "
     "do harm."},
    {"scatter_constant", SEVERITY_CAUTION,
     "Scattered radiation was taken for the same everywhere: gray values are off, most of all near the patient's "
     "surface."},
    {"scatter_faint", SEVERITY_CAUTION,
     "The images of scattered radiation hardly show any: they may be in another unit, and gray values are off then."},
    {"no_scatter", SEVERITY_CAUTION,
     "Images of scattered radiation that the scan announces are not there yet: it waits for them."},
    {"scatter_limited", SEVERITY_CAUTION,
     "The correction for scattered radiation wanted to take nearly all of the signal in some places: gray values may "
     "be wrong there."},
    {"scatter_exceeds", SEVERITY_SERIOUS,
     "The scattered radiation given for this scan is more than was measured in many places: the image may be wrong."},
    {"scatter_uneven", SEVERITY_CAUTION,
     "Images of scattered radiation from nearly the same direction differ too much: one of them is wrong, and gray "
     "values may be off."},
    {"scatter_spikes", SEVERITY_CAUTION,
     "Single pixels of the images of scattered radiation were wrong and were replaced from their neighbours."},
    {"air_saturated", SEVERITY_SERIOUS, "The value given for air is one at which the detector is saturated."},
    {"incomplete", SEVERITY_CAUTION, "The scan was broken off: the image is made of the projections that arrived."},
    {"no_flat", SEVERITY_SERIOUS, "The scan lacks its flat image: nothing can be reconstructed before it arrives."},
    {"implausible_images", SEVERITY_SERIOUS,
     "The flat or the dark image is unlike any that a detector makes: gray values may be wrong."},
    {"no_dark", SEVERITY_CAUTION, "The scan has a flat but no dark image: gray values may be too low."},
    {"files_missing", SEVERITY_SERIOUS, "The file of the projections is gone: the scan must be sent again."},
    {"damaged_projections", SEVERITY_SERIOUS,
     "The disk has damaged some projections: they must be sent again before the scan can be used."},
    {"damaged_image", SEVERITY_SERIOUS,
     "The disk has damaged a calibration image of the scan: it must be sent again before the scan can be used."},
    {"damaged_volume", SEVERITY_SERIOUS, "The disk has damaged this image: it must be made again."},
    {"damaged_checkpoint", SEVERITY_INFO,
     "What the job had saved for a restart was damaged on the disk and was left out; the result is the same."},
    {"fewer_devices", SEVERITY_INFO, "The job was computed on fewer devices than it asked for."},
    {"processor_fallback", SEVERITY_CAUTION,
     "The device that should have made the image failed: it is made by the processor, which takes longer; the result "
     "is the same."},
    {"defect_map", SEVERITY_INFO, "Bad pixels of the detector were replaced from their neighbours."},
    {"defects_wide", SEVERITY_SERIOUS,
     "Bad pixels of the detector are too many, or too close together, to be filled in: the image may be wrong there."},
    {"detector_shadow", SEVERITY_SERIOUS,
     "The edge of the detector lay in shadow in all projections, as behind a collimator, and nothing in the scan "
     "takes that off: it was left out, and the image shows less than the scan should."},
    {"stuck_pixels", SEVERITY_CAUTION,
     "Some pixels of the detector do not follow the others and were replaced from their neighbours."},
    {"rings", SEVERITY_INFO, "Some pixels of the detector had changed since it was calibrated, and were corrected."},
    {"geometry_refined", SEVERITY_INFO,
     "The arm did not stand as the scan says; where it stood was found from the projections."},
    {"geometry_by_reference", SEVERITY_CAUTION,
     "Where the arm stood was found by the volume of another scan: the image is right only if that is of the same "
     "object."},
    {"motion_followed", SEVERITY_CAUTION,
     "The object moved during the sweep; its motion was found from the projections."},
    {"not_refined", SEVERITY_INFO, "The geometry was kept as it is: no other one fits the projections better."},
    {"defects", SEVERITY_CAUTION, "Some samples could not be used and were replaced from their neighbours."},
    {"blank_views", SEVERITY_CAUTION, "Some projections are empty or show nothing, and were left out."},
    {"dark_parts", SEVERITY_CAUTION,
     "Some projections lack a part of the detector or show it with another signal; it was taken from other "
     "projections, or they were left out, where that was possible."},
    {"frozen_views", SEVERITY_CAUTION,
     "Some projections are copies of the ones before them, and were left out where that was possible."},
    {"dose_steps", SEVERITY_CAUTION,
     "Some projections were taken with another dose than those beside them, and were corrected or left out where that "
     "was possible."},
    {"shifted_views", SEVERITY_SERIOUS,
     "Some projections lie aside of the others, as when the patient or the arm moves; they were left out where that "
     "was "
     "possible."},
    {"misplaced_views", SEVERITY_SERIOUS,
     "Some projections were not taken where the scan says, as when they are exchanged; they were put in their places "
     "or left out, where that was possible."},
    {"spoiled_views", SEVERITY_SERIOUS,
     "Spoiled projections could neither be corrected nor left out: the image may be wrong."},
    {"no_object", SEVERITY_SERIOUS, "No projection shows anything: the image is empty."},
    {"air_region", SEVERITY_CAUTION, "The brightness of air changed during the scan, and was corrected."},
    {"air_level", SEVERITY_CAUTION,
     "Air is darker or brighter in some projections than it should be: gray values may be off."},
    {"brighter_than_air", SEVERITY_SERIOUS,
     "The projections are brighter than the flat image or the value for air: gray values are wrong."},
    {"line_integrals", SEVERITY_SERIOUS, "The projections' values are unlike line integrals: the image may be wrong."},
    {"byte_order", SEVERITY_SERIOUS, "The projections look like noise: their bytes may be in the wrong order."},
    /* ---- of the reconstruction ---- */
    {"truncated", SEVERITY_CAUTION,
     "The patient is wider than the detector: gray values are estimates, most of all near the rim of the image."},
    {"faint_from_zero", SEVERITY_SERIOUS,
     "The patient is wider than the detector, and the reconstruction began with an empty image: it is too faint, most "
     "of "
     "all towards its rim."},
    {"outside_grid", SEVERITY_INFO, "The patient goes on outside of the image, and the image allows for it."},
    {"averaged_pixels", SEVERITY_INFO,
     "The image's voxels are coarser than what the projections show, which was smoothed to fit them; smaller voxels "
     "would show more."},
    {"rays_left_out", SEVERITY_INFO,
     "There is something very dense in the image, metal or as dense as that: expect streaks around it."},
    {"very_dense", SEVERITY_CAUTION,
     "There is a lot that is very dense in the image, such as metal or very dense bone: expect streaks, and do not "
     "rely "
     "on gray values in it and beside it."},
    {"iterations_held_back", SEVERITY_CAUTION,
     "Iterations would make parts of the image rougher, by noise or by streaks, as of something dense in it or beside "
     "it: those stay nearer to the image that the iterations began with, after its noise reduction."},
    {"noise_beside_metal", SEVERITY_CAUTION,
     "The image is very noisy, as beside a lot of metal: fine detail is smoothed away, and gray values are estimates."},
    {"iterations_settled", SEVERITY_INFO,
     "The projections show more than the image can hold, finer detail or a part of the patient beyond the detector, so "
     "that later iterations change it less."},
    {"grid_unseen", SEVERITY_SERIOUS, "The image lies where no projection sees it: it shows nothing."},
    {"grid_too_small", SEVERITY_CAUTION, "The image was asked for as a single voxel or a line of voxels."},
    {"sparse_views", SEVERITY_CAUTION,
     "There are far fewer projections than so fine an image needs: expect streaks, most of all away from the centre."},
    {"slices_unseen", SEVERITY_CAUTION,
     "The first or last slices are not seen by all projections: their gray values are not reliable."},
    {"end_slices", SEVERITY_CAUTION,
     "The patient ends close to the first or the last slices of the image: their gray values are uncertain."},
    {"slices_smoothed", SEVERITY_INFO,
     "The projections do not show how neighbouring slices differ: the image is smoothed across slices."},
    {"residual_high", SEVERITY_SERIOUS,
     "The image does not agree with the projections: it may be wrong, or need far more iterations."},
    {"tv_without_sart", SEVERITY_INFO, "Noise reduction was asked for after iterations, and there were none."},
    {"tv_without_effect", SEVERITY_CAUTION,
     "The noise reduction that was asked for is too weak for this scan: the image is about as noisy as without it."},
    {"metal", SEVERITY_CAUTION, "There is metal: what is shown within 10 mm of it is an estimate."},
    {"no_metal", SEVERITY_INFO, "No metal was found in the image."},
    {0},
};

const struct warning_kind *warning_kind(const char *code)
{
	static const struct warning_kind other = {"", SEVERITY_CAUTION,
						  "There is a fact to look at; its detail says which."};
	const struct warning_kind *kind = warning_kinds;

	while (kind->code != NULL && strcmp(kind->code, code) != 0)
		kind++;
	return kind->code != NULL ? kind : &other;
}

bool warning_is_known(const char *code)
{
	return warning_kind(code)->code[0] != 0;
}

/* ---- lists of projections ---- */

void warning_views_add(struct warning_views *views, int projection)
{
	int *last = views->ranges > 0 ? views->range[views->ranges - 1] : NULL;

	views->count++;
	if (last != NULL && last[1] == projection - 1) {
		last[1] = projection;
	} else if (views->ranges < WARNING_RANGES_MOST) {
		views->range[views->ranges][0] = views->range[views->ranges][1] = projection;
		views->ranges++;
	}
}

void warning_views_describe(const struct warning_views *views, char *ret, size_t size)
{
	size_t used = 0;
	int told = 0;

	ret[0] = 0;
	for (int i = 0; i < views->ranges && used < size; i++) {
		const int *range = views->range[i];

		used += (size_t)(range[0] == range[1]
				     ? snprintf(ret + used, size - used, "%s%d", i > 0 ? ", " : "", range[0])
				     : snprintf(ret + used, size - used, "%s%d to %d", i > 0 ? ", " : "", range[0],
						range[1]));
		told += range[1] - range[0] + 1;
	}
	if (told < views->count && used < size)
		snprintf(ret + used, size - used, " and %d more", views->count - told);
}

/* "count left_out mended first-last first-last ...", as many ranges as the text has room for. */
static void write_views(const struct warning_views *views, char *ret, size_t size)
{
	size_t used = (size_t)snprintf(ret, size, "\t%d %d %d", views->count, views->left_out, views->mended);

	for (int i = 0; i < views->ranges; i++) {
		const int length = snprintf(ret + used, size - used, " %d-%d", views->range[i][0], views->range[i][1]);

		if (used + (size_t)length >= size) {
			ret[used] = 0;
			return;
		}
		used += (size_t)length;
	}
}

void warning_parse(const char *text, char ret_detail[WARNING_DETAIL_SIZE], struct warning_views *ret_views)
{
	const char *tab = strchr(text, '\t');
	const int length = tab != NULL ? (int)(tab - text) : (int)strlen(text);
	struct warning_views views = {0};
	int used = 0;

	snprintf(ret_detail, WARNING_DETAIL_SIZE, "%.*s", length, text);
	if (tab != NULL && sscanf(tab, "\t%d %d %d%n", &views.count, &views.left_out, &views.mended, &used) == 3) {
		for (const char *at = tab + used; views.ranges < WARNING_RANGES_MOST; at += used) {
			int *range = views.range[views.ranges];

			if (sscanf(at, " %d-%d%n", &range[0], &range[1], &used) != 2)
				break;
			views.ranges++;
		}
	}
	*ret_views = views;
}

static void tell(const struct warning_sink *sink, const char *code, const struct warning_views *views,
		 const char *format, va_list args)
{
	char text[WARNING_TEXT_SIZE];
	size_t used;

	assert(warning_is_known(code));
	if (sink->tell == NULL)
		return;
	vsnprintf(text, WARNING_DETAIL_SIZE, format, args);
	used = strlen(text);
	if (views != NULL && views->count > 0)
		write_views(views, text + used, sizeof(text) - used);
	sink->tell(sink->context, code, text);
}

void warning_tell_views(const struct warning_sink *sink, const char *code, const struct warning_views *views,
			const char *format, ...)
{
	va_list args;

	va_start(args, format);
	tell(sink, code, views, format, args);
	va_end(args);
}

void warning_tell(const struct warning_sink *sink, const char *code, const char *format, ...)
{
	va_list args;

	va_start(args, format);
	tell(sink, code, NULL, format, args);
	va_end(args);
}
