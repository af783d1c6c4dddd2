#!/usr/bin/env bash
# 200 series sent to an archive by either protocol, with a kill -9 of the daemon, of cbct-dicom or of the archive in the middle of
# each: every one arrives once, whole, with its own patient. SEND_KILLS is another number.
. "$(dirname "$0")/../http/lib.sh"
. "$top/tests/http/archive.sh"

test_every_series_arrives_once() {
	need_archive
	kills "${SEND_KILLS:-200}"
}

test_every_series_is_committed_once() {
	need_archive
	ldd "$BUILD/cbct-dicom" | grep libdcmnet >/dev/null || skip "cbct-dicom was built without libdcmtk-dev"
	kills "${SEND_KILLS:-200}" dimse
}

run_tests
