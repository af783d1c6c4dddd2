#!/usr/bin/env bash
# A fleet: daemons that compute each other's jobs, with their ledger in a PostgreSQL server of Debian's (docs/fleet.md).
# An owner has no device here unless a test says so: its jobs can only be computed elsewhere.
. "$(dirname "$0")/lib.sh"
. "$here/fleet.sh"

cbct simulate -o "$work/counts" --phantom head --scale 70 --views 30 --columns 48 --rows 36 --pixel 7 --photons 30000 >/dev/null
trap 'stop_slurm; stop_hosts; stop_postgresql' EXIT

test_the_ledger_gives_each_offer_to_one_and_knows_old_numbers() {
	need_server
	CBCT_TEST_CATALOGUE=$database "$BUILD/unit" ledger >"$work/unit" 2>&1 || { cat "$work/unit"; fail "the unit tests"; }
	grep -q '^100%: Checks: 9' "$work/unit" || fail "all of them passed: $(cat "$work/unit")"
}

test_a_job_is_computed_by_another_host_to_the_same_bits() {
	begin
	undisturbed "$scan_dir" "$small" small
	taker a
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	wait_job succeeded
	expect_json '(.device | startswith("a: ")) and .backend == "cpu" and .attempts == 1 and .error == null and (.plan | length > 0) and .memory.total > 0'
	expect_json '(.history | length == 3) and .volumes == 3 and .denoising.noise_hu != null and .progress == 1'
	expect_json ".geometry_agreement.views > 0 and .geometry_agreement == $(cat "$work/small.agreement")"
	same_bits small
	told_once
	# The file is this daemon's: its ids, its scan's name.
	req GET "/v1/jobs/$job/volumes/fdk/provenance"
	expect_status 200
	expect_json ".job == \"$job\" and .scan == \"$scan\" and .scan_name == \"simulated\" and .stage == \"fdk\""
	curl -s "$url/v1/jobs/$job/volumes/final" >"$work/final.nii"
	cbct reproduce "$work/final.nii" --url "$url" --from "$work/c/scans/$scan" >"$work/reproduced" 2>&1 || fail "the same volume again: $(cat "$work/reproduced")"
	nothing_left a
	empty_ledger
}

test_counts_with_their_images_and_a_patient_who_stays_at_home() {
	begin
	local with_images='.detector += {} | .name = "Doe^Jane" | .patient = {"position": "FFP", "name": "Doe^Jane", "id": "4711"} | .labels = {"ward": "secret"}'
	rm -rf "$work/patient"
	cp -r "$work/counts" "$work/patient"
	jq "$with_images" "$work/counts/scan.json" >"$work/patient/scan.json"
	undisturbed "$work/patient" "$small" patient
	taker a --log-level debug
	owner c
	at c
	post_scan "$work/patient"
	post_projections "$work/patient"
	post_job "$small"
	wait_job succeeded
	same_bits patient
	req GET "/v1/jobs/$job/volumes/final/provenance"
	expect_json '.left_right == "known" and .patient.position == "FFP"'
	nothing_left a
	! grep -rqE 'Doe|4711|secret' "$work/a" "$work/a.err" || fail "nothing of the patient on another host: $(grep -rlE 'Doe|4711|secret' "$work/a" "$work/a.err")"
}

test_images_of_scatter_go_along() {
	begin
	cbct simulate -o "$work/scattered" --phantom head --scale 70 --views 30 --columns 48 --rows 36 --pixel 7 --raw air >/dev/null
	jq '.projections.scatter = {"kind": "images", "columns": 8, "rows": 6, "every": 12}' "$work/scattered/scan.json" >"$work/announced.json"
	mv "$work/announced.json" "$work/scattered/scan.json"
	python3 -c 'import array, sys; array.array("f", [300 + i % 48 for i in range(4 * 48)]).tofile(sys.stdout.buffer)' >"$work/scattered/scatter.raw"
	start_daemon --threads 1
	scan=$(cbct upload --quiet --url "$url" "$work/scattered")
	post_job "$small"
	wait_job succeeded
	get_volume final "$work/scattered.raw" format=raw
	req GET "/v1/jobs/$job/volumes/final/provenance"
	jq .images "$body" >"$work/scattered.images"
	stop_daemon
	taker a
	owner c
	at c
	scan=$(cbct upload --quiet --url "$url" "$work/scattered")
	post_job "$small"
	wait_job succeeded 60
	same_bits scattered
	req GET "/v1/jobs/$job/volumes/final/provenance"
	jq .images "$body" | cmp - "$work/scattered.images" || fail "the same images"
	nothing_left a
}

