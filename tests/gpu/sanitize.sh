#!/usr/bin/env bash
# compute-sanitizer over the checks of the operations: out of bounds, races in shared memory, reads of what nobody wrote.
# What it does not know is the card's own: scenes are few and small, each kind of kernel at least once.
set -uo pipefail
BUILD=${BUILD:-build}
sanitizer=$(command -v compute-sanitizer || ls /usr/local/cuda/bin/compute-sanitizer 2>/dev/null)
if [ -z "$sanitizer" ] || ! nvidia-smi -L >/dev/null 2>&1; then
	echo "SKIPPED: compute-sanitizer needs itself and a device"
	exit 0
fi
failures=0
for tool in memcheck racecheck initcheck; do
	if "$sanitizer" --tool $tool --error-exitcode 9 "$BUILD/gpu_check" --brief >"$BUILD/sanitize-$tool.txt" 2>&1; then
		echo "pass $tool"
	else
		echo "FAIL $tool: $BUILD/sanitize-$tool.txt" && grep -m3 "=========" "$BUILD/sanitize-$tool.txt"
		failures=$((failures + 1))
	fi
done
[ $failures = 0 ]
