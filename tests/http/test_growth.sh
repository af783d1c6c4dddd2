#!/usr/bin/env bash
# A short form of what tests/soak/test_growth.sh does for two hours: scans in and out, descriptors and threads stay.
. "$(dirname "$0")/lib.sh"

test_scans_in_and_out_leave_no_descriptor_and_no_thread_behind() {
	[ "${SANITIZED:-0}" = 0 ] || skip "the sanitizers' own allocator cannot be loaded beside build/live_bytes.so"
	/usr/bin/python3 "$here/growth.py" "$BUILD" "$work/growth" --scans 50 >"$work/growth.log" || fail "nothing grows: $(cat "$work/growth.log")"
	tail -1 "$work/growth.log"
}

run_tests
