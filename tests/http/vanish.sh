#!/usr/bin/env bash
# In a network of its own (unshare -rn): watchers and readers of streams whose peer vanishes without a word are let go.
. "$(dirname "$0")/lib.sh"
set -euo pipefail
scan_dir=$1
grid='"grid": {"size": [32, 24, 16], "spacing_mm": [3, 4, 5]}'
open_files() { ls "/proc/$(cat "$work/daemon.pid")/fd" | wc -l; }

ip link set lo up
start_daemon
post_scan "$scan_dir"
post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
silent=$job
post_scan "$scan_dir"
post_projections "$scan_dir"
post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 100000, \"subsets\": \"views\"}, \"emit\": [\"fdk\"]}"
until req GET "/v1/jobs/$job/volumes" && [ "$(json '.volumes | length')" = 1 ]; do sleep 0.1; done
# the volume is ready to be streamed: its encoded copy stays open
curl -sS -N --max-time 1 -o /dev/null "$url/v1/jobs/$job/stream" 2>/dev/null || true
sleep 1
before=$(open_files)

pids=()
for ((i = 0; i < 8; i++)); do
	for path in "$job/events" "$silent/events" "$job/stream"; do
		curl -sS -N -o "$work/got.${path#*/}.$i" "$url/v1/jobs/$path" 2>/dev/null &
		pids+=($!)
	done
done
for ((i = 0; i < 600; i++)); do
	[ "$(stat -c %s "$work"/got.stream.* 2>/dev/null | awk '$1 > 49152' | wc -l)" = 8 ] && [ -s "$work/got.events.7" ] && break
	sleep 0.05
done
[ "$(open_files)" -ge $((before + 24)) ] || fail "24 connections over $before, got $(open_files)"
ip link set lo down
started=$SECONDS
for ((i = 0; i < 240; i++)); do
	[ "$(open_files)" -le "$before" ] && break
	sleep 0.25
done
[ "$(open_files)" -le "$before" ] || fail "descriptors as before ($before), got $(open_files)"
echo "  seconds until all that vanished were let go = $((SECONDS - started))"
kill -9 "${pids[@]}"
wait "${pids[@]}" 2>/dev/null || true
ip link set lo up
req GET /livez
expect_status 200
