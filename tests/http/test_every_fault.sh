#!/usr/bin/env bash
# A sample of what tests/soak/test_every_fault.sh does with every call: one fails, and nothing acknowledged is lost.
. "$(dirname "$0")/lib.sh"

test_a_call_that_fails_once_loses_nothing() {
	[ "${SANITIZED:-0}" = 0 ] || skip "the sanitizers' own allocator cannot be loaded beside build/every.so"
	/usr/bin/python3 "$here/every.py" "$BUILD" "$work/every" --stride 7 cbctd:rename:5 cbctd:write:5 cbctd:fsync:5 \
		cbct-worker:fdatasync:5 >"$work/every.log" || fail "all of it holds: $(cat "$work/every.log")"
	tail -1 "$work/every.log"
}

run_tests
