#!/usr/bin/env bash
# The catalogue in PostgreSQL: what clients and jobs see of it is the same, and nothing is lost, told twice or left
# behind where its server is killed, stopped, restarted, or where the answer to a commit never comes.
. "$(dirname "$0")/lib.sh"
. "$(dirname "$0")/postgresql.sh"
program=cbctd-held # asserts the order of locks
unset CBCT_TEST_CATALOGUE

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
small="{\"scan\": \"SCAN\", \"grid\": {\"size\": [32, 32, 16], \"spacing_mm\": [3, 3, 4]}, \"fdk\": {}, \"sart\": {\"iterations\": 4}}"
long="{\"scan\": \"SCAN\", \"grid\": {\"size\": [32, 32, 16], \"spacing_mm\": [3, 3, 4]}, \"fdk\": {}, \"sart\": {\"iterations\": 300}, \"emit\": [\"fdk\", 100]}"
[ "${SANITIZED:-0}" = 0 ] || long=${long/300/60} long=${long/100/20}

start_postgresql || { [ -n "${why:-}" ] || exit 1; }
pkg-config --exists libpq 2>/dev/null || why="libpq is not installed"
trap 'stop_daemon; [ -z "${lossy:-}" ] || kill "$lossy"; kill_rest; stop_postgresql' EXIT
kill_rest() { [ ! -e "$work/lossy.pid" ] || kill "$(cat "$work/lossy.pid")" 2>/dev/null; }
need_server() {
	[ -z "${why:-}" ] || skip "$why"
	local pid
	pid=$(head -1 "$pg_folder/server/data/postmaster.pid" 2>/dev/null) && kill -0 "$pid" 2>/dev/null || start_server
	pg_pid=$(head -1 "$pg_folder/server/data/postmaster.pid")
}
# start ADDRESS [OPTION ...]: a daemon with a state directory of its own
start() {
	local address=$1
	shift
	need_server
	rm -rf "$state"
	start_daemon --catalogue "$address" "$@"
}
again() { start_daemon --catalogue "$database" "$@"; }
becomes_ready() {
	local i
	for ((i = 0; i < 2400; i++)); do
		[ "$(curl -s -o /dev/null -w '%{http_code}' "$url/readyz")" = 200 ] && return 0
		sleep 0.05
	done
	fail "ready again"
}
away() { # METHOD PATH ...: is answered at once, and says what is the matter
	req "$@"
	expect_problem 503
	expect_json '.type == "urn:cbctd:problem:catalogue-away"'
	[ "$(header retry-after)" = 1 ] || fail "Retry-After"
}
metric() { curl -s "$url/metrics" | sed -n "s/^cbctd_$1\({[^}]*}\)\{0,1\} //p"; }
# Nothing is told twice: one end, and each iteration, warning and volume once.
told_once() {
	curl -s --max-time 20 "$url/v1/jobs/$job/events" >"$work/events"
	[ "$(grep -c '^event: end' "$work/events")" = 1 ] || fail "one end, got: $(grep -A 2 '^event: end' "$work/events")"
	[ "$(grep -A 1 '^event: progress' "$work/events" | grep -o '"iteration":[0-9]*' | sort | uniq -d | wc -l)" = 0 ] || fail "each iteration once"
}
undisturbed() { # the bits of the long job, from a daemon whose catalogue is its own
	[ -e "$work/undisturbed.raw" ] && return
	local state=$work/undisturbed
	start_daemon
	reconstruct "$scan_dir" "$long"
	get_volume final "$work/undisturbed.raw" format=raw
	stop_daemon
}
succeeds_with_the_same_bits() {
	wait_job succeeded
	expect_json '.attempts == 1 and .error == null'
	get_volume final "$work/final.raw" format=raw
	cmp "$work/final.raw" "$work/undisturbed.raw" || fail "the bits of an undisturbed run"
	told_once
}

test_the_store_and_the_jobs_keep_their_rules() {
	need_server
	CBCT_TEST_CATALOGUE=$database "$BUILD/unit" sums queue job store catalogue >"$work/unit" 2>&1 || { cat "$work/unit"; fail "the unit tests"; }
	grep -q '^100%: Checks: [1-9]' "$work/unit" || fail "all of them passed: $(cat "$work/unit")"
	expect_number "$(grep -c '^SKIP' "$work/unit")" == 13 "tests about SQLite's own files"
}

