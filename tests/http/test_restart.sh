#!/usr/bin/env bash
# What was acknowledged is there after kill -9, SIGTERM and a dead worker; full and failing disks are test_disk.sh's.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
one=$((64 * 48 * 4))
grid='"grid": {"size": [32, 32, 16], "spacing_mm": [3, 3, 4]}'
long=160 # iterations, of 13 ms or more: enough to be killed in the middle, also on a fast machine
[ "${SANITIZED:-0}" = 0 ] || long=60

projection() { # K
	dd if="$scan_dir/projections.raw" bs=$one skip="$1" count=1 status=none
}

running_at() { # ITERATION: waits until the job is there
	local i
	for ((i = 0; i < 2400; i++)); do
		req GET "/v1/jobs/$job"
		[ "$(json '.iteration // 0')" -ge "$1" ] && return 0
		sleep 0.05
	done
	fail "iteration $1 of job $job: $(head -c 400 "$body")"
}

test_everything_is_known_again_after_kill_9() {
	local k finished keyed_scan
	start_daemon
	post_scan "$scan_dir"
	finished=$scan
	keyed() { req POST /v1/scans -H 'Content-Type: application/json' -H 'Idempotency-Key: k' --data-binary "@$scan_dir/scan.json"; }
	keyed
	keyed_scan=$(json .id)
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 2}}"
	wait_job succeeded
	cp "$body" "$work/before"
	get_volume final "$work/final.before"
	post_scan "$scan_dir"
	for k in 3 4 17; do
		projection $k >"$work/one"
		req PUT "/v1/scans/$scan/projections/$k" -T "$work/one"
		expect_status 201
	done
	stop_daemon KILL
	start_daemon
	req GET "/v1/scans/$scan"
	expect_json '.received == [[3, 4], [17, 17]]'
	for k in 3 4 17; do
		projection $k >"$work/one"
		req GET "/v1/scans/$scan/projections/$k"
		cmp "$body" "$work/one" || fail "projection $k as it was sent"
		req PUT "/v1/scans/$scan/projections/$k" -T "$work/one"
		expect_status 200
	done
	req GET "/v1/jobs/$job"
	diff <(jq -S '{state, history, grid, scan, attempts}' "$body") <(jq -S '{state, history, grid, scan, attempts}' "$work/before") || fail "the job as it was"
	get_volume final "$work/final.after"
	cmp "$work/final.before" "$work/final.after" || fail "the volume as it was"
	req GET /v1/scans
	expect_json "[.scans[].id] == [\"$scan\", \"$keyed_scan\", \"$finished\"]"
	keyed
	[ "$(json .id)" = "$keyed_scan" ] || fail "the scan that its Idempotency-Key made"
	stop_daemon
}

acknowledged_at_least() { # COUNT
	local i
	for ((i = 0; i < 2400; i++)); do
		[ "$(wc -l <"$work/acknowledged")" -lt "$1" ] || return 0
		sleep 0.05
	done
	fail "$1 projections acknowledged"
}

test_kill_9_in_the_middle_of_uploads_loses_nothing_that_was_acknowledged() {
	local round k pids
	start_daemon
	post_scan "$scan_dir"
	: >"$work/acknowledged"
	for round in 1 2 3 4; do
		pids=()
		for k in $(seq $(((round - 1) * 15)) $((round * 15 - 1))); do
			(
				code=$(projection "$k" |
					curl -s -o /dev/null -w '%{http_code}' --data-binary @- -X PUT "$url/v1/scans/$scan/projections/$k") || true
				[[ $code == 20[01] ]] && echo "$k" >>"$work/acknowledged"
				true
			) &
			pids+=($!)
			# Half of them in peace until some are acknowledged, then the daemon dies over the others.
			[ "$k" != $((round * 15 - 9)) ] || acknowledged_at_least $((round * 3))
			[ "$k" != $((round * 15 - 1)) ] || stop_daemon KILL
		done
		wait "${pids[@]}" || true
		start_daemon
	done
	echo "  acknowledged projections = $(wc -l <"$work/acknowledged") (of 60)"
	req GET "/v1/scans/$scan"
	cp "$body" "$work/scan"
	while read -r k; do
		jq -e ".received | any(.[0] <= $k and .[1] >= $k)" "$work/scan" >/dev/null || fail "projection $k, acknowledged"
		req GET "/v1/scans/$scan/projections/$k"
		projection "$k" | cmp - "$body" || fail "projection $k as it was sent"
	done <"$work/acknowledged"
	[ -s "$work/acknowledged" ] || fail "some projections acknowledged"
	stop_daemon
}

