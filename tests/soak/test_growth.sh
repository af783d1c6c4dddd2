#!/usr/bin/env bash
# Small scans in and out for hours, and what the daemon and its worker keep of each: tests/http/growth.py.
. "$(dirname "$0")/../http/lib.sh"

test_two_thousand_scans_in_two_hours_leave_nothing_behind() {
	/usr/bin/python3 "$top/tests/http/growth.py" "$BUILD" "$work/growth" --scans "${SCANS:-2000}" --seconds "${GROWTH_SECONDS:-7200}" \
		>"$work/growth.log" || fail "nothing grows: $(cat "$work/growth.log")"
	cat "$work/growth.log"
}

run_tests
