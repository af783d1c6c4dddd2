#!/usr/bin/env bash
# Every test: the house's rules, the unit tests and the black-box tests over HTTP, JOBS parts at a time: five for each
# processor, since most of those over HTTP wait four fifths of their time. Unit suites compute: one for each processor,
# and what waits for nothing goes behind what does (nice), so that they take the time that the others leave. What
# cannot run here is skipped aloud; what is long is left to --soak. Closes with `N passed, N failed, N skipped`.
# Usage: tests/run.sh [--soak] [FILTER ...]   only the parts whose path has one of the words in it; --soak: the long
# tests, those of tests/soak and those that a unit suite tags as long, in place of all others
set -uo pipefail
cd "$(dirname "$0")/.."
export BUILD=${BUILD:-build}
# Parts share the processors: threads that wait for others of theirs leave them to the rest, at once.
export OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive}
processors=$(nproc)
out=$BUILD/test/parts
rm -rf "$BUILD"/test/{exchanges,reported.*,parts}
mkdir -p "$out"
results=$BUILD/test/results
: >"$results"

# Parts take from a second to seven minutes. Of suites and of the others those that take longest begin first, so that
# none of them is left alone on one processor at the end.
if [ "${1:-}" = --soak ]; then
	shift
	# Of the unit suites the tests that are tagged as long.
	for part in $(grep -l 'tcase_set_tags(.*"long")' tests/unit/test_*.c); do
		part=${part##*/test_}
		parts+=("unit/${part%.c}")
	done
	parts+=(tests/soak/test_*.sh)
	export CK_INCLUDE_TAGS=long
	JOBS=${JOBS:-$((processors + 3))}
else
	JOBS=${JOBS:-$((5 * processors))}
	export CK_EXCLUDE_TAGS=long
	parts=(unit/recon unit/study unit/exterior unit/calibrate unit/detector unit/refine unit/metal unit/outofcore
		unit/calibrate_views unit/noise unit/algorithm unit/stuck unit/averaging unit/backend)
	begin_with=(fleet restart devices_of_a_job page real postgresql phantom refine scatter fleet_network supervise
		arriving metal job damage dimse send dicom demo faulty_device empty_views patient rings import events memory)
	rest=$("$BUILD/unit" --list | sed 's,^,unit/,') || exit 1
	for part in "${begin_with[@]}"; do rest+=" tests/http/test_$part.sh tests/web/test_$part.sh"; done
	for part in $rest tests/http/test_*.sh tests/web/test_*.sh lint; do
		[[ " ${parts[*]} " == *" $part "* ]] || parts+=("$part")
	done
fi

wanted() {
	local path=$1
	shift
	[ $# = 0 ] && return 0
	local word
	for word; do [[ $path == *$word* ]] && return 0; done
	return 1
}

# The reports of a sanitizer, of any process of a part, the daemon and its workers too, come into files of its own; only the
# one for undefined behaviour, beside another, writes to standard error whatever it is told, and ends the process.
# A part that leaves a report has failed.
sanitized() { # PART FILE-OR-FOLDER: its output
	grep -rIhs -A 12 'runtime error: ' "$2" >"$reports.undefined" || rm "$reports.undefined"
	local report
	for report in "$reports".*; do
		[ -e "$report" ] || continue
		echo "FAIL $1: a sanitizer's report"
		head -60 "$report" | sed 's/^/    /'
		echo "fail $1 sanitizer" >>"$RESULTS"
		mv "$report" "$BUILD/test/reported.${1//\//.}.${report##*.}"
	done
}

unit_suite() { # NAME
	local log=$out/unit.$1.log status counts checks failures errors skips i
	# The study's 50 iterations take half an hour under a sanitizer; LEAVE_OUT names suites (-NAME) that are left out aloud.
	if [[ " ${LEAVE_OUT:-} " == *" -$1 "* ]]; then
		echo "SKIP unit suite $1: too slow under a sanitizer"
		echo "skip unit suite $1: too slow under a sanitizer" >>"$RESULTS"
		return
	fi
	CK_LOG_FILE_NAME=$out/unit.$1.check CK_TIMEOUT_MULTIPLIER=5 nice -n 10 "$BUILD/unit" "$1" 2>&1 | tee "$log"
	status=${PIPESTATUS[0]}
	# check's closing line: "100%: Checks: 42, Failures: 0, Errors: 0"
	counts=$(grep -oE 'Checks: [0-9]+, Failures: [0-9]+, Errors: [0-9]+' "$log" | tail -1)
	read -r checks failures errors <<<"$(tr -dc '0-9 ' <<<"$counts")"
	if [ -z "${checks:-}" ] || { [ "$status" != 0 ] && [ "$((failures + errors))" = 0 ]; }; then
		echo "FAIL unit $1: ended with status $status before its summary"
		echo "fail unit $1" >>"$RESULTS"
	else
		# A unit test that finds no data says "SKIP unit: why", and passes nothing.
		skips=$(grep -cE '^SKIP ' "$log")
		for ((i = 0; i < checks - failures - errors - skips; i++)); do echo "pass unit"; done >>"$RESULTS"
		for ((i = 0; i < failures + errors; i++)); do echo "fail unit $1"; done >>"$RESULTS"
	fi
	grep -E '^SKIP ' "$log" | sed 's/^SKIP /skip /' >>"$RESULTS"
	sanitized "unit/$1" "$log"
}

# One part in a process of its own; its lines for the sum at the end come into a file of its own.
run_part() { # PART
	local name=${1//\//.} started=$SECONDS tool options reports
	export RESULTS=$out/$name.results
	reports=$(realpath "$BUILD/test")/sanitizer.$name
	rm -f "$reports".*
	for tool in ASAN LSAN UBSAN TSAN; do
		options=${tool}_OPTIONS
		export "$options=${!options:+${!options}:}log_path=$reports"
	done
	export UBSAN_OPTIONS=$UBSAN_OPTIONS:halt_on_error=1:print_stacktrace=1
	case $1 in
	lint)
		if tests/lint.sh; then echo "pass lint" >>"$RESULTS"; else echo "fail lint" >>"$RESULTS"; fi
		;;
	unit/*) unit_suite "${1#unit/}" ;;
	*)
		bash "$1" || true
		sanitized "$1" "$BUILD/test/$(basename "$1" .sh)"
		;;
	esac
	[ -s "$RESULTS" ] || echo "fail $1: it has no result" >"$RESULTS"
	# The last line is what all processes of this part used that were waited for: in the program, in the kernel. It is not
	# piped, since the shell of a pipe has none.
	times >"$out/$name.times"
	echo "-- $((SECONDS - started)) s, of processors $(tail -1 "$out/$name.times")"
}

# JOBS parts at a time. A part's output is shown in one piece when it has ended. Each is a process group of its own (-m),
# so that all of it, its daemons too, ends when this script is told to.
set -m
declare -A running=()
show() { # waits for the part that ends next
	local ended
	wait -n -p ended "${!running[@]}"
	printf '\n== %s\n' "${running[$ended]}"
	cat "$out/${running[$ended]//\//.}.out"
	unset "running[$ended]"
}
stop_all() {
	local pid
	for pid in "${!running[@]}"; do kill -- "-$pid" 2>/dev/null; done
	exit 1
}
trap stop_all INT TERM
waiting=()
for part in "${parts[@]}"; do
	{ [ "$part" = lint ] || [[ $part == unit/* ]] || [ -e "$part" ]; } && wanted "$part" "$@" && waiting+=("$part")
done
next_part() { # into part: the first that may begin; 1 where none may
	local i suites=0
	[ ${#running[@]} -lt "$JOBS" ] || return 1
	for part in "${running[@]}"; do [[ $part == unit/* ]] && suites=$((suites + 1)); done
	for i in "${!waiting[@]}"; do
		part=${waiting[i]}
		[[ $part == unit/* && $suites -ge $processors ]] && continue
		unset "waiting[$i]"
		return 0
	done
	return 1
}
while [ ${#waiting[@]} -gt 0 ]; do
	next_part || {
		show
		continue
	}
	run_part "$part" >"$out/${part//\//.}.out" 2>&1 &
	running[$!]=$part
done
while [ ${#running[@]} -gt 0 ]; do show; done
cat "$out"/*.results >"$results" 2>/dev/null

if wanted http "$@" && [ -d "$BUILD/test/exchanges" ]; then
	printf '\n== %s\n' "exchanges and proto/openapi.yaml"
	python=${PYTHON:-/usr/bin/python3}
	if ! "$python" -c 'import jsonschema, yaml' 2>/dev/null; then
		echo "SKIP exchanges: python3-jsonschema and python3-yaml are not here"
		echo "skip exchanges with the schema: python3-jsonschema and python3-yaml are not here" >>"$results"
	elif "$python" proto/openapi.py --json proto/openapi.yaml >"$BUILD/test/openapi.json" &&
		"$python" tests/http/exchanges.py "$BUILD/test/openapi.json" "$BUILD"/test/exchanges/test_*; then
		echo "pass exchanges with the schema" >>"$results"
	else
		echo "fail exchanges with the schema" >>"$results"
	fi
fi

passed=$(grep -c '^pass' "$results")
failed=$(grep -c '^fail' "$results")
skipped=$(grep -c '^skip' "$results")
if [ "$skipped" != 0 ]; then
	printf '\nskipped:\n'
	grep '^skip' "$results" | sed 's/^skip /  /'
fi
if [ "$failed" != 0 ]; then
	printf '\nfailed:\n'
	grep '^fail' "$results" | sed 's/^fail /  /' | sort | uniq -c
fi
printf '\n%d passed, %d failed, %d skipped\n' "$passed" "$failed" "$skipped"
[ "$failed" = 0 ] && [ "$passed" != 0 ]
