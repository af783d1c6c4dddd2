#!/usr/bin/env bash
# Full disks, disks that fail for a moment, syncs that fail: what waits, what is tried again, and what is final.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
small='"grid": {"size": [16, 16, 16], "spacing_mm": [5, 5, 5]}'
large='"grid": {"size": [128, 128, 128], "spacing_mm": [1, 1, 1]}' # 8 MiB a volume
library=$(realpath "$BUILD")/faults.so

# faulty_daemon [OPTION ...]: fault CALL ERRNO PART TIMES decides what fails
faulty_daemon() {
	[ "${SANITIZED:-0}" = 0 ] || skip "a sanitizer must be the first library of a process"
	export CBCT_TEST_FAULTS=$work/faults
	rm -f "$work/faults" "$work/faults.count"
	LD_PRELOAD=$library start_daemon "$@"
}
fault() { # CALL ERRNO PART TIMES [PASS]: see faults.c
	rm -f "$work/faults.count"
	echo "$1 $2 $3 $4 ${5:-0}" >"$work/faults.new"
	mv "$work/faults.new" "$work/faults"
}
no_fault() { rm -f "$work/faults"; }
daemon_ends() { # with status 1, and says why
	local pid
	pid=$(cat "$work/daemon.pid")
	timeout 30 tail --pid="$pid" -f /dev/null || fail "the end of a daemon whose disk failed"
	grep -q 'the disk failed, stopping: .*Input/output error' "$work/cbctd.err" || fail "a word of why it ended"
	rm "$work/cbctd.err"
}
waits_for() { # WHAT
	local end=$((SECONDS + 60))
	until req GET "/v1/jobs/$job" && [ "$(json '.state + " " + (.waiting_for | join(" "))')" = "queued $1" ]; do
		[ $SECONDS -lt $end ] || fail "a job that waits for $1: $(json '{state, waiting_for, error}')"
		sleep 0.05
	done
}

small_disk() { # SIZE
	disk=$work/small # not local: the trap runs after the function
	mkdir -p "$disk"
	mount -t tmpfs -o size="$1" none "$disk" 2>/dev/null || skip "no permission to mount a small tmpfs"
	trap 'stop_daemon; umount "$disk"' EXIT
	state=$disk/state start_daemon
}

test_a_job_that_meets_a_full_disk_waits_for_room() {
	local first
	small_disk 6m
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @<(jq '.projections.count = 600 | .geometry = {kind: "circular",
	    source_to_isocentre_mm: 600, source_to_detector_mm: 1000, first_angle_deg: 0, angle_step_deg: 0.6}' "$scan_dir/scan.json")
	expect_problem 507
	header Retry-After | grep -qE '^[0-9]+$' || fail "Retry-After of a full disk"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $large, \"fdk\": {}}"
	first=$job
	waits_for space
	expect_json '.error == null'
	# it is in nobody's way
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}}"
	wait_job succeeded
	mount -o remount,size=60m "$disk"
	job=$first
	wait_job succeeded
	expect_json '.volumes == 1'
	stop_daemon
}

test_a_disk_that_was_full_for_a_moment_is_tried_again() {
	faulty_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	fault fallocate 28 final.nii 1
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}}"
	wait_job succeeded
	[ -s "$work/faults.count" ] || fail "a volume that met a full disk"
	no_fault
	stop_daemon
}

test_a_read_that_fails_once_is_no_damage() {
	faulty_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	fault pread 5 projections.raw 1
	req GET "/v1/scans/$scan/projections/3"
	expect_status 200
	[ -s "$work/faults.count" ] || fail "a read that failed"
	no_fault
	req GET "/v1/scans/$scan"
	expect_json '.missing == []'
	stop_daemon
}