test_a_running_job_is_queued_again_after_kill_9() {
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": $long, \"subsets\": \"views\"}, \"emit\": [1, $long]}"
	running_at 3
	stop_daemon KILL
	start_daemon
	wait_job succeeded
	expect_json ".attempts == 2 and ([.history[].iteration] == [range(1; $long + 1)])"
	req GET "/v1/jobs/$job/volumes"
	expect_json "[.volumes[].name] == [\"final\", \"iter-$long\", \"iter-1\"]"
	stop_daemon
}

test_sigterm_leaves_a_checkpoint_and_exits_0() {
	local at
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": $long, \"subsets\": \"views\"}}"
	running_at 5
	at=$(json .iteration)
	stop_daemon TERM
	[ "$stop_status" = 0 ] || fail "exit status 0, got $stop_status"
	start_daemon
	req GET "/v1/jobs/$job"
	expect_json ".iteration >= $at"
	wait_job succeeded
	expect_json "[.history[].iteration] == [range(1; $long + 1)]"
	stop_daemon
}

test_a_dead_worker_takes_nothing_with_it() {
	local worker
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": $long, \"subsets\": \"views\"}}"
	running_at 2
	worker=$(worker_of)
	kill -9 "$worker"
	wait_job succeeded
	expect_json '.attempts == 2'
	stop_daemon
}

# held_at FILE: the iteration of a checkpoint, 0 where there is none
held_at() {
	local text
	text=$(head -c 40 "$work/state/jobs/$job/$1" 2>/dev/null | tr -d '\0') || true
	[[ $text =~ ^cbctd\ checkpoint\ ([0-9]+) ]] && echo "${BASH_REMATCH[1]}" || echo 0
}
held_behind() { # ITERATION: waits until the newest checkpoint is of a later one; prints it
	local i at
	for ((i = 0; i < 6000; i++)); do
		at=$(held_at checkpoint.f32)
		[ "$at" -le "$1" ] || { echo "$at"; return 0; }
		sleep 0.02
	done
	fail "a checkpoint behind iteration $1"
}

test_a_job_goes_on_from_its_newest_checkpoint_however_often_it_is_killed() {
	local recipe at=0 i many=200
	for recipe in '"sart": {"iterations": '$many', "subsets": "views"}, "tv": {"method": "gradient", "iterations": 1}' '"cgls": {"iterations": '$many'}'; do
		at=0
		start_daemon --checkpoint-seconds 0.05
		post_scan "$scan_dir"
		post_projections "$scan_dir"
		recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, $recipe, \"emit\": [20]}"
		post_job "$recipe"
		wait_job succeeded
		[ ! -e "$work/state/jobs/$job/checkpoint.f32" ] || fail "no checkpoint of a job that has ended"
		cp "$body" "$work/undisturbed"
		get_volume final "$work/final.undisturbed" format=raw
		post_job "$recipe"
		# More often than a job without progress may lose its worker; every third time the daemon goes, too.
		for ((i = 1; i <= 4; i++)); do
			at=$(held_behind "$at")
			if [ $((i % 3)) = 0 ]; then
				stop_daemon KILL
				at=$(held_at checkpoint.f32)
				start_daemon --checkpoint-seconds 0.05
			else
				kill -9 "$(worker_of)"
			fi
			running_at "$at"
			expect_json '.state == "running" or .state == "queued" or .state == "succeeded"'
		done
		wait_job succeeded
		expect_json ".attempts > 3 and ([.history[].iteration] == [range(1; $many + 1)])"
		diff <(jq -S '[.history[] | del(.seconds)]' "$body") <(jq -S '[.history[] | del(.seconds)]' "$work/undisturbed") ||
			fail "the history of an undisturbed run"
		get_volume final "$work/final" format=raw
		cmp "$work/final" "$work/final.undisturbed" || fail "the bits of an undisturbed run"
		stop_daemon
	done
}

