# What tests of fleets share, sourced by them behind lib.sh: a PostgreSQL server for the ledger, hosts, and what is asked of
# them. A test may have hosts in networks of their own: address_of[NAME], and within[NAME], the command that starts a
# program there.
. "$here/postgresql.sh"
[ -z "${CBCT_TEST_CATALOGUE:-}" ] || unset CBCT_TEST_CATALOGUE

scan_dir=$work/scan
cbct simulate -o "$scan_dir" --phantom head --scale 70 --views 64 --columns 48 --rows 36 --pixel 7 >/dev/null
grid='"grid": {"size": [32, 32, 24], "spacing_mm": [5, 5, 5]}'
small="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 3}, \"tv\": {}, \"emit\": [\"fdk\", 1]}"
long="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 300}, \"emit\": [\"fdk\", 100]}"
[ "${SANITIZED:-0}" = 0 ] || long=${long/300/60} long=${long/100/20}

start_postgresql || { [ -n "${why:-}" ] || exit 1; }
pkg-config --exists libpq 2>/dev/null || why="libpq is not installed"
declare -A address_of=() within=()
trap 'stop_hosts; stop_postgresql' EXIT
printf '#!/bin/sh\nexec false\n' >"$work/no-device"
chmod +x "$work/no-device"
lease=3

need_server() { [ -z "${why:-}" ] || skip "$why"; }
# start_host NAME [OPTION ...]: a daemon of the fleet; its address is in NAME.url, its process in NAME.pid
start_host() {
	local name=$1 address=${address_of[$1]:-127.0.0.1} out=$work/$1.out port=$((20000 + RANDOM % 10000)) i
	shift
	for ((i = 0; i < 20; i++)); do
		: >"$out"
		${within[$name]:-} "$BUILD/cbctd-held" --listen "$address:$port" --state-dir "$work/$name" --backend cpu --threads 1 --fleet test \
			--fleet-database "$database" --fleet-lease "$lease" --fleet-keep-scans 0 --fleet-host "$name" "${@//PORT/$port}" >"$out" 2>>"$work/$name.err" &
		echo $! >"$work/$name.pid"
		until [ -s "$out" ] || ! kill -0 "$(cat "$work/$name.pid")" 2>/dev/null; do sleep 0.05; done
		[ -s "$out" ] && break
		port=$((20000 + RANDOM % 10000))
	done
	sed -n 's/^listening on //p' "$out" >"$work/$name.url"
	[ -s "$work/$name.url" ] || fail "host $name, got $(tail -3 "$work/$name.err")"
}
taker() { start_host "$1" --fleet-address http://127.0.0.1:PORT "${@:2}"; }
owner() { start_host "$1" --worker "$work/no-device" "${@:2}"; }
stop_host() { # NAME [SIGNAL]
	local pid
	pid=$(cat "$work/$1.pid" 2>/dev/null) || return 0
	rm -f "$work/$1.pid"
	kill "-${2:-TERM}" "$pid" 2>/dev/null || true
	while kill -0 "$pid" 2>/dev/null; do sleep 0.05; done
}
stop_hosts() {
	local file name
	for file in "$work"/*.pid; do
		[ -e "$file" ] || continue
		name=${file##*/}
		kill -CONT "$(cat "$file")" 2>/dev/null
		stop_host "${name%.pid}" KILL
	done
}
begin() { # each test has a fleet of its own
	need_server
	stop_hosts
	rm -rf "$work"/{a,b,c,undisturbed} "$work"/{a,b,c}.err
	sql 'SET client_min_messages = error; DROP SCHEMA IF EXISTS cbctd_fleet_test CASCADE'
}
at() { url=$(cat "$work/$1.url"); } # NAME: requests go to that host from now on
given_to() { # HOST: $job runs there
	local i
	for ((i = 0; i < 600; i++)); do
		req GET "/v1/jobs/$job"
		expect_status 200
		[[ $(json '.state == "running" and (.device | startswith("'"$1"':"))') = true ]] && return 0
		sleep 0.05
	done
	fail "job $job on $1, got $(json '{state, device}')"
}
progresses() { # $job has done an iteration
	local i
	for ((i = 0; i < 600; i++)); do
		req GET "/v1/jobs/$job"
		[ "$(json '.history | length > 0')" = true ] && return 0
		sleep 0.05
	done
	fail "iterations of $job, got $(head -c 600 "$body")"
}
# undisturbed DIR JOB NAME: the bits of that job from a daemon that is in no fleet, and how well its geometry fits
undisturbed() {
	local state=$work/undisturbed url
	[ -e "$work/$3.raw" ] && return
	start_daemon --threads 1
	reconstruct "$1" "$2"
	req GET "/v1/jobs/$job"
	jq .geometry_agreement "$body" >"$work/$3.agreement"
	get_volume final "$work/$3.raw" format=raw
	cp "$work/$3.raw" "$work/$3.keep"
	stop_daemon
}
same_bits() { # NAME
	get_volume final "$work/final.raw" format=raw
	cmp "$work/final.raw" "$work/$1.raw" || fail "the bits of an undisturbed run"
}
told_once() { # Nothing of the job is told twice: one end, each iteration once.
	curl -s --max-time 20 "$url/v1/jobs/$job/events" >"$work/events"
	[ "$(grep -c '^event: end' "$work/events")" = 1 ] || fail "one end, got: $(grep -A 2 '^event: end' "$work/events")"
	[ "$(grep -A 1 '^event: progress' "$work/events" | grep -o '"iteration":[0-9]*' | sort | uniq -d | wc -l)" = 0 ] || fail "each iteration once"
}
nothing_left() { # HOST: neither jobs nor scans of others
	local i
	at "$1"
	for ((i = 0; i < 400; i++)); do
		[ "$(curl -s "$url/v1/jobs" | jq '.jobs | length')$(curl -s "$url/v1/scans" | jq '.scans | length')" = 00 ] && return 0
		sleep 0.05
	done
	fail "nothing of others on $1, got $(curl -s "$url/v1/jobs" | jq -c '[.jobs[] | {id, state}]') $(curl -s "$url/v1/scans" | jq -c '[.scans[].name]')"
}
empty_ledger() {
	local i
	for ((i = 0; i < 200; i++)); do
		[ "$(sql 'SELECT count(*) FROM cbctd_fleet_test.offers')" = 0 ] && return 0
		sleep 0.05
	done
	fail "no offers, got $(sql 'SELECT * FROM cbctd_fleet_test.offers')"
}
