#!/usr/bin/env bash
# Several workers, one for each device: jobs run beside each other, each on its own worker. Workers of the CPU
# stand for cards, unless BACKEND=cuda finds two of them.
. "$(dirname "$0")/lib.sh"

devices=0,3 iterations=150
[ "$BACKEND" = cpu ] || devices=0,1 iterations=5000
scan_dir=$work/ball
endless='{"scan": "SCAN", "grid": {"size": [24, 24, 16], "spacing_mm": [4, 4, 5]}, "sart": {"iterations": 100000, "subsets": "views"}}'

running() { # N: as many jobs run
	local end=$((SECONDS + 60))
	while :; do
		req GET /v1/devices
		[ "$(jq '[.devices[] | select(.state == "busy")] | length' "$body")" = "$1" ] && return
		[ $SECONDS -lt $end ] || fail "$1 busy workers: $(head -c 800 "$body")"
		sleep 0.1
	done
}

test_each_worker_has_a_job() {
	local jobs=()
	cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --columns 64 --rows 48 --pixel 4 -o "$scan_dir" 2>/dev/null
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	running 0
	for _ in 1 2 3; do
		post_job "$endless"
		jobs+=("$job")
	done
	running 2
	expect_json "[.devices[].device_index] == [$devices]"
	expect_json '([.devices[].job] | unique | length) == 2'
	req GET "/v1/jobs/${jobs[2]}"
	expect_json '.state == "queued"'
	# Whoever comes free takes the next one.
	req DELETE "/v1/jobs/${jobs[0]}"
	job=${jobs[0]} && wait_job cancelled
	running 2
	req GET "/v1/jobs/${jobs[2]}"
	expect_json '.state == "running"'
	for job in "${jobs[1]}" "${jobs[2]}"; do
		req DELETE "/v1/jobs/$job"
		wait_job cancelled
	done
}

test_all_devices_give_the_same_bits() {
	local recipe='{"scan": "SCAN", "grid": {"size": [48, 48, 24], "spacing_mm": [2, 2, 3]}, "fdk": {}, "sart": {"iterations": '$iterations', "subsets": 1}}'
	local first second digest
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$recipe"
	first=$job
	post_job "$recipe"
	second=$job
	running 2
	job=$first && wait_job succeeded
	req GET "/v1/jobs/$first/volumes"
	digest=$(json '.volumes[0].digest')
	job=$second && wait_job succeeded
	req GET "/v1/jobs/$second/volumes"
	[ "$(json '.volumes[0].digest')" = "$digest" ] || fail "the digest of the other device's volume"
}

test_lists_of_devices() {
	local list
	for list in 0, ,1 0,x x 0,,1 -1; do
		if "$BUILD/cbctd" --devices "$list" --print-config >/dev/null 2>"$work/refused"; then
			fail "--devices $list refused"
		fi
		grep -q -- '--devices' "$work/refused" || fail "a message about --devices, got $(cat "$work/refused")"
	done
	"$BUILD/cbctd" --devices 0,2 --print-config | grep '^devices *= *0,2' >/dev/null || fail "devices = 0,2"
}

start_daemon --devices $devices --threads 1 || exit 1
run_tests