test_a_read_of_the_catalogue_that_fails_once_is_no_damage() {
	local passed
	need_sqlite
	faulty_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	for passed in 0 1; do # each is tried twice
		stop_daemon
		fault pread 5 /catalogue.sqlite 2 "$passed"
		LD_PRELOAD=$library start_daemon
		[ "$(stat -c %s "$work/faults.count")" -gt "$passed" ] || fail "a read of the catalogue that failed"
		req GET /v1/quarantine
		expect_json '.entries == []'
		req GET "/v1/scans/$scan"
		expect_json '.missing == []'
	done
	# Nor is one that cannot be opened: the start ends with the reason.
	stop_daemon
	fault open 13 state/catalogue.sqlite 1000
	! LD_PRELOAD=$library timeout 20 "$BUILD/cbctd" --listen 127.0.0.1:0 --state-dir "$work/state" >"$work/refused" 2>&1 || fail "no start"
	grep -q 'catalogue.sqlite: Permission denied' "$work/refused" || fail "the reason in $(cat "$work/refused")"
	no_fault
	LD_PRELOAD=$library start_daemon
	req GET /v1/quarantine
	expect_json '.entries == []'
	# One that fails again is, and the catalogue is made again from the directories.
	stop_daemon
	fault pread 5 /catalogue.sqlite 4
	LD_PRELOAD=$library start_daemon
	req GET /v1/quarantine
	expect_json '[.entries[].from] == ["catalogue.sqlite"]'
	req GET "/v1/scans/$scan"
	expect_json '.missing == []'
	no_fault
	stop_daemon
}

test_an_image_of_scatter_that_could_not_be_removed_gives_place_to_another() {
	put() { # BYTE: the image of projection 0
		head -c 64 /dev/zero | tr '\0' "$1" >"$work/image.raw"
		req PUT "/v1/scans/$scan/scatter/0" --data-binary @"$work/image.raw"
	}
	faulty_daemon
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @<(jq '.projections += {quantity: "intensity", air: 60000,
	    scatter: {kind: "images", columns: 4, rows: 4, every: 60}}' "$scan_dir/scan.json")
	expect_status 201
	scan=$(json .id)
	put A
	expect_status 201
	fault open 5 scatter.raw 1 # once: it is tried again
	req DELETE "/v1/scans/$scan/scatter/0"
	expect_status 204
	put A
	expect_status 201
	fault open 5 scatter.raw 2
	req DELETE "/v1/scans/$scan/scatter/0"
	expect_problem 500
	put B
	expect_status 201
	req GET "/v1/scans/$scan/scatter/0"
	cmp "$body" "$work/image.raw" || fail "the second image"
	no_fault
	stop_daemon
}

test_a_full_disk_can_be_emptied() {
	local done_job filled=0
	small_disk 24m
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}, \"sart\": {\"iterations\": 40, \"subsets\": 1}}"
	wait_job succeeded
	done_job=$job
	# to the last byte
	while head -c 65536 /dev/zero >"$disk/fill.$filled" 2>/dev/null; do filled=$((filled + 1)); done
	head -c 4096 /dev/zero >>"$disk/fill.last" 2>/dev/null || true
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "@$scan_dir/scan.json"
	expect_problem 507
	req DELETE "/v1/jobs/$done_job"
	expect_status 204
	req DELETE "/v1/scans/$scan"
	expect_status 204
	rm -f "$disk"/fill.*
	req GET /v1/scans
	expect_json '.scans == []'
	stop_daemon KILL
	state=$disk/state start_daemon
	req GET /v1/jobs
	expect_json '.jobs == []'
	stop_daemon
}

test_a_start_on_a_full_disk() {
	local full
	small_disk 6m
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	for full in before after; do # the daemon has ended
		[ $full = before ] || stop_daemon
		cat /dev/zero >"$disk/fill.$full" 2>/dev/null || true
		[ "$(df --output=avail "$disk" | tail -1)" -eq 0 ] || fail "a full disk"
		[ $full = after ] || stop_daemon
		state=$disk/state start_daemon
		req GET "/v1/scans/$scan"
		expect_json '.missing == []'
		req GET "/v1/scans/$scan/projections/3?format=raw"
		expect_status 200
	done
	req DELETE "/v1/scans/$scan"
	expect_status 204
	rm "$disk"/fill.*
	post_scan "$scan_dir"
	stop_daemon
}

