#!/usr/bin/env bash
# Faults of a fleet under load: tests/http/fleet_faults.py.
. "$(dirname "$0")/../http/lib.sh"
. "$(dirname "$0")/../http/postgresql.sh"
trap stop_postgresql EXIT

test_three_hundred_faults_of_a_fleet_under_load_lose_and_repeat_nothing() {
	start_postgresql || skip "${why:-the server does not start}"
	trap stop_postgresql EXIT
	/usr/bin/python3 "$top/tests/http/fleet_faults.py" "$BUILD" "$work/faults" "$database" "$pg_folder/server/data" \
		"${as_server[*]} $pg_programs/pg_ctl -D $pg_folder/server/data -l $pg_folder/server/log -w -t 30 start" \
		--faults "${FAULTS:-300}" ${SEED:+--seed "$SEED"} >"$work/faults.log" 2>&1 || fail "nothing is lost or repeated: $(cat "$work/faults.log")"
	cat "$work/faults.log"
	sed 's/^/  faults = /' "$work/faults.log" | tail -1
}

run_tests
