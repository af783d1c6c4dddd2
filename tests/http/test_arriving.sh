#!/usr/bin/env bash
# FDK while the projections arrive: in any order, interrupted in every way; and scans that are broken off.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball raw_dir=$work/raw
views=60 one=$((64 * 48 * 4))
ball=(--phantom ball --scale 30 --density 0.02 --shift 5,-8,6 --views $views --arc 300 --columns 64 --rows 48 --pixel 4
	--source-to-isocentre 600 --source-to-detector 1000)
cbct simulate "${ball[@]}" -o "$scan_dir" >/dev/null || exit 1
cbct simulate "${ball[@]}" --raw flat --sample float32 -o "$raw_dir" >/dev/null || exit 1
grid='"grid": {"size": [48, 48, 24], "spacing_mm": [2, 2, 3]}'
fdk="{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
long="{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 100000, \"subsets\": \"views\"}}"

# A test that failed leaves nothing that the next one would wait for.
fresh_daemon() {
	rm -rf "$state"
	start_daemon
}
# send DIR FIRST LAST [STATUS]: that run in one body
send() {
	dd if="$1/projections.raw" bs=$one skip="$2" count=$(($3 - $2 + 1)) status=none >"$work/run"
	req PUT "/v1/scans/$scan/projections/$2-$3" -T "$work/run"
	expect_status "${4:-201}"
}
# reconstructed COUNT [SECONDS]: waits until the job, still waiting, has taken in so many
reconstructed() {
	local end=$((SECONDS + ${2:-60}))
	while :; do
		req GET "/v1/jobs/$job"
		expect_json '.state == "waiting"'
		[ "$(json .views.reconstructed)" = "$1" ] && return 0
		[ $SECONDS -lt $end ] || fail "$1 projections reconstructed: $(json '{state, stage, views}')"
		sleep 0.02
	done
}
digest() { # NAME: of a volume of $job
	req GET "/v1/jobs/$job/volumes"
	expect_status 200
	json ".volumes[] | select(.name == \"$1\") | .digest"
}
# What the same recipe gives of the whole scan posted afterwards.
expect_same_as_afterwards() { # RECIPE [NAME]
	local arrived
	arrived=$(digest "${2:-final}")
	post_job "$1"
	wait_job succeeded
	[ "$(digest "${2:-final}")" = "$arrived" ] || fail "the bits of the job that was posted afterwards"
}
# kill_worker ATTEMPT: until the daemon has seen that the job's worker died and calls it so often tried
kill_worker() {
	local end=$((SECONDS + 60))
	kill -9 "$(worker_of)"
	until req GET "/v1/jobs/$job" && [ "$(json .attempts)" = "$1" ]; do
		[ $SECONDS -lt $end ] || fail "attempt $1 of job $job: $(json '{state, attempts}')"
		sleep 0.02
	done
}

test_fdk_goes_along_and_the_rest_of_the_pipeline_follows() {
	fresh_daemon
	local recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 2, \"subsets\": 5}, \"tv\": {}, \"emit\": [\"fdk\", 1]}"
	post_scan "$scan_dir"
	post_job "$recipe"
	expect_json '.state == "waiting" and .views == {received: 0, reconstructed: 0, of: 60}'
	send "$scan_dir" 0 19
	reconstructed 20
	expect_json '.stage == "fdk" and .views == {received: 20, reconstructed: 20, of: 60} and .progress > 0 and .progress < 1'
	expect_json '.backend == "'"$BACKEND"'" and (.plan | length > 0) and .attempts == 0 and .started == null and .eta_s == null'
	req GET /v1/devices
	expect_json ".devices[0] | .state == \"busy\" and .job == \"$job\""
	send "$scan_dir" 20 58
	reconstructed 59
	send "$scan_dir" 59 59
	wait_job succeeded
	expect_json '.attempts == 1 and .views == {received: 60, reconstructed: 60, of: 60} and .progress == 1'
	expect_json '[.history[].iteration] == [1, 2] and .volumes == 3'
	# in the order of their numbers: the same bits
	expect_same_as_afterwards "$recipe"
}

test_the_progress_of_the_job_before_is_not_that_of_the_next() {
	fresh_daemon
	local stages
	# whether the last progress of a job was told depends on the time since the one before: several kinds
	for stages in '"fdk": {}' '"fdk": {}, "tv": {}'; do
		post_scan "$scan_dir"
		post_projections "$scan_dir"
		post_job "{\"scan\": \"SCAN\", $grid, $stages}"
		wait_job succeeded
		post_scan "$scan_dir"
		post_job "$fdk"
		sleep 0.1 # attended, with nothing to reconstruct yet
		send "$scan_dir" 0 2
		reconstructed 3
		expect_json '.stage == "fdk" and .iteration == 0 and .progress < 0.1'
		req DELETE "/v1/jobs/$job?wait=30"
		expect_json '.state == "cancelled"'
	done
}

