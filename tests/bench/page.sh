#!/usr/bin/env bash
# How soon the page shows a finished job of 256^3 voxels on loopback: Chromium without a graphics card, nothing cached, medians
# of five; how long each step of a walk through it holds the page up; planes and slabs of 512^3 voxels. A table, and
# $BUILD/bench/page.json and steps.json. Measures the machine as it is: leave it alone meanwhile.
set -euo pipefail
cd "$(dirname "$0")/../.."
BUILD=$(realpath "${BUILD:-build}")
. tests/bench/lib.sh
work=$BUILD/bench/page tools=$BUILD/web-tests
CHROMIUM=$(command -v chromium || true)
if [ -z "$CHROMIUM" ] || [ ! -d "$tools/node_modules" ] || [ ! -e "$BUILD/web/files/index.html" ]; then
	echo "the page is not measured: that needs chromium, the page and what 'make check' installs for its tests"
	exit 0
fi
start_daemon "$work" --backend cpu

export CBCT_URL=$url
"$BUILD/cbct" simulate --phantom head --scale 88 --density 0.02 --views 60 --columns 160 --rows 160 --pixel 2 --photons 100000 -o "$work/scan" >/dev/null
scan=$("$BUILD/cbct" upload "$work/scan" 2>/dev/null)
job=$(curl -sf "$url/v1/jobs" -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"grid\": {\"size\": [256, 256, 256], \"spacing_mm\": [0.8, 0.8, 0.8]}, \"fdk\": {}}" | jq -r .id)
until curl -sf "$url/v1/jobs/$job?wait=60" | jq -e '.state == "succeeded"' >/dev/null; do :; done

cp tests/bench/page.mjs "$tools/bench.mjs"
URL=$url JOB=$job CHROMIUM=$CHROMIUM HOME=$work node "$tools/bench.mjs" >"$BUILD/bench/page.json"
jq -r '"page, first picture of 256^3            \(.first_picture_ms) ms (goal 2000)",
	"page, voxels of all planes here         \(.voxels_ms) ms",
	"page, rendering, without graphics card  \(.rendering_ms) ms"' "$BUILD/bench/page.json"

cp tests/bench/steps.mjs "$tools/steps.mjs"
URL=$url JOB=$job CHROMIUM=$CHROMIUM HOME=$work node "$tools/steps.mjs" >"$BUILD/bench/steps.json"
echo "longest task of the page in each step, ms of the processor and of the clock (goal 100):"
jq -r 'to_entries[] | "  \(.key): \(.value.cpu_ms) \(.value.ms)"' "$BUILD/bench/steps.json"
node tests/bench/planes.mjs clients/web/src/sample.js
