#!/usr/bin/env bash
# Jobs on several devices: shares of the processor, which pretend to be cards where some of them fail.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks
export CBCT_TEST_CARDS=$work/cards

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
grid='"grid": {"size": [32, 32, 32], "spacing_mm": [3, 3, 2]}'
recipe='{"scan": "SCAN", '$grid', "fdk": {}, "sart": {"iterations": 20, "subsets": 6}, "emit": ["fdk", 10]}'
endless='{"scan": "SCAN", '$grid', "fdk": {}, "sart": {"iterations": 100000, "subsets": "views"}}'
with() { printf '%s' "${1%\}}, $2}"; } # JSON MEMBERS

trouble() { echo "$@" >"$CBCT_TEST_CARDS.new" && mv "$CBCT_TEST_CARDS.new" "$CBCT_TEST_CARDS"; } # CALL DEVICES
start_posted() {                                                                                    # OPTION ...
	rm -rf "$state" "$CBCT_TEST_CARDS"
	start_daemon --worker "$BUILD/cbct-worker-held" --threads 1 "$@"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
}
digests() { # of all volumes of $job
	local end=$((SECONDS + patience))
	until req GET "/v1/jobs/$job/volumes" && member 'all(.volumes[]; .digest)' "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "digests of $job"
		sleep 0.05
	done
	json '[.volumes[] | .name + " " + .digest] | sort | join(", ")'
}
devices_become() { # FILTER
	local end=$((SECONDS + patience))
	until req GET /v1/devices && member "$1" "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "$1 of $(head -c 1500 "$body")"
		sleep 0.05
	done
}
all_idle() { devices_become 'all(.devices[]; .state == "idle")'; }
job_becomes() { # FILTER
	local end=$((SECONDS + patience))
	until req GET "/v1/jobs/$job" && member "$1" "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "$1 of $(head -c 1500 "$body")"
		sleep 0.02
	done
}
cancel() { # JOB
	job=$1
	req DELETE "/v1/jobs/$job"
	expect_status 202
	wait_job cancelled
}

