#!/usr/bin/env bash
# Faults of a fleet under load: tests/http/fleet_faults.py, in namespaces of its own where they can be had.
if [ -z "${CBCT_TEST_NETWORK:-}" ] && unshare --net --mount true 2>/dev/null; then
	CBCT_TEST_NETWORK=1 exec unshare --net --mount -- bash "$0" "$@"
fi
pg_address=10.77.0.1
if [ -n "${CBCT_TEST_NETWORK:-}" ]; then
	ip link set lo up && ip link add bridge0 type bridge && ip address add $pg_address/24 dev bridge0 && ip link set bridge0 up || unset CBCT_TEST_NETWORK
fi
[ -n "${CBCT_TEST_NETWORK:-}" ] || pg_address=
. "$(dirname "$0")/../http/lib.sh"
. "$(dirname "$0")/../http/postgresql.sh"
trap stop_postgresql EXIT

test_three_hundred_faults_of_a_fleet_under_load_lose_and_repeat_nothing() {
	start_postgresql || skip "${why:-the server does not start}"
	trap stop_postgresql EXIT
	if [ -n "$pg_address" ]; then
		database="postgresql://cbctd@$pg_address/postgres"
	else
		echo "no network namespaces here: links are not cut, and no disk is full"
	fi
	/usr/bin/python3 "$top/tests/http/fleet_faults.py" "$BUILD" "$work/faults" "$database" "$pg_folder/server/data" \
		"${as_server[*]} $pg_programs/pg_ctl -D $pg_folder/server/data -l $pg_folder/server/log -w -t 30 start" \
		--faults "${FAULTS:-300}" ${SEED:+--seed "$SEED"} ${FAULT_SECONDS:+--seconds "$FAULT_SECONDS"} ${pg_address:+--bridge bridge0} \
		>"$work/faults.log" 2>&1 || fail "nothing is lost or repeated: $(cat "$work/faults.log")"
	cat "$work/faults.log"
	sed 's/^/  faults = /' "$work/faults.log" | tail -2
}

run_tests
