#!/usr/bin/env bash
# Rates over loopback HTTP, the sync to disk included: 100 projections of 559 x 559 float32 in separate PUTs, over one
# connection and over four, and in one body, and through TLS; downloads of a 512 MiB volume. Best of three. A table, and
# $BUILD/bench/http.json. Measures the machine as it is: leave it alone meanwhile.
set -euo pipefail
cd "$(dirname "$0")/../.."
BUILD=$(realpath "${BUILD:-build}")
. tests/bench/lib.sh
work=$BUILD/bench/http
count=100 one=$((559 * 559 * 4)) repeats=3
start_daemon "$work" --backend cpu
mkdir "$work/views"

# 0x40404040 is a float of 3.004: finite, and as good as any other where nothing is compressed
head -c $((one * count)) /dev/zero | tr '\0' '\100' >"$work/all"
split -b $one -d -a 3 "$work/all" "$work/views/"

new_scan() { # COLUMNS ROWS COUNT
	curl -sf "$url/v1/scans" -H 'Content-Type: application/json' -d "{\"name\": \"bench\", \"detector\": {\"columns\": $1, \"rows\": $2, \"pixel_mm\": [0.8, 0.8]},
	  \"projections\": {\"count\": $3, \"sample\": \"float32\", \"quantity\": \"line_integral\"},
	  \"geometry\": {\"kind\": \"circular\", \"source_to_isocentre_mm\": 620, \"source_to_detector_mm\": 1100,
	  \"first_angle_deg\": 0, \"angle_step_deg\": $((360 / $3))}}" | jq -r .id
}
# Seconds of "$@", told apart from what prepares it.
seconds() {
	local start=$EPOCHREALTIME
	"$@"
	echo "$EPOCHREALTIME $start" | awk '{ print $1 - $2 }'
}
put_config() { # FIRST STEP: a curl configuration that sends every STEP-th view from FIRST on
	local k
	for ((k = $1; k < count; k += $2)); do
		printf 'url = "%s/v1/scans/%s/projections/%d"\nupload-file = "%s/views/%03d"\noutput = /dev/null\n' "$url" "$scan" "$k" "$work" "$k"
	done
}
send_separately() { curl -sf -K "$work/curl.0"; }
send_parallel() {
	local i pids=()
	for i in 0 1 2 3; do
		curl -sf -K "$work/curl.$i" &
		pids+=($!)
	done
	wait "${pids[@]}"
}
send_whole() { curl -sf -o /dev/null -T "$work/all" "$url/v1/scans/$scan/projections"; }
complete() { curl -sf "$url/v1/scans/$scan" | jq -e '.missing == []' >/dev/null; }

results=()
result() { # NAME BYTES SECONDS...
	local name=$1 bytes=$2 best
	shift 2
	best=$(printf '%s\n' "$@" | sort -g | head -1)
	printf '%-44s %8.1f MB %8.3f s %9.0f MB/s\n' "$name" "$(awk "BEGIN { print $bytes / 1e6 }")" "$best" \
		"$(awk "BEGIN { print $bytes / 1e6 / $best }")"
	results+=("$(jq -cn --arg name "$name" --argjson bytes "$bytes" --argjson seconds "$best" \
		'{name: $name, bytes: $bytes, seconds: $seconds, mb_per_s: ($bytes / 1e6 / $seconds)}')")
}

bench_put() { # NAME FUNCTION CONNECTIONS
	local times=() i
	for ((i = 0; i < repeats; i++)); do
		scan=$(new_scan 559 559 $count)
		for ((c = 0; c < $3; c++)); do put_config "$c" "$3" >"$work/curl.$c"; done
		sync
		times+=("$(seconds "$2")")
		complete
		curl -sf -X DELETE "$url/v1/scans/$scan"
	done
	result "$1" $((one * count)) "${times[@]}"
}
bench_put "upload, $count PUTs, 1 connection" send_separately 1
bench_put "upload, $count PUTs, 4 connections" send_parallel 4
bench_put "upload, one body" send_whole 1

# A small scan makes a large volume quickly.
scan=$(new_scan 16 16 4)
head -c $((16 * 16 * 4 * 4)) "$work/all" | curl -sf -o /dev/null -T - "$url/v1/scans/$scan/projections"
job=$(curl -sf "$url/v1/jobs" -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"grid\": {\"size\": [512, 512, 512], \"spacing_mm\": [0.1, 0.1, 0.1]}, \"fdk\": {}}" | jq -r .id)
until curl -sf "$url/v1/jobs/$job?wait=60" | jq -e '.state == "succeeded"' >/dev/null; do :; done

get() { curl -sf -o /dev/null "$@"; }
bench_get() { # NAME QUERY [CURL OPTION ...]
	local name=$1 from="$url/v1/jobs/$job/volumes/final$2" times=() i
	shift 2
	for ((i = 0; i < repeats; i++)); do times+=("$(seconds get "$@" "$from")"); done
	result "$name" $((512 * 512 * 512 * 4)) "${times[@]}"
}
bench_get "download, nifti float32" ""
bench_get "download, raw float32" "?format=raw"
bench_get "download, mha float32" "?format=mha"
bench_get "download, nifti int16 (rate of float32 read)" "?type=int16"
bench_get "download, nifti zstd (rate of float32 read)" "" -H 'Accept-Encoding: zstd'

# The same upload through TLS, whose goal is 80 % of the rate without.
kill "$daemon"
wait "$daemon" 2>/dev/null || true
openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout "$work/key.pem" -out "$work/certificate.pem" -days 2 \
	-subj /CN=localhost -addext subjectAltName=IP:127.0.0.1 2>/dev/null
chmod 600 "$work/key.pem"
export CURL_CA_BUNDLE=$work/certificate.pem
start_daemon "$work/tls" --backend cpu --tls-cert "$work/certificate.pem" --tls-key "$work/key.pem"
bench_put "upload, one body, TLS" send_whole 1
bench_put "upload, $count PUTs, 4 connections, TLS" send_parallel 4
rm -rf "$work"/{all,views,curl.*,key.pem,certificate.pem}

printf '%s\n' "${results[@]}" | jq -s '{results: .}' >"$BUILD/bench/http.json"