test_a_job_has_several_devices() {
	local whole first single
	start_posted --workers 3
	all_idle
	post_job "$(with "$endless" '"devices": 2')"
	job_becomes '.state == "running" and .iteration > 0'
	expect_json '.devices == 2 and .ran_on == [0, 1] and (.device | startswith("2 x ")) and (.plan | startswith("2 cards"))'
	expect_json '.plan | contains("slabs of 16 slices, seen by")'
	first=$job
	devices_become ".devices | [.[].state] == [\"busy\", \"lent\", \"idle\"] and .[0].job == \"$first\" and .[1].job == \"$first\" and .[1].answers and .[2].job == null"
	# The third one is still to be had, and the two are not.
	post_job "$endless"
	single=$job
	job_becomes '.state == "running" and .ran_on == [2] and .devices == 1'
	post_job "$recipe"
	job_becomes '.state == "queued" and .waiting_for == ["worker"]'
	cancel "$first"
	devices_become 'all(.devices[1, 2]; .state != "lent")'
	cancel "$single"
	all_idle
	# The same number of devices, the same bits; another number, the same within rounding.
	post_job "$(with "$recipe" '"devices": 2')" && wait_job succeeded && whole=$(digests)
	get_volume final "$work/two.raw" format=raw
	get_volume final "$work/two.nii"
	# The command that needs no daemon has them, too.
	with "$recipe" '"devices": 2' >"$work/two.json"
	rm -rf "$work/alone"
	cbct recon "$scan_dir" "$work/two.json" --backend cpu --threads 2 --quiet -o "$work/alone"
	expect_number "$(cbct compare --json "$work/two.nii" "$work/alone/final.nii" | jq .rmse)" == 0 "difference to cbct recon"
	! cbct recon "$scan_dir" --devices all --backend cpu -o "$work/alone" 2>"$work/said" || fail "all of no daemon"
	grep -q "how many" "$work/said" || fail "the reason, got $(cat "$work/said")"
	post_job "$(with "$recipe" '"devices": 2')" && wait_job succeeded && [ "$(digests)" = "$whole" ] || fail "the same bits"
	post_job "$(with "$recipe" '"devices": "all"')" && wait_job succeeded
	expect_json '.ran_on == [0, 1, 2] and .devices == "all" and .warnings == []'
	[ "$(digests)" != "$whole" ] || fail "other bits of three devices"
	get_volume final "$work/three.raw" format=raw
	expect_number "$("$python" - "$work/two.raw" "$work/three.raw" <<'PYTHON'
import array, sys
a, b = (array.array("f", open(name, "rb").read()) for name in sys.argv[1:])
print((sum((x - y) ** 2 for x, y in zip(a, b)) / sum(x * x for x in a)) ** .5)
PYTHON
	)" "<" 1e-5 "difference between two and three devices"
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "$(with "${recipe//SCAN/$scan}" '"devices": 4')"
	expect_problem 422 /devices
	# What fits into no memory is refused as for one device.
	for count in 1 3 '"all"'; do
		req POST /v1/jobs -H 'Content-Type: application/json' --data-binary \
			"{\"scan\": \"$scan\", \"grid\": {\"size\": [2048, 2048, 2048], \"spacing_mm\": [0.05, 0.05, 0.05]}, \"cgls\": {\"iterations\": 2}, \"tv\": {\"method\": \"tgv\"}, \"devices\": $count}"
		expect_problem 422 /grid/size
	done
	for wrong in 0 17 '"some"' 1.5; do
		req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "$(with "${recipe//SCAN/$scan}" "\"devices\": $wrong")"
		[[ $status == 4* ]] && expect_problem "$status" /devices
	done
}

# Bits of a run on two devices that nobody disturbed.
undisturbed() {
	all_idle
	post_job "$(with "$recipe" '"devices": 2')"
	wait_job succeeded
	expect_json '.attempts == 1'
	digests
}

test_kills_in_the_middle_change_no_bit() {
	local whole pid
	start_posted --workers 2 --checkpoint-seconds 0.02
	whole=$(undisturbed)
	all_idle
	# The worker that has both devices.
	post_job "$(with "$recipe" '"devices": 2')"
	job_becomes '.iteration >= 2 or .state == "succeeded"'
	pid=$(sed -n 's/.*worker 0 (pid \([0-9]*\)).*/\1/p' "$work/cbctd.err" | tail -1)
	kill -KILL "$pid" 2>/dev/null || true
	wait_job succeeded
	expect_json '.ran_on == [0, 1]'
	[ "$(digests)" = "$whole" ] || fail "the bits of an undisturbed run after the worker was killed"
	# The worker whose device is lent: that one's process has nothing to do with the job.
	all_idle
	post_job "$(with "$endless" '"devices": 2')"
	job_becomes '.iteration > 0'
	pid=$(sed -n 's/.*worker 1 (pid \([0-9]*\)).*/\1/p' "$work/cbctd.err" | tail -1)
	kill -KILL "$pid"
	devices_become '.devices[1] | .restarts >= 1 and .state == "lent"'
	job_becomes '.state == "running" and .attempts == 1'
	cancel "$job"
	# The daemon.
	all_idle
	post_job "$(with "$recipe" '"devices": 2')"
	job_becomes '.iteration >= 2 or .state == "succeeded"'
	stop_daemon KILL
	start_daemon --worker "$BUILD/cbct-worker-held" --threads 1 --workers 2
	wait_job succeeded
	expect_json '.ran_on == [0, 1]'
	[ "$(digests)" = "$whole" ] || fail "the bits of an undisturbed run after the daemon was killed"
}

# A checkpoint is of no number of devices.
test_a_job_goes_on_with_another_number_of_devices() {
	local before after
	start_posted --workers 2
	undisturbed >/dev/null
	get_volume final "$work/two.nii"
	for counts in "3 1" "2 3"; do
		read -r before after <<<"$counts"
		# Again where it had ended before the daemon was killed.
		while :; do
			stop_daemon
			start_posted --workers "$before" --checkpoint-seconds 0.02
			all_idle
			post_job "$(with "$recipe" '"devices": "all"')"
			job_becomes '.iteration >= 2 or .state == "succeeded"'
			stop_daemon KILL
			start_daemon --worker "$BUILD/cbct-worker-held" --threads 1 --workers "$after"
			wait_job succeeded
			[ "$(json .attempts)" = 1 ] || break
		done
		expect_json "(.ran_on | length) == $after and ([.history[].iteration] == [range(1; 21)])"
		get_volume final "$work/other.nii"
		expect_number "$(cbct compare --json "$work/other.nii" "$work/two.nii" | jq .rmse)" "<" 2e-7 "difference to two devices"
	done
}

test_devices_are_kept_for_the_job_whose_turn_it_is() {
	local one two wide later
	start_posted --workers 2
	all_idle
	post_job "$endless" && one=$job
	post_job "$endless" && two=$job
	job_becomes '.state == "running"'
	post_job "$(with "$recipe" '"devices": 2')" && wide=$job
	post_job "$recipe" && later=$job
	cancel "$one"
	# One device is free, and the job behind it does not get it.
	job=$wide && job_becomes '.state == "queued" and .waiting_for == ["devices"]'
	job=$later && job_becomes '.state == "queued" and .waiting_for == ["worker"]'
	devices_become '[.devices[].state] == ["idle", "busy"]'
	cancel "$two"
	job=$wide && wait_job succeeded
	expect_json '.ran_on | sort == [0, 1]'
	job=$later && wait_job succeeded
	req GET "/v1/jobs/$wide"
	one=$(json .started)
	req GET "/v1/jobs/$later"
	[[ $(json .started) > $one ]] || fail "the job for two devices begins before the one that came later"
}

# Idle devices are kept for a job no longer than --keep-devices says, and it begins with them.
test_a_job_that_has_waited_begins_with_what_is_free() {
	local one two wide
	start_posted --workers 3 --keep-devices 0.5
	all_idle
	post_job "$endless" && one=$job
	post_job "$endless" && two=$job
	job_becomes '.state == "running"'
	for count in 3 '"all"'; do
		post_job "$(with "$recipe" "\"devices\": $count")"
		wait_job succeeded
		expect_json '.ran_on == [2]'
		expect_json '[.warnings[] | select(.code == "fewer_devices") | .detail] == ["1 of the devices that it asks for: it has waited 0 s for the others, which other jobs had"]'
	done
	cancel "$one"
	# Two of three, and what comes behind it has its turn when these are free again.
	post_job "$(with "$endless" '"devices": 3')" && wide=$job
	job_becomes '.state == "running" and (.ran_on | sort == [0, 2])'
	post_job "$recipe" && one=$job
	job_becomes '.state == "queued" and .waiting_for == ["worker"]'
	cancel "$wide"
	job=$one && wait_job succeeded
	cancel "$two"
	# All that it wants are free: nothing is told.
	all_idle
	post_job "$(with "$recipe" '"devices": 3')"
	wait_job succeeded
	expect_json '.ran_on == [0, 1, 2] and .warnings == []'
}

