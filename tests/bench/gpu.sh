#!/usr/bin/env bash
# Times of the CUDA backend: the ceilings of this card, every operation beside its goal and as a part of them, and whole
# jobs through HTTP. Writes $BUILD/bench/gpu.json and gpu_ceilings.json, prints tables. Skipped aloud without a device.
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
nvidia-smi --query-gpu=name,driver_version,clocks.sm,clocks.mem,power.limit --format=csv
"$BUILD/gpu_ceilings" | tee "$out/gpu_ceilings.json"
"$BUILD/gpu_bench" --json "$out/gpu.json" --ceilings "$out/gpu_ceilings.json" "$@"
nvidia-smi --query-gpu=clocks.sm,clocks.mem,temperature.gpu --format=csv
BUILD=$BUILD tests/bench/gpu_jobs.sh