test_a_zombie_is_not_heard() {
	begin
	undisturbed "$scan_dir" "$long" long
	taker a
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	given_to a
	progresses
	kill -STOP "$(cat "$work/a.pid")" # its worker goes on
	taker b
	at c
	given_to b
	kill -CONT "$(cat "$work/a.pid")"
	wait_job succeeded
	expect_json '.attempts == 1 and (.device | startswith("b: "))'
	same_bits long
	told_once
	nothing_left a
	nothing_left b
}

test_an_owner_that_is_killed_goes_on_where_the_other_host_is() {
	local lease=60 # longer than a daemon takes to start, on however loaded a machine
	# Its process for the other host lives on until it sees that its daemon is gone: it ends then, and the job does not.
	local -A within=([c]="env LD_PRELOAD=$(realpath "$BUILD")/faults.so CBCT_TEST_FAULTS=$work/faults")
	echo 'prctl 1 parent 1000000 0' >"$work/faults"
	begin
	undisturbed "$scan_dir" "$long" long
	taker a
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	given_to a
	progresses
	stop_host c KILL
	owner c
	at c
	wait_job succeeded
	expect_json '.error == null and (.device | startswith("a: "))'
	[ "$(grep -c 'of host c is claimed' "$work/a.err")" = 1 ] || fail "one claim: $(grep 'is claimed' "$work/a.err")"
	same_bits long
	told_once
	nothing_left a
	empty_ledger
	[ "$(curl -s "$(cat "$work/c.url")/metrics" | grep -c '^cbctd_fleet_up 1$')" = 1 ] || fail "metrics of the fleet"
}

test_a_cart_alone_goes_on_and_gives_nothing_away_that_it_can_do_itself() {
	begin
	undisturbed "$scan_dir" "$small" small
	# The fleet's database is not there: nothing waits for it.
	start_host b --fleet-database postgresql://cbctd@127.0.0.1:1/none
	at b
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	wait_job succeeded
	expect_json '.device | startswith("b:") | not'
	same_bits small
	grep -q 'the fleet cannot be reached, jobs go on here' "$work/b.err" || fail "that it is told"
	stop_host b
	taker a
	start_host b
	at b
	post_job "$small"
	wait_job succeeded
	expect_json '.device | startswith("a:") | not'
}

test_a_database_that_goes_away_stops_no_job() {
	begin
	undisturbed "$scan_dir" "$long" long
	taker a
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	given_to a
	kill_server
	wait_job succeeded
	expect_json '.attempts == 1 and (.device | startswith("a: "))'
	same_bits long
	told_once
	start_server
	# What comes now goes there again.
	post_job "$small"
	wait_job succeeded
	nothing_left a
}

test_a_cancel_reaches_the_other_host_and_an_urgent_job_goes_first_there() {
	begin
	taker a
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	given_to a
	progresses
	local first=$job
	post_job "${small/\"fdk\"/\"priority\": \"stat\", \"fdk\"}"
	wait_job succeeded
	req GET "/v1/jobs/$first"
	expect_json '.state == "running"'
	job=$first
	req DELETE "/v1/jobs/$job"
	expect_status 202
	wait_job cancelled
	nothing_left a
	empty_ledger
}