# recorded: the iteration that the catalogue knows a checkpoint of; a copy is read, since another program's writes are damage
recorded() {
	rm -rf "$work/copy" && mkdir "$work/copy" && cp "$work/state"/catalogue.sqlite* "$work/copy"
	python3 -c 'import sqlite3, sys; print(sqlite3.connect(sys.argv[1]).execute("SELECT checkpoint FROM jobs WHERE id = ?", sys.argv[2:]).fetchone()[0])' \
		"$work/copy/catalogue.sqlite" "$job"
}

test_a_job_goes_on_from_the_other_checkpoint_where_one_is_damaged_or_not_recorded() {
	need_sqlite
	local at kind name recipe
	recipe="{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": $long, \"subsets\": \"views\"}}"
	start_daemon --checkpoint-seconds 0.1
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$recipe"
	wait_job succeeded
	get_volume final "$work/final.undisturbed" format=raw
	for kind in damaged unrecorded; do
		post_job "$recipe"
		at=$(held_behind "$(held_behind 0)")
		stop_daemon KILL
		if [ $kind = damaged ]; then
			at=$(recorded)
			[ "$(held_at checkpoint-before.f32)" -gt 0 ] || fail "two checkpoints kept in turn"
			[ "$at" -gt 0 ] || fail "a checkpoint in the catalogue"
			name=checkpoint.f32
			[ "$(held_at checkpoint-before.f32)" != "$at" ] || name=checkpoint-before.f32
			printf 'X' | dd of="$work/state/jobs/$job/$name" bs=1 seek=5000 conv=notrunc status=none
		else # a catalogue that has not heard of the last ones
			rm -rf "$work/older" && mkdir "$work/older" && cp "$work/state"/catalogue.sqlite* "$work/older"
			start_daemon --checkpoint-seconds 0.1
			held_behind "$(held_behind "$at")" >/dev/null
			stop_daemon KILL
			rm "$work/state"/catalogue.sqlite*
			cp "$work/older"/* "$work/state"
		fi
		start_daemon --checkpoint-seconds 0.1
		wait_job succeeded
		expect_json "[.history[].iteration] == [range(1; $long + 1)]"
		if [ $kind = damaged ]; then
			expect_json '[.warnings[].code] == ["damaged_checkpoint"]'
		else
			expect_json '.warnings == []'
		fi
		get_volume final "$work/final" format=raw
		cmp "$work/final" "$work/final.undisturbed" || fail "the bits of an undisturbed run"
	done
	stop_daemon
}

# A job whose FDK volume is told of and stays unsettled for as long as $hold is there.
hold=$work/hold
told_and_held() {
	local i
	: >"$hold"
	CBCT_TEST_HOLD=$hold start_daemon --worker "$BUILD/cbct-worker-held"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 3}, \"emit\": [\"fdk\"]}"
	for ((i = 0; i < 2400; i++)); do
		req GET "/v1/jobs/$job/volumes?wait=0"
		expect_status 200
		[ "$(json '.volumes | length')" = 0 ] || break
		sleep 0.05
	done
	expect_json '[.volumes[].name] == ["fdk"] and (.volumes[0] | has("digest") | not)'
	get_volume fdk "$work/told" format=raw
	etag=$(header etag)
}
digest_of() { echo "sha-256=:$(openssl dgst -sha256 -binary "$1" | base64 -w 0):"; }
events_of() { curl -sS -N --max-time 60 "$url/v1/jobs/$job/events" | awk '/^event: /{ printf "%s%s", sep, $2; sep = " " }'; }

# The first checkpoint takes three times as long as the iterations that are left: no other would be on the disk in time.
test_a_checkpoint_that_the_end_would_overtake_is_not_begun() {
	local i
	: >"$hold"
	CBCT_TEST_HOLD=$hold start_daemon --worker "$BUILD/cbct-worker-held" --checkpoint-seconds 0.01
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": null, \"sart\": {\"iterations\": $((4 * long)), \"subsets\": 1}}"
	for ((i = 0; i < 2400; i++)); do
		req GET "/v1/jobs/$job"
		[ "$(json '.iteration // 0')" -lt $((3 * long)) ] || break
		sleep 0.05
	done
	expect_json '.state == "running"'
	rm "$hold"
	wait_job succeeded
	req GET /metrics
	[ "$(awk '$1 == "cbctd_checkpoints_total" { print $2 }' "$body")" = 1 ] || fail "one checkpoint, got $(grep '^cbctd_checkpoints_total' "$body")"
	stop_daemon
}

test_a_volume_is_told_of_before_it_is_on_the_disk_and_the_job_ends_after() {
	local list
	told_and_held
	req GET "/v1/jobs/$job/volumes?wait=0.2"
	expect_json '.volumes[0] | has("digest") | not'
	curl -sS --max-time 60 "$url/v1/jobs/$job/volumes" >"$work/list" &
	list=$!
	req GET "/v1/jobs/$job?wait=1"
	expect_json '.state == "running"'
	[ ! -s "$work/list" ] || fail "a list that waits for the digest"
	rm "$hold"
	wait $list
	[ "$(jq -r '.volumes[] | select(.name == "fdk") | .digest' "$work/list")" = "$(digest_of "$work/told")" ] ||
		fail "the digest of what was told of: $(cat "$work/list")"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes"
	expect_json '[.volumes[].name] == ["final", "fdk"] and (.volumes | all(.digest | startswith("sha-256=:")))'
	get_volume fdk "$work/settled" format=raw
	[ "$(header etag)" = "$etag" ] || fail "the ETag $etag still, got $(header etag)"
	cmp "$work/told" "$work/settled" || fail "the same voxels"
	get_volume final "$work/final" format=raw
	[ "$(jq -r '.volumes[0].digest' <(curl -sS "$url/v1/jobs/$job/volumes"))" = "$(digest_of "$work/final")" ] || fail "the digest of the final volume"
	[ "$(header etag)" != "$etag" ] || fail "another ETag for another volume"
	stop_daemon
}

test_a_volume_that_was_told_of_outlives_its_worker() {
	told_and_held
	kill -9 "$(worker_of)"
	# not done by the next worker, whose syncs are held up too
	req GET "/v1/jobs/$job/volumes?wait=20"
	expect_json ".volumes | any(.name == \"fdk\" and .digest == \"$(digest_of "$work/told")\")"
	rm "$hold"
	wait_job succeeded
	expect_json '.attempts == 2'
	get_volume fdk "$work/again" format=raw
	cmp "$work/told" "$work/again" || fail "the same bits from the second attempt"
	[ "$(header etag)" != "$etag" ] || fail "another ETag for a volume that was made again"
	[ "$(events_of | tr ' ' '\n' | grep -c volume)" = 2 ] || fail "each volume told of once, got $(events_of)"
	stop_daemon
}

test_a_volume_that_was_told_of_outlives_a_job_that_is_cancelled_and_its_worker() {
	told_and_held
	req DELETE "/v1/jobs/$job"
	expect_status 202
	kill -9 "$(worker_of)"
	wait_job cancelled
	req GET "/v1/jobs/$job/volumes"
	expect_json "[.volumes[] | {name, digest}] == [{name: \"fdk\", digest: \"$(digest_of "$work/told")\"}]"
	rm "$hold"
	stop_daemon
	start_daemon
	get_volume fdk "$work/again" format=raw
	cmp "$work/told" "$work/again" || fail "the volume after a restart"
	stop_daemon
}

test_a_volume_that_was_told_of_is_made_again_when_the_daemon_dies_too_soon() {
	told_and_held
	stop_daemon KILL
	rm "$hold"
	start_daemon
	grep -q "volume fdk had not reached the disk" "$work/cbctd.err" || fail "what becomes of it in the log"
	# a stream that asks for it meanwhile waits until it is there again
	curl -sS --max-time 120 "$url/v1/jobs/$job/stream?format=raw" >"$work/stream"
	wait_job succeeded
	expect_json '.attempts == 2'
	grep -qa '^CBCT-Volume: fdk' "$work/stream" && grep -qa '^CBCT-Volume: final' "$work/stream" || fail "both volumes in the stream"
	get_volume fdk "$work/again" format=raw
	cmp "$work/told" "$work/again" || fail "the same bits once more"
	[ "$(events_of | tr ' ' '\n' | grep -c volume)" = 2 ] || fail "each volume told of once, got $(events_of)"
	stop_daemon
}

# A job that has ended and whose digests do not come for as long as $hold is there.
ended_and_held() {
	: >"$hold"
	CBCT_TEST_HOLD_DIGEST=$hold start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"emit\": [\"fdk\"]}"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes?wait=0"
	expect_json '[.volumes[] | [.name, has("digest")]] == [["final", false], ["fdk", false]]'
	get_volume fdk "$work/ended" format=raw
	etag=$(header etag)
}
expect_digests() {
	expect_json "[.volumes[] | {name, digest}] == ([\"final\", \"fdk\"] | map({name: ., digest: \"$(digest_of "$work/ended")\"}))"
}

test_a_job_ends_before_its_digests_are_known() {
	local list first deleted
	ended_and_held
	first=$job
	curl -sS --max-time 60 "$url/v1/jobs/$first/volumes" >"$work/list" &
	list=$!
	# others are served meanwhile, by the next worker too
	kill -9 "$(worker_of)"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	wait_job succeeded
	deleted=$job
	req DELETE "/v1/jobs/$deleted"
	expect_status 204
	[ ! -s "$work/list" ] || fail "a list that waits for the digests"
	rm "$hold"
	wait $list
	job=$first
	req GET "/v1/jobs/$job/volumes"
	expect_digests
	jq -e --slurpfile now <(curl -sS "$url/v1/jobs/$job/volumes") '. == $now[0]' "$work/list" >/dev/null || fail "the list that waited: $(cat "$work/list")"
	get_volume fdk "$work/hashed" format=raw
	[ "$(header etag)" = "$etag" ] || fail "the ETag $etag still, got $(header etag)"
	stop_daemon
	! grep -q "job $deleted.*digest" "$work/cbctd.err" || fail "no word of a job that was deleted"
}

test_digests_that_a_daemon_did_not_live_to_make_come_from_the_next() {
	ended_and_held
	stop_daemon KILL
	rm "$hold"
	start_daemon
	req GET "/v1/jobs/$job/volumes"
	expect_digests
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded" and .attempts == 1'
	get_volume fdk "$work/again" format=raw
	cmp "$work/ended" "$work/again" || fail "the volume after a restart"
	[ "$(header etag)" = "$etag" ] || fail "the ETag $etag still, got $(header etag)"
	stop_daemon
}

test_a_checkpoint_that_is_gone_begins_the_job_again() {
	local yielded
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": $long, \"subsets\": \"views\"}}"
	yielded=$job
	running_at 2
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 100000, \"subsets\": \"views\"}, \"priority\": \"stat\"}"
	running_at 1
	req GET "/v1/jobs/$yielded"
	expect_json '.state == "queued" and .iteration >= 2 and .attempts == 1'
	rm "$state/jobs/$yielded/checkpoint.f32"
	req DELETE "/v1/jobs/$job?wait=30"
	expect_json '.state == "cancelled"'
	job=$yielded
	wait_job succeeded
	expect_json ".attempts == 2 and ([.history[].iteration] == [range(1; $long + 1)])"
	stop_daemon
}

test_on_a_full_disk_who_makes_room_waits_for_it() {
	local low
	small=$work/small
	mkdir -p "$small"
	mount -t tmpfs -o size=6m none "$small" 2>/dev/null || skip "no permission to mount a small tmpfs"
	trap 'stop_daemon; umount "$small"' EXIT
	state=$small/state start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	# neither its checkpoint nor its volume has room
	post_job '{"scan": "SCAN", "grid": {"size": [128, 128, 128], "spacing_mm": [1, 1, 1]}, "fdk": null, "sart": {"iterations": 500, "subsets": 1}}'
	low=$job
	running_at 1
	post_job '{"scan": "SCAN", "grid": {"size": [16, 16, 16], "spacing_mm": [5, 5, 5]}, "fdk": {}, "priority": "stat"}'
	wait_job succeeded
	# its volume would have no room either: it waits for that, and not with a worker
	job=$low
	until req GET "/v1/jobs/$job" && [ "$(json '.state')" = queued ]; do sleep 0.05; done
	expect_json '.waiting_for == ["space"] and .attempts == 2'
	req DELETE "/v1/jobs/$low"
	wait_job cancelled
	stop_daemon
}

test_checkpoints_leave_room_for_the_volume() {
	local size
	small=$work/small
	# of 8 MiB each: room for the volume alone, and for one or two checkpoints beside it
	for size in 14m 22m 30m; do
		mkdir -p "$small"
		mount -t tmpfs -o size=$size none "$small" 2>/dev/null || skip "no permission to mount a small tmpfs"
		trap 'stop_daemon; umount "$small"' EXIT
		state=$small/state start_daemon --checkpoint-seconds 0.1
		post_scan "$scan_dir"
		post_projections "$scan_dir"
		post_job '{"scan": "SCAN", "grid": {"size": [128, 128, 128], "spacing_mm": [1, 1, 1]}, "fdk": null, "sart": {"iterations": 6, "subsets": 1}}'
		wait_job succeeded
		expect_json '.attempts == 1'
		stop_daemon
		umount "$small"
		trap - EXIT
	done
}

test_a_worker_that_does_not_exit_keeps_nobody() {
	local pid
	# one that does its work, and then stays
	printf '#!/bin/sh\n"%s" "$@"\nexec sleep 300\n' "$BUILD/cbct-worker" >"$work/worker"
	chmod +x "$work/worker"
	start_daemon --worker "$work/worker" --stop-timeout 5
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	# nobody may yield in the only iteration: the job ends well after the worker was told to quit
	post_job '{"scan": "SCAN", "grid": {"size": [192, 192, 192], "spacing_mm": [1, 1, 1]}, "fdk": null, "sart": {"iterations": 1, "subsets": 1}}'
	pid=$(cat "$work/daemon.pid")
	while [ "$(json .state)" != running ]; do req GET "/v1/jobs/$job"; done
	kill "$pid"
	timeout 60 tail --pid="$pid" -f /dev/null || { kill -9 "$pid"; fail "the end of the daemon"; }
	stop_daemon
	start_daemon
	wait_job succeeded
	stop_daemon
}

test_a_volume_that_cannot_be_recorded_is_no_success() {
	CBCT_TEST_REFUSE=$work/refuse start_daemon
	echo "volume final" >"$work/refuse"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	wait_job failed
	expect_json '.error.detail | test("refused")'
	rm "$work/refuse"
	stop_daemon
}

test_two_daemons_do_not_share_a_state_directory() {
	start_daemon
	if timeout 10 "$BUILD/cbctd" --listen 127.0.0.1:0 --state-dir "$state" --backend cpu >"$work/second.out" 2>&1; then
		fail "a refusal"
	fi
	grep -qi 'use' "$work/second.out" || fail "a message that says it is in use: $(cat "$work/second.out")"
	stop_daemon
}

test_settings_as_flag_line_and_environment() {
	[[ $("$BUILD/cbctd" --help) == *--state-dir* ]] || fail "--help with --state-dir"
	local name
	for name in cbctd cbct-worker cbct cbct-cuda cbct-dicom; do
		[ -x "$BUILD/$name" ] || continue
		[[ $("$BUILD/$name" --version) =~ ^$name\ [0-9]+\.[0-9]+\.[0-9]+$ ]] || fail "the version of $name"
	done
	! "$BUILD/cbctd" --listen nonsense --versions 2>/dev/null || fail "another flag refused"
	"$BUILD/cbctd" --print-config >"$work/config"
	grep -q '^listen' "$work/config" || fail "listen in --print-config"
	CBCTD_LISTEN=127.0.0.1:3333 "$BUILD/cbctd" --print-config | grep '127.0.0.1:3333' >/dev/null || fail "the environment's value"
	sed 's/^listen.*/listen = 127.0.0.1:4444/' "$work/config" >"$work/config2"
	"$BUILD/cbctd" --config "$work/config2" --print-config | grep '127.0.0.1:4444' >/dev/null || fail "the config file's value"
	"$BUILD/cbctd" --config "$work/config2" --listen 127.0.0.1:5555 --print-config | grep '127.0.0.1:5555' >/dev/null || fail "the flag before the file"
	CBCTD_MAX_JOB=4 "$BUILD/cbctd" --print-config 2>"$work/out" >/dev/null || fail "a variable of somebody else's, perhaps"
	grep -q 'warning: CBCTD_MAX_JOB: no setting' "$work/out" || fail "the unknown variable, told: $(cat "$work/out")"
	"$BUILD/cbctd" --print-config 2>"$work/out" >/dev/null
	[ ! -s "$work/out" ] || fail "nothing to tell: $(cat "$work/out")"
	echo 'state-dir = "/tmp/x"' >"$work/config3"
	! "$BUILD/cbctd" --config "$work/config3" --print-config >"$work/out" 2>&1 || fail "quotes refused"
	grep -q 'config3:1: state-dir: values have no quotes' "$work/out" || fail "why: $(cat "$work/out")"
	# what is behind a zero byte would be left out
	printf 'threads = 2\n\0\nbackend = cpu\n' >"$work/config4"
	! "$BUILD/cbctd" --config "$work/config4" --print-config >"$work/out" 2>&1 || fail "a zero byte refused"
	grep -q 'config4: it has a zero byte' "$work/out" || fail "why: $(cat "$work/out")"
	# what is printed reads as it was: all digits, and no address of nothing
	printf 'listen = 127.0.0.1:1\nlisten =\nheader-timeout = 12.3456789\n' >"$work/config5"
	"$BUILD/cbctd" --config "$work/config5" --print-config >"$work/config6"
	grep -q '^header-timeout = 12.3456789$' "$work/config6" || fail "all digits: $(grep timeout "$work/config6")"
	grep -q '^listen = 127.0.0.1:1$' "$work/config6" || fail "one address: $(grep ^listen "$work/config6")"
	if "$BUILD/cbctd" --listen 0.0.0.0:0 --state-dir "$work/other" >"$work/out" 2>&1; then
		fail "a refusal to listen beyond loopback without tokens and TLS"
	fi
	if "$BUILD/cbctd" --listen 127.0.0.1:99999 --state-dir "$work/other" >"$work/out" 2>&1; then
		fail "a refusal of a port beyond 65535"
	fi
	if "$BUILD/cbctd" --no-such-flag >"$work/out" 2>&1; then
		fail "a refusal of an unknown flag"
	fi
}

test_a_unix_socket() {
	local socket=$work/s i
	"$BUILD/cbctd" --listen "unix:$socket" --state-dir "$work/unix-state" --backend cpu >"$work/unix.out" 2>&1 &
	echo $! >"$work/daemon.pid"
	for ((i = 0; i < 2400; i++)); do
		[ "$(curl -s -o /dev/null -w '%{http_code}' --unix-socket "$socket" http://localhost/livez)" = 200 ] && break
		sleep 0.05
	done
	[ "$(curl -s -o /dev/null -w '%{http_code}' --unix-socket "$socket" http://localhost/livez)" = 200 ] || fail "an answer over the socket"
	stop_daemon
}

stop_after_each=1 run_tests
