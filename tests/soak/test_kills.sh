#!/usr/bin/env bash
# kill -9 at random moments of uploads and of reconstructions, of daemon and worker: tests/http/kills.py.
. "$(dirname "$0")/../http/lib.sh"

test_a_thousand_kills_during_uploads_and_three_hundred_during_reconstructions_lose_nothing() {
	/usr/bin/python3 "$top/tests/http/kills.py" "$BUILD" "$work/kills" --uploads "${UPLOAD_KILLS:-1000}" --jobs "${JOB_KILLS:-300}" ${SEED:+--seed "$SEED"} \
		>"$work/kills.log" || fail "nothing is lost: $(cat "$work/kills.log")"
	cat "$work/kills.log"
}

run_tests