# Two devices: what was measured on one of them says nothing of two, and the queue is counted device by device.
test_forecasts_know_the_devices() {
	local long=${endless/100000/ITERATIONS} one two wide later
	start_posted --workers 2 --keep-devices 20
	all_idle
	post_job "${long/ITERATIONS/6}" && wait_job succeeded
	post_job "${long/ITERATIONS/100000}" && one=$job
	post_job "${long/ITERATIONS/50000}" && two=$job
	for job in $one $two; do job_becomes '.state == "running" and .iteration > 3'; done
	post_job "$(with "${long/ITERATIONS/40000}" '"devices": 2')" && wide=$job
	req GET '/v1/jobs?state=queued,running'
	# Unless it will begin with the first that is free, after 20 s.
	expect_json '.jobs | map({(.id): .}) | add | ([.["'"$one"'", "'"$two"'"].eta_s] | sort) as $free | .["'"$wide"'"] |
		.start_s > 0 and ((.eta_s == null) == ($free[1] <= $free[0] + 20) or ($free[1] - $free[0] - 20 | fabs) < 1)'
	cancel "$wide"
	for job in $one $two; do cancel "$job"; done
	all_idle
	post_job "$(with "${long/ITERATIONS/6}" '"devices": 2')" && wait_job succeeded
	post_job "${long/ITERATIONS/100000}" && one=$job
	post_job "${long/ITERATIONS/50000}" && two=$job
	for job in $one $two; do job_becomes '.state == "running" and .iteration > 3'; done
	post_job "$(with "${long/ITERATIONS/40000}" '"devices": 2')" && wide=$job
	post_job "${long/ITERATIONS/6}" && later=$job
	req GET '/v1/jobs?state=queued,running'
	# Both devices, or the first one, once that has been kept for 20 s; then what is behind it, on the first that is free.
	expect_json '.jobs | map({(.id): .}) | add | ([.["'"$one"'", "'"$two"'"].eta_s] | sort) as $free | .["'"$wide"'"] as $wide | .["'"$later"'"] as $later |
		def near(other): (. - other | fabs) < 0.05 * other + 1;
		($free[1] <= $free[0] + 20) as $both |
		(($free[1] - $free[0] - 20 | fabs) < 1) or
		($wide.start_s | near(if $both then $free[1] else $free[0] + 20 end)) and
		($later.start_s | near(if $both then $wide.eta_s else [$wide.eta_s, $free[1]] | min end)) and
		$wide.eta_s > $wide.start_s and $later.eta_s > $later.start_s'
	for job in $later $wide $two $one; do cancel "$job"; done
}

