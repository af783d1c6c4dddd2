/* Any bytes as a file of images (MetaImage, TIFF, NumPy, DICOM): refused with a reason, or as many pixels as it says.
 */
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "clients/cbct/images.h"
#include "tests/fuzz/fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	enum { PIXELS_MOST = 1 << 20, IMAGES_MOST = 4 };
	static const struct image_options options = IMAGE_OPTIONS_DEFAULTS;
	static int file = -1;
	struct images *images = NULL;
	struct error err = {0};
	char path[64];

	if (file < 0)
		file = memfd_create("images", MFD_CLOEXEC);
	PROMISE(file >= 0 && ftruncate(file, 0) == 0 && pwrite(file, data, size, 0) == (ssize_t)size);
	snprintf(path, sizeof(path), "/proc/self/fd/%d", file);
	if (images_open(path, &options, &images, &err) != 0) {
		PROMISE(images == NULL && err.code < 0 && err.text[0] != '\0');
		return 0;
	}
	PROMISE(images->columns >= 1 && images->rows >= 1 && images->count >= 1);
	if ((size_t)images->columns * (size_t)images->rows <= PIXELS_MOST) {
		float *pixels = malloc(sizeof(float) * (size_t)images->columns * (size_t)images->rows);

		PROMISE(pixels != NULL);
		for (int i = 0; i < images->count && i < IMAGES_MOST; i++)
			if (images_read(images, i, pixels, &err) != 0)
				PROMISE(err.code < 0 && err.text[0] != '\0');
		free(pixels);
	}
	images_free(images);
	return 0;
}
