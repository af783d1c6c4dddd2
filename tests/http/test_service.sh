#!/usr/bin/env bash
# The daemon as a service: what its manager is told, the watchdog, sockets that the manager has opened, and the units.
. "$(dirname "$0")/lib.sh"
stop_after_each=1
told=$work/told
python=${PYTHON:-/usr/bin/python3}

# managed [MANAGER-OPTION ...]: the daemon, started by a service manager
managed() {
	: >"$told"
	printf '#!/bin/sh\nexec %s %s %s %s -- %s/cbctd-held "$@"\n' "$python" "$here/manager.py" "$told" "$*" "$BUILD" >"$work/managed"
	chmod +x "$work/managed"
	program=test/test_service/managed start_daemon
}
told_within() { # SECONDS PATTERN
	local i
	for ((i = 0; i < $1 * 50; i++)); do
		grep -qE "$2" "$told" && return 0
		sleep 0.02
	done
	fail "$2 within $1 s: $(cat "$told")"
}
fed() { grep -c '^WATCHDOG=1' "$told" || true; }

test_the_manager_is_told_of_start_reload_and_stop() {
	managed
	told_within 5 '^READY=1 STATUS=.*0 running, 0 queued'
	[ "$(head -1 "$told" | cut -d' ' -f1)" = READY=1 ] || fail "READY=1 first: $(cat "$told")"
	kill -HUP "$(cat "$work/daemon.pid")"
	told_within 5 '^RELOADING=1 MONOTONIC_USEC=[0-9]+$'
	told_within 5 '^READY=1$'
	[ "$(fed)" = 0 ] || fail "no watchdog where none is asked for"
	stop_daemon
	[ "$stop_status" = 0 ] || fail "exit status 0, got $stop_status"
	told_within 5 '^STOPPING=1$'
}

test_a_reload_takes_the_level_of_the_log_and_tells_what_has_to_wait() {
	: >"$work/cbctd.err"
	echo 'log-level = info' >"$work/cbctd.conf"
	program=cbctd-held start_daemon --config "$work/cbctd.conf"
	req GET /livez
	! grep -q 'target=/livez' "$work/cbctd.err" || fail "no line for a request at first"
	printf 'log-level = debug\nmax-wait = 17\nthreads = 3\n' >"$work/cbctd.conf"
	kill -HUP "$(cat "$work/daemon.pid")"
	log_has 'count from the next start on: threads, max-wait$'
	req GET '/livez?token=cbct_secret'
	log_has 'target=/livez'
	! grep -q cbct_secret "$work/cbctd.err" || fail "no query in the log"
	echo 'log-level = loud' >"$work/cbctd.conf"
	kill -HUP "$(cat "$work/daemon.pid")"
	log_has 'the settings that were read before stay: .*cbctd.conf:1: log-level: "loud"'
	req GET /livez
	expect_status 200
	[ "$(cat "$body")" = "alive, $("$BUILD/cbctd" --version)" ] || fail "the version, got $(cat "$body")"
}
log_has() { # PATTERN
	local i
	for ((i = 0; i < 6000; i++)); do
		grep -qE "$1" "$work/cbctd.err" && return 0
		sleep 0.02
	done
	fail "$1 in the log: $(tail -5 "$work/cbctd.err")"
}

test_workers_are_not_the_service() {
	local pid
	managed --watchdog 10 --tcp 127.0.0.1
	pid=$(worker_of)
	! tr '\0' '\n' <"/proc/$pid/environ" | grep -E '^(NOTIFY_SOCKET|WATCHDOG_|LISTEN_)' || fail "nothing of the manager in a worker's environment"
}