# Removals have used the room that was set aside for them, and whatever is free is taken at once by others.
test_starts_on_a_full_disk_again_and_again() {
	local round scans=() waiting running
	fill() { cat /dev/zero >"$disk/fill.$1" 2>/dev/null || true; }
	small_disk 16m
	for round in 1 2 3; do
		post_scan "$scan_dir"
		post_projections "$scan_dir"
		scans+=("$scan")
	done
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}, \"sart\": {\"iterations\": 100000, \"subsets\": \"views\"}, \"emit\": [\"fdk\"]}"
	running=$job
	state_becomes running
	post_scan "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}}"
	waiting=$job
	for round in KILL KILL TERM KILL; do
		rm -f "$disk/state/reserve"
		fill "$round.$RANDOM"
		stop_daemon $round
		fill "after.$RANDOM"
		[ "$(df --output=avail "$disk" | tail -1)" -eq 0 ] || fail "a full disk"
		state=$disk/state start_daemon
		req GET /v1/scans
		expect_json '.scans | length == 4'
		req GET "/v1/scans/${scans[0]}/projections/3?format=raw"
		expect_status 200
		cmp "$body" <(dd if="$scan_dir/projections.raw" bs=$((64 * 48 * 4)) skip=3 count=1 status=none) || fail "projection 3"
		req GET "/v1/jobs/$running"
		expect_json '.state == "running" or .state == "queued"'
	done
	fill now
	req GET /readyz
	expect_status 200
	grep -q '^disk: it is full' "$body" || fail "a word of the full disk, got $(cat "$body")"
	req PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
	expect_problem 507
	header Retry-After | grep -qE '^[0-9]+$' || fail "Retry-After of a full disk"
	# It goes on by itself as soon as a client has made room.
	for round in 0 1; do
		req DELETE "/v1/scans/${scans[$round]}"
		expect_status 204
	done
	req DELETE "/v1/jobs/$running?wait=20"
	expect_json '.state == "cancelled"'
	req DELETE "/v1/jobs/$running"
	expect_status 204
	post_projections "$scan_dir"
	job=$waiting
	wait_job succeeded
	for round in reserve reserve-start; do
		[ -s "$disk/state/$round" ] || fail "room set aside again: $round"
	done
	req GET /readyz
	[ "$(cat "$body")" = ready ] || fail "nothing of a full disk, got $(cat "$body")"
	stop_daemon
}

test_a_step_that_had_no_room_keeps_no_daemon_from_starting() {
	truncate -s 48m "$work/image"
	mkfs.ext4 -q -m 0 "$work/image"
	disk=$work/small # not local: the trap runs after the function
	mkdir -p "$disk"
	mount -o loop "$work/image" "$disk" 2>/dev/null || skip "no permission to mount a small disk"
	trap 'umount "$disk"' EXIT
	state=$disk/state start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	stop_daemon
	python3 "$here/full_disk.py" "$BUILD" "$disk" "$scan"
}

test_a_moment_without_descriptors_or_with_a_slow_disk_ends_no_job() {
	faulty_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	fault open 24 projections.raw 1 # EMFILE
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}}"
	wait_job succeeded
	expect_json '.attempts == 2'
	fault open 5 scan.json 1 # EIO
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}}"
	wait_job succeeded
	# one that stays is no moment
	fault open 5 projections.raw 1000000
	post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}}"
	wait_job failed
	expect_json '.error.detail | test("3 times")'
	no_fault
	stop_daemon
}

test_a_sync_that_failed_is_final() {
	local what
	# of a worker's volume, of the digest thread, of a job's record, of a directory: whoever asks a second time is told that all is well
	for what in "fdatasync 5 .nii 1" "fdatasync 5 .nii 1 1" "fsync 5 record.json 1 1" "fsync 5 /jobs/ 1 1" "fsync 5 /scans/ 1"; do
		faulty_daemon
		post_scan "$scan_dir"
		post_projections "$scan_dir"
		# shellcheck disable=SC2086
		fault $what
		if [[ $what == *scans* ]]; then
			req POST /v1/scans -H 'Content-Type: application/json' --data-binary "@$scan_dir/scan.json"
			expect_problem 500
		else
			post_job "{\"scan\": \"SCAN\", $small, \"fdk\": {}}"
		fi
		daemon_ends
		stop_daemon
		no_fault
		start_daemon
		if [[ $what != *scans* ]]; then
			wait_job succeeded
			get_volume final "$work/final"
		fi
		req GET "/v1/scans/$scan"
		expect_json '.missing == []'
		stop_daemon
	done
}

test_sighup_ends_nothing() {
	local pid
	start_daemon
	pid=$(cat "$work/daemon.pid")
	kill -HUP "$pid"
	kill -HUP "$pid"
	sleep 0.2
	req GET /livez
	expect_status 200
	stop_daemon
}

stop_after_each=1 run_tests
