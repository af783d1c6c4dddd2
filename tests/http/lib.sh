# The black-box tests' tools, sourced by test_*.sh: a real cbctd on a free port,
# curl, and checks that say what they expected. A file defines test_* functions
# and ends with `run_tests`; each runs in a subshell that stops at its first
# failure. `skip WHY` ends a test that cannot run here, aloud.

here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
top=$(cd "$here/../.." && pwd)
BUILD=$(cd "$top" && realpath "${BUILD:-build}")
DATA=${CBCT_TEST_DATA:-$top/../shared/data}
PATH=$BUILD:$PATH
work=$BUILD/test/$(basename "${BASH_SOURCE[1]}" .sh)
RESULTS=${RESULTS:-/dev/null}
BACKEND=${BACKEND:-cpu} # of what can be asked of either: check-gpu
# Seconds that a test waits for what must come. It is no assertion: a machine under load may take a hundred times as
# long as an idle one.
patience=900
rm -rf "$work"
mkdir -p "$work"

# start_daemon [OPTION ...]: sets $url; the state directory is $state (kept over restarts), the port a free one or $port,
# the program cbctd or $program. CBCT_TEST_CATALOGUE is the --catalogue of all daemons (tests/postgresql.sh).
state=$work/state
start_daemon() {
	local out=$work/cbctd.out i daemon_pid
	: >"$out"
	"$BUILD/${program:-cbctd}" --listen "127.0.0.1:${port:-0}" --state-dir "$state" --backend "$BACKEND" \
		${CBCT_TEST_CATALOGUE:+--catalogue "$CBCT_TEST_CATALOGUE"} "$@" >"$out" 2>>"$work/cbctd.err" &
	daemon_pid=$!
	echo "$daemon_pid" >"$work/daemon.pid"
	for ((i = 0; i < 2400; i++)); do
		url=$(sed -n 's/^listening on \(https*:\)/\1/p' "$out" | head -1)
		[ -n "$url" ] && break
		kill -0 "$daemon_pid" 2>/dev/null || break
		sleep 0.05
	done
	if [ -z "$url" ]; then
		echo "cbctd did not start: $(tail -5 "$work/cbctd.err")" >&2
		return 1
	fi
	export CBCT_URL=$url
	# A worker must have said hello before jobs are judged by its memory.
	for ((i = 0; i < 2400; i++)); do
		[ "$(curl -s -o /dev/null -w '%{http_code}' "$url/readyz")" = 200 ] && return 0
		sleep 0.05
	done
	echo "cbctd is not ready after two minutes" >&2
	return 1
}

# stop_daemon [SIGNAL]: waits for the end; $stop_status is its exit status where this
# shell started it (a test that restarts the daemon runs in a subshell).
stop_daemon() {
	local pid
	stop_status=0
	pid=$(cat "$work/daemon.pid" 2>/dev/null) || return 0
	rm -f "$work/daemon.pid"
	kill "-${1:-TERM}" "$pid" 2>/dev/null || true
	wait "$pid" 2>/dev/null || stop_status=$?
	while kill -0 "$pid" 2>/dev/null; do sleep 0.05; done
}
trap stop_daemon EXIT

fail() {
	echo "expected: $*" >&2
	exit 1
}
skip() {
	echo "$*" >"$work/skip"
	exit 77
}
need_sqlite() { # where CBCT_TEST_CATALOGUE says another one
	[ -z "${CBCT_TEST_CATALOGUE:-}" ] || skip "it is about SQLite's own file"
}
in_own_mounts() { # COMMAND ...: what it mounts is there for itself alone, and goes with it
	local as_root=()
	[ "$(id -u)" = 0 ] || as_root=(--user --map-root-user)
	unshare "${as_root[@]}" --mount "$@"
}
need_mounts() {
	[ -e /dev/fuse ] || skip "there is no /dev/fuse"
	in_own_mounts true 2>/dev/null || skip "nobody may mount here"
}
need_data() {
	local name
	for name; do [ -e "$DATA/$name" ] || skip "test data $name is not here"; done
}