test_stat_makes_room_and_gets_it() {
	local one two wide
	start_posted --workers 2
	all_idle
	post_job "$endless" && one=$job
	post_job "$endless" && two=$job
	job_becomes '.state == "running" and .iteration > 0'
	# Two devices for a job of higher priority: both make room.
	post_job "$(with "$recipe" '"devices": 2, "priority": "stat"')" && wide=$job
	wait_job succeeded
	expect_json '.ran_on == [0, 1]'
	for job in $one $two; do job_becomes '.state == "running" and .attempts == 1'; done
	cancel "$one"
	cancel "$two"
	# A job that has both leaves both, and goes on later.
	all_idle
	post_job "$(with "$endless" '"devices": 2')" && wide=$job
	job_becomes '.iteration > 0'
	post_job "$(with "$recipe" '"priority": "stat"')"
	wait_job succeeded
	job=$wide && job_becomes '.state == "running" and .attempts == 1 and .ran_on == [0, 1]'
	cancel "$wide"
}

test_the_default_of_the_daemon() {
	start_posted --workers 2 --devices-per-job 0
	all_idle
	post_job "$recipe" && wait_job succeeded
	expect_json '.devices == "all" and .ran_on == [0, 1]'
	post_job "$(with "$recipe" '"devices": 1')" && wait_job succeeded
	expect_json '.devices == 1 and .ran_on == [0]'
	stop_daemon
	start_daemon --worker "$BUILD/cbct-worker-held" --threads 1 --workers 2 --devices-per-job 4
	post_job "$recipe" && wait_job succeeded
	expect_json '.devices == 2 and (.ran_on | length == 2)'
}

# While projections arrive: the same bits as of those that were there.
test_projections_arrive() {
	local whole bytes=$((64 * 48 * 4)) i
	start_posted --workers 2
	whole=$(undisturbed)
	post_scan "$scan_dir"
	post_job "$(with "$recipe" '"devices": 2')"
	for i in 0 15 30 45; do
		dd if="$scan_dir/projections.raw" of="$work/part" bs=$bytes skip=$i count=15 2>/dev/null
		req PUT "/v1/scans/$scan/projections/$i-$((i + 14))" -T "$work/part"
		expect_status 201
		[ $i != 0 ] || job_becomes '.views.reconstructed > 0 and .ran_on == [0, 1]'
	done
	wait_job succeeded
	expect_json '.attempts == 1'
	[ "$(digests)" = "$whole" ] || fail "the bits of projections that were there before"
}

test_a_device_dies_in_the_middle() {
	BACKEND=cuda start_posted --devices 0,1,2 --checkpoint-seconds 0.02
	all_idle
	trouble iterate 1
	post_job "$(with "$recipe" '"devices": 3')"
	wait_job succeeded
	# The others go on, from the last checkpoint; the device that failed is told of, and the job.
	expect_json '.attempts == 2 and .ran_on == [0, 2] and ([.history[].iteration] == [range(1; 21)])'
	expect_json '[.warnings[] | select(.code == "fewer_devices") | .detail] | length == 1 and (.[0] | startswith("2 of 3 devices"))'
	devices_become '[.devices[].errors] == [0, 1, 0] and (.devices[1].last_error | startswith("device 1: the card has counted"))'
	# Time and again, and it is set aside as one that fails alone; then it is nobody's.
	for _ in 1 2; do
		all_idle
		post_job "$(with "$recipe" '"devices": 3')"
		wait_job succeeded
	done
	devices_become '.devices[1].set_aside != null and .devices[0].set_aside == null and .devices[2].set_aside == null'
	devices_become '.devices[0].state == "idle" and .devices[2].state == "idle"'
	post_job "$(with "$recipe" '"devices": "all"')"
	wait_job succeeded
	expect_json '.attempts == 1 and .ran_on == [0, 2] and .warnings == []'
}

# Whatever comes and goes: no device has two jobs.
test_no_device_has_two_jobs() {
	local i jobs=()
	start_posted --workers 3
	all_idle
	for i in 1 2 3 1 2 '"all"' 1 2; do
		post_job "$(with "$recipe" "\"devices\": $i")"
		jobs+=("$job")
	done
	for job in "${jobs[@]}"; do
		wait_job succeeded
		jq -c '.ran_on[] as $device | {device: $device, started, ended, attempts}' "$body"
	done >"$work/runs"
	# Jobs that were not interrupted, each with a device from `started` to `ended`.
	jq -se 'map(select(.attempts == 1)) | group_by(.device) | all(sort_by(.started) | [., .[1:]] | transpose | all(.[1] == null or .[0].ended <= .[1].started))' \
		"$work/runs" >/dev/null || fail "devices with one job at a time: $(cat "$work/runs")"
	all_idle
}

python=${PYTHON:-python3}
stop_after_each=1
run_tests
