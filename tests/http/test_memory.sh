#!/usr/bin/env bash
# A daemon in a small control group: jobs that do not fit are refused, and a worker that the kernel ends for want of
# memory is replaced, told of as such, and loses its job nothing.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
grid='"grid": {"size": [32, 32, 16], "spacing_mm": [3, 3, 4]}'
recipe_of() { # ITERATIONS
	echo "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": $1, \"subsets\": \"views\"}}"
}

remove_group() {
	local i
	stop_daemon
	for ((i = 0; i < 2400; i++)); do
		rmdir "$group" 2>/dev/null && return 0
		sleep 0.05
	done
}
# make_group MIB: $group, a control group of this size, which goes with the test
make_group() {
	local limit
	[ "${SANITIZED:-0}" = 0 ] || skip "a sanitizer's memory is counted, too"
	groups=/sys/fs/cgroup/memory limit=memory.limit_in_bytes
	[ -e $groups/$limit ] || groups=/sys/fs/cgroup limit=memory.max
	home=$groups$(awk -F: '$2 == "memory" { path = $3; exit } $1 == 0 { path = $3 } END { print path }' /proc/self/cgroup)
	[ -e "$home/cgroup.procs" ] || home=$groups
	group=$groups/cbct-test-$$
	mkdir "$group" 2>/dev/null || skip "nobody may make a control group here"
	trap remove_group EXIT
	[ -e "$group/$limit" ] || skip "control groups of this machine do not bound memory"
	echo $(($1 << 20)) >"$group/$limit" || skip "the memory of a control group cannot be set here"
}
start_in_group() { # OPTION ...: the daemon is in the group, and this shell is not
	rm -rf "$state"
	echo $BASHPID >"$group/cgroup.procs"
	start_daemon "$@"
	echo $BASHPID >"$home/cgroup.procs"
}
# starve: takes the group's memory until its worker has ended, and gives it back
starve() {
	local worker i
	worker=$(worker_of)
	echo 1000 >"/proc/$worker/oom_score_adj" # it is the kernel's choice, and not who takes the memory
	for i in 1 2 3; do
		(
			echo $BASHPID >"$group/cgroup.procs"
			exec /usr/bin/python3 -c 'import os, sys, time
def ended():  # whether its parent has come to know of it, or not yet
    try:
        return open("/proc/" + sys.argv[1] + "/stat").read().rpartition(") ")[2][0] in "ZX"
    except OSError:
        return True
taken = []
end = time.monotonic() + 20
while not ended() and time.monotonic() < end:
    taken.append(bytearray(1 << 20))
    time.sleep(0.001)' "$worker"
		) || true # the kernel may take both, where the worker gives its memory back slowly
		gone_within "$worker" 5 && return
	done
	fail "the kernel ends worker $worker"
}
gone_within() { # PID SECONDS
	local i
	for ((i = 0; i < $2 * 20; i++)); do
		[ -e "/proc/$1" ] || return 0
		sleep 0.05
	done
	return 1
}

test_a_job_that_does_not_fit_into_the_group_is_refused() {
	make_group 300
	start_in_group
	req GET /v1/devices
	expect_json ".devices[0].memory | .total == $((300 << 20)) and .free <= $((300 << 20))"
	post_scan "$scan_dir"
	req POST /v1/jobs -H 'Content-Type: application/json' \
		--data-binary "{\"scan\": \"$scan\", \"grid\": {\"size\": [512, 512, 512], \"spacing_mm\": [0.2, 0.2, 0.2]}, \"fdk\": {}}"
	expect_problem 422 /grid/size
	expect_json ".detail | test(\"$((300 << 20)) are available\")"
	(
		echo $BASHPID >"$group/cgroup.procs"
		cbct doctor --json "$state" >"$work/report" || true
	)
	jq -e 'any(.[]; .subject == "memory" and (.finding | test("control group allows 0.3 GB")))' "$work/report" >/dev/null ||
		fail "the limit: $(jq -c '.[] | select(.subject == "memory")' "$work/report")"
}

test_a_worker_that_is_ended_for_want_of_memory_loses_nothing() {
	local undisturbed recipe
	recipe=$(recipe_of 200) # many times as long as it takes to starve it
	make_group 300
	start_in_group --checkpoint-seconds 0.05
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$recipe"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes"
	undisturbed=$(json '.volumes[] | select(.name == "final") | .digest')
	post_job "$recipe"
	state_becomes running
	starve
	wait_job succeeded
	expect_json '.attempts >= 2'
	req GET "/v1/jobs/$job/volumes"
	[ "$(json '.volumes[] | select(.name == "final") | .digest')" = "$undisturbed" ] || fail "the bits of an undisturbed run"
	grep -q 'by the kernel for want of memory; its control group allows 300 MiB' "$work/cbctd.err" || fail "why, in the log"
	req GET /v1/devices
	expect_json '.devices[0] | .errors == 0 and (.last_error | test("want of memory"))'
	# A kill that was told of explains no other one.
	: >"$work/cbctd.err"
	kill -KILL "$(worker_of)"
	for ((i = 0; i < 2400; i++)); do
		grep -q 'ended with signal 9' "$work/cbctd.err" && break
		sleep 0.05
	done
	grep 'ended with signal 9' "$work/cbctd.err" | grep -qv 'want of memory' || fail "another kill is not the kernel's"
}

test_a_job_that_starves_each_time_says_so() {
	local i
	make_group 300
	start_in_group --checkpoint-seconds 1000
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$(recipe_of 5000)"
	for i in 1 2 3; do
		state_becomes running
		starve
		[ $i = 3 ] || {
			req GET "/v1/jobs/$job"
			expect_json '.state == "queued" or .state == "running"'
		}
	done
	wait_job failed
	expect_json '.error.type == "urn:cbctd:problem:no-memory" and (.error.detail | test("broken off 3 times.*want of memory"))'
	expect_json ".error.report | .signal == 9 and .out_of_memory.limit == $((300 << 20)) and .device.errors == 0"
}

stop_after_each=1 run_tests
