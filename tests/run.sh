#!/usr/bin/env bash
# Every test: the house's rules, the unit tests, then the black-box tests over HTTP.
# What cannot run here is skipped aloud. Closes with `N passed, N failed, N skipped`.
# Usage: tests/run.sh [--soak] [FILTER ...]   only the parts whose path has one of the words in it; --soak: the long
# tests of tests/soak in place of all others
set -uo pipefail
cd "$(dirname "$0")/.."
export BUILD=${BUILD:-build}
mkdir -p "$BUILD/test"
results=$BUILD/test/results
rm -rf "$BUILD"/test/{exchanges,reported.*}
: >"$results"

parts=(tests/http/test_*.sh tests/web/test_*.sh)
if [ "${1:-}" = --soak ]; then
	shift
	parts=(tests/soak/test_*.sh)
	soak=1
fi

wanted() {
	local path=$1
	shift
	[[ -n ${soak:-} && $path != tests/soak/* ]] && return 1
	[ $# = 0 ] && return 0
	local word
	for word; do [[ $path == *$word* ]] && return 0; done
	return 1
}

part() {
	printf '\n== %s\n' "$1"
}

# What a sanitizer has to say of any process, the daemon and its workers too, comes into files of its own; only the
# one for undefined behaviour, beside another, writes to standard error whatever it is told, and ends the process.
# A part that leaves a report has failed.
reports=$(realpath "$BUILD/test")/sanitizer
rm -f "$reports".*
for tool in ASAN LSAN UBSAN TSAN; do
	options=${tool}_OPTIONS
	export "$options=${!options:+${!options}:}log_path=$reports"
done
export UBSAN_OPTIONS=$UBSAN_OPTIONS:halt_on_error=1:print_stacktrace=1
sanitized() { # PART FILE-OR-FOLDER: its output
	grep -rIhs -A 12 'runtime error: ' "$2" >"$reports.undefined" || rm "$reports.undefined"
	local report
	for report in "$reports".*; do
		[ -e "$report" ] || continue
		echo "FAIL $1: a sanitizer's report"
		head -60 "$report" | sed 's/^/    /'
		echo "fail $1 sanitizer" >>"$results"
		mv "$report" "$BUILD/test/reported.$(basename "$1" .sh).${report##*.}"
	done
}

if wanted lint "$@"; then
	part "lint"
	if tests/lint.sh; then echo "pass lint" >>"$results"; else echo "fail lint" >>"$results"; fi
fi

if wanted unit "$@"; then
	part "unit"
	log=$BUILD/test/unit.log
	# The study's 50 iterations take half an hour under a sanitizer; LEAVE_OUT names suites (-NAME) that are left out aloud.
	for suite in ${LEAVE_OUT:-}; do
		echo "SKIP unit suite ${suite#-}: too slow under a sanitizer"
		echo "skip unit suite ${suite#-}: too slow under a sanitizer" >>"$results"
	done
	# shellcheck disable=SC2086
	CK_LOG_FILE_NAME=$BUILD/test/unit.check "$BUILD/unit" ${LEAVE_OUT:-} 2>&1 | tee "$log"
	status=${PIPESTATUS[0]}
	# check's closing line: "100%: Checks: 42, Failures: 0, Errors: 0"
	counts=$(grep -oE 'Checks: [0-9]+, Failures: [0-9]+, Errors: [0-9]+' "$log" | tail -1)
	read -r checks failures errors <<<"$(tr -dc '0-9 ' <<<"$counts")"
	if [ -z "${checks:-}" ] || { [ "$status" != 0 ] && [ "$((failures + errors))" = 0 ]; }; then
		echo "FAIL unit: ended with status $status before its summary"
		echo "fail unit" >>"$results"
	else
		# A unit test that finds no data says "SKIP unit: why", and passes nothing.
		skips=$(grep -E '^SKIP ' "$log" | grep -vc '^SKIP unit suite' || true)
		for ((i = 0; i < checks - failures - errors - skips; i++)); do echo "pass unit"; done >>"$results"
		for ((i = 0; i < failures + errors; i++)); do echo "fail unit"; done >>"$results"
	fi
	grep -E '^SKIP ' "$log" | sed 's/^SKIP /skip /' >>"$results"
	sanitized unit "$log"
fi

for file in "${parts[@]}"; do
	[ -e "$file" ] || continue
	wanted "$file" "$@" || continue
	part "$file"
	RESULTS=$results bash "$file" || true
	sanitized "$(basename "$file")" "$BUILD/test/$(basename "$file" .sh)"
done

if wanted http "$@"; then
	part "exchanges and proto/openapi.yaml"
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
