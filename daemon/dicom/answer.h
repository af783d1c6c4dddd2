#ifndef CBCT_DAEMON_DICOM_ANSWER_H
#define CBCT_DAEMON_DICOM_ANSWER_H

#include <stddef.h>

#include "core/error.h"

/*
 * What an archive answers to a request of DICOMweb (PS3.18), in DICOM JSON (PS3.18, F). Pure functions of the bytes,
 * which are a stranger's; bytes may be NULL where size is 0. Any thread.
 */

/* ERR_IO with the number of a status that refuses. The words of an archive's own may name a patient: they are not told.
 */
int answer_refusal(long status, const char *what, struct error *err);

/* Visits each SOP Instance UID of a page of QIDO-RS; returns how many results it has, or ERR_IO. */
int answer_instances(const char *bytes, size_t size, void (*visit)(void *context, const char *instance), void *context,
		     struct error *err);

/* STOW-RS: 200: all, 202: some, 409: none was stored; which, and why, its FailedSOPSequence says. 0 for all. */
int answer_stored(const char *bytes, size_t size, long status, struct error *err);

#endif