test_any_order_with_gaps_and_repeats() {
	fresh_daemon
	local k order first
	post_scan "$scan_dir"
	post_job "$fdk"
	order=$(for ((k = 0; k < views; k++)); do echo $((k * 37 % views)); done)
	for k in $order; do
		send "$scan_dir" "$k" "$k"
		[ $((k % 7)) != 0 ] || send "$scan_dir" "$k" "$k" 200
		[ "$k" != 0 ] || reconstructed 1
	done
	wait_job succeeded
	first=$(digest final)
	post_job "$fdk"
	wait_job succeeded
	[ "$(digest final)" = "$first" ] || fail "the bits of the job that was posted afterwards"
	# and whenever the worker hears of them: those that lead are reconstructed, the others once it is their turn
	post_scan "$scan_dir"
	for k in 5 6 7 0 1 3; do send "$scan_dir" "$k" "$k"; done
	post_job "$fdk"
	reconstructed 2
	send "$scan_dir" 2 2
	reconstructed 4
	send "$scan_dir" 50 59
	send "$scan_dir" 4 49
	wait_job succeeded
	[ "$(digest final)" = "$first" ] || fail "the same bits from any order"
}

test_from_several_connections_at_once() {
	fresh_daemon
	local i k pids=()
	post_scan "$scan_dir"
	post_job "$fdk"
	for i in 0 1 2 3; do
		(
			for ((k = i; k < views; k += 4)); do
				dd if="$scan_dir/projections.raw" bs=$one skip="$k" count=1 status=none |
					curl -sf -o /dev/null -X PUT --data-binary @- "$url/v1/scans/$scan/projections/$k" || exit 1
			done
		) &
		pids+=($!)
	done
	for i in "${pids[@]}"; do wait "$i" || fail "each projection stored"; done
	wait_job succeeded
	expect_json '.attempts == 1'
	expect_same_as_afterwards "$fdk"
}

test_who_only_waits_blocks_nobody() {
	fresh_daemon
	local waiting
	post_scan "$scan_dir"
	post_job "$fdk"
	waiting=$job
	send "$scan_dir" 0 9
	reconstructed 10
	local growing=$scan
	# ready jobs of its own priority, after a moment of patience, and of a higher one at once
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$fdk"
	wait_job succeeded
	post_job "${fdk%\}}, \"priority\": \"stat\"}"
	wait_job succeeded
	# nothing was lost
	job=$waiting
	scan=$growing
	reconstructed 10
	expect_json '.attempts == 0'
	send "$scan_dir" 10 59
	wait_job succeeded
	expect_json '.attempts == 1'
	expect_same_as_afterwards "$fdk"
}

test_an_urgent_scan_that_comes_in_takes_the_worker() {
	fresh_daemon
	local running urgent other
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	running=$job
	state_becomes running
	post_scan "$scan_dir"
	post_job "${fdk%\}}, \"priority\": \"urgent\"}"
	urgent=$job
	# before the first projection there is nothing to make room for
	send "$scan_dir" 0 9
	reconstructed 10
	job=$running
	state_becomes queued
	job=$urgent
	send "$scan_dir" 10 59
	wait_job succeeded
	# of two that wait, the one that gets projections has the worker
	job=$running
	req DELETE "/v1/jobs/$job?wait=30"
	expect_json '.state == "cancelled"'
	post_scan "$scan_dir"
	post_job "$fdk"
	other=$job
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 1
	reconstructed 2 || fail "the worker for the job whose projections come"
	send "$scan_dir" 2 59
	wait_job succeeded
	job=$other
	req DELETE "/v1/jobs/$job?wait=30"
	expect_json '.state == "cancelled"'
}

test_an_urgent_scan_has_the_worker_that_was_long_in_making_room() {
	rm -rf "$state"
	local hold=$work/hold running
	CBCT_TEST_HOLD=$hold start_daemon --worker "$BUILD/cbct-worker-held"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	running=$job
	state_becomes running
	post_scan "$scan_dir"
	post_job "${fdk%\}}, \"priority\": \"urgent\"}"
	# its checkpoint takes longer than anybody is patient with a scan that sends nothing
	: >"$hold"
	send "$scan_dir" 0 9
	sleep 3
	rm "$hold"
	reconstructed 10 20
	send "$scan_dir" 10 59
	wait_job succeeded
	job=$running
	req DELETE "/v1/jobs/$job?wait=30"
	expect_json '.state == "cancelled"'
}

