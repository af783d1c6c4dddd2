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
sanitize() { # TOOL PROGRAM [ARGUMENT ...]
	local out=$BUILD/sanitize-$1-$2.txt
	if "$sanitizer" --tool "$1" --error-exitcode 9 "$BUILD/$2" --brief "${@:3}" >"$out" 2>&1; then
		echo "pass $1 of $2"
	else
		echo "FAIL $1 of $2: $out" && grep -m3 "=========" "$out"
		failures=$((failures + 1))
	fi
}
for tool in memcheck racecheck initcheck; do
	sanitize $tool gpu_check
done
# Not initcheck: it looks at a recorded iteration when that is launched, before the kernels in it have written what it copies.
for tool in memcheck racecheck; do
	if [ "$(nvidia-smi -L | wc -l)" -gt 1 ]; then
		sanitize $tool gpu_cards 2
	else
		echo "SKIPPED: $tool of gpu_cards needs two devices"
	fi
done
[ $failures = 0 ]
