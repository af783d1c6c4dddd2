#!/usr/bin/env bash
# Times of the CUDA backend: the ceilings of this card, every operation, and whole jobs through HTTP; then each row beside its
# goal, the best peer, the ceilings and the last kept result (gpu_rows.py), which fails where one is a tenth slower than that.
# Writes $BUILD/bench/gpu.json with clocks and driver, with PICTURE=1 (needs matplotlib) gpu.svg too. Skipped aloud without a device.
# Usage: tests/bench/gpu.sh [gpu_bench's options]
set -euo pipefail
cd "$(dirname "$0")/../.."
BUILD=$(realpath "${BUILD:-build}")
out=$BUILD/bench
mkdir -p "$out"
if ! nvidia-smi -L >/dev/null 2>&1; then
	echo "SKIPPED: no CUDA device answers"
	exit 0
fi
asked=name,driver_version,clocks.sm,clocks.mem,power.limit
nvidia-smi --query-gpu=$asked --format=csv
"$BUILD/gpu_ceilings" | tee "$out/gpu_ceilings.json"
"$BUILD/gpu_bench" --json "$out/gpu_times.json" --ceilings "$out/gpu_ceilings.json" "$@"
# The clocks while it is warm.
nvidia-smi --query-gpu=$asked --format=csv,noheader,nounits | head -1 >"$out/gpu_state.txt"
jq --slurpfile ceilings "$out/gpu_ceilings.json" --rawfile state "$out/gpu_state.txt" \
	--arg commit "$(git describe --always --dirty 2>/dev/null)" --arg date "$(date -u +%F)" '
	($state | rtrimstr("\n") | split(", ")) as $s |
	{date: $date, commit: $commit, device: $s[0], driver: $s[1], clocks_mhz: {sm: ($s[2] | tonumber), memory: ($s[3] | tonumber)},
	 power_limit_w: ($s[4] | tonumber), ceilings: $ceilings[0], results: .results}' "$out/gpu_times.json" >"$out/gpu.json"
BUILD=$BUILD tests/bench/gpu_jobs.sh | tee "$out/gpu_jobs.txt"
"${PYTHON:-/usr/bin/python3}" tests/bench/gpu_rows.py "$out/gpu.json" ${PICTURE:+--picture "$out/gpu.svg"}
