#!/usr/bin/env bash
# Lists of jobs and scans by state, scan, priority, label and text, and how long what has not ended still takes.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

# Two scans, one with labels; of the first a job that succeeded, a failed and a cancelled one, and one that waits.
cbct simulate --phantom ball --scale 30 --views 20 --arc 360 --columns 24 --rows 16 --pixel 8 --name 'Knie Übung' -o "$work/scan" >/dev/null || exit 1
start_daemon --threads 1 || exit 1
post_scan "$work/scan"
knee=$scan
post_projections "$work/scan"
small='"grid": {"size": [8, 8, 8], "spacing_mm": [9, 9, 9]}, "fdk": {}'
post_job "{\"scan\": \"$knee\", $small, \"labels\": {\"room\": \"2\", \"who\": \"Ada\"}}"
done_job=$job
wait_job succeeded
post_job "{\"scan\": \"$knee\", $small, \"priority\": \"stat\"}"
stat_job=$job
wait_job succeeded
req POST /v1/scans -H 'Content-Type: application/json' --data-binary '{"name": "hip", "labels": {"room": "3"}, "detector": {"columns": 4, "rows": 4, "pixel_mm": [1, 1]},
	"projections": {"count": 3, "sample": "float32", "quantity": "line_integral"},
	"geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "angle_step_deg": 120}}'
hip=$(json .id)
post_job "{\"scan\": \"$hip\", $small, \"priority\": \"urgent\"}"
waiting_job=$job

listed() { # PATH: the ids, in the order of the list
	req GET "$1"
	expect_status 200
	jq -r '(.jobs // .scans)[].id' "$body" | paste -sd ' '
}
expect_list() { # PATH ID ...
	local path=$1 got
	shift
	got=$(listed "$path")
	[ "$got" = "$*" ] || fail "$path: $*, got $got"
}

test_jobs_are_found_by_what_is_said_of_them() {
	expect_list /v1/jobs "$waiting_job" "$stat_job" "$done_job"
	expect_list '/v1/jobs?state=succeeded' "$stat_job" "$done_job"
	expect_list '/v1/jobs?state=waiting,failed' "$waiting_job"
	expect_list '/v1/jobs?state=failed'
	expect_list "/v1/jobs?scan=$knee" "$stat_job" "$done_job"
	expect_list '/v1/jobs?priority=stat,urgent' "$waiting_job" "$stat_job"
	expect_list '/v1/jobs?label=room' "$waiting_job" "$done_job"
	expect_list '/v1/jobs?label=room%3D2' "$done_job"
	expect_list '/v1/jobs?label=room%3D3' "$waiting_job"
	expect_list '/v1/jobs?label=roo'
	expect_list '/v1/jobs?label=room%3D'
	expect_list '/v1/jobs?text=KNIE%20%C3%BCb' "$stat_job" "$done_job"
	expect_list '/v1/jobs?text=ada' "$done_job"
	expect_list "/v1/jobs?text=$waiting_job" "$waiting_job"
	expect_list '/v1/jobs?text=nothing%20of%20that'
	expect_list "/v1/jobs?scan=$knee&state=succeeded&priority=routine&label=who&text=ADA" "$done_job"
	expect_list '/v1/scans?state=receiving' "$hip"
	expect_list '/v1/scans?state=receiving,complete' "$hip" "$knee"
	expect_list '/v1/scans?label=room%3D3' "$hip"
	expect_list '/v1/scans?text=knie' "$knee"
}

test_cbct_and_python_ask_the_same() {
	[ "$(cbct jobs --text 'knie üb' --state succeeded --priority stat | cut -d' ' -f1)" = "$stat_job" ] || fail "cbct jobs"
	[ "$(cbct jobs --label room=2 --scan "$knee" | cut -d' ' -f1)" = "$done_job" ] || fail "cbct jobs --label"
	[ "$(cbct scans --state receiving | cut -d' ' -f1)" = "$hip" ] || fail "cbct scans"
	"${PYTHON:-/usr/bin/python3}" -c 'import numpy, requests' 2>/dev/null || skip "python3-numpy or python3-requests is not here"
	[ "$(PYTHONPATH=$top/clients/python "${PYTHON:-/usr/bin/python3}" -c "
import cbctd
client = cbctd.Client('$url')
print(*[job['id'] for job in client.jobs(text='ADA', state='succeeded')], *[scan['id'] for scan in client.scans(label='room=3')])")" = "$done_job $hip" ] ||
		fail "Client.jobs and Client.scans"
}