# req METHOD PATH [CURL OPTION ...]: sets $status, $body (a file) and $headers (a file).
body=$work/body
headers=$work/headers
req() {
	local method=$1 path=$2 media whole=1
	shift 2
	local how=(-X "$method")
	[ "$method" = HEAD ] && how=(--head)
	: >"$headers"
	status=$(curl -sS "${how[@]}" -o "$body" -D "$headers" -w '%{http_code} %{content_type}' --max-time "$patience" "$@" "$url$path") || whole=0
	media=${status#* } status=${status%% *}
	[ $whole = 0 ] && [[ $media != text/event-stream* ]] || record "$method" "$path" "$media" "$@"
}
# One line for each exchange, which tests/http/exchanges.py holds against the schema: method, target, status, header
# fields, JSON sent, JSON or events received.
exchanges=$BUILD/test/exchanges/$(basename "${BASH_SOURCE[1]}" .sh)
mkdir -p "${exchanges%/*}"
rm -f "$exchanges"
record() { # METHOD TARGET MEDIA-TYPE [CURL OPTION ...]
	local sent="" line
	line="$1	$2	$status	$(awk '/^HTTP\// { all = "" } NF > 1 { sub(/\r$/, ""); all = all $0 "\037" } END { printf "%s", all }' "$headers")"
	local media=$3
	shift 3
	while [ $# -gt 1 ]; do
		[ "$1" != --data-binary ] || sent=$2
		shift
	done
	{
		printf '%s\t' "$line"
		case $sent in
		@*) tr '\n\t' '  ' <"${sent#@}" ;;
		*) printf '%s' "$sent" | tr '\n\t' '  ' ;;
		esac
		printf '\t'
		case $media in
		*json* | text/event-stream*) tr '\n' '\036' <"$body" ;;
		esac
		printf '\n'
	} >>"$exchanges"
}
header() { # NAME: the value in the last reply
	awk -v name="$(tr 'A-Z' 'a-z' <<<"$1")" 'BEGIN { FS = ": *" } tolower($1) == name { sub(/^[^:]*: */, ""); sub(/\r$/, ""); print; exit }' "$headers"
}
expect_status() {
	[ "$status" = "$1" ] || fail "status $1, got $status: $(head -c 600 "$body" 2>/dev/null)"
}
# What is asked of a document most goes without jq (tests/http/member.c), where that was built.
command -v member >/dev/null || member() { jq -er "$1" "$2"; }
json() { member "$1" "$body"; }
expect_json() { # FILTER: a jq condition that must be true of the last body
	member "$1" "$body" >/dev/null 2>&1 || fail "$1 of $(head -c 1200 "$body")"
}
# A problem document of this status; a pointer where one is given.
expect_problem() {
	expect_status "$1"
	[[ $(header content-type) == application/problem+json* ]] || fail "application/problem+json, got $(header content-type): $(head -c 300 "$body")"
	expect_json ".status == $1 and (.type | startswith(\"urn:cbctd:problem:\")) and (.title | length > 0) and (.detail | length > 0) and (.request_id | length > 0)"
	[ $# -lt 2 ] || expect_json ".pointer == \"$2\""
}
expect_number() { # VALUE OP LIMIT NAME, OP one of <= >= < > ==
	awk -v a="$1" -v b="$3" "BEGIN { exit !(a == a && a != \"\" && a + 0 $2 b + 0) }" || fail "$4 $2 $3, got $1"
	echo "  $4 = $1 ($2 $3)"
}

# The daemon's worker, or the one that comes after one that has just died.
worker_of() {
	local i pid
	for ((i = 0; i < 6000; i++)); do
		pid=$(pgrep -P "$(cat "$work/daemon.pid")" | head -1) && [ -n "$pid" ] && { echo "$pid"; return 0; }
		sleep 0.02
	done
	fail "a worker"
}

# state_becomes STATE: of $job, that it may leave again
state_becomes() {
	local end=$((SECONDS + patience))
	until req GET "/v1/jobs/$job" && [ "$(json .state)" = "$1" ]; do
		[ $SECONDS -lt $end ] || fail "job $job $1: $(json '{state, stage, views}')"
		sleep 0.02
	done
}

# A scan of DIR (scan.json, projections.raw) posted with curl alone; sets $scan.
post_scan() {
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$1/scan.json"
	expect_status 201
	scan=$(json .id)
	[ "$(header location)" = "/v1/scans/$scan" ] || fail "Location /v1/scans/$scan"
}
post_projections() {
	local image
	for image in flat dark; do
		[ -e "$1/$image.f32" ] || continue
		req PUT "/v1/scans/$scan/$image" --data-binary @"$1/$image.f32"
		[[ $status == 20[014] ]] || fail "$image stored, got $status"
	done
	if [ -e "$1/defects.u8" ]; then
		req PUT "/v1/scans/$scan/defects" --data-binary @"$1/defects.u8"
		[[ $status == 20[014] ]] || fail "defects stored, got $status"
	fi
	req PUT "/v1/scans/$scan/projections" -T "$1/projections.raw"
	expect_status 201
}
# post_job JSON, with SCAN standing for the scan's id; sets $job.
post_job() {
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${1//SCAN/$scan}"
	expect_status 202
	job=$(json .id)
}
# wait_job STATE
wait_job() {
	local end=$((SECONDS + patience))
	while :; do
		req GET "/v1/jobs/$job?wait=20"
		expect_status 200
		case $(json .state) in
		succeeded | failed | cancelled) break ;;
		esac
		[ $SECONDS -lt $end ] || fail "the end of job $job: $(head -c 600 "$body")"
	done
	expect_json ".state == \"$1\""
}
get_volume() { # NAME FILE [QUERY]
	req GET "/v1/jobs/$job/volumes/$1${3:+?$3}"
	expect_status 200
	mv "$body" "$2"
}
# reconstruct DIR JOB-JSON: the whole way by curl; volumes are then fetched with get_volume.
reconstruct() {
	post_scan "$1"
	post_projections "$1"
	post_job "$2"
	wait_job succeeded
}

run_tests() {
	local name status started
	for name in $(sed -n 's/^\(test_[a-z0-9_]*\)().*/\1/p' "$0"); do
		rm -f "$work/skip"
		started=$SECONDS
		(
			set -eEuo pipefail
			trap 'echo "failed at ${BASH_SOURCE[0]##*/}:$LINENO: $BASH_COMMAND" >&2' ERR
			trap - EXIT
			"$name"
		) >"$work/$name.log" 2>&1
		status=$?
		[ -z "${stop_after_each:-}" ] || stop_daemon
		case $status in
		0)
			echo "pass $name ($((SECONDS - started)) s)"
			grep '^  .* = ' "$work/$name.log"
			echo "pass $(basename "$0") $name" >>"$RESULTS"
			;;
		77)
			echo "SKIP $name: $(cat "$work/skip")"
			echo "skip $(basename "$0") $name: $(cat "$work/skip")" >>"$RESULTS"
			;;
		*)
			echo "FAIL $name"
			sed 's/^/    /' "$work/$name.log" | tail -25
			echo "fail $(basename "$0") $name" >>"$RESULTS"
			;;
		esac
	done
}
