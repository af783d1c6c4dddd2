#!/usr/bin/env bash
# Whole jobs through HTTP on the CUDA backend: seconds from the last projection's acknowledgement to the end of the job and
# of the last volume's download behind it; and, for a client that listens to the events, to the end of that download as soon
# as the volume is kept. The job is posted before the projections, which come as fast as they can.
set -euo pipefail
cd "$(dirname "$0")/../.."
BUILD=$(realpath "${BUILD:-build}")
PATH=$BUILD:$PATH
work=$BUILD/bench/jobs
SCRATCH=${SCRATCH:-$work}
rm -rf "$work" "$SCRATCH/state" && mkdir -p "$work" "$SCRATCH"

cbctd --listen 127.0.0.1:0 --state-dir "$SCRATCH/state" --backend cuda --log-level info >"$work/out" 2>"$work/err" &
daemon=$!
trap 'kill $daemon 2>/dev/null; wait $daemon 2>/dev/null; rm -rf "$SCRATCH/state" "$SCRATCH"/scan-*' EXIT
until grep -q 'cuda, ' "$work/err"; do
	kill -0 $daemon || { cat "$work/err"; exit 1; }
	sleep 0.05
done
url=$(sed -n 's/^listening on //p' "$work/out")
export CBCT_URL=$url

now() { date +%s%N; }
seconds() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.3f", (b - a) / 1e9 }'; }
json=(-sS -H 'Content-Type: application/json')

simulate() { # NAME ...: a scan directory
	local name=$1
	shift
	[ -d "$SCRATCH/scan-$name" ] || cbct simulate -o "$SCRATCH/scan-$name" --phantom head --scale 45 --density 0.0192 "$@" >/dev/null 2>&1
}

fetch() { # JOB: its last volume, and when that was there
	curl -sS "$url/v1/jobs/$1/volumes/final?format=raw" -o /dev/null
	now
}

median() { sort -n | awk '{ line[NR] = $0 } END { print line[int((NR + 1) / 2)] }'; }

measure() { # WHAT SCAN JOB: medians of REPEATS
	local what=$1 directory=$SCRATCH/scan-$2 scan job sent ended listens line
	rm -f "$work"/rows-*
	for ((i = 0; i < 2 * ${REPEATS:-3}; i++)); do
		listens=$((i % 2))
		scan=$(curl "${json[@]}" --data-binary @"$directory/scan.json" "$url/v1/scans" | jq -r .id)
		job=$(curl "${json[@]}" --data-binary "$(jq -c --arg scan "$scan" '. + {scan: $scan}' <<<"$3")" "$url/v1/jobs" | jq -r .id)
		if ((listens)); then
			(
				grep -q -m 1 '/volumes/final"' < <(curl -sN "$url/v1/jobs/$job/events")
				fetch "$job" >"$work/fetched"
			) &
		fi
		cbct upload "$directory" --scan "$scan" --quiet >/dev/null
		sent=$(now)
		if ((listens)); then
			wait $!
			echo "$(seconds "$sent" "$(cat "$work/fetched")")" >>"$work/rows-1"
		fi
		curl -sS "$url/v1/jobs/$job?wait=100" -o "$work/job.json"
		ended=$(now)
		((listens)) ||
			echo "$(seconds "$sent" "$ended") $(seconds "$sent" "$(fetch "$job")") $(jq -c '[.state, .timings, .plan]' "$work/job.json")" >>"$work/rows-0"
		curl -sS -X DELETE "$url/v1/jobs/$job" -o /dev/null
		curl -sS -X DELETE "$url/v1/scans/$scan" -o /dev/null
	done
	read -r ended line < <(median <"$work/rows-0")
	printf '%-34s ended %s s, downloaded %s s; as soon as kept %s s  %s\n' "$what" "$ended" "${line%% *}" \
		"$(median <"$work/rows-1")" "${line#* }"
}

simulate A --views 100 --columns 559 --rows 559 --pixel 0.529
measure "A, FDK" A '{"grid": {"size": [256, 256, 256], "spacing_mm": [0.3725, 0.3725, 0.3725]}, "fdk": {}}'
measure "A, FDK, 50 SART view by view" A '{"grid": {"size": [256, 256, 256], "spacing_mm": [0.3725, 0.3725, 0.3725]},
	"fdk": {}, "sart": {"iterations": 50, "subsets": "views"}, "emit": [5, 10, 50]}'
simulate D --views 496 --arc 200 --columns 1240 --rows 960 --pixel 0.308 --photons 100000 --raw air
measure "D, FDK" D '{"grid": {"size": [512, 512, 512], "spacing_mm": [0.1862, 0.1862, 0.1862]}, "fdk": {}}'