test_a_job_whose_projections_are_all_there_waits_for_its_worker() {
	rm -rf "$state"
	local hang=$work/hang
	CBCT_TEST_HANG=$hang start_daemon --worker "$BUILD/cbct-worker-held"
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 9
	reconstructed 10
	: >"$hang"
	send "$scan_dir" 10 59
	req GET "/v1/jobs/$job"
	# it waits until the daemon has seen that all are there, and runs from then on
	expect_json '.views.received == 60 and .views.reconstructed < 60 and ([.state, .waiting_for] | . == ["waiting", ["worker"]] or . == ["running", []])'
	rm "$hang"
	wait_job succeeded
	expect_json '.waiting_for == []'
}

test_cancel_and_delete_while_it_waits() {
	fresh_daemon
	local worker
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 9
	reconstructed 10
	req DELETE "/v1/scans/$scan"
	expect_problem 409
	worker=$(worker_of)
	req DELETE "/v1/jobs/$job?wait=30"
	expect_status 202
	expect_json '.state == "cancelled"'
	[ "$(worker_of)" = "$worker" ] || fail "the worker alive"
	req DELETE "/v1/jobs/$job"
	expect_status 204
	send "$scan_dir" 10 59
	req DELETE "/v1/scans/$scan"
	expect_status 204
	# it is free again
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 59
	wait_job succeeded
	req DELETE "/v1/scans/$scan"
	expect_status 204
	req GET "/v1/jobs/$job"
	expect_json '.views == null'
}

test_a_worker_that_dies_in_the_middle() {
	fresh_daemon
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 29
	reconstructed 30
	kill_worker 2
	send "$scan_dir" 30 39
	reconstructed 40
	kill_worker 3
	send "$scan_dir" 40 59
	wait_job succeeded
	expect_json '.attempts == 3'
	expect_same_as_afterwards "$fdk"
	# three times is enough
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 9
	reconstructed 10
	kill_worker 2
	reconstructed 10
	kill_worker 3
	reconstructed 10
	kill -9 "$(worker_of)"
	wait_job failed
	expect_json '.error.detail | test("3 times without a checkpoint between them, last: its worker ended with signal 9 .*; it was in stage fdk behind iteration 0 on .")'
}

test_a_daemon_that_dies_or_stops_in_the_middle() {
	fresh_daemon
	local signal
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 9
	send "$scan_dir" 20 39
	reconstructed 10
	for signal in KILL TERM; do
		stop_daemon $signal
		[ $signal != TERM ] || [ "$stop_status" = 0 ] || fail "exit status 0"
		start_daemon
		reconstructed 10
	done
	send "$scan_dir" 40 59
	send "$scan_dir" 10 19
	wait_job succeeded
	expect_same_as_afterwards "$fdk"
}

