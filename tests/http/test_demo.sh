#!/usr/bin/env bash
# The demo and the curl examples do what they say.
. "$(dirname "$0")/lib.sh"

test_demo_runs_to_its_end() {
	[ "${SANITIZED:-0}" = 0 ] || skip "too slow under a sanitizer"
	"$top/clients/curl/demo.sh" >"$work/demo.out" 2>&1 || fail "exit status 0: $(tail -5 "$work/demo.out")"
}

test_curl_examples() {
	local example
	start_daemon
	for example in "$top"/clients/curl/*.sh; do
		[ "$(basename "$example")" = demo.sh ] && continue
		echo "$example"
		CBCT_URL=$url timeout 120 "$example" >"$work/example.out" 2>&1 || fail "exit status 0 of $example: $(tail -5 "$work/example.out")"
	done
	stop_daemon
}

run_tests
