#!/usr/bin/env bash
# Runs each fuzz target for FUZZ_SECONDS (default 10) from its seeds; what it finds stays in $BUILD/corpus.
# An input that breaks a promise is kept as $BUILD/crash-*, and `$BUILD/fuzz_NAME FILE` runs it again.
set -uo pipefail
cd "$(dirname "$0")/../.."
build=${BUILD:-build/fuzz}
failed=0
export UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1

for source in tests/fuzz/fuzz_*.c; do
	name=$(basename "$source" .c)
	seeds=tests/fuzz/seeds/${name#fuzz_}
	corpus=$build/corpus/$name
	mkdir -p "$corpus"
	if "$build/$name" -max_total_time="${FUZZ_SECONDS:-10}" -max_len=20000 -timeout=20 -rss_limit_mb=2048 -print_final_stats=1 \
		-dict=tests/fuzz/json.dict -artifact_prefix="$build/crash-$name-" "$corpus" "$seeds" >"$build/$name.log" 2>&1; then
		echo "ok   $name: $(sed -n 's/^stat::number_of_executed_units: *//p' "$build/$name.log") inputs"
	else
		echo "FAIL $name: $build/$name.log"
		tail -n 30 "$build/$name.log"
		failed=1
	fi
done
exit $failed
