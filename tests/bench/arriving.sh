#!/usr/bin/env bash
# FDK while the arm turns: a job is posted first, then its projections are sent at the rate of a detector. How long after
# the last 2xx the FDK volume is kept (reconstructed, whole in its file, and told of), and what each PUT took meanwhile.
#
#   arriving.sh [BACKEND COLUMNS ROWS VIEWS RATE GRID SAMPLE GOAL_MS]    one case; without arguments the CPU's
#   arriving.sh cuda 1240 960 496 60 512 uint16 100
#
# A table, and $BUILD/bench/arriving.json. Measures the machine as it is: leave it alone meanwhile.
set -euo pipefail
cd "$(dirname "$0")/../.."
BUILD=$(realpath "${BUILD:-build}")
. tests/bench/lib.sh
backend=${1:-cpu} columns=${2:-308} rows=${3:-240} views=${4:-200} rate=${5:-30} grid=${6:-128} sample=${7:-float32} goal=${8:-500}
repeats=${REPEATS:-3} connections=2
work=$BUILD/bench/arriving

start_daemon "$work" --backend "$backend"

# 0x40404040 is a float of 3.004, 0x4040 are 16448 counts: as good as any other
one=$((columns * rows * 4)) projections="{\"count\": $views, \"sample\": \"float32\", \"quantity\": \"line_integral\"}"
if [ "$sample" = uint16 ]; then
	one=$((columns * rows * 2)) projections="{\"count\": $views, \"sample\": \"uint16\", \"quantity\": \"intensity\", \"air\": 60000}"
fi
head -c $((one * views)) /dev/zero | tr '\0' '\100' >"$work/all"

# The detector is 382 mm wide, the volume 160 mm.
scan_document() {
	jq -n --argjson c "$columns" --argjson r "$rows" --argjson n "$views" --argjson p "$projections" '{name: "bench",
	  detector: {columns: $c, rows: $r, pixel_mm: [382 / $c, 382 / $c]}, projections: $p,
	  geometry: {kind: "circular", source_to_isocentre_mm: 620, source_to_detector_mm: 1100, first_angle_deg: 0,
	             angle_step_deg: (200 / ($n - 1))}}'
}
job_document() {
	jq -n --arg s "$scan" --argjson g "$grid" '{scan: $s, grid: {size: [$g, $g, $g], spacing_mm: [160 / $g, 160 / $g, 160 / $g]},
	  fdk: {}, emit: ["fdk"]}'
}

: >"$work/results"
for ((i = 0; i < repeats; i++)); do
	scan=$(scan_document | curl -sf "$url/v1/scans" -H 'Content-Type: application/json' --data-binary @- | jq -r .id)
	job=$(job_document | curl -sf "$url/v1/jobs" -H 'Content-Type: application/json' --data-binary @- | jq -r .id)
	sync
	until curl -sf "$url/v1/jobs/$job" | jq -e '.plan != null' >/dev/null; do sleep 0.1; done # it is opened
	"$BUILD/acquire" "${url##*:}" "$scan" "$job" "$work/all" "$views" "$one" "$rate" $connections >>"$work/results"
	curl -sf "$url/v1/jobs/$job" | jq -c '{device, timings}' >"$work/job"
	curl -sf -X DELETE "$url/v1/jobs/$job"
	curl -sf -X DELETE "$url/v1/scans/$scan"
done

jq -s --arg backend "$backend" --argjson grid "$grid" --arg size "$columns x $rows" --arg sample "$sample" --argjson goal "$goal" \
	--slurpfile job "$work/job" '{backend: $backend, device: $job[0].device, detector: $size, sample: $sample, grid: $grid,
	goal_ms: $goal, last_timings: $job[0].timings, runs: .}' "$work/results" >"$BUILD/bench/arriving.json"
jq -r '"FDK while it arrives, \(.backend), \(.runs[0].views) views of \(.detector) \(.sample) at \(.runs[0].rate)/s, \(.grid)^3:",
	(.runs[] | "  kept \(.fdk_kept_ms) ms after the last 2xx; PUT median \(.put_ms.median), 99 % \(.put_ms.p99), most \(.put_ms.most) ms; sent at most \(.late_ms.most) ms late"),
	"  goal \(.goal_ms) ms; after the last projection, of the last run: FDK \(.last_timings.fdk) s, save \(.last_timings.save) s"' "$BUILD/bench/arriving.json"
echo "written: $BUILD/bench/arriving.json"
