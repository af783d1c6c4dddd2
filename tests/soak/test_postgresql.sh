#!/usr/bin/env bash
# Faults of the catalogue's server, of the way to it and of the daemon, under load: tests/http/postgresql_faults.py.
. "$(dirname "$0")/../http/lib.sh"
. "$(dirname "$0")/../http/postgresql.sh"
trap '[ -z "${lossy:-}" ] || kill "$lossy"; stop_postgresql' EXIT

test_three_hundred_faults_of_the_catalogues_server_under_load_lose_and_repeat_nothing() {
	start_postgresql || skip "${why:-the server does not start}"
	trap '[ -z "${lossy:-}" ] || kill "$lossy"; stop_postgresql' EXIT
	mkdir -p "$work/lossy"
	python3 "$top/tests/http/lossy.py" "$pg_folder/server" "$work/lossy" >"$work/lossy.out" 2>"$work/lossy.err" &
	lossy=$!
	local i
	for ((i = 0; i < 200; i++)); do [ -s "$work/lossy.out" ] && break; sleep 0.05; done
	/usr/bin/python3 "$top/tests/http/postgresql_faults.py" "$BUILD" "$work/faults" "postgresql://cbctd@/postgres?host=$work/lossy" \
		"$pg_folder/server/data" "$work/lossy" \
		"${as_server[*]} $pg_programs/pg_ctl -D $pg_folder/server/data -l $pg_folder/server/log -w -t 30 start" \
		--faults "${FAULTS:-300}" ${SEED:+--seed "$SEED"} >"$work/faults.log" 2>&1 || fail "nothing is lost or repeated: $(cat "$work/faults.log")"
	cat "$work/faults.log"
	sed 's/^/  faults = /' "$work/faults.log" | tail -1
}

run_tests