test_all_that_was_acknowledged_is_there_after_kill_9() {
	start "$database"
	reconstruct "$scan_dir" "$small"
	cp "$body" "$work/before"
	get_volume final "$work/final.before"
	[ ! -e "$state/catalogue.sqlite" ] || fail "no catalogue in the state directory"
	expect_number "$(sql "SELECT count(*) FROM $(cat "$state/catalogue.postgresql").projections")" == 60 "rows of projections"
	stop_daemon KILL
	again
	req GET "/v1/jobs/$job"
	diff <(jq -S '{state, history, grid, scan, attempts}' "$body") <(jq -S '{state, history, grid, scan, attempts}' "$work/before") || fail "the job as it was"
	get_volume final "$work/final.after"
	cmp "$work/final.before" "$work/final.after" || fail "the volume as it was"
	req GET /readyz
	expect_status 200
	[ "$(cat "$body")" = ready ] || fail "nothing was found or set aside, got $(cat "$body")"
}

test_a_server_that_is_killed_and_started_again() {
	local acquired
	undisturbed
	start "$database"
	post_scan "$scan_dir"
	acquired=$scan
	head -c $((64 * 48 * 4)) "$scan_dir/projections.raw" >"$work/one"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	state_becomes running
	kill_server
	away POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${small//SCAN/$scan}"
	away POST /v1/scans -H 'Content-Type: application/json' --data-binary "@$scan_dir/scan.json"
	away DELETE "/v1/jobs/$job"
	away PUT "/v1/scans/$acquired/projections/0" -T "$work/one"
	req GET "/v1/scans/$acquired"
	expect_json '.received == []'
	away GET "/v1/jobs/$job/volumes"
	away GET /readyz
	req GET /livez
	expect_status 200
	req GET "/v1/scans/$scan" # what stays in memory is told
	expect_status 200
	[ "$(metric catalogue_up)" = 0 ] || fail "cbctd_catalogue_up 0"
	sleep 6 # longer than a worker may be silent
	start_server
	becomes_ready
	[ "$(metric catalogue_up)" = 1 ] || fail "cbctd_catalogue_up 1"
	req PUT "/v1/scans/$acquired/projections/0" -T "$work/one"
	expect_status 201
	succeeds_with_the_same_bits
	req GET /v1/jobs
	expect_json '.jobs | length == 1'
	req GET /v1/scans
	expect_json '.scans | length == 2'
	stop_daemon KILL
	again
	req GET /v1/jobs
	expect_json '.jobs | length == 1'
	req GET /v1/scans
	expect_json '.scans | length == 2'
	req GET "/v1/scans/$acquired"
	expect_json '.received == [[0, 0]]'
	req GET /readyz
	[ "$(cat "$body")" = ready ] || fail "nothing was found or set aside, got $(cat "$body")"
}

test_a_server_that_stands_still_counts_as_away() {
	undisturbed
	start "$database" --catalogue-timeout 0.5
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	state_becomes running
	kill -STOP $(server_processes)
	away POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${small//SCAN/$scan}"
	away GET /readyz
	sleep 3
	away GET "/v1/jobs/$job/volumes"
	kill -CONT $(server_processes)
	becomes_ready
	succeeds_with_the_same_bits
	req GET /v1/jobs
	expect_json '.jobs | length == 1'
}

test_a_daemon_stops_and_its_jobs_go_on_though_the_server_is_away() {
	local started
	undisturbed
	start "$database"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	state_becomes running
	kill_server
	away POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${small//SCAN/$scan}"
	stop_daemon
	[ "$stop_status" = 0 ] || fail "exit status 0, got $stop_status"
	start_server
	again
	wait_job succeeded
	get_volume final "$work/final.raw" format=raw
	cmp "$work/final.raw" "$work/undisturbed.raw" || fail "the bits of an undisturbed run"
	told_once
}

# A way to the server on which commits can be lost, before or after the server has done them.
start_lossy() {
	need_server
	mkdir -p "$work/lossy"
	python3 "$here/lossy.py" "$pg_folder/server" "$work/lossy" >"$work/lossy.out" 2>"$work/lossy.err" &
	echo $! >"$work/lossy.pid"
	local i
	for ((i = 0; i < 200; i++)); do [ -s "$work/lossy.out" ] && break; sleep 0.05; done
	lossy_database="postgresql://cbctd@/postgres?host=$work/lossy"
}

test_a_commit_whose_answer_is_lost_is_told_once() {
	local way refused schema i
	start_lossy
	start "$lossy_database"
	schema=$(cat "$state/catalogue.postgresql")
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	for way in before after; do
		echo $way >"$work/lossy/lose"
		away POST /v1/jobs -H 'Content-Type: application/json' -H "Idempotency-Key: $way" --data-binary "${small//SCAN/$scan}"
		req GET /v1/jobs
		refused=$(json '.jobs | length')
		becomes_ready
		req POST /v1/jobs -H 'Content-Type: application/json' -H "Idempotency-Key: $way" --data-binary "${small//SCAN/$scan}"
		expect_status 202
		job=$(json .id)
		wait_job succeeded
		told_once
		req GET /v1/jobs
		expect_json ".jobs | length == $((refused + 1))"
		expect_number "$(sql "SELECT count(*) FROM $schema.jobs")" == $((refused + 1)) "rows of jobs"
		expect_number "$(ls "$state/jobs" | wc -l)" == $((refused + 1)) "directories of jobs"
		# the same of a scan
		echo $way >"$work/lossy/lose"
		away POST /v1/scans -H 'Content-Type: application/json' -H "Idempotency-Key: $way" --data-binary "@$scan_dir/scan.json"
		becomes_ready
		req POST /v1/scans -H 'Content-Type: application/json' -H "Idempotency-Key: $way" --data-binary "@$scan_dir/scan.json"
		expect_status 201
	done
	expect_number "$(sql "SELECT count(*) FROM $schema.scans")" == 3 "rows of scans"
	# and of each commit that a job makes in its life, one after the other
	undisturbed_small=$(curl -s "$url/v1/jobs/$job/volumes" | jq -r '.volumes[] | select(.name == "final").sha256')
	for ((i = 0; i < 14; i++)); do
		post_job "$small"
		sleep "0.0$((i * 2 % 10))"
		if [ $((i % 2)) = 0 ]; then echo after; else echo before; fi >"$work/lossy/lose"
		wait_job succeeded
		rm -f "$work/lossy/lose"
		becomes_ready
		told_once
	done
	expect_number "$(sql "SELECT count(*) FROM $schema.jobs")" == 16 "rows of jobs"
	expect_number "$(sql "SELECT count(*) FROM $schema.events WHERE kind = 'end'")" == 16 "ends"
	cp -a "$state" "$work/left"
	stop_daemon KILL
	start_daemon --catalogue "$lossy_database"
	req GET /v1/jobs
	expect_json '(.jobs | length == 16) and all(.jobs[]; .state == "succeeded")'
	req GET /readyz
	[ "$(cat "$body")" = ready ] || fail "nothing was found or set aside, got $(cat "$body")"
}

test_a_second_daemon_of_the_same_catalogue_is_refused() {
	start "$database"
	post_scan "$scan_dir"
	cp -a "$state" "$work/copied"
	if timeout 60 "$BUILD/cbctd" --listen 127.0.0.1:0 --state-dir "$work/copied" --backend cpu --catalogue "$database" >"$work/second" 2>&1; then fail "the second daemon refused"; fi
	grep -q 'in use by another cbctd' "$work/second" || fail "the reason, got $(cat "$work/second")"
	rm -rf "$work/copied"
	post_scan "$scan_dir"
}

test_a_catalogue_that_is_lost_or_made_again_on_request() {
	local schema
	start "$database"
	reconstruct "$scan_dir" "$small"
	cp "$body" "$work/before"
	stop_daemon
	schema=$(cat "$state/catalogue.postgresql")
	sql "DROP SCHEMA $schema CASCADE"
	again
	req GET /readyz
	grep -q 'quarantine: 1' "$body" || fail "that it was lost is told, got $(cat "$body")"
	req GET /v1/quarantine
	expect_json '.entries[0].from == "catalogue.postgresql" and (.entries[0].why | test("1 scans and 1 jobs"))'
	req GET "/v1/jobs/$job"
	diff <(jq -S '{state, history, scan, attempts}' "$body") <(jq -S '{state, history, scan, attempts}' "$work/before") || fail "the job as it was"
	stop_daemon
	"$BUILD/cbctd" --state-dir "$state" --catalogue "$database" --rebuild-catalogue >"$work/rebuilt" 2>&1 || fail "a rebuild: $(cat "$work/rebuilt")"
	grep -q 'has 1 scans and 1 jobs again' "$work/rebuilt" || fail "what was found, got $(cat "$work/rebuilt")"
	expect_number "$(sql "SELECT count(*) FROM pg_namespace WHERE nspname LIKE '${schema}_aside_%'")" == 1 "schemas set aside"
	[ "$(cat "$state/catalogue.postgresql")" != "$schema" ] || fail "another schema"
	again
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded"'
	stop_daemon
	# from one database to the other and back: the directories are the truth
	start_daemon
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded"'
	post_job "$small"
	wait_job succeeded
	stop_daemon
	again
	req GET /v1/jobs
	expect_json '.jobs | length == 2'
}

test_a_backup_takes_no_catalogue_and_its_copy_gets_one_of_its_own() {
	start "$database"
	reconstruct "$scan_dir" "$small"
	rm -rf "$work/backup" "$work/restored"
	cbct backup "$state" "$work/backup" >"$work/told" 2>&1 || fail "a backup: $(cat "$work/told")"
	[ -z "$(find "$work/backup" -name 'catalogue*')" ] || fail "no catalogue in the backup"
	cbct restore "$work/backup" "$work/restored" >"$work/told" 2>&1 || fail "a restore: $(cat "$work/told")"
	local schema state=$work/restored
	schema=$(cat "$work/state/catalogue.postgresql")
	stop_daemon
	again
	[ "$(cat "$state/catalogue.postgresql")" != "$schema" ] || fail "a schema of its own"
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded"'
}

test_a_password_is_never_shown() {
	local address shown
	for address in 'postgresql://cbctd:se%23cret@host/db' 'postgresql://cbctd@host/db?sslmode=require&password=se%23cret' \
		'postgresql://cbctd:se%23cret@one,two:5433/db?application_name=a:b@c' 'postgresql://cbctd:se/cret@host/db' 'postgresql://cbctd:se?cr@et@host/db'; do
		shown=$("$BUILD/cbctd" --catalogue "$address" --print-config 2>&1) || [[ $address == *[/?]*cr* ]] || [ -n "${why:-}" ] || fail "settings are printed: $shown"
		! grep -qE 'cret|cr@et' <<<"$shown" || fail "no password in $(grep cr <<<"$shown")"
		! grep -q '^catalogue = postgres' <<<"$shown" || grep -q '^catalogue = postgresql://cbctd.*\*\*\*' <<<"$shown" || fail "the rest of it: $(grep '^catalogue' <<<"$shown")"
	done
	echo 'catalogue postgresql://cbctd:secret@host/db' >"$work/wrong.conf"
	! "$BUILD/cbctd" --config "$work/wrong.conf" --print-config 2>&1 | grep -q secret || fail "no password in a complaint of a line"
	for address in 'postgresql://cbctd:secret@host:notaport/db' 'postgresql://cbctd:secret@[::1/db' 'postgresql://cbctd:secret/two@host/db' 'mysql://cbctd:secret@host' 'postgresql:secret' 'host=127.0.0.1 password=secret' \
		'postgresql://cbctd:secret@/postgres?host=/nonexistent' 'postgresql://cbctd:secret@host/db?nothing=here'; do
		if timeout 60 "$BUILD/cbctd" --listen 127.0.0.1:0 --state-dir "$work/none" --catalogue "$address" >"$work/told" 2>&1; then fail "$address refused"; fi
		! grep -q secret "$work/told" || fail "no password in: $(cat "$work/told")"
		grep -qE 'catalogue' "$work/told" || fail "what is wrong: $(cat "$work/told")"
	done
	[ -z "${why:-}" ] || skip "$why"
	! grep -rqE 'cbctd:|secret' "$work/cbctd.err" || fail "no password in the log"
}

test_a_cbctd_without_libpq_refuses_it_by_name() {
	if "$BUILD/cbctd-without-postgresql" --listen 127.0.0.1:0 --state-dir "$work/none" --catalogue postgresql://host/db >"$work/told" 2>&1; then fail "refused"; fi
	grep -q 'built without libpq' "$work/told" || fail "the reason, got $(cat "$work/told")"
	grep -q "^catalogue = sqlite" <<<"$("$BUILD/cbctd-without-postgresql" --print-config)" || fail "the default"
}

stop_after_each=1
run_tests
