/*
 * A scan directory in, volumes out: reconstruction.h. A volume's file is there whole or not at all: it is written
 * beside its place, synced and renamed; every return value on that way counts.
 */
#include "proto/reconstruction.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/algebra.h"
#include "core/cards/cards.h"
#include "core/recon/algorithm.h"
#include "core/correct/rings.h"
#include "core/correct/scatter_images.h"
#include "core/correct/shadow.h"
#include "core/correct/stuck.h"
#include "core/pulse.h"
#include "core/scan/crop.h"
#include "proto/calibration_files.h"
#include "proto/checkpoint.h"
#include "proto/durable.h"
#include "proto/format.h"
#include "proto/nifti.h"
#include "proto/reference.h"
#include "proto/refinement.h"
#include "proto/refining_file.h"
#include "proto/saver.h"
#include "proto/seal.h"
#include "proto/sums.h"
#include "proto/scan_directory.h"
#include "proto/scatter_file.h"

_Static_assert((int)VOLUME_FILE_OFFSET == (int)NIFTI_VOXELS, "a NIfTI-1 header and its extension");

enum {
	READ_BYTES = 8 << 20,  /* projections in one go: small beside the scan, large beside a system call */
	PIECE_BYTES = 8 << 20, /* voxels in one go through memory of their own, on their way to the disk */
	PLACE_BYTES = 64 << 20 /* straight into a file: long enough for a device to overlap its own pieces */
};

/*
 * s that a disk may take for one step: a disk that is spun down, or busy with another's writes, is waited for, for as
 * long as the kernel waits for a disk's answer. Large files are read, written and synced in pieces, each of them a
 * step.
 */
static const double SLOW_DISK = 30;

struct run {
	const struct reconstruction_hooks *hooks;
	const char *directory;
	const struct recipe *recipe;
	struct recon *recon;               /* NULL before it is opened */
	double told, before;               /* the fraction that was told last, and that when it was opened last */
	struct checkpointer *checkpointer; /* NULL where nobody asks for checkpoints */
	struct history history;            /* of the iterations so far */
	struct provenance provenance;
	bool sealed; /* the volumes' files */
	bool ahead;  /* the next volume's file is prepared while the device computes */
	bool prepared;
	struct saver *saver; /* NULL before the first */
	/* The volume that was written last: "final" may be the same iterate. Announced, and settled while the run goes
	 * on. */
	struct saved_volume saved; /* no bytes: there is none */
	char saved_name[32], saved_stage[16];
	int saved_iteration;
	struct saved_volume link; /* another name of it, announced and not settled; no bytes: there is none */
	char link_name[32];
	struct error trouble; /* what stopped the run from a question of its */
};

static int settle(struct run *run, bool wait, struct error *err);

/* Until the next call, with false, the steps are those of a disk. */
static void disk_steps(struct run *run, bool begin)
{
	if (run->hooks->on_step != NULL)
		run->hooks->on_step(run->hooks->recon.context, begin ? SLOW_DISK : 0);
}

/* Asked so often that a volume is reported settled soon after it is. */
static bool run_cancelled(void *context)
{
	struct run *run = context;
	const struct reconstruction_hooks *hooks = run->hooks;

	if (run->trouble.code == 0)
		settle(run, false, &run->trouble);
	if (run->trouble.code != 0)
		return true;
	return hooks->recon.cancelled != NULL && hooks->recon.cancelled(hooks->recon.context);
}

/* Announces a checkpoint that has reached the disk. */
static int announce_checkpoint(struct run *run, bool wait, struct error *err)
{
	int iteration, code = checkpointer_settled(run->checkpointer, wait, &iteration, err);

	if (code == 0 && iteration > 0)
		code = run->hooks->on_checkpoint(run->hooks->recon.context, iteration, err);
	return code;
}

/* Seconds that the iterations to come take if each takes as long as those so far; rules may end them sooner. */
static double seconds_left(const struct run *run)
{
	const struct history *history = &run->history;
	const int left = recipe_iterations(run->recipe) - recon_iteration(run->recon);

	return history->count > 0 ? left * history->seconds / history->count : INFINITY;
}

/*
 * Behind an iteration that is not the last. The volumes that were announced are on the disk before a checkpoint is
 * begun: a run that goes on from it would not make them again.
 */
static int keep_checkpoint(struct run *run, struct error *err)
{
	const double left = seconds_left(run);
	int code = announce_checkpoint(run, false, err);

	if (code != 0)
		return code;
	if (!checkpointer_due(run->checkpointer, left)) {
		checkpointer_prepare(run->checkpointer, run->recon, &run->history, left);
		return 0;
	}
	code = settle(run, false, err);
	if (code != 0 || (run->saver != NULL && saver_busy(run->saver)))
		return code;
	disk_steps(run, true);
	code = checkpointer_begin(run->checkpointer, run->recon, &run->history, err);
	disk_steps(run, false);
	return code;
}

static bool run_yield(void *context)
{
	struct run *run = context;
	const struct reconstruction_hooks *hooks = run->hooks;

	if (hooks->recon.yield != NULL && hooks->recon.yield(hooks->recon.context))
		return true;
	/* The run's next question is whether it is cancelled, which the trouble answers. */
	if (run->checkpointer != NULL && run->trouble.code == 0 && recon_iteration(run->recon) > 0)
		keep_checkpoint(run, &run->trouble);
	return false;
}

static void prepare(struct run *run, enum stage stage, int iteration);

static void run_progress(void *context, enum stage stage, int iteration, double fraction)
{
	struct run *run = context;
	const struct reconstruction_hooks *hooks = run->hooks;

	run->told = run->before + (1 - run->before) * fraction;
	if (stage != STAGE_FDK) /* FDK's progress is reported with every projection: push_some */
		prepare(run, stage, iteration);
	if (hooks->recon.progress != NULL)
		hooks->recon.progress(hooks->recon.context, stage, iteration, run->told);
}

static void run_row(void *context, const struct history_row *row)
{
	struct run *run = context;
	const struct reconstruction_hooks *hooks = run->hooks;

	/* The run's next question is whether it is cancelled, which the trouble answers. */
	if (run->trouble.code == 0)
		history_add(&run->history, row, &run->trouble);
	if (hooks->recon.row != NULL)
		hooks->recon.row(hooks->recon.context, row);
}

static void run_denoising(void *context, double noise_hu, double alpha)
{
	const struct reconstruction_hooks *hooks = ((struct run *)context)->hooks;

	if (hooks->recon.denoising != NULL)
		hooks->recon.denoising(hooks->recon.context, noise_hu, alpha);
}

static void run_agreement(void *context, const struct recon_agreement *agreement)
{
	const struct reconstruction_hooks *hooks = ((struct run *)context)->hooks;

	if (hooks->recon.agreement != NULL)
		hooks->recon.agreement(hooks->recon.context, agreement);
}

static void run_stopped(void *context, const struct recon_stop *stop)
{
	const struct reconstruction_hooks *hooks = ((struct run *)context)->hooks;

	if (hooks->recon.stopped != NULL)
		hooks->recon.stopped(hooks->recon.context, stop);
}

static void run_warning(void *context, const char *code, const char *detail)
{
	const struct reconstruction_hooks *hooks = ((struct run *)context)->hooks;

	if (hooks->recon.warning != NULL)
		hooks->recon.warning(hooks->recon.context, code, detail);
}

