#!/usr/bin/env bash
# Workers that are stopped, hang or do not heed a cancel: each is found, ended and replaced, and its job goes on.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
grid='"grid": {"size": [32, 32, 16], "spacing_mm": [3, 3, 4]}'
many=150
[ "${SANITIZED:-0}" = 0 ] || many=60
recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": $many, \"subsets\": \"views\"}}"
hang=$work/hang

worker_of() { pgrep -P "$(cat "$work/daemon.pid")" | head -1; }
start_posted() { # OPTION ...: a daemon with a whole scan
	rm -rf "$state"
	CBCT_TEST_HANG=$hang start_daemon --worker "$BUILD/cbct-worker-held" --checkpoint-seconds 0.05 "$@"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
}
# replaced PID WHY: the daemon has ended that worker and said why
replaced() {
	local end=$((SECONDS + 90))
	while kill -0 "$1" 2>/dev/null; do
		[ $SECONDS -lt $end ] || fail "no worker $1 any more"
		sleep 0.05
	done
	grep -q "$2" "$work/cbctd.err" || fail "\"$2\" in the log"
	: >"$work/cbctd.err"
}
ready_again() {
	local end=$((SECONDS + 30))
	until req GET /readyz && [ "$status" = 200 ]; do
		[ $SECONDS -lt $end ] || fail "ready again"
		sleep 0.05
	done
}
digest() { # of the final volume of $job
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | select(.name == "final") | .digest'
}

test_a_worker_that_is_stopped_while_it_is_idle() {
	local first
	start_posted
	req GET /v1/devices
	expect_json '.devices[0] | .state == "idle" and .step_age_s >= 0'
	first=$(worker_of)
	kill -STOP "$first"
	replaced "$first" "no sign of life"
	ready_again
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	wait_job succeeded
	expect_json '.attempts == 1'
}

test_a_worker_that_is_stopped_with_a_job() {
	local undisturbed first i
	start_posted
	post_job "$recipe"
	wait_job succeeded
	undisturbed=$(digest)
	post_job "$recipe"
	for ((i = 0; i < 6000; i++)); do
		[ ! -e "$state/jobs/$job/checkpoint.f32" ] || break
		sleep 0.02
	done
	first=$(worker_of)
	kill -STOP "$first"
	req GET "/v1/jobs/$job"
	expect_json '.state == "running"'
	replaced "$first" "no sign of life"
	wait_job succeeded
	expect_json ".attempts == 2 and ([.history[].iteration] == [range(1; $many + 1)])"
	[ "$(digest)" = "$undisturbed" ] || fail "the bits of an undisturbed run"
}

test_a_worker_that_hangs_in_a_step() {
	local first
	start_posted
	: >"$hang"
	post_job "$recipe"
	state_becomes running
	first=$(worker_of)
	replaced "$first" "finished no step"
	rm "$hang"
	wait_job succeeded
	expect_json '.attempts == 2'
}

test_a_worker_that_hangs_on_its_disk() {
	local first hold=$work/hold
	rm -rf "$state"
	CBCT_TEST_HOLD=$hold start_daemon --worker "$BUILD/cbct-worker-held"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	: >"$hold"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	first=$(worker_of)
	replaced "$first" "finished no step for 3[0-9][.][0-9] s"
	rm "$hold"
	wait_job succeeded
	expect_json '.attempts == 2'
}

test_a_cancel_of_a_job_whose_worker_does_not_heed_it() {
	local first how
	start_posted
	for how in stopped hung; do
		[ $how = stopped ] || : >"$hang"
		post_job "$recipe"
		state_becomes running
		first=$(worker_of)
		[ $how = hung ] || kill -STOP "$first"
		req DELETE "/v1/jobs/$job?wait=60"
		expect_status 202
		expect_json '.state == "cancelled"'
		replaced "$first" "did not cancel"
		rm -f "$hang"
		ready_again
	done
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	wait_job succeeded
}

# As one in a call of the kernel that does not return: a signal does not end it.
test_a_cancel_of_a_job_whose_worker_cannot_be_killed() {
	local first i
	freezer=/sys/fs/cgroup/freezer/cbct-test-$$ # not local: the trap runs after the function
	mkdir "$freezer" 2>/dev/null || skip "nobody may make a control group here that freezes processes"
	trap 'echo THAWED >"$freezer/freezer.state"; stop_daemon; rmdir "$freezer"' EXIT
	start_posted
	post_job "${recipe/$many/5000}"
	state_becomes running
	first=$(worker_of)
	echo "$first" >"$freezer/cgroup.procs"
	echo FROZEN >"$freezer/freezer.state"
	for ((i = 0; i < 2400; i++)); do
		[ "$(cat "$freezer/freezer.state")" = FROZEN ] && break
		sleep 0.05
	done
	req DELETE "/v1/jobs/$job?wait=60"
	expect_status 202
	expect_json '.state == "cancelled"'
	kill -0 "$first" || fail "worker $first, which is frozen, is still there"
	req GET /readyz
	expect_status 503
	echo THAWED >"$freezer/freezer.state"
	replaced "$first" "did not cancel"
	ready_again
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	wait_job succeeded
}

stop_after_each=1 run_tests