test_the_watchdog_is_fed_only_while_each_part_is_alive() {
	local part before
	export CBCT_TEST_STUCK=$work/stuck
	rm -f "$CBCT_TEST_STUCK"
	managed --watchdog 0.9
	told_within 5 '^WATCHDOG=1 STATUS=ready, 0 running'
	for part in http supervisor catalogue; do
		echo "$part" >"$CBCT_TEST_STUCK"
		sleep 0.7 # of a look that had begun before
		before=$(fed)
		sleep 1
		[ "$(fed)" = "$before" ] || fail "no food while $part hangs: $(cat "$told")"
		rm "$CBCT_TEST_STUCK"
		sleep 1
		expect_number "$(fed)" '>' "$before" "meals after $part"
	done
	grep -q 'the watchdog is not fed: HTTP: [0-9] of 4 threads do not answer' "$work/cbctd.err" || fail "HTTP in the log"
	grep -q 'the watchdog is not fed: the supervisor: ' "$work/cbctd.err" || fail "the supervisor in the log"
	grep -q 'the watchdog is fed again' "$work/cbctd.err" || fail "the end of it in the log"
}

test_one_thread_that_hangs_is_found_at_every_look() {
	export CBCT_TEST_STUCK=$work/stuck
	rm -f "$CBCT_TEST_STUCK"
	managed --watchdog 0.9
	told_within 5 '^WATCHDOG=1'
	echo thread >"$CBCT_TEST_STUCK"
	told_within 5 '^STATUS=HTTP: 1 of 4 threads'
	sleep 1.5
	cp "$told" "$work/told.then"
	rm "$CBCT_TEST_STUCK"
	expect_number "$(grep -c '^STATUS=HTTP: 1 of 4 threads' "$work/told.then")" '>=' 3 "looks that found it"
	! sed -n '/^STATUS=HTTP/,$p' "$work/told.then" | grep '^WATCHDOG=1' || fail "no food meanwhile: $(cat "$work/told.then")"
}

test_threads_of_tls_are_asked_too_and_no_client_makes_room() {
	local i before
	openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout "$work/key.pem" -out "$work/cert.pem" -days 2 \
		-subj /CN=localhost -addext subjectAltName=IP:127.0.0.1 2>/dev/null
	: >"$told"
	printf '#!/bin/sh\nexec %s %s %s --watchdog 0.6 -- %s/cbctd-held "$@" --log-level debug\n' "$python" "$here/manager.py" "$told" "$BUILD" >"$work/managed"
	program=test/test_service/managed CURL_CA_BUNDLE=$work/cert.pem start_daemon --tls-cert "$work/cert.pem" --tls-key "$work/key.pem" \
		--listen "unix:$work/socket" --max-connections 4 --max-connections-per-address 4
	told_within 5 '^WATCHDOG=1'
	curl -sN --unix-socket "$work/socket" http://localhost/v1/events >"$work/events" &
	sleep 0.2
	before=$(fed)
	sleep 1
	expect_number "$(fed)" '>' "$before" meals
	! grep -q '^STATUS=HTTP' "$told" || fail "all threads answer: $(cat "$told")"
	kill -0 $! || fail "the client that listens stays"
	kill $!
	stop_daemon
}

test_sockets_of_the_manager_are_served_and_stay() {
	local socket=$work/handed.sock
	rm -f "$socket"
	managed --tcp 127.0.0.1 --unix "$socket"
	grep -qx "listening on unix:$socket" "$work/cbctd.out" || fail "the Unix socket: $(cat "$work/cbctd.out")"
	req GET /livez
	expect_status 200
	curl -sf --unix-socket "$socket" http://localhost/livez >/dev/null || fail "an answer on the Unix socket"
	! grep -q ':2228' "$work/cbctd.out" || fail "no other address"
	stop_daemon
	[ -S "$socket" ] || fail "the manager's socket stays where it is"
}

test_sockets_that_are_not_safe_or_no_sockets_are_refused() {
	managed --tcp 0.0.0.0 && fail "no start on all addresses without tokens"
	tail -3 "$work/cbctd.err" | grep -q 'reached from other machines; without tokens and TLS' || fail "why: $(tail -3 "$work/cbctd.err")"
	managed --datagram && fail "no start on a datagram socket"
	tail -3 "$work/cbctd.err" | grep -q 'descriptor 3 of LISTEN_FDS is no stream socket' || fail "why: $(tail -3 "$work/cbctd.err")"
}

run_tests
