#!/usr/bin/env bash
# Runs each fuzz target for FUZZ_SECONDS (default 10) of the clock, FUZZ_JOBS (default 1) at a time, from its seeds.
# What they find stays in $BUILD/corpus, and what all runs on a corpus have done in $BUILD/total: the target, seconds of
# processor time and inputs without a finding since the last one. FUZZ_ONLY="scan job": these targets alone.
# An input that breaks a promise is kept as $BUILD/crash-*, and `$BUILD/fuzz_NAME FILE` runs it again.
set -uo pipefail
cd "$(dirname "$0")/../.."
build=${BUILD:-build/fuzz}
export UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1
mkdir -p "$build/corpus" "$build/total"

# adds NAME SECONDS INPUTS to the total of a target, or begins anew
add() {
	local seconds=0 inputs=0
	[ "$2" = anew ] || read -r _ seconds inputs 2>/dev/null <"$build/total/$1" || true
	awk -v n="$1" -v s="$seconds" -v i="$inputs" -v ms="${3:-0}" -v mi="${4:-0}" \
		'BEGIN {printf "%s %.1f %.0f\n", n, s + ms, i + mi}' >"$build/total/$1.new" && mv "$build/total/$1.new" "$build/total/$1"
}

fuzz() { # NAME
	local corpus=$build/corpus/fuzz_$1 log=$build/fuzz_$1.log status inputs seconds
	mkdir -p "$corpus"
	TIMEFORMAT='%U %S'
	{ time "$build/fuzz_$1" -max_total_time="${FUZZ_SECONDS:-10}" -max_len=20000 -timeout=20 -rss_limit_mb=2048 -print_final_stats=1 \
		-dict=tests/fuzz/json.dict -artifact_prefix="$build/crash-$1-" "$corpus" "tests/fuzz/seeds/$1" >"$log" 2>&1; } 2>"$log.time"
	status=$?
	seconds=$(awk '{print $1 + $2}' "$log.time")
	inputs=$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")
	if [ $status = 0 ]; then
		add "$1" more "$seconds" "$inputs"
		echo "ok   $1: $inputs inputs; in all $(awk '{print $3 " in " $2 " s of processor time"}' "$build/total/$1")"
	else
		add "$1" anew
		echo "FAIL $1: $log"
		tail -n 30 "$log"
	fi
	return $status
}

failed=0 running=0
for program in "$build"/fuzz_*; do
	name=${program##*/fuzz_}
	[[ $name != *.* && (-z ${FUZZ_ONLY:-} || " $FUZZ_ONLY " == *" $name "*) ]] || continue
	if [ $running -ge "${FUZZ_JOBS:-1}" ]; then
		wait -n || failed=1
		running=$((running - 1))
	fi
	fuzz "$name" &
	running=$((running + 1))
done
while [ $running -gt 0 ]; do
	wait -n || failed=1
	running=$((running - 1))
done
exit $failed
