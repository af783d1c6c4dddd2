#!/usr/bin/env bash
# Devices that fail: their jobs go on elsewhere, on the processor where that is allowed, or end with a report; a device
# that fails time and again is set aside until it is cleared. Workers of the processor pretend to be cards.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks
BACKEND=cuda
export CBCT_TEST_CARDS=$work/cards

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
recipe='{"scan": "SCAN", "grid": {"size": [32, 32, 16], "spacing_mm": [3, 3, 4]}, "fdk": {}, "sart": {"iterations": 40, "subsets": "views"}, "emit": ["fdk", 20]}'

trouble() { echo "$@" >"$CBCT_TEST_CARDS.new" && mv "$CBCT_TEST_CARDS.new" "$CBCT_TEST_CARDS"; } # CALL DEVICES
start_posted() {                                                                                    # OPTION ...
	rm -rf "$state" "$CBCT_TEST_CARDS"
	start_daemon --worker "$BUILD/cbct-worker-held" --threads 1 "$@"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
}
digest() { # of the final volume of $job
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | select(.name == "final") | .digest'
}
devices_become() { # FILTER
	local end=$((SECONDS + 60))
	until req GET /v1/devices && member "$1" "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "$1 of $(head -c 1500 "$body")"
		sleep 0.05
	done
}

test_a_device_error_moves_the_job_to_another_device() {
	local undisturbed
	start_posted --devices 0,1 --checkpoint-seconds 0.02
	devices_become '[.devices[].state] == ["idle", "idle"]'
	post_job "$recipe"
	wait_job succeeded
	undisturbed=$(digest)
	trouble iterate 0
	post_job "$recipe"
	wait_job succeeded
	expect_json '.attempts == 2 and ([.history[].iteration] == [range(1; 41)])'
	# Nothing of what was made after the error: the bits are those of a run without one.
	[ "$(digest)" = "$undisturbed" ] || fail "the bits of an undisturbed run"
	devices_become '.devices[0].errors == 1 and .devices[0].set_aside == null and (.devices[0].last_error | contains("cannot correct")) and .devices[1].errors == 0'
}

test_deaths_without_progress_move_it_too() {
	start_posted --devices 0,1 --checkpoint-seconds 3600
	devices_become '[.devices[].state] == ["idle", "idle"]'
	trouble kill 0
	post_job "$recipe"
	wait_job succeeded
	expect_json ".attempts | . == 2 or . == 3"
	devices_become '.devices[0].errors == 0' # its process was killed, which says nothing of the device
}

test_a_device_with_repeated_errors_is_set_aside() {
	local i since
	start_posted --devices 0,1
	devices_become '[.devices[].state] == ["idle", "idle"]'
	trouble filter 0
	for ((i = 0; i < 3; i++)); do
		devices_become '.devices[0].state == "idle"'
		post_job "$recipe"
		wait_job succeeded
	done
	devices_become '.devices[0] | .errors == 3 and .set_aside.test_in_s > 20 and .answers == false and .state == "absent"'
	req GET /readyz
	expect_status 200
	# Its jobs go to the other one.
	post_job "$recipe"
	wait_job succeeded
	expect_json '.attempts == 1'
	# A restart forgets neither: it begins with the self-test, which fails as before.
	since=$(curl -s "$url/v1/devices" | jq -r '.devices[0].set_aside.since')
	stop_daemon
	start_daemon --worker "$BUILD/cbct-worker-held" --threads 1 --devices 0,1
	devices_become ".devices[0] | .errors == 3 and .set_aside.since == \"$since\" and .answers == false and .state == \"absent\" and .set_aside.test_in_s > 20"
	grep -q 'device 0 was set aside before this start' "$work/cbctd.err" || fail "told in the log"
	for i in 7 2 x 0.5 -1; do
		req POST "/v1/devices/$i/clear"
		expect_problem 404
	done
	rm "$CBCT_TEST_CARDS"
	req POST /v1/devices/0/clear
	expect_status 200
	expect_json '.index == 0 and .set_aside == null and .errors == 0'
	devices_become '.devices[0].state == "idle" and .devices[0].answers and .devices[0].errors == 0'
	stop_daemon
	start_daemon --worker "$BUILD/cbct-worker-held" --threads 1 --devices 0,1
	devices_become '.devices[0] | .set_aside == null and .errors == 0 and .state == "idle"'
}

test_all_devices_are_set_aside() {
	local i
	start_posted
	trouble filter 0
	for i in 1 2 3; do
		post_job "$recipe"
		# One device alone: three runs, and with the third it is set aside.
		[ "$i" = 1 ] || break
		wait_job failed
	done
	req GET "/v1/jobs/$job"
	expect_json '.state == "queued" and .waiting_for == ["worker"]'
	req GET /readyz
	expect_problem 503
	devices_become '.devices[0].set_aside != null'
	rm "$CBCT_TEST_CARDS"
	req POST /v1/devices/0/clear
	wait_job succeeded
	req GET /readyz
	expect_status 200
}