/* ---- kept volumes ---- */

static void set_text(char *ret, size_t size, const char *text)
{
	snprintf(ret, size, "%s", text != NULL ? text : "");
}

/* Slices of one piece: whole ones, at least one. */
static int slices_of_a_piece(const struct grid *grid, size_t bytes, size_t *ret_slice)
{
	size_t slice = (size_t)grid->size[0] * (size_t)grid->size[1] * sizeof(float);
	int slices = slice < bytes ? (int)(bytes / slice) : 1;

	*ret_slice = slice;
	return slices < grid->size[2] ? slices : grid->size[2];
}

static bool emits(const struct recipe *recipe, int what)
{
	for (int i = 0; i < recipe->emits; i++) {
		if (recipe->emit[i] == what)
			return true;
	}
	return false;
}

/* Whether a volume is kept at the end of what begins. That a stop rule ends the iterations cannot be known. */
static bool ends_with_volume(const struct recipe *recipe, enum stage stage, int iteration)
{
	bool tv = recipe->tv.on && recipe->tv.after_fdk;

	if (stage == STAGE_FDK)
		return recipe->fdk.on && (emits(recipe, EMIT_FDK) || (recipe->algorithm == NULL && !tv));
	if (stage == STAGE_TV && iteration == 0)
		return emits(recipe, EMIT_FDK_TV) || recipe->algorithm == NULL;
	return recipe->algorithm != NULL && stage == recipe->algorithm->stage &&
	       (iteration == recipe_iterations(recipe) || emits(recipe, iteration));
}

static int open_saver(struct run *run, struct error *err)
{
	return run->saver != NULL ? 0 : saver_new(run->sealed, &run->saver, err);
}

/* Soon after the beginning of a stage: the file that it ends with, where the processor has nothing better to do. */
static void prepare(struct run *run, enum stage stage, int iteration)
{
	struct error ignored;
	char path[PATH_MAX];

	if (!run->ahead || run->prepared || run->recon == NULL || !ends_with_volume(run->recipe, stage, iteration) ||
	    path_join(path, sizeof(path), run->directory, "blank", "", &ignored) != 0 || open_saver(run, &ignored) != 0)
		return;
	run->prepared = true;
	saver_prepare(run->saver, path, VOLUME_FILE_OFFSET + grid_voxels(recon_grid(run->recon)) * sizeof(float));
}

static int announce_settled(struct run *run, const char *name, struct error *err)
{
	if (run->hooks->on_settled == NULL)
		return 0;
	return run->hooks->on_settled(run->hooks->recon.context, name, err);
}

static int settle_link(struct run *run, struct error *err)
{
	int code = durable_sync_names(run->link.path, err);

	if (code != 0)
		unlink(run->link.path);
	run->link.bytes = 0;
	return code != 0 ? code : announce_settled(run, run->link_name, err);
}

/* Announces when the volume that was saved last is settled; waits for that where it must. */
static int settle(struct run *run, bool wait, struct error *err)
{
	bool done = true;
	int code = 0;

	if (run->saver != NULL && saver_busy(run->saver)) {
		code = saver_finish(run->saver, wait, &done, err);
		if (code != 0) {
			if (run->link.bytes > 0)
				unlink(run->link.path);
			run->saved.bytes = run->link.bytes = 0;
		}
		if (code == 0 && done)
			code = announce_settled(run, run->saved_name, err);
	}
	if (code == 0 && done && run->link.bytes > 0)
		code = settle_link(run, err);
	return code;
}

/* The iterate as it is now, straight into its file. */
static int write_voxels(struct run *run, struct recon *recon, struct error *err)
{
	const struct grid *grid = recon_grid(recon);
	size_t slice;
	int slices = slices_of_a_piece(grid, PLACE_BYTES, &slice), code = 0;

	for (int z = 0; z < grid->size[2] && code == 0; z += slices) {
		int count = z + slices <= grid->size[2] ? slices : grid->size[2] - z;
		void *place;

		code = saver_piece(run->saver, (size_t)count * slice, &place, err);
		if (code == 0)
			code = recon_read(recon, z, count, place, err);
		if (code == 0)
			saver_give(run->saver, (size_t)count * slice);
	}
	if (code != 0) {
		saver_abandon(run->saver);
		return code;
	}
	return saver_end(run->saver, err);
}

/* Header and voxels under the volume's own name. */
static int write_volume(struct run *run, struct recon *recon, const struct kept_volume *kept,
			struct saved_volume *saved, struct error *err)
{
	uint8_t header[FORMAT_HEADER_MAX];
	size_t length;
	int code = open_saver(run, err);

	if (code != 0)
		return code;
	/* Nothing of the name: "final" may be a link to this file. */
	snprintf(run->provenance.stage, sizeof(run->provenance.stage), "%s", kept->stage);
	run->provenance.iteration = kept->iteration;
	code = volume_formats[0].header(kept->grid, VOLUME_FLOAT32, &run->provenance, header, &length, err);
	if (code != 0)
		return code;
	run->prepared = false;
	code = saver_begin(run->saver, saved->path, header, length, saved->bytes, err);
	if (code == 0)
		code = write_voxels(run, recon, err);
	if (code != 0)
		return code;
	saved->written = saver_written(run->saver);
	run->saved = *saved;
	run->saved_iteration = kept->iteration;
	snprintf(run->saved_name, sizeof(run->saved_name), "%s", kept->name);
	snprintf(run->saved_stage, sizeof(run->saved_stage), "%s", kept->stage);
	return 0;
}

/* As another name of the volume that was written last, where it is the same and the file system can do that. */
static int link_volume(struct run *run, const struct kept_volume *kept, struct saved_volume *saved, bool *ret_linked,
		       struct error *err)
{
	bool same = run->saved.bytes > 0 && run->saved_iteration == kept->iteration &&
		    strcmp(run->saved_stage, kept->stage) == 0;
	/* A file that had the name before is lost for one that will not be. */
	int code = same && access(saved->path, F_OK) == 0 ? settle(run, true, err) : 0;

	if (code == 0 && same)
		code = durable_link(run->saved.path, saved->path, ret_linked, err);
	if (code == 0 && *ret_linked) {
		saved->written = run->saved.written;
		run->link = *saved;
		snprintf(run->link_name, sizeof(run->link_name), "%s", kept->name);
	}
	return code;
}

static int run_keep(void *context, struct recon *recon, const struct kept_volume *kept, struct error *err)
{
	struct run *run = context;
	struct saved_volume saved = {.bytes = grid_voxels(kept->grid) * sizeof(float)};
	bool linked = false;
	int code = path_join(saved.path, sizeof(saved.path), run->directory, kept->name, ".nii", err);

	disk_steps(run, true);
	if (code == 0)
		code = link_volume(run, kept, &saved, &linked, err);
	if (code == 0 && !linked)
		code = settle(run, true, err);
	if (code == 0 && !linked)
		code = write_volume(run, recon, kept, &saved, err);
	disk_steps(run, false);
	if (code == 0 && run->hooks->on_volume != NULL)
		code = run->hooks->on_volume(run->hooks->recon.context, kept, &saved, err);
	return code != 0 ? code : settle(run, false, err);
}

/* ---- the three steps ---- */