# The projections came in another order than that of their numbers, and the job is killed when all are there.
test_a_job_that_is_killed_behind_its_last_projection() {
	local undisturbed recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 12, \"subsets\": \"views\"}, \"emit\": [\"fdk\"]}" at
	fresh_daemon
	post_scan "$scan_dir"
	post_job "$recipe"
	send "$scan_dir" 30 59
	send "$scan_dir" 0 29
	wait_job succeeded
	undisturbed=$(digest fdk)$(digest final)
	for at in 0 3; do
		post_scan "$scan_dir"
		post_job "$recipe"
		send "$scan_dir" 40 59
		send "$scan_dir" 0 29
		reconstructed 30
		send "$scan_dir" 30 39
		until req GET "/v1/jobs/$job" && [ "$(json .state)" != waiting ] && [ "$(json ".iteration // 0")" -ge $at ]; do sleep 0.01; done
		stop_daemon KILL
		start_daemon
		wait_job succeeded
		[ "$(digest fdk)$(digest final)" = "$undisturbed" ] || fail "the bits of an undisturbed run, killed at iteration $at"
	done
}

test_a_run_that_cannot_be_recorded_yet_is_recorded_later() {
	CBCT_TEST_REFUSE=$work/refuse fresh_daemon
	post_scan "$scan_dir"
	post_job "$fdk"
	send "$scan_dir" 0 9
	reconstructed 10
	echo running >"$work/refuse"
	send "$scan_dir" 10 59
	until [ "$(json '.volumes // 0')" -ge 1 ]; do req GET "/v1/jobs/$job"; done # it is done with it meanwhile
	expect_json '.state == "waiting" and .views.reconstructed == 60'
	rm "$work/refuse"
	wait_job succeeded
	expect_json '.attempts == 1'
}

test_a_digest_that_cannot_be_recorded_yet_is_recorded_later() {
	CBCT_TEST_REFUSE=$work/refuse fresh_daemon
	echo digest >"$work/refuse"
	post_scan "$scan_dir"
	send "$scan_dir" 0 59
	post_job "$fdk"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes?wait=1"
	expect_json '[.volumes[].digest] == [null]'
	rm "$work/refuse"
	req GET "/v1/jobs/$job/volumes?wait=20"
	expect_json '.volumes[0].digest | length > 40'
}

test_images_that_come_late() {
	fresh_daemon
	post_scan "$raw_dir"
	post_job "$fdk"
	send "$raw_dir" 0 9
	# nothing can be made of counts alone
	req GET "/v1/jobs/$job"
	expect_json '.state == "waiting" and .stage == null and .views.reconstructed == 0'
	req PUT "/v1/scans/$scan/flat" -T "$raw_dir/flat.f32"
	expect_status 201
	reconstructed 10
	# what was reconstructed without the dark is void
	req PUT "/v1/scans/$scan/dark" -T "$raw_dir/dark.f32"
	expect_status 201
	send "$raw_dir" 10 19
	reconstructed 20
	send "$raw_dir" 20 59
	wait_job succeeded
	expect_json '.attempts == 1'
	expect_same_as_afterwards "$fdk"
}

# A dark that is taken after the run: the job has all projections, its first volumes are there.
test_an_image_that_comes_while_the_job_runs() {
	fresh_daemon
	local stages='"fdk": {}, "sart": {"subsets": "views", "iterations"' end=$((SECONDS + 60)) events fdk_digest one_digest
	post_scan "$raw_dir"
	req PUT "/v1/scans/$scan/flat" -T "$raw_dir/flat.f32"
	expect_status 201
	send "$raw_dir" 0 59
	post_job "{\"scan\": \"SCAN\", $grid, $stages: 100000}, \"emit\": [\"fdk\", 1]}"
	until req GET "/v1/jobs/$job" && [ "$(json '.volumes')" = 2 ]; do [ $SECONDS -lt $end ] || fail "two volumes"; done
	expect_json '.state == "running" and .attempts == 1 and [.warnings[].code] == ["no_dark"]'
	req PUT "/v1/scans/$scan/dark" -T "$raw_dir/dark.f32"
	expect_status 201
	until req GET "/v1/jobs/$job" && [ "$(json '.attempts')" = 2 ] && [ "$(json '.state')" = running ] && [ "$(json '.volumes')" = 2 ]; do
		[ $SECONDS -lt $end ] || fail "two volumes once more"
	done
	expect_json '.state == "running" and (.warnings | all(.code != "no_dark")) and .history[0].iteration == 1'
	req DELETE "/v1/jobs/$job?wait=30"
	expect_json '.state == "cancelled"'
	until fdk_digest=$(digest fdk) && one_digest=$(digest iter-1) && [[ $fdk_digest == sha* && $one_digest == sha* ]]; do
		[ $SECONDS -lt $end ] || fail "the digests"
	done
	# what was told of the run without the dark has gone
	req GET "/v1/jobs/$job/events"
	events=$(grep -c '^event: volume' "$body")
	[ "$events" = 2 ] || fail "two volumes told, got $events"
	if grep -q no_dark "$body"; then fail "no warning of the run without the dark"; fi
	# as if it had been there before
	post_job "{\"scan\": \"SCAN\", $grid, $stages: 1}, \"emit\": [\"fdk\"]}"
	wait_job succeeded
	[ "$(digest fdk)" = "$fdk_digest" ] || fail "the bits of the FDK volume of the job that was posted afterwards"
	[ "$(digest final)" = "$one_digest" ] || fail "the bits of the iteration of the job that was posted afterwards"
}

test_counts_that_only_wait_for_a_flat_say_so() {
	fresh_daemon
	post_scan "$raw_dir"
	post_job "$fdk"
	req GET "/v1/jobs/$job"
	expect_json '.waiting_for == ["flat", "projections"]'
	send "$raw_dir" 0 58
	req GET "/v1/scans/$scan"
	expect_json '.warnings | all(.code != "no_flat")'
	send "$raw_dir" 59 59
	req GET "/v1/scans/$scan"
	expect_json '.state == "complete" and (.warnings | any(.code == "no_flat" and (.detail | test("flat"))))'
	expect_json '[.warnings[] | select(.code == "no_flat") | .severity, (.summary | length > 20)] == ["serious", true]'
	# its job says so itself, and the same after a restart; the scan's fact is not told a second time
	req GET "/v1/jobs/$job"
	expect_json '.state == "waiting" and .waiting_for == ["flat"] and .warnings == []'
	stop_daemon
	start_daemon
	req GET "/v1/jobs/$job"
	expect_json '.state == "waiting" and .waiting_for == ["flat"] and .warnings == []'
	req PUT "/v1/scans/$scan/flat" -T "$raw_dir/flat.f32"
	expect_status 201
	wait_job succeeded
	expect_json '[.warnings[].code] == ["no_dark"]'
	req GET "/v1/scans/$scan"
	expect_json '.warnings | all(.code != "no_flat")'
}

test_a_scan_that_is_broken_off_is_completed_with_what_is_there() {
	fresh_daemon
	local recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 1, \"subsets\": 50}}" arrived short=$work/short
	post_scan "$scan_dir"
	req POST "/v1/scans/$scan/complete"
	expect_problem 409
	send "$scan_dir" 3 3
	req POST "/v1/scans/$scan/complete"
	expect_problem 409
	expect_json '.detail | test("1 of 60")'
	post_job "$recipe"
	send "$scan_dir" 4 47
	reconstructed 0 # nothing leads yet
	req POST "/v1/scans/$scan/complete"
	expect_status 200
	expect_json '.state == "complete" and .received == [[3, 47]] and .missing == [[0, 2], [48, 59]] and .received_count == 45'
	expect_json '.derived.arc_deg > 223 and .derived.arc_deg < 224 and .derived.short_scan and .projections.count == 60'
	expect_json '[.warnings[] | select(.code == "incomplete") | .detail | test("45 of 60")] == [true]'
	cp "$body" "$work/completed"
	wait_job succeeded
	expect_json '.views == {received: 45, reconstructed: 45, of: 45} and .attempts == 1 and .waiting_for == []'
	expect_json '.warnings | all(.code != "incomplete")' # the scan tells it
	arrived=$(digest final)
	# closed is closed
	req POST "/v1/scans/$scan/complete"
	expect_status 200
	diff "$body" "$work/completed" || fail "the same document"
	send "$scan_dir" 0 0 409
	send "$scan_dir" 47 48 409
	send "$scan_dir" 3 47 200
	stop_daemon KILL
	start_daemon
	req GET "/v1/scans/$scan"
	diff "$body" "$work/completed" || fail "the same document after a restart"
	send "$scan_dir" 0 0 409
	post_job "$fdk"
	wait_job succeeded
	# as if no more had been planned
	mkdir -p "$short"
	dd if="$scan_dir/projections.raw" bs=$one skip=3 count=45 of="$short/projections.raw" status=none
	jq '.projections.count = 45 | .geometry.first_angle_deg += 3 * .geometry.angle_step_deg' "$scan_dir/scan.json" >"$short/scan.json"
	post_scan "$short"
	post_projections "$short"
	post_job "${recipe/50/45}"
	wait_job succeeded
	[ "$(digest final)" = "$arrived" ] || fail "the bits of a scan of those 45 views"
	# nothing is missing: nothing changes
	req POST "/v1/scans/$scan/complete"
	expect_status 200
	expect_json '.missing == [] and (.warnings | all(.code != "incomplete"))'
	req POST "/v1/scans/1m00000000000000/complete"
	expect_problem 404
}

test_cbct_completes_a_scan() {
	fresh_daemon
	post_scan "$scan_dir"
	if cbct complete "$scan" 2>"$work/error"; then fail "a refusal"; fi
	grep -q '0 of 60' "$work/error" || fail "the numbers: $(cat "$work/error")"
	local watcher
	post_job "$fdk"
	send "$scan_dir" 0 49
	cbct watch "$job" >"$work/said" 2>&1 &
	watcher=$!
	for ((i = 0; i < 200; i++)); do
		grep -q 'waiting, 50 of 60 projections' "$work/said" && break
		sleep 0.05
	done
	[ $i -lt 200 ] || fail "the watcher's line: $(cat "$work/said")"
	[[ $(cbct complete "$scan") == "$scan"*"50 of 60 projections" ]] || fail "50 of 60 projections"
	wait $watcher || fail "the watcher to see it succeed: $(cat "$work/said")"
}

stop_after_each=1 run_tests