test_a_failed_job_has_a_report() {
	start_posted --checkpoint-seconds 3600
	trouble kill 0
	post_job "$recipe"
	wait_job failed
	expect_json '.error.detail | startswith("it was broken off 3 times without a checkpoint between them, last: its worker ended with signal 9")'
	expect_json '.error.report | .runs == 3 and .signal == 9 and (.ended | startswith("signal 9")) and (.last_message | length > 0) and .device.index == 0 and .device.set_aside == false'
	stop_daemon
	rm "$CBCT_TEST_CARDS"
	start_daemon --worker "$BUILD/cbct-worker-held" --threads 1
	req GET "/v1/jobs/$job"
	expect_json '.error.report.runs == 3'
}

test_the_processor_takes_over_where_it_may() {
	start_posted --fallback cpu --checkpoint-seconds 0.02
	req GET /v1/devices
	expect_json '(.devices | length) == 2 and .devices[1].fallback and .devices[1].state == "absent" and .devices[1].backend == "cpu"'
	trouble filter 0
	post_job "$recipe"
	wait_job succeeded
	expect_json '.attempts == 2 and .backend == "cpu" and ([.warnings[] | select(.code == "processor_fallback") | .detail] | length == 1 and (.[0] | startswith("device 0 failed (the card has fallen")))'
	# Measured by now.
	post_job "$recipe"
	wait_job succeeded
	expect_json '[.warnings[] | select(.code == "processor_fallback") | .detail] | length == 1 and (.[0] | test("about .* s for an iteration, and .* s for 40 of them"))'
	# Not needed any more, its process ends.
	devices_become '.devices[1].state == "absent"'
	rm "$CBCT_TEST_CARDS"
	post_job "$recipe"
	wait_job succeeded
	expect_json '.backend == "cuda" and .warnings == []'
}

test_the_processor_takes_the_jobs_of_devices_that_are_set_aside() {
	start_posted --fallback cpu
	trouble filter 0
	for _ in 1 2 3; do
		devices_become '.devices[0].state == "idle"'
		post_job "$recipe"
		wait_job succeeded
	done
	devices_become '.devices[0].set_aside != null and .devices[1].state == "idle"'
	req GET /readyz
	expect_status 200
	post_job "$recipe"
	wait_job succeeded
	expect_json '.attempts == 1 and ([.warnings[] | select(.code == "processor_fallback") | .detail][0] | startswith("all devices are set aside"))'
}

# As after an upgrade without the driver: no process of the card ever says hello.
test_the_processor_takes_the_jobs_of_devices_that_never_answer() {
	rm -rf "$state" "$CBCT_TEST_CARDS"
	(unset CBCT_TEST_CARDS && start_daemon --threads 1 --devices 63 --fallback cpu)
	url=$(sed -n 's/^listening on \(http:\)/\1/p' "$work/cbctd.out")
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$recipe"
	wait_job succeeded
	expect_json '.backend == "cpu" and ([.warnings[] | select(.code == "processor_fallback") | .detail][0] | startswith("all devices are set aside or do not answer"))'
	devices_become '.devices[0].set_aside == null and .devices[0].answers == false'
}

# The worker that hangs is killed 13 s after its last step; who asks is told before that.
test_a_worker_that_hangs_does_not_answer() {
	start_posted
	post_job "$recipe"
	wait_job succeeded
	trouble hang 0
	post_job "$recipe"
	state_becomes running
	devices_become '.devices[0].answers == false'
	expect_json '.devices[0].state == "busy" and .devices[0].step_age_s > 4'
	req GET /readyz
	expect_problem 503
	rm "$CBCT_TEST_CARDS"
	devices_become '.devices[0].answers'
	wait_job succeeded
	expect_json '.attempts == 1'
}

test_the_self_test() {
	local how pid
	rm -f "$CBCT_TEST_CARDS"
	for how in filter iterate none; do
		trouble $how 0
		# With its end of the socket closed it passes the test, and finds nobody to say hello to.
		pid=0
		"$BUILD/cbct-worker-held" --backend cuda --device 0 --threads 1 --self-test --socket 9 2>"$work/test.err" || pid=$?
		case $how in
		none) grep -q "Bad file" "$work/test.err" || fail "a test that passes, got $(cat "$work/test.err")" ;;
		*) [ $pid = 1 ] && grep -q "card has" "$work/test.err" || fail "the card's error, got $pid, $(cat "$work/test.err")" ;;
		esac
	done
}

stop_after_each=1 run_tests
