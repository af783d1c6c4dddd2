#!/usr/bin/env bash
# Whoever holds connections, for good or ill: acquisition gets in.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks
python=${PYTHON:-/usr/bin/python3}
command -v "$python" >/dev/null || python=python3
raw() { "$python" "$here/raw_http.py" "${url##*:}" "$@"; }
stop_after_each=1

test_idle_and_trickling_connections_make_room() {
	start_daemon --max-connections 40
	raw idle 20
	raw trickling 20
}
test_slow_uploads_and_readers_make_room() {
	start_daemon --max-connections 40 --minimum-rate 64K
	raw slow_uploads 20
	raw slow_readers 20
}
test_readers_of_what_has_no_known_length_are_held_to_the_pace() {
	start_daemon --transfer-grace 2 --minimum-rate 64K --listen "unix:$work/socket"
	cbct simulate -o "$work/scan" --phantom head --views 8 --columns 24 --rows 24 --pixel 8 --photons 2000 >/dev/null
	reconstruct "$work/scan" '{"scan": "SCAN", "grid": {"size": [144, 144, 144], "spacing_mm": [0.7, 0.7, 0.7]}, "fdk": {"window": "ram-lak"}}'
	raw stalled "$job"
	raw stalled "$job" "$work/socket"
}
test_clients_that_vanish_while_they_wait_make_room() {
	start_daemon --max-connections 12 --max-connections-per-address 12
	cbct simulate -o "$work/scan" --phantom ball --views 4 --columns 8 --rows 8 --pixel 20 >/dev/null
	post_scan "$work/scan"
	post_job '{"scan": "SCAN", "fdk": {}}' # waits for its projections
	raw vanished "$job"
}
test_where_all_are_busy_reading_is_refused_and_writing_served() {
	start_daemon --max-connections 40
	raw busy 20 429
	stop_daemon
	start_daemon --max-connections 12 --max-connections-per-address 12
	raw busy 12 503
}
test_users_of_a_unix_socket_are_counted_too() {
	start_daemon --max-connections 40 --listen "unix:$work/socket"
	raw busy 20 429 "$work/socket"
}
test_without_descriptors_it_waits_and_recovers() {
	start_daemon --log-level info
	raw descriptors "$(cat "$work/daemon.pid")"
	[ "$(grep -c 'no connection can be accepted' "$work/cbctd.err")" = 1 ] || fail "told once, got $(grep 'no connection' "$work/cbctd.err")"
}
test_limits_fit_the_descriptors_there_are() {
	(
		ulimit -n 104
		start_daemon
		raw idle 10
	)
	grep -q '20 connections in place of 2048' "$work/cbctd.err" || fail "the limit told: $(cat "$work/cbctd.err")"
}

run_tests
