#!/usr/bin/env bash
# Each call of the daemon and its worker fails once, in a small scan from POST to download: tests/http/every.py.
. "$(dirname "$0")/../http/lib.sh"

test_every_call_fails_once() {
	/usr/bin/python3 "$top/tests/http/every.py" "$BUILD" "$work/every" --processes "$(nproc --all)" --stride "${STRIDE:-1}" --seconds "${SECONDS_MOST:-1000000}" >"$work/every.log" || fail "all of it holds: $(cat "$work/every.log")"
	tail -1 "$work/every.log"
}

run_tests