# checkpoint_beyond ITERATION: the owner has a later one of $job; its iteration is in $checkpoint
checkpoint_beyond() {
	local i
	for ((i = 0; i < 600; i++)); do
		req GET "/v1/jobs/$job/checkpoint" -H 'Range: bytes=0-159'
		checkpoint=$(header cbct-iteration)
		[ "$status" = 206 ] && [ "${checkpoint:-0}" -gt "$1" ] && return 0
		sleep 0.05
	done
	fail "a checkpoint of $job behind iteration $1, got $status $checkpoint"
}
# went_on_behind HOST ITERATION: the job there has made no row up to that one
went_on_behind() {
	local there i
	for ((i = 0; i < 600; i++)); do
		there=$(curl -s "$(cat "$work/$1.url")/v1/jobs" | jq -r '.jobs[0].id // ""')
		[ -n "$there" ] && curl -s "$(cat "$work/$1.url")/v1/jobs/$there" >"$work/there" && jq -e '.history | length > 0' "$work/there" >/dev/null && break
		sleep 0.05
	done
	jq -e ".history[0].iteration > $2" "$work/there" >/dev/null || fail "rows behind $2 on $1, got $(jq -c '.history[0]' "$work/there")"
}
test_a_job_goes_on_elsewhere_from_its_checkpoint() {
	local checkpoint
	begin
	undisturbed "$scan_dir" "$long" long
	start_host c --checkpoint-seconds 0.2
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	checkpoint_beyond 0
	stop_host c
	# What was begun at home goes on elsewhere.
	owner c --checkpoint-seconds 0.2
	taker a --checkpoint-seconds 0.2
	at c
	given_to a
	went_on_behind a "$checkpoint"
	checkpoint_beyond "$((checkpoint + 20))"
	stop_host a KILL
	taker b --checkpoint-seconds 0.2
	at c
	given_to b
	went_on_behind b "$checkpoint"
	wait_job succeeded
	expect_json '.error == null and (.device | startswith("b: ")) and ([.history[].iteration] == [range(1; (.history | length) + 1)])'
	same_bits long
	told_once
	# It comes back, and finds that what it had is another's.
	taker a
	nothing_left a
	nothing_left b
	empty_ledger
	[ ! -e "$work/c/jobs/$job/checkpoint.f32" ] || fail "no checkpoint is left"
}