struct reconstruction {
	struct run run;
	struct recon_hooks hooks;
	struct scan_files files;
	int pushed;    /* views that the recon has: the first of them */
	int batch;     /* projections that are read at once */
	int *views;    /* [batch] */
	char *samples; /* [batch][row][column] */
	struct recon *recon;
	bool resumed;
	/* Parameters that the recon is opened with. */
	const struct backend *backend;
	struct device *device;
	const struct reconstruction_options *options;
	int iteration; /* that the checkpoint is expected to hold */
	int announced; /* projections of scan.json, also those that never come */
	struct linearise linearise;
	/* Looks for stuck pixels in the views as they pass; NULL before the recon is opened, and where too few are. */
	struct stuck *stuck;
	/* Looks for shadows in the same views. Where there are any, the lit part is the detector, images included. */
	struct shadow *shadow;
	struct pixel_area lit;
	struct geometry lit_geometry; /* owned; no views: all of the detector is lit */
	void *lit_image[IMAGE_COUNT], *lit_stuck;
	struct scatter_file scatter; /* where the scan has images of it */
	int *scattered;              /* [images], the projections that have one */
	struct scatter_source scatter_source;
	float *errors, *flat;  /* of pixels' gain, and the image that has them; NULL where there are none */
	bool looked;           /* what is asked of all views for their pixels is known */
	bool refined;          /* what is asked of all views for their poses is known */
	bool keeps_all;        /* all projections are kept, so that spoiled ones can be mended */
	struct geometry poses; /* that were found, owned; no views: the scan's own */
};

static int projection_of(const struct reconstruction *reconstruction, int view)
{
	const int *projection = reconstruction->files.scan->projection;

	return projection == NULL ? view : projection[view];
}

/* Of the detector that the views are taken from. */
static const struct geometry *detector_geometry(const struct reconstruction *reconstruction)
{
	return reconstruction->lit_geometry.views != NULL ? &reconstruction->lit_geometry
							  : &reconstruction->files.scan->geometry;
}

static int allocate(struct reconstruction *reconstruction, struct error *err)
{
	size_t bytes = scan_projection_bytes(reconstruction->files.scan);

	reconstruction->batch = bytes < READ_BYTES ? (int)(READ_BYTES / bytes) : 1;
	if (reconstruction->batch > reconstruction->files.scan->count)
		reconstruction->batch = reconstruction->files.scan->count;
	reconstruction->views = malloc((size_t)reconstruction->batch * sizeof(*reconstruction->views));
	reconstruction->samples = malloc((size_t)reconstruction->batch * bytes);
	if (reconstruction->views == NULL || reconstruction->samples == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d projections of %zu bytes", reconstruction->batch,
				 bytes);
	return 0;
}

static int read_scatter(void *context, int at, float *ret_image, struct error *err)
{
	const struct reconstruction *reconstruction = context;
	const struct scatter_file *file = &reconstruction->scatter;
	struct sum sum;

	return scatter_file_read(file,
				 scatter_image_of(&file->images, file->projections, reconstruction->scattered[at]),
				 ret_image, &sum, err);
}