test_pages_of_what_fits_have_all_of_it_once() {
	req GET '/v1/jobs?state=succeeded&limit=1'
	expect_json ".jobs[0].id == \"$stat_job\" and .next == \"$stat_job\""
	req GET "/v1/jobs?state=succeeded&limit=1&after=$stat_job"
	expect_json ".jobs[0].id == \"$done_job\" and .next == null"
	req GET "/v1/jobs?limit=2&state=waiting,succeeded"
	expect_json '(.jobs | length) == 2 and .next != null'
}

test_what_nobody_knows_is_refused_with_what_is_known() {
	local query words
	while IFS='|' read -r query words; do
		req GET "$query"
		expect_problem 400
		[[ $(json .detail) == *"$words"* ]] || fail "$words in: $(json .detail)"
	done <<-'EOT'
		/v1/jobs?state=done|waiting, queued, running, succeeded, failed, cancelled
		/v1/jobs?state=|waiting, queued
		/v1/jobs?state=failed,|waiting, queued
		/v1/jobs?priority=high|routine, urgent, stat
		/v1/jobs?scan=knee|expected an id
		/v1/jobs?label=|NAME=VALUE
		/v1/scans?state=waiting|receiving, complete
		/v1/scans?scan=1|label
	EOT
	req GET "/v1/jobs?text=$(printf 'x%.0s' {1..201})"
	expect_problem 400
	# characters, not bytes
	expect_list "/v1/jobs?text=$(printf '%%C3%%A4%.0s' {1..200})"
	# bytes that are no UTF-8 stand in no document, nor in a refusal's
	for query in text=%FF label=a%3D%C3 text=%ED%A0%80 'text=%C0%AF'; do
		req GET "/v1/jobs?$query"
		expect_status 400
		expect_json '.detail | contains("UTF-8")'
	done
}

# One worker: a long job runs, two more are queued. Their iterations are of the same kind as those of the job before.
test_what_is_queued_says_when_it_begins_and_ends() {
	local first second third i
	long='"grid": {"size": [24, 24, 24], "spacing_mm": [3, 3, 3]}, "fdk": {}, "sart": {"iterations": ITERATIONS, "subsets": 1}'
	post_job "{\"scan\": \"$knee\", ${long/ITERATIONS/40}}"
	wait_job succeeded
	post_job "{\"scan\": \"$knee\", ${long/ITERATIONS/100000}}"
	first=$job
	for ((i = 0; i < 2400; i++)); do # some of its iterations are over
		req GET "/v1/jobs/$first"
		[ "$(json '.iteration > 20')" = true ] && break
		sleep 0.05
	done
	post_job "{\"scan\": \"$knee\", ${long/ITERATIONS/40000}}"
	second=$job
	post_job "{\"scan\": \"$knee\", ${long/ITERATIONS/20000}}"
	third=$job
	post_job "{\"scan\": \"$knee\", $small, \"cgls\": {\"iterations\": 3}}"
	req GET "/v1/jobs/$job"
	expect_json '.state == "queued" and .eta_s == null' # nobody has measured conjugate gradients yet
	req GET '/v1/jobs?state=queued,running'
	expect_json '.jobs | map({(.id): .}) | add | .["'"$first"'"] as $a | .["'"$second"'"] as $b | .["'"$third"'"] as $c |
		$a.start_s == null and $a.eta_s > 0 and $b.start_s > 0 and
		($b.start_s - $a.eta_s | fabs) < 0.05 * $a.eta_s + 1 and
		(($b.eta_s - $b.start_s) / ($c.eta_s - $c.start_s) - 2 | fabs) < 0.02 and
		($c.start_s - $b.eta_s | fabs) < 0.01 * $b.eta_s + 1'
	for job in "$job" "$third" "$second" "$first"; do
		req DELETE "/v1/jobs/$job"
		expect_status 202
	done
	wait_job cancelled
}

run_tests