# answered_by WHAT STATUS: GET of it, here, is answered so within some seconds
answered_by() {
	local i
	for ((i = 0; i < 200; i++)); do
		req GET "$1"
		[ "$status" = "$2" ] && return 0
		sleep 0.05
	done
	fail "$1 answered with $2, got $status: $(head -c 400 "$body")"
}
test_a_daemon_passes_on_what_another_one_has() {
	local home
	begin
	taker a
	taker b
	owner c # without an address
	at a
	home=$url
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	wait_job succeeded
	at b
	answered_by "/v1/jobs/$job" 307
	[ "$(header location)" = "$home/v1/jobs/$job" ] || fail "Location at $home, got $(header location)"
	expect_json '.type == "urn:cbctd:problem:elsewhere" and (.detail | contains("host a"))'
	req GET "/v1/jobs/$job/volumes/final/slice?axis=z&index=3"
	expect_status 307
	[ "$(header location)" = "$home/v1/jobs/$job/volumes/final/slice?axis=z&index=3" ] || fail "path and query, got $(header location)"
	answered_by "/v1/scans/$scan" 307
	req PUT "/v1/scans/$scan/projections/0" --data-binary @"$scan_dir/projections.raw"
	expect_status 307
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${small//SCAN/$scan}"
	expect_status 307
	[ "$(header location)" = "$home/v1/jobs" ] || fail "the job is posted there, got $(header location)"
	curl -sL "$url/v1/jobs/$job" | jq -e '.state == "succeeded"' >/dev/null || fail "who follows gets there"
	cbct get "$job" final --url "$url" -o "$work/final.nii" >/dev/null || fail "cbct follows"
	cmp "$work/final.nii" <(curl -s "$home/v1/jobs/$job/volumes/final") || fail "the same volume"
	# Nobody redirects to itself: what the owner has removed is gone.
	at a
	req DELETE "/v1/jobs/$job"
	expect_status 204
	at b
	answered_by "/v1/jobs/$job" 404
	# A host that is away, and one that has no address.
	stop_host a KILL
	answered_by "/v1/scans/$scan" 503
	expect_json '.detail | contains("host a of the fleet has it")'
	at c
	post_scan "$scan_dir"
	at b
	answered_by "/v1/scans/$scan" 404
	for i in {1..100}; do
		[[ $(json .detail) == *"host c of the fleet has it, which has no address"* ]] && break
		sleep 0.05
		req GET "/v1/scans/$scan"
	done
	expect_json '.detail | contains("host c of the fleet has it, which has no address")'
}

test_a_scan_is_brought_once_for_all_its_jobs() {
	local i stored
	begin
	undisturbed "$scan_dir" "$small" small
	taker a --fleet-keep-scans 600 --log-level debug
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	for i in 1 2 3; do
		post_job "$small"
		wait_job succeeded
		expect_json '.device | startswith("a: ")'
		same_bits small
	done
	# In as many runs as their announcements came in.
	stored=$(grep -o 'method=PUT target=/v1/scans/[^ ]*/projections/[0-9-]*' "$work/a.err" | sed 's/.*\///' |
		awk -F- '{ views += $2 - $1 + 1 } END { print views }')
	[ "$stored" = 64 ] || fail "64 projections were sent once, got $stored"
	[ "$(curl -s "$(cat "$work/a.url")/v1/scans" | jq '.scans | length')" = 1 ] || fail "one copy"
	# It goes with the scan.
	for job in $(curl -s "$url/v1/jobs" | jq -r '.jobs[].id'); do
		req DELETE "/v1/jobs/$job"
		expect_status 204
	done
	req DELETE "/v1/scans/$scan"
	expect_status 204
	nothing_left a
}

# turns_until HOST: projections come, one a second, until some of $job's are reconstructed there; $next is the next to come
turns_until() {
	local end
	while [ "$next" -lt 60 ]; do
		dd if="$scan_dir/projections.raw" of="$work/projection" bs=6912 skip="$next" count=1 2>/dev/null
		req PUT "/v1/scans/$scan/projections/$next" --data-binary @"$work/projection"
		expect_status 201
		next=$((next + 1))
		end=$((SECONDS + 1))
		while [ "$SECONDS" -le "$end" ]; do
			req GET "/v1/jobs/$job"
			expect_json '.state == "waiting"'
			[ "$(json '(.device // "" | startswith("'"$1"': ")) and .views.reconstructed > 0')" = true ] && return 0
			sleep 0.1
		done
	done
	fail "job $job is attended by $1, got $(json '{state, device, views}')"
}
test_an_arm_that_turns_is_followed_on_another_host() {
	local next=0
	begin
	undisturbed "$scan_dir" "$small" small
	taker a
	owner c
	at c
	post_scan "$scan_dir"
	post_job "$small"
	turns_until a
	stop_host a KILL
	taker b
	at c
	turns_until b
	req PUT "/v1/scans/$scan/projections" --data-binary @"$scan_dir/projections.raw"
	expect_status 201
	wait_job succeeded
	expect_json '(.device | startswith("b: ")) and .error == null'
	same_bits small
	told_once
	nothing_left b
	empty_ledger
}

# where JSON JOB: the job with that "where"
where() { printf '%s' "${2/\"fdk\"/\"where\": $1, \"fdk\"}"; }
waits_for_a_host() {
	req GET "/v1/jobs/$job"
	expect_json '.state == "queued" and .waiting_for == ["host"] and .start_s == null and .eta_s == null'
}
# waits_because WORDS: the job's document says so within some seconds
waits_because() {
	local i
	for ((i = 0; i < 300; i++)); do
		req GET "/v1/jobs/$job"
		[[ $(json '.waiting_detail // ""') == *"$1"* ]] && break
		sleep 0.05
	done
	expect_json '.state == "queued" and (.waiting_for | index("host") != null)'
	[[ $(json .waiting_detail) == *"$1"* ]] || fail "waits because: $1, got $(json .waiting_detail)"
}
test_a_job_on_several_devices_goes_where_they_are_and_why_one_waits_is_told() {
	begin
	undisturbed "$scan_dir" "$small" small
	taker a --device-memory 400000000
	start_host c --device-memory 300000000
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	# Nobody has two devices: that is told, and the host with one claims nothing of it.
	post_job "${small/\"fdk\"/\"devices\": 2, \"fdk\"}"
	waits_because 'none of the 1 hosts that take jobs just now can run it: 2 devices are wanted'
	! grep -q 'is claimed' "$work/a.err" || fail "no claim by a host with one device"
	taker b --workers 2
	at c
	wait_job succeeded
	expect_json '(.device | startswith("b: ")) and .devices == 2 and (.plan | contains("2 "))'
	# Reasons, at once where they are known.
	post_job "$(where '{"host": "d"}' "$small")"
	expect_json '.waiting_for == ["host"] and .waiting_detail == "no host of the fleet has ever been called d"'
	post_job "$(where '{"host": "a", "memory": 500000000}' "$small")"
	waits_because 'host a can never run it as it is: it has 1 device of at most 400000000 bytes, and 1 device of 500000000 bytes are wanted'
	post_job "$(where '{"host": "a"}' "$small")"
	wait_job succeeded
	expect_json '.waiting_detail == null and .waiting_for == []'
	stop_host a KILL
	sleep "$lease"
	post_job "$(where '{"host": "a"}' "$small")"
	waits_because 'host a was last seen'
	stop_hosts
	start_daemon --threads 1 --fleet-host cart
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$(where '{"host": "b"}' "$small")"
	expect_json '.waiting_detail == "this host, cart, may not run it by its \"where\", and is in no fleet"'
	stop_daemon
}

# paced NAME SECONDS [OPTION ...]: a host whose worker takes that long for jobs of 4 and of 60 iterations
paced() { PACED_WORKER=$BUILD/cbct-worker PACED_SECONDS="4:$2,60:$(($2 * 15))" start_host "$1" --worker "$top/tests/bench/paced_worker.py" "${@:3}"; }
runs_on() { # PATTERN of jq on the device: $job runs
	local i
	for ((i = 0; i < 1200; i++)); do
		req GET "/v1/jobs/$job"
		[ "$(json '.state == "running" or .state == "succeeded"')" = true ] && break
		sleep 0.05
	done
	[ "$(json ".device | $1")" = true ]
}
cancel_it() {
	req DELETE "/v1/jobs/$job"
	wait_job cancelled
}
test_large_jobs_go_to_a_faster_host_and_small_ones_stay_on_the_cart() {
	local try
	# So small that computing it is a small part of the times, on a busy machine as well.
	local few='"grid": {"size": [16, 16, 8], "spacing_mm": [12, 12, 12]}'
	local some="{\"scan\": \"SCAN\", $few, \"fdk\": {}, \"sart\": {\"iterations\": X, \"subsets\": 1}, \"emit\": []}"
	begin
	paced a 0 --fleet-address http://127.0.0.1:PORT
	paced c 16
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	# What such jobs take is learned on either.
	post_job "$(where '{"host": "c"}' "${some/X/4}")"
	wait_job succeeded
	post_job "$(where '{"host": "a"}' "${some/X/4}")"
	wait_job succeeded
	for ((try = 0; try < 5; try++)); do
		sleep 1
		post_job "${some/X/60}"
		runs_on 'startswith("a: ")' && break
		cancel_it # it was not known here yet
	done
	wait_job succeeded
	expect_json '.device | startswith("a: ")'
	some=${some/16, 16, 8/8, 8, 4}
	post_job "${some/X/1}"
	wait_job succeeded
	expect_json '.device | startswith("a: ") | not'
	# Where bringing it takes longer than all of it here, it stays.
	stop_host c
	paced c 16 --fleet-link 1K
	at c
	sleep 2
	some=${some/8, 8, 4/16, 16, 8}
	post_job "${some/X/60}"
	runs_on 'startswith("a: ") | not' || fail "it stays, got $(json .device)"
	cancel_it
	[ "$(sql "SELECT rates <> '' FROM cbctd_fleet_test.hosts WHERE name = 'c'")" = t ] || fail "what jobs take on c is told"
}

test_a_job_runs_where_it_says_and_waits_for_a_host_that_is_not_there() {
	local absent
	begin
	undisturbed "$scan_dir" "$small" small
	taker a --device-memory 400000000
	start_host c --device-memory 300000000
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	# The host that it names, and the one with the memory, though the owner's own device has nothing to do.
	post_job "$(where '{"host": "a"}' "$small")"
	wait_job succeeded
	expect_json '(.device | startswith("a: ")) and .where == {host: "a", memory: null, devices: null}'
	same_bits small
	post_job "$(where '{"memory": 350000000}' "$small")"
	wait_job succeeded
	expect_json '(.device | startswith("a: ")) and .where.memory == 350000000'
	post_job "$(where '{"host": "c", "memory": 300000000, "devices": 1}' "$small")"
	wait_job succeeded
	expect_json '.device | startswith("a: ") | not'
	# Nobody is that host: the job waits, others go by, and another start knows it still.
	post_job "$(where '{"host": "b"}' "${small/\"fdk\"/\"priority\": \"stat\", \"fdk\"}")"
	absent=$job
	waits_for_a_host
	post_job "$(where '{"devices": 2}' "$small")"
	waits_for_a_host
	req DELETE "/v1/jobs/$job"
	expect_status 202
	post_job "$small"
	wait_job succeeded
	expect_json '.where == null and (.device | startswith("a: ") | not)'
	job=$absent
	stop_host c
	start_host c --device-memory 300000000
	at c
	waits_for_a_host
	expect_json '.where.host == "b"'
	taker b
	at c
	wait_job succeeded
	expect_json '.device | startswith("b: ")'
	same_bits small
	nothing_left a
	nothing_left b
	# A cart that is in no fleet has its name all the same.
	stop_hosts
	start_daemon --threads 1 --fleet-host cart
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$(where '{"host": "cart"}' "$small")"
	wait_job succeeded
	post_job "$(where '{"host": "b"}' "$small")"
	waits_for_a_host
	stop_daemon
}

test_a_taker_ends_when_it_has_been_idle_and_not_before() {
	local pid i
	begin
	undisturbed "$scan_dir" "$small" small
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	taker a --until-idle 4
	pid=$(cat "$work/a.pid")
	at c
	wait_job succeeded
	expect_json '.device | startswith("a: ")'
	same_bits small
	told_once
	for ((i = 0; i < 600; i++)); do
		kill -0 "$pid" 2>/dev/null || break
		sleep 0.05
	done
	wait "$pid" || fail "it ends well, got $?: $(tail -3 "$work/a.err")"
	rm -f "$work/a.pid"
	grep -q 'stopping: no job for 4 s' "$work/a.err" || fail "the reason, got $(tail -3 "$work/a.err")"
	empty_ledger
}

# Slurm's two daemons for one host, as whoever runs the test, with no authentication but on this machine's own ports.
start_slurm() {
	local i port=$((20000 + RANDOM % 5000)) user
	user=$(id -un)
	export SLURM_CONF=$work/slurm/slurm.conf
	mkdir -p "$work/slurm/state" "$work/slurm/spool"
	cat >"$SLURM_CONF" <<-END
		ClusterName=test
		SlurmctldHost=$(hostname -s)(127.0.0.1)
		AuthType=auth/none
		CredType=cred/none
		SlurmUser=$user
		SlurmdUser=$user
		SlurmctldPort=$port
		SlurmdPort=$((port + 1))
		SlurmctldPidFile=$work/slurm/slurmctld.pid
		SlurmdPidFile=$work/slurm/slurmd.pid
		StateSaveLocation=$work/slurm/state
		SlurmdSpoolDir=$work/slurm/spool
		ProctrackType=proctrack/linuxproc
		TaskPlugin=task/none
		SwitchType=switch/none
		MpiDefault=none
		JobAcctGatherType=jobacct_gather/none
		NodeName=$(hostname -s) NodeAddr=127.0.0.1 CPUs=1 State=UNKNOWN
		PartitionName=all Nodes=ALL Default=YES State=UP
	END
	slurmctld -c -D >"$work/slurm/slurmctld.out" 2>&1 &
	echo $! >"$work/slurm/processes"
	slurmd -D >"$work/slurm/slurmd.out" 2>&1 &
	echo $! >>"$work/slurm/processes"
	for ((i = 0; i < 150; i++)); do
		[[ $(timeout 5 sinfo -h -o %t 2>/dev/null) = idle ]] && return 0
		sleep 0.1
	done
	return 1
}
stop_slurm() {
	local pid
	[ -e "$work/slurm/processes" ] || return 0
	export SLURM_CONF=$work/slurm/slurm.conf
	timeout 10 scancel -u "$(id -un)" 2>/dev/null || true
	timeout 10 scancel --signal=KILL --full -u "$(id -un)" 2>/dev/null || true
	tac "$work/slurm/processes" | while read -r pid; do
		kill "$pid" 2>/dev/null || continue
		while kill -0 "$pid" 2>/dev/null; do sleep 0.05; done
	done
	rm -f "$work/slurm/processes"
}
# submit: a taker as a job of Slurm, whose number is in $slurm_job
submit() {
	local port=$((25000 + RANDOM % 5000))
	slurm_job=$(PATH=$BUILD:$PATH LISTEN=127.0.0.1:$port ADDRESS=http://127.0.0.1:$port IDLE=4 timeout 10 \
		sbatch --parsable -o "$work/slurm/%j.out" "$top/systemd/cbctd.sbatch" --backend cpu --threads 1 --fleet test \
		--fleet-database "$database" --fleet-lease "$lease")
}
ends_well() { # $slurm_job
	local i
	for ((i = 0; i < 300; i++)); do
		timeout 5 scontrol -o show job "$slurm_job" >"$work/slurm/job" 2>&1
		! grep -qE 'JobState=(PENDING|RUNNING|COMPLETING) ' "$work/slurm/job" && break
		sleep 0.1
	done
	grep -q 'JobState=COMPLETED .*ExitCode=0:0' "$work/slurm/job" || fail "COMPLETED, got $(cat "$work/slurm/job") $(tail -5 "$work/slurm/$slurm_job.out")"
}
test_slurm_starts_takers_drains_them_and_has_its_node_back() {
	local tool
	need_server
	for tool in slurmctld slurmd sbatch; do command -v "$tool" >/dev/null || skip "Slurm is not installed"; done
	begin
	undisturbed "$scan_dir" "$small" small
	start_slurm || skip "Slurm does not start here: $(tail -2 "$work"/slurm/*.out)"
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	submit
	given_to "slurm-$slurm_job"
	progresses
	timeout 10 scancel --batch --signal=TERM "$slurm_job"
	ends_well
	req GET "/v1/jobs/$job"
	expect_json '.state == "queued" and .attempts == 1 and .error == null'
	req DELETE "/v1/jobs/$job"
	expect_status 202
	post_job "$small"
	submit
	wait_job succeeded
	expect_json ".device | startswith(\"slurm-$slurm_job: \")"
	same_bits small
	ends_well
	empty_ledger
	stop_slurm
}

test_tokens_and_tls_between_daemons() {
	begin
	openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=localhost -addext 'subjectAltName=IP:127.0.0.1,DNS:localhost' \
		-keyout "$work/key.pem" -out "$work/cert.pem" 2>/dev/null
	chmod 600 "$work/key.pem"
	rm -f "$work/tokens" "$work/token"
	(umask 077; cbct token new peer --role acquire --file "$work/tokens" >"$work/token")
	printf 'cacert = "%s"\nheader = "Authorization: Bearer %s"\n' "$work/cert.pem" "$(cat "$work/token")" >"$work/.curlrc"
	start_host a --fleet-address https://127.0.0.1:PORT --tokens "$work/tokens" --tls-cert "$work/cert.pem" --tls-key "$work/key.pem"
	# Without the token, and without the authority, nothing is given.
	owner c
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	waits_because 'host a has claimed jobs and cannot be given them: '
	stop_host c
	# A token that may only look, one that nobody knows, one that has expired: told, and no job is held to be at fault.
	(umask 077
		cbct token new looks --role view --file "$work/tokens" >"$work/view"
		cbct token new late --role acquire --expires "$(date -u -d '3 seconds' +%Y-%m-%dT%H:%M:%SZ)" --file "$work/tokens" >"$work/late"
		sed 's/.$/_/' "$work/token" >"$work/unknown")
	kill -HUP "$(cat "$work/a.pid")"
	sleep 3
	for each in view:'the token shown has the role view' unknown:'it refuses this host' late:'it refuses this host'; do
		owner c --fleet-token "$work/${each%%:*}" --fleet-cacert "$work/cert.pem"
		at c
		waits_because "${each#*:}"
		req GET /readyz
		expect_status 503
		expect_json '.detail | contains("host a cannot be given jobs: ")'
		grep -q "warning: host a of the fleet has claimed job $job and cannot be given it: .*${each#*:}" "$work/c.err" || fail "a line of the log, got $(tail -3 "$work/c.err")"
		stop_host c
		rm -f "$work/c.err"
	done
	owner c --fleet-token "$work/token" --fleet-cacert "$work/cert.pem"
	at c
	wait_job succeeded
	expect_json '.device | startswith("a: ")'
	# Keys of clients with a name are kept with it: what is cancelled here goes there, and so does the scan when it goes.
	post_job "$long"
	given_to a
	progresses
	req DELETE "/v1/jobs/$job"
	expect_status 202
	wait_job cancelled
	for job in $(curl -s "$url/v1/jobs" | jq -r '.jobs[].id'); do
		req DELETE "/v1/jobs/$job"
		expect_status 204
	done
	req DELETE "/v1/scans/$scan"
	expect_status 204
	CURL_HOME=$work nothing_left a
}

# A host that has no room gives a job back at once, and has time for others between two attempts.
test_a_host_without_room_gives_back_and_takes_others() {
	local large
	begin
	cbct simulate -o "$work/large" --phantom head --scale 70 --views 200 --columns 96 --rows 64 --pixel 4 >/dev/null
	taker a --max-bytes 8M
	owner c
	at a
	post_scan "$work/large"
	post_projections "$work/large"
	at c
	post_scan "$work/large"
	post_projections "$work/large"
	post_job "${small%\}}, \"where\": {\"host\": \"a\"}}"
	large=$job
	for ((i = 0; i < 600; i++)); do
		[ "$(grep -c "job $large comes back from a: .*has no room" "$work/c.err")" -ge 3 ] && break
		sleep 0.05
	done
	grep -q "job $large comes back from a: .*has no room" "$work/c.err" || fail "it comes back: $(tail -3 "$work/c.err")"
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	wait_job succeeded
	expect_json '.device | startswith("a: ")'
	job=$large
	req GET "/v1/jobs/$job"
	expect_json '.state == "queued" or .state == "running"'
	req DELETE "/v1/jobs/$job"
	expect_status 202
}

test_settings_that_cannot_be_right_are_refused() {
	local told
	refused() {
		if told=$("$BUILD/cbctd" --listen 127.0.0.1:0 --state-dir "$work/none" "$@" 2>&1); then fail "$* refused"; fi
		[ ! -e "$work/none" ] || fail "nothing was touched"
	}
	refused --fleet test
	refused --fleet 'a b' --fleet-database postgresql://host/db
	refused --fleet test --fleet-database postgresql://host/db --fleet-host 'a b'
	refused --fleet test --fleet-database 'postgresql://cbctd:secret@host:none/db'
	! grep -q secret <<<"$told" || fail "no password in: $told"
	if told=$("$BUILD/cbctd-without-postgresql" --listen 127.0.0.1:0 --state-dir "$work/none" --fleet test --fleet-database postgresql://host/db 2>&1); then fail "refused"; fi
	grep -q 'built without libpq' <<<"$told" || fail "the reason, got $told"
	! "$BUILD/cbctd" --fleet test --fleet-database 'postgresql://cbctd:secret@host/db' --print-config 2>&1 | grep -q secret || fail "no password is printed"
}

run_tests