/* Opens the images of scatter, where the scan has any: those of the projections that are present. */
static int open_scatter(struct reconstruction *reconstruction, struct error *err)
{
	const struct reconstruction_options *options = reconstruction->options;
	const struct scatter_images *images = &reconstruction->files.scan->scatter.images;
	struct scatter_source *source = &reconstruction->scatter_source;
	struct scatter_file *file = &reconstruction->scatter;
	bool whole;
	int code;

	if (images->columns == 0)
		return 0;
	code = scatter_file_open(options->scan_directory, images, reconstruction->announced, false, file, &whole, err);
	if (options->checked && (code == ERR_NOT_FOUND || code == ERR_INVALID || (code == 0 && file->sums < 0)))
		return error_set(err, ERR_DAMAGED, "the scan's images of scatter are damaged");
	if (code != 0)
		return code;
	reconstruction->scattered = malloc((size_t)file->count * sizeof(*reconstruction->scattered));
	if (reconstruction->scattered == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a list of %d images", file->count);
	for (int i = 0; i < file->count; i++) {
		const int projection = scatter_image_projection(images, file->projections, i);

		if (options->present == NULL || options->present[projection])
			reconstruction->scattered[source->count++] = projection;
	}
	source->context = reconstruction;
	source->projections = reconstruction->scattered;
	source->read = read_scatter;
	return 0;
}

static int set_linearise(struct reconstruction *reconstruction, struct error *err)
{
	const struct scan_files *files = &reconstruction->files;
	struct linearise *linearise = &reconstruction->linearise;

	*linearise = scan_linearise(files->scan);
	for (int i = 0; i < IMAGE_COUNT; i++)
		linearise->image[i] = files->image[i];
	linearise->scatter_source = &reconstruction->scatter_source;
	if (linearise->quantity == QUANTITY_INTENSITY && linearise->air <= 0 && linearise->image[IMAGE_FLAT] == NULL)
		return error_set(err, ERR_IMPOSSIBLE, "intensities need an air value or a flat image, none is there");
	return 0;
}

/* The last iteration behind which no volume has been kept since `iteration`: a run that began later would lack one. */
static int latest_checkpoint(const struct recipe *recipe, int iteration)
{
	int latest = INT_MAX;

	for (int i = 0; i < recipe->emits; i++) {
		if (recipe->emit[i] > iteration && recipe->emit[i] <= latest)
			latest = recipe->emit[i] - 1;
	}
	return latest;
}

static int resume(struct reconstruction *reconstruction, struct error *err)
{
	struct run *run = &reconstruction->run;
	const int known = reconstruction->iteration;
	const struct checkpoint_target target = {.iteration = known,
						 .latest = latest_checkpoint(reconstruction->options->recipe, known)};
	struct error damage;
	char detail[512];
	int code =
	    checkpoint_resume(run->recon, reconstruction->options->checkpoint, &target, &run->history, &damage, err);

	if (code != 0)
		return code;
	/* Opened again, it causes no second warning, and no row comes twice. */
	reconstruction->iteration = recon_iteration(run->recon);
	if (damage.code != 0) {
		snprintf(detail, sizeof(detail), "%.350s; the job went on behind iteration %d", damage.text,
			 reconstruction->iteration);
		run_warning(run, "damaged_checkpoint", detail);
	}
	for (int i = 0; i < run->history.count && run->hooks->recon.row != NULL; i++) {
		if (run->history.rows[i].iteration > known)
			run->hooks->recon.row(run->hooks->recon.context, &run->history.rows[i]);
	}
	return 0;
}

static bool looks_for_poses(const struct reconstruction *reconstruction)
{
	const struct recipe *recipe = reconstruction->options->recipe;

	return (recipe->refine.geometry || recipe->refine.motion) && !reconstruction->refined;
}

/* Before the geometry is refined no iteration is gone on from: it stands on another geometry. */
static int open_recon(struct reconstruction *reconstruction, struct error *err)
{
	const struct geometry *geometry =
	    reconstruction->poses.views != NULL ? &reconstruction->poses : detector_geometry(reconstruction);
	struct recipe recipe = *reconstruction->options->recipe;
	int code;

	if (reconstruction->refined) {
		recipe.refine.geometry = recipe.refine.motion = false;
		recipe.refine.reference[0] = '\0';
	}
	recipe.keep_all = reconstruction->keeps_all;
	code = recon_open(reconstruction->backend, reconstruction->device, geometry, &reconstruction->linearise,
			  &recipe, &reconstruction->hooks, &reconstruction->recon, err);
	reconstruction->run.recon = reconstruction->recon;
	return code == 0 && reconstruction->resumed && !looks_for_poses(reconstruction) ? resume(reconstruction, err)
											: code;
}

/* Opens the reconstruction anew, without a projection. */
static int open_again(struct reconstruction *reconstruction, struct error *err)
{
	recon_free(reconstruction->recon);
	reconstruction->recon = NULL;
	reconstruction->run.recon = NULL;
	reconstruction->run.before = reconstruction->run.told;
	reconstruction->pushed = 0;
	return open_recon(reconstruction, err);
}

static int open_first(struct reconstruction *reconstruction, struct error *err)
{
	const struct reconstruction_hooks *hooks = reconstruction->run.hooks;
	const struct geometry *geometry = &reconstruction->files.scan->geometry;
	int code = set_linearise(reconstruction, err);

	if (code == 0)
		code = open_recon(reconstruction, err);
	if (code == 0)
		code = stuck_new(&reconstruction->linearise, geometry, reconstruction->backend != &backend_cpu,
				 &reconstruction->stuck, err);
	if (code == 0 && reconstruction->stuck != NULL)
		code = shadow_new(&reconstruction->linearise, geometry, STUCK_VIEWS, &reconstruction->shadow, err);
	if (code == 0 && hooks->on_open != NULL)
		hooks->on_open(hooks->recon.context, recon_memory_taken(reconstruction->recon),
			       recon_plan(reconstruction->recon));
	return code;
}

/* Rows of a view, unverified: all of the view is when it is pushed. */
static int read_rows(void *context, int view, int first, int rows, void *to, struct error *err)
{
	const struct reconstruction *reconstruction = context;
	const struct scan_files *files = &reconstruction->files;
	const struct geometry *whole = &files->scan->geometry, *lit = detector_geometry(reconstruction);
	const size_t bytes = scan_projection_bytes(files->scan), row = bytes / (size_t)whole->rows;
	const size_t pixel = row / (size_t)whole->columns, lit_row = pixel * (size_t)lit->columns;
	const size_t at = (size_t)projection_of(reconstruction, view) * bytes +
			  row * (size_t)(reconstruction->lit.first[1] + first) +
			  pixel * (size_t)reconstruction->lit.first[0];
	int code = 0;

	if (lit_row == row)
		return file_read_at(files->projections, to, row * (size_t)rows, at, "projections.raw", err);
	for (int i = 0; i < rows && code == 0; i++)
		code = file_read_at(files->projections, (char *)to + (size_t)i * lit_row, lit_row, at + (size_t)i * row,
				    "projections.raw", err);
	return code;
}

/* Looks for errors of pixels' gain, beside the stuck ones; with an image that has them they are gone from counts. */
static int look_for_rings(struct reconstruction *reconstruction, struct error *err)
{
	const struct geometry *geometry = detector_geometry(reconstruction);
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	const struct rings_source source = {read_rows, reconstruction};
	const struct cancel cancel = {run_cancelled, &reconstruction->run};
	struct linearise *linearise = &reconstruction->linearise;
	struct rings_found found;
	char detail[160];
	int code;

	reconstruction->errors = malloc(pixels * sizeof(*reconstruction->errors));
	if (reconstruction->errors == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory to look for rings");
	disk_steps(&reconstruction->run, true);
	code = rings_find(linearise, geometry, &source, &cancel, reconstruction->errors, &found, err);
	disk_steps(&reconstruction->run, false);
	if (code == 0 && found.pixels > 0 && linearise->quantity == QUANTITY_INTENSITY) {
		reconstruction->flat = rings_flat(linearise, reconstruction->errors, pixels);
		if (reconstruction->flat == NULL)
			return error_set(err, ERR_NO_MEMORY, "no memory for a flat image");
		linearise->image[IMAGE_FLAT] = reconstruction->flat;
	}
	if (code < 0 || found.pixels == 0 || reconstruction->flat != NULL) {
		free(reconstruction->errors);
		reconstruction->errors = NULL;
	}
	if (code == 0 && found.pixels > 0) {
		snprintf(
		    detail, sizeof(detail),
		    "%zu pixels have another gain than the flat image says, by %.2g %% (root mean square): they are "
		    "mended",
		    found.pixels, 100 * found.rms);
		run_warning(&reconstruction->run, "rings", detail);
	}
	return code;
}

static bool looks_for_rings(const struct reconstruction *reconstruction)
{
	return reconstruction->options->recipe->rings;
}

/* ---- edges of the detector in shadow ---- */

static int crop_image(const struct reconstruction *reconstruction, const void *image, size_t pixel_bytes,
		      void **ret_cropped, struct error *err)
{
	const struct pixel_area *lit = &reconstruction->lit;

	*ret_cropped = malloc((size_t)lit->count[0] * (size_t)lit->count[1] * pixel_bytes);
	if (*ret_cropped == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for an image of %d x %d pixels", lit->count[0],
				 lit->count[1]);
	pixels_crop(image, pixel_bytes, reconstruction->files.scan->geometry.columns, lit, *ret_cropped);
	return 0;
}

/* Pixels beside a border that are held against those in shadow follow them badly; none of these is stuck. */
static void forget_stuck_beside(const struct shadow_found *found, const struct pixel_area *lit, unsigned char *map)
{
	enum { BESIDE = 3 };

	for (int row = 0; row < lit->count[1]; row++)
		for (int column = 0; column < lit->count[0]; column++)
			if ((found->before[0] > 0 && column < BESIDE) || (found->before[1] > 0 && row < BESIDE) ||
			    (found->behind[0] > 0 && column >= lit->count[0] - BESIDE) ||
			    (found->behind[1] > 0 && row >= lit->count[1] - BESIDE))
				map[(size_t)row * (size_t)lit->count[0] + (size_t)column] = 0;
}

/* An air region becomes its lit part; one without any is none. */
static void crop_region(const struct pixel_area *lit, struct linearise *linearise)
{
	for (int i = 0; i < 2; i++) {
		const int from = linearise->air_region[i] - lit->first[i];
		const int to = linearise->air_region[2 + i] - lit->first[i];

		linearise->has_air_region = linearise->has_air_region && to >= 0 && from < lit->count[i];
		linearise->air_region[i] = from > 0 ? from : 0;
		linearise->air_region[2 + i] = to < lit->count[i] ? to : lit->count[i] - 1;
	}
}

/* The images and the geometry of what is lit. */
static int crop_detector(struct reconstruction *reconstruction, const struct shadow_found *found, struct error *err)
{
	const struct geometry *whole = &reconstruction->files.scan->geometry;
	struct linearise *linearise = &reconstruction->linearise;
	struct pixel_area *lit = &reconstruction->lit;
	int code = 0;

	*lit = (struct pixel_area){
	    {found->before[0], found->before[1]},
	    {whole->columns - found->before[0] - found->behind[0], whole->rows - found->before[1] - found->behind[1]}};
	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		if (linearise->image[i] == NULL)
			continue;
		code = crop_image(reconstruction, linearise->image[i], image_bytes(i, 1, 1),
				  &reconstruction->lit_image[i], err);
		linearise->image[i] = reconstruction->lit_image[i];
	}
	if (code == 0 && linearise->stuck != NULL) {
		code = crop_image(reconstruction, linearise->stuck, 1, &reconstruction->lit_stuck, err);
		linearise->stuck = reconstruction->lit_stuck;
		if (code == 0)
			forget_stuck_beside(found, lit, reconstruction->lit_stuck);
	}
	crop_region(lit, linearise);
	memcpy(reconstruction->scatter_source.outside,
	       (int[]){found->before[0], found->behind[0], found->before[1], found->behind[1]},
	       sizeof(reconstruction->scatter_source.outside));
	return code == 0 ? geometry_crop(&reconstruction->lit_geometry, whole, lit, err) : code;
}

/* "the first 12 and the last 9 of 80 columns"; empty where none is in shadow. */
static void describe_shadow(int before, int behind, int all, const char *name, char *ret, size_t size)
{
	if (before > 0 && behind > 0)
		snprintf(ret, size, "the first %d and the last %d of %d %s", before, behind, all, name);
	else if (before > 0 || behind > 0)
		snprintf(ret, size, "the %s %d of %d %s", before > 0 ? "first" : "last", before + behind, all, name);
	else
		ret[0] = 0;
}

/* What the samples are divided by, if anything is known of it, does not have the shadow. */
static const char *unshadowed(const struct linearise *linearise)
{
	if (linearise->quantity == QUANTITY_LINE_INTEGRAL)
		return ", as where line integrals were made with a flat image that lacks the shadow";
	if (linearise->image[IMAGE_FLAT] == NULL)
		return ", and there is no flat image to divide by";
	return ", and not in the flat image";
}

static void tell_shadow(struct reconstruction *reconstruction, const struct shadow_found *found)
{
	const struct geometry *whole = &reconstruction->files.scan->geometry;
	char columns[80], rows[80], detail[420];

	describe_shadow(found->before[0], found->behind[0], whole->columns, "columns", columns, sizeof(columns));
	describe_shadow(found->before[1], found->behind[1], whole->rows, "rows", rows, sizeof(rows));
	snprintf(
	    detail, sizeof(detail),
	    "%s%s%s are darker than those beside them, by line integrals of %.2g to %.2g, in all of %d projections "
	    "looked at%s: they were left out",
	    columns, columns[0] != 0 && rows[0] != 0 ? " and " : "", rows, (double)found->least, (double)found->most,
	    found->views, unshadowed(&reconstruction->linearise));
	run_warning(&reconstruction->run, "detector_shadow", detail);
}

/* Looks for edges in shadow, and takes what is lit for the detector. */
static int look_for_shadow(struct reconstruction *reconstruction, struct error *err)
{
	struct shadow_found found;
	int code = reconstruction->shadow != NULL ? shadow_find(reconstruction->shadow, &found, err) : 0;

	if (code <= 0)
		return code;
	tell_shadow(reconstruction, &found);
	return crop_detector(reconstruction, &found, err);
}

/* The lit parts of a batch, one after the other. */
static void crop_samples(struct reconstruction *reconstruction, int count)
{
	const size_t bytes = scan_projection_bytes(reconstruction->files.scan);
	const struct geometry *whole = &reconstruction->files.scan->geometry;
	const size_t pixel = bytes / ((size_t)whole->columns * (size_t)whole->rows);
	const size_t lit = (size_t)reconstruction->lit.count[0] * (size_t)reconstruction->lit.count[1] * pixel;

	for (int i = 0; i < count; i++)
		pixels_crop(reconstruction->samples + (size_t)i * bytes, pixel, whole->columns, &reconstruction->lit,
			    reconstruction->samples + (size_t)i * lit);
}

/*
 * Called once all views that tell of pixels have come. Where pixels are stuck or in shadow, or have another gain, the
 * reconstruction is opened anew without them, *ret_again, and has none of the projections: earlier ones went in with
 * these pixels.
 */
static int heed_pixels(struct reconstruction *reconstruction, bool *ret_again, struct error *err)
{
	int code = 0;

	*ret_again = false;
	if (reconstruction->looked)
		return 0;
	reconstruction->looked = true;
	if (reconstruction->stuck != NULL)
		reconstruction->linearise.stuck = stuck_find(reconstruction->stuck);
	code = look_for_shadow(reconstruction, err);
	if (code == 0 && looks_for_rings(reconstruction))
		code = look_for_rings(reconstruction, err);
	*ret_again = reconstruction->linearise.stuck != NULL || reconstruction->flat != NULL ||
		     reconstruction->errors != NULL || reconstruction->lit_geometry.views != NULL;
	if (code < 0 || !*ret_again)
		return code;
	return open_again(reconstruction, err);
}

static int write_refined(const struct reconstruction *reconstruction, const struct refined *refined, struct error *err)
{
	cJSON *document = refined_json(refined);
	char path[1200];
	int code = document == NULL
		       ? error_set(err, ERR_NO_MEMORY, "no memory for what was refined")
		       : path_join(path, sizeof(path), reconstruction->run.directory, REFINEMENT_FILE, "", err);

	if (code == 0)
		code = reconstruction->run.sealed ? sealed_write(path, document, err)
						  : unsealed_write(path, document, err);
	cJSON_Delete(document);
	return code;
}

/* What was changed stands in a file of the job before it is told. */
static int tell_refinement(struct reconstruction *reconstruction, const struct refinement *refinement,
			   struct error *err)
{
	const struct geometry *whole = &reconstruction->files.scan->geometry;
	const enum refine_kind kind = reconstruction->options->recipe->refine.motion ? REFINE_MOTION : REFINE_GEOMETRY;
	struct refined refined;
	char detail[400];
	const char *warning;
	int code = refined_open(&refined, refinement, kind, whole->count, err);

	if (code < 0)
		return code;
	for (int k = 0; k < refined.count; k++) {
		double motion[PATH_NUMBERS];

		recon_motion(reconstruction->recon, refinement, k, motion);
		refine_change(kind, &whole->views[k], motion, refined.change[k]);
		refined.views[k] = view_of_moved(&whole->views[k], motion);
		refined.projections[k] = projection_of(reconstruction, k);
	}
	refined_measure(&refined);
	code = write_refined(reconstruction, &refined, err);
	warning = refined_tell(&refined, detail, sizeof(detail));
	if (code == 0 && !reconstruction->resumed)
		run_warning(&reconstruction->run, warning, detail);
	refined_clear(&refined);
	return code;
}

/* No voxels where the recipe names none. */
static int read_reference(struct reconstruction *reconstruction, struct refine_reference *ret_reference,
			  struct error *err)
{
	const struct reconstruction_options *options = reconstruction->options;
	int code;

	if (options->recipe->refine.reference[0] == '\0')
		return 0;
	if (options->reference == NULL)
		return error_set_at(err, ERR_IMPOSSIBLE, "/refine/reference",
				    "a reference is a job of a daemon's: here there is none");
	disk_steps(&reconstruction->run, true);
	code = reference_read(options->reference, &options->reference_grid, ret_reference, err);
	disk_steps(&reconstruction->run, false);
	return code;
}

/* What a refinement goes by in this job: another one with the same views may have had another reference. */
static uint64_t own_basis(const struct reconstruction *reconstruction, uint64_t basis)
{
	const char *slash = strrchr(reconstruction->run.directory, '/');

	/* The directory's name is the job's. FNV-1a. */
	for (const char *at = slash != NULL ? slash + 1 : reconstruction->run.directory; *at != '\0'; at++)
		basis = (basis ^ (unsigned char)*at) * 1099511628211u;
	return basis;
}

/* What is reached on the way is kept where iterations are: a daemon's job may end in its midst, and goes on later. */
static int find_poses(struct reconstruction *reconstruction, struct refinement *ret_refinement, struct error *err)
{
	const double seconds = reconstruction->options->checkpoint_seconds;
	const char *directory = reconstruction->run.directory;
	struct refine_reference reference = {.voxels = NULL};
	struct refining_file *file = NULL;
	int code = read_reference(reconstruction, &reference, err);

	if (code == 0 && reconstruction->run.sealed && seconds > 0)
		code =
		    refining_file_open(directory, own_basis(reconstruction, recon_refine_basis(reconstruction->recon)),
				       seconds, &file, err);
	if (code == 0)
		code = recon_refine(reconstruction->recon, reference.voxels != NULL ? &reference : NULL,
				    file != NULL ? refining_file_keep(file) : NULL, ret_refinement,
				    &reconstruction->poses, err);
	if (code == 0)
		ret_refinement->basis = own_basis(reconstruction, ret_refinement->basis);
	refining_file_free(file);
	free((void *)(uintptr_t)reference.voxels);
	return code;
}

/*
 * What the run has found whose checkpoint is gone on from, or one that ended before it had any. False where it is not
 * there whole, or is another's: it is found again then.
 */
static bool read_refined(const struct reconstruction *reconstruction, struct refinement *ret_refinement)
{
	cJSON *document = NULL;
	struct error ignored;
	char path[1200];
	bool read = reconstruction->run.sealed &&
		    path_join(path, sizeof(path), reconstruction->run.directory, REFINEMENT_FILE, "", &ignored) == 0 &&
		    sealed_read(path, &document, &ignored) == 0 &&
		    refinement_parse(document, ret_refinement, &ignored) == 0 &&
		    ret_refinement->basis == own_basis(reconstruction, recon_refine_basis(reconstruction->recon));

	cJSON_Delete(document);
	return read;
}

/*
 * Called once all projections have been pushed. Where another geometry fits them better the reconstruction is opened
 * anew with it, *ret_again, and has none of them; a resumed one, too, to go on from its checkpoint.
 */
static int heed_poses(struct reconstruction *reconstruction, bool *ret_again, struct error *err)
{
	struct refinement refinement;
	int code;

	*ret_again = false;
	if (!looks_for_poses(reconstruction))
		return 0;
	if (read_refined(reconstruction, &refinement))
		code = recon_refine_again(reconstruction->recon, &refinement, &reconstruction->poses, err);
	else
		code = find_poses(reconstruction, &refinement, err);
	if (code < 0)
		return code;
	reconstruction->refined = true;
	*ret_again = refinement.accepted || reconstruction->resumed;
	code = tell_refinement(reconstruction, &refinement, err);
	if (code == 0)
		refining_file_remove(reconstruction->run.directory);
	if (code == 0 && run_yield(&reconstruction->run))
		return error_set(err, ERR_BUSY, "yielded once the geometry was refined");
	return code == 0 && *ret_again ? open_again(reconstruction, err) : code;
}

/*
 * Called once all projections have been pushed, and their pixels and poses heeded. Where views are spoiled which can be
 * mended only if all projections are kept, the reconstruction is opened anew and keeps them, *ret_again. Without the
 * memory for that they stay as they are, which is told.
 */
static int heed_spoiled(struct reconstruction *reconstruction, bool *ret_again, struct error *err)
{
	int code = recon_lacks(reconstruction->recon, ret_again, err);

	if (code < 0 || !*ret_again)
		return code;
	reconstruction->keeps_all = true;
	code = open_again(reconstruction, err);
	if (code != ERR_NO_MEMORY)
		return code;
	reconstruction->keeps_all = false;
	return open_again(reconstruction, err);
}

/* Sets the provenance in the volumes' files, but for stage and iteration. */
static int set_provenance(struct reconstruction *reconstruction, const struct reconstruction_options *options,
			  struct error *err)
{
	struct provenance *provenance = &reconstruction->run.provenance;
	const struct scan *scan = reconstruction->files.scan;
	struct device_info info;
	int code;

	provenance->patient = options->patient != NULL ? *options->patient : scan->patient;
	set_text(provenance->program, sizeof(provenance->program), options->program);
	set_text(provenance->job, sizeof(provenance->job), options->job);
	set_text(provenance->scan, sizeof(provenance->scan), options->scan);
	set_text(provenance->scan_name, sizeof(provenance->scan_name), scan->name);
	set_text(provenance->commit, sizeof(provenance->commit), program_commit);
	set_text(provenance->backend, sizeof(provenance->backend),
		 reconstruction->backend == &backend_cards ? cards_below(reconstruction->device)->name
							   : reconstruction->backend->name);
	reconstruction->backend->describe(reconstruction->device, &info);
	set_text(provenance->device, sizeof(provenance->device), info.name);
	provenance->recipe = recipe_json(options->recipe);
	if (provenance->recipe == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a recipe");
	code = digest_recipe(provenance->recipe, provenance->recipe_digest, err);
	return code == 0 ? digest_scan(scan, provenance->scan_digest, err) : code;
}

/* The digest over those of the images of scatter. */
static int set_scatter_digest(struct reconstruction *reconstruction, struct error *err)
{
	const struct scatter_file *file = &reconstruction->scatter;
	uint8_t *sha256;
	int code = 0;

	if (file->count == 0 || file->sums < 0)
		return 0;
	sha256 = calloc((size_t)file->count, DIGEST_BYTES);
	if (sha256 == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for %d digests", file->count);
	for (int i = 0; i < reconstruction->scatter_source.count && code == 0; i++) {
		const int image = scatter_image_of(&file->images, file->projections, reconstruction->scattered[i]);
		unsigned char state = SUM_NONE;
		struct sum sum;

		code = sums_get(file->sums, image, 1, 0, &sum, &state, err);
		if (code == 0 && state == SUM_GOOD)
			memcpy(sha256 + (size_t)image * DIGEST_BYTES, sum.sha256, DIGEST_BYTES);
	}
	if (code == 0)
		code = digest_projections(sha256, file->count, reconstruction->run.provenance.scatter_digest, err);
	free(sha256);
	return code;
}

/* Sets the digests of the images and, once all have been pushed, of the projections, where the directory has records.
 */
static int set_digests(struct reconstruction *reconstruction, struct error *err)
{
	struct provenance *provenance = &reconstruction->run.provenance;
	const struct scan_files *files = &reconstruction->files;
	uint8_t *sha256;
	struct sum *sums;
	unsigned char *states;
	int code = 0;

	if (files->sums < 0)
		return 0;
	if (set_scatter_digest(reconstruction, err) != 0)
		return err->code;
	sha256 = calloc((size_t)reconstruction->announced, DIGEST_BYTES);
	sums = calloc((size_t)reconstruction->announced, sizeof(*sums));
	states = calloc((size_t)reconstruction->announced, 1);
	if (sha256 == NULL || sums == NULL || states == NULL)
		code = error_set(err, ERR_NO_MEMORY, "no memory for %d digests", reconstruction->announced);
	if (code == 0)
		code = sums_get(files->sums, 0, reconstruction->announced, 0, sums, states, err);
	for (int i = 0; i < files->scan->count && code == 0; i++) {
		const int k = projection_of(reconstruction, i);

		if (states[k] == SUM_GOOD)
			memcpy(sha256 + (size_t)k * DIGEST_BYTES, sums[k].sha256, DIGEST_BYTES);
	}
	if (code == 0)
		code = digest_projections(sha256, reconstruction->announced, provenance->projections_digest, err);
	for (int i = 0; i < IMAGE_COUNT && code == 0; i++) {
		if (files->image[i] == NULL)
			continue;
		code = sums_get(files->sums, image_kinds[i].slot, 1, 0, sums, states, err);
		if (code == 0 && states[0] == SUM_GOOD)
			digest_text(sums[0].sha256, provenance->image_digest[i]);
	}
	free(sha256);
	free(sums);
	free(states);
	return code;
}

int reconstruction_open(const struct backend *backend, struct device *device,
			const struct reconstruction_options *options, struct reconstruction **ret_reconstruction,
			struct error *err)
{
	struct reconstruction *reconstruction = calloc(1, sizeof(*reconstruction));
	int code;

	if (reconstruction == NULL)
		return error_set(err, ERR_NO_MEMORY, "no memory for a reconstruction");
	reconstruction->run = (struct run){.hooks = options->hooks,
					   .directory = options->out_directory,
					   .recipe = options->recipe,
					   .sealed = options->checked,
					   .ahead = backend->own_memory};
	reconstruction->hooks = (struct recon_hooks){.context = &reconstruction->run,
						     .cancelled = run_cancelled,
						     .yield = run_yield,
						     .progress = run_progress,
						     .row = run_row,
						     .keep = run_keep,
						     .denoising = run_denoising,
						     .stopped = run_stopped,
						     .agreement = run_agreement,
						     .warning = run_warning};
	reconstruction->backend = backend;
	reconstruction->device = device;
	reconstruction->files.projections = reconstruction->files.sums = -1;
	reconstruction->options = options;
	code = scan_files_open(options->scan_directory, &reconstruction->files, err);
	if (code == 0 && options->checked && reconstruction->files.sums < 0)
		code = error_set(err, ERR_DAMAGED, "the scan has no %s", SUMS_FILE);
	if (code == 0)
		code = set_provenance(reconstruction, options, err);
	if (code == 0)
		reconstruction->announced = reconstruction->files.scan->count;
	if (code == 0)
		code = open_scatter(reconstruction, err);
	if (code == 0)
		code = options->present == NULL ? 0 : scan_reduce(reconstruction->files.scan, options->present, err);
	if (code == 0)
		code = allocate(reconstruction, err);
	reconstruction->iteration = options->iteration;
	reconstruction->resumed = options->checkpoint != NULL;
	if (code == 0 && options->checkpoint_seconds > 0 && options->checkpoint == NULL)
		checkpoint_remove(options->out_directory);
	if (code == 0 && options->checkpoint_seconds > 0)
		code = checkpointer_new(options->out_directory, options->checkpoint_seconds, backend->own_memory,
					&reconstruction->run.checkpointer, err);
	if (code == 0)
		code = open_first(reconstruction, err);
	if (code != 0)
		reconstruction_close(reconstruction);
	else
		*ret_reconstruction = reconstruction;
	return code;
}

void reconstruction_close(struct reconstruction *reconstruction)
{
	if (reconstruction == NULL)
		return;
	checkpointer_free(reconstruction->run.checkpointer);
	free(reconstruction->run.history.rows);
	saver_free(reconstruction->run.saver);
	provenance_clear(&reconstruction->run.provenance);
	recon_free(reconstruction->recon);
	stuck_free(reconstruction->stuck);
	shadow_free(reconstruction->shadow);
	geometry_clear(&reconstruction->lit_geometry);
	for (int i = 0; i < IMAGE_COUNT; i++)
		free(reconstruction->lit_image[i]);
	free(reconstruction->lit_stuck);
	free(reconstruction->errors);
	free(reconstruction->flat);
	geometry_clear(&reconstruction->poses);
	scan_files_close(&reconstruction->files);
	scatter_file_close(&reconstruction->scatter);
	free(reconstruction->scattered);
	free(reconstruction->views);
	free(reconstruction->samples);
	free(reconstruction);
}

int reconstruction_pushed(const struct reconstruction *reconstruction)
{
	return reconstruction->pushed;
}

int reconstruction_wanted(const struct reconstruction *reconstruction)
{
	return reconstruction->files.scan->count;
}

/* A part of one projection, read and summed by one core while it is in that core's cache. */
struct piece {
	size_t first, size; /* bytes within the run */
	uint32_t crc;
	struct error error; /* code 0: it is there */
};

/* One core reads a fifth of what the page cache gives, and sums half as fast as it reads. */
static void read_pieces(int file, char *ret_to, size_t offset, struct piece *pieces, int count)
{
#pragma omp parallel for schedule(dynamic)
	for (int i = 0; i < count; i++) {
		struct piece *piece = &pieces[i];

		if (file_read_at(file, ret_to + piece->first, piece->size, offset + piece->first, "projections.raw",
				 &piece->error) == 0)
			piece->crc = checksum(0, ret_to + piece->first, piece->size);
		pulse_beat();
	}
}

static int join_pieces(const struct piece *pieces, int count, uint32_t *ret_crc, struct error *err)
{
	uint32_t crc = 0;

	for (int i = 0; i < count; i++) {
		if (pieces[i].error.code != 0) {
			*err = pieces[i].error;
			return err->code;
		}
		crc = checksum_join(crc, pieces[i].crc, pieces[i].size);
	}
	*ret_crc = crc;
	return 0;
}

static int check_projection(const struct sum *sum, enum sum_state state, int projection, uint32_t crc,
			    struct error *err)
{
	if (state != SUM_GOOD || sum->lost)
		return error_set(err, ERR_DAMAGED,
				 "projection %d has no record in %s: it was never received, or the record is damaged",
				 projection, SUMS_FILE);
	if (sum->crc != crc)
		return error_set(err, ERR_DAMAGED, "projection %d is damaged: its samples do not fit their checksum",
				 projection);
	return 0;
}

/* `count` neighbours from `first` on, at most a batch. */
static int read_run(struct reconstruction *reconstruction, int first, int count, char *ret_to, struct error *err)
{
	enum { PIECE = 512 << 10 };
	size_t bytes = scan_projection_bytes(reconstruction->files.scan);
	int each = (int)((bytes + PIECE - 1) / PIECE), code = 0;
	struct piece *pieces = calloc((size_t)count * (size_t)each, sizeof(*pieces));
	struct sum *sums = calloc((size_t)count, sizeof(*sums));
	unsigned char *states = calloc((size_t)count, 1);

	if (pieces == NULL || sums == NULL || states == NULL) {
		code = error_set(err, ERR_NO_MEMORY, "no memory for checksums");
		goto out;
	}
	for (int i = 0; i < count * each; i++) {
		size_t at = (size_t)(i % each) * PIECE;

		pieces[i].first = (size_t)(i / each) * bytes + at;
		pieces[i].size = bytes - at < PIECE ? bytes - at : PIECE;
	}
	read_pieces(reconstruction->files.projections, ret_to, (size_t)first * bytes, pieces, count * each);
	if (reconstruction->files.sums >= 0)
		code = sums_get(reconstruction->files.sums, first, count, bytes, sums, states, err);
	for (int i = 0; i < count && code == 0; i++) {
		uint32_t crc = 0;

		code = join_pieces(pieces + i * each, each, &crc, err);
		if (code == 0 && reconstruction->files.sums >= 0)
			code = check_projection(&sums[i], states[i], first + i, crc, err);
	}
out:
	free(pieces);
	free(sums);
	free(states);
	return code;
}

/* Into samples, at most a batch of views from `view` on; neighbours in the file in one go. */
static int read_views(struct reconstruction *reconstruction, int view, int count, struct error *err)
{
	size_t bytes = scan_projection_bytes(reconstruction->files.scan);
	int code = 0;

	for (int at = 0, next; at < count && code == 0; at = next) {
		int first = projection_of(reconstruction, view + at);

		for (next = at + 1; next < count && projection_of(reconstruction, view + next) == first + next - at;)
			next++;
		code = read_run(reconstruction, first, next - at, reconstruction->samples + (size_t)at * bytes, err);
	}
	return code;
}

/* Line integrals are float32, and no flat image is held against them. */
static void take_errors_off(struct reconstruction *reconstruction, int count)
{
	const struct geometry *geometry = detector_geometry(reconstruction);
	const size_t pixels = (size_t)geometry->columns * (size_t)geometry->rows;
	float *samples = (float *)reconstruction->samples;

	for (int i = 0; i < count; i++)
		algebra_axpby(pixels, -1, reconstruction->errors, 1, samples + (size_t)i * pixels);
}

/* Looks at the pixels of a view, one of those that stuck_wants. */
static void look_at_pixels(struct reconstruction *reconstruction, const void *samples)
{
	stuck_add(reconstruction->stuck, samples);
	if (reconstruction->shadow != NULL)
		shadow_add(reconstruction->shadow, samples);
}

/* At most a batch. */
static int push_some(struct reconstruction *reconstruction, int count, struct error *err)
{
	const size_t bytes = scan_projection_bytes(reconstruction->files.scan);
	int code;

	disk_steps(&reconstruction->run, true);
	code = read_views(reconstruction, reconstruction->pushed, count, err);
	disk_steps(&reconstruction->run, false);
	for (int i = 0; i < count; i++)
		reconstruction->views[i] = reconstruction->pushed + i;
	for (int i = 0; i < count && code == 0 && reconstruction->stuck != NULL && !reconstruction->looked; i++)
		if (stuck_wants(reconstruction->stuck, reconstruction->views[i]))
			look_at_pixels(reconstruction, reconstruction->samples + (size_t)i * bytes);
	if (code == 0 && reconstruction->lit_geometry.views != NULL)
		crop_samples(reconstruction, count);
	if (code == 0 && reconstruction->errors != NULL)
		take_errors_off(reconstruction, count);
	if (code == 0)
		code = recon_push(reconstruction->recon, reconstruction->samples, reconstruction->views, count, err);
	reconstruction->pushed += code == 0 ? count : 0;
	/* The file is not prepared at the beginning: an arm may stand still for minutes. */
	if (code == 0 && !reconstruction->resumed &&
	    2 * reconstruction->pushed >= reconstruction_wanted(reconstruction))
		prepare(&reconstruction->run, STAGE_FDK, 0);
	return code;
}

int reconstruction_push(struct reconstruction *reconstruction, int count, struct error *err)
{
	int code = 0;

	if (count > reconstruction_wanted(reconstruction))
		return error_set(err, ERR_INVALID, "%d projections of a scan of %d", count,
				 reconstruction_wanted(reconstruction));
	while (reconstruction->pushed < count && code == 0) {
		int rest = count - reconstruction->pushed;

		code = push_some(reconstruction, rest < reconstruction->batch ? rest : reconstruction->batch, err);
	}
	return code;
}

/* All views that stuck pixels are looked for in, ahead of the others, where none has been pushed yet. */
static int look_ahead(struct reconstruction *reconstruction, struct error *err)
{
	bool again;
	int code = 0;

	if (reconstruction->looked || reconstruction->pushed > 0)
		return 0;
	for (int i = 0; i < reconstruction_wanted(reconstruction) && code == 0; i++) {
		if (reconstruction->stuck == NULL || !stuck_wants(reconstruction->stuck, i))
			continue;
		code = read_views(reconstruction, i, 1, err);
		if (code == 0)
			look_at_pixels(reconstruction, reconstruction->samples);
	}
	return code == 0 ? heed_pixels(reconstruction, &again, err) : code;
}

int reconstruction_push_rest(struct reconstruction *reconstruction, struct error *err)
{
	int code = look_ahead(reconstruction, err);

	return code == 0 ? reconstruction_push(reconstruction, reconstruction_wanted(reconstruction), err) : code;
}

int reconstruction_finish(struct reconstruction *reconstruction, struct error *err)
{
	struct run *run = &reconstruction->run;
	struct error trouble;
	bool again = false;
	/* Where projections came one by one, what is wrong with pixels is known only now. */
	int code = reconstruction->pushed == reconstruction_wanted(reconstruction)
		       ? heed_pixels(reconstruction, &again, err)
		       : 0;

	if (code == 0 && again)
		code = reconstruction_push_rest(reconstruction, err);
	if (code == 0 && reconstruction->pushed == reconstruction_wanted(reconstruction))
		code = heed_poses(reconstruction, &again, err);
	else
		again = false;
	if (code == 0 && again)
		code = reconstruction_push_rest(reconstruction, err);
	again = false;
	if (code == 0 && reconstruction->pushed == reconstruction_wanted(reconstruction))
		code = heed_spoiled(reconstruction, &again, err);
	if (code == 0 && again)
		code = reconstruction_push_rest(reconstruction, err);
	if (code == 0)
		code = set_digests(reconstruction, err);
	if (code == 0)
		code = recon_run(reconstruction->recon, err);

	/* Announced volumes are settled, however the run ends. Nobody goes on from a run that has come to its end. */
	disk_steps(run, true);
	if (run->checkpointer != NULL && (code == 0 || code == ERR_CANCELLED))
		checkpointer_discard(run->checkpointer);
	if (run->trouble.code == 0)
		settle(run, true, &run->trouble);
	/* A checkpoint on its way would take the place of one that is written now. */
	if (run->trouble.code == 0 && run->checkpointer != NULL)
		announce_checkpoint(run, true, &run->trouble);
	if (run->trouble.code != 0 && (code == 0 || code == ERR_BUSY || code == ERR_CANCELLED)) {
		*err = run->trouble;
		return run->trouble.code;
	}
	if (code == ERR_BUSY && recon_iteration(reconstruction->recon) > 0 &&
	    checkpoint_save(reconstruction->recon, &run->history, run->directory, &trouble) != 0) {
		*err = trouble;
		code = trouble.code;
	}
	return code;
}

int reconstruction_run(const struct backend *backend, struct device *device,
		       const struct reconstruction_options *options, struct error *err)
{
	struct reconstruction *reconstruction = NULL;
	int code = reconstruction_open(backend, device, options, &reconstruction, err);

	if (code == 0)
		code = reconstruction_push_rest(reconstruction, err);
	if (code == 0)
		code = reconstruction_finish(reconstruction, err);
	reconstruction_close(reconstruction);
	return code;
}
