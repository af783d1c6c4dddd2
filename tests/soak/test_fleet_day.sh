#!/usr/bin/env bash
# A day of 20 carts and 4 servers in some ten minutes: tests/bench/fleet_day.py.
. "$(dirname "$0")/../http/lib.sh"
. "$(dirname "$0")/../http/postgresql.sh"
trap stop_postgresql EXIT

test_a_day_of_twenty_carts_and_four_servers_loses_no_job() {
	start_postgresql || skip "${why:-the server does not start}"
	trap stop_postgresql EXIT
	/usr/bin/python3 "$top/tests/bench/fleet_day.py" "$BUILD" "$work/day" "$database" --hours "${HOURS:-8}" >"$work/day.out" 2>&1 ||
		fail "all jobs succeed: $(cat "$work/day.out")"
	cat "$work/day.out"
	sed 's/^/  day = /' "$work/day.out"
}

run_tests
