#!/usr/bin/env bash
# /metrics: what is counted, that Prometheus can read it, and that the alerts and the dashboard name what there is.
. "$(dirname "$0")/lib.sh"

rules=$top/systemd/cbctd-alerts.yaml
dashboard=$top/systemd/cbctd-dashboard.json

# metric NAME-AND-LABELS: its value in the last body
metric() {
	local line
	line=$(grep -F "$1 " "$body" | grep -v '^#') || fail "the metric $1"
	echo "${line##* }"
}
metric_is() { # NAME-AND-LABELS OP VALUE
	expect_number "$(metric "$1")" "$2" "$3" "$1"
}
need_promtool() { command -v promtool >/dev/null || skip "promtool (Debian's prometheus) is not here"; }
scrape() {
	req GET /metrics
	expect_status 200
}

work_with() { # a whole job, of a name that must stay out, and a few requests that are refused
	simulate
	reconstruct "$work/scan" '{"scan": "SCAN", "sart": {"iterations": 3}, "tv": null, "priority": "stat", "labels": {"who": "Zwolle"}}'
	req GET "/v1/jobs/$job/volumes/final"
	expect_status 200
	req GET /v1/jobs/none
	expect_status 404
	req GET /nowhere
	expect_status 404
	req PUT /v1/jobs
	expect_status 405
}
simulate() {
	[ -e "$work/scan/scan.json" ] || cbct simulate -o "$work/scan" --phantom head --views 24 --columns 24 --rows 20 --pixel 6 >/dev/null
	sed -i 's/"name": *"[^"]*"/"name": "Zwolle knee"/' "$work/scan/scan.json"
}

test_requests_bytes_and_seconds_by_route() {
	local bytes last
	work_with
	bytes=$(stat -c %s "$work/scan/projections.raw")
	scrape
	metric_is 'cbctd_requests_total{method="PUT",route="/v1/scans/{}/projections",status="201"}' == 1
	metric_is 'cbctd_received_bytes_total{method="PUT",route="/v1/scans/{}/projections",status="201"}' == "$bytes"
	metric_is 'cbctd_requests_total{method="GET",route="/v1/jobs/{}",status="404"}' == 1
	metric_is 'cbctd_requests_total{method="any",route="none",status="404"}' '>=' 1
	metric_is 'cbctd_sent_bytes_total{method="GET",route="/v1/jobs/{}/volumes/{}",status="200"}' '>' 1000
	metric_is 'cbctd_request_seconds_count{method="PUT",route="/v1/scans/{}/projections"}' == 1
	# Buckets grow, and the last has all.
	awk -F '[ "]' '/^cbctd_request_seconds_bucket\{method="GET",route="\/livez"/ || /^cbctd_request_seconds_bucket\{method="GET",route="\/readyz"/ {
		if ($NF < last && $5 == route) exit 1; last = $NF; route = $5 }' "$body" || fail "buckets that grow"
	! grep -qE 'Zwolle|'"$scan|$job" "$body" || fail "no name and no id: $(grep -E 'Zwolle|'"$scan|$job" "$body")"
}

test_jobs_stages_and_checkpoints() {
	simulate
	post_scan "$work/scan" # a job that waits for its projections
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"priority\": \"urgent\"}"
	expect_status 202
	sleep 0.1
	scrape
	metric_is 'cbctd_jobs{state="waiting",priority="urgent"}' == 1
	metric_is 'cbctd_jobs{state="succeeded",priority="stat"}' == 1
	metric_is 'cbctd_oldest_job_seconds{state="waiting",priority="urgent"}' '>' 0.05
	metric_is 'cbctd_oldest_job_seconds{state="queued",priority="stat"}' == 0
	metric_is cbctd_iterations_total == 3
	metric_is 'cbctd_jobs_ended_total{state="succeeded"}' == 1
	metric_is 'cbctd_stage_seconds_count{stage="sart"}' == 1
	metric_is 'cbctd_stage_seconds_sum{stage="sart"}' '>' 0
	metric_is cbctd_checkpoints_total '>=' 0
	metric_is cbctd_disk_free_bytes '>' 1e6
	expect_number "$(metric cbctd_disk_size_bytes)" '>=' "$(metric cbctd_disk_free_bytes)" cbctd_disk_size_bytes
	metric_is process_resident_memory_bytes '>' 1e6
	metric_is process_open_fds '>' 5
	expect_number "$(metric process_start_time_seconds)" '>' "$(($(date +%s) - 300))" process_start_time_seconds
	expect_number "$(metric process_start_time_seconds)" '<' "$(($(date +%s) + 2))" process_start_time_seconds
}

test_cards_are_told_of_and_lost_ones_too() {
	local i card='gpu="0",uuid="GPU-0000-0",name="A \"test\" card"' other='gpu="1",uuid="GPU-0000-1",name="A \"test\" card"'
	scrape
	metric_is "cbctd_gpu_answers{$card}" == 1
	metric_is "cbctd_gpu_memory_size_bytes{$card}" == $((24 << 30))
	metric_is "cbctd_gpu_memory_used_bytes{$card}" == 1000000
	metric_is "cbctd_gpu_temperature_celsius{$card}" == 61
	metric_is "cbctd_gpu_memory_errors_total{$card,kind=\"uncorrected\"}" == 2
	metric_is "cbctd_gpu_temperature_celsius{$other}" == 48 # which has no error correction
	! grep -q 'cbctd_gpu_memory_errors_total{gpu="1"' "$body" || fail "no errors of a card that counts none"
	echo '62 2000000 3 2' >"$work/cards"
	for ((i = 0; i < 1200; i++)); do
		scrape
		grep -qF "cbctd_gpu_answers{$other} 0" "$body" && break
		sleep 0.1
	done
	metric_is "cbctd_gpu_answers{$other}" == 0
	metric_is "cbctd_gpu_temperature_celsius{$card}" == 62
}

test_prometheus_reads_it_without_a_complaint() {
	need_promtool
	scrape
	promtool check metrics <"$body" || fail "promtool check metrics"
}

test_alerts_are_rules_and_fire_when_they_should() {
	need_promtool
	local alert expected=""
	promtool check rules "$rules" || fail "promtool check rules"
	# CbctdStatWaits for 'stat' and CbctdQueueStands for both together are one alert each.
	for alert in $(sed -n 's/^ *- alert: //p' "$rules" | sort); do
		expected+="{labels: '{alertname=\"$alert\"}', value: 1},"
	done
	sed -e "s,RULES,$rules," -e "s/EXPECTED/[${expected%,}]/" "$here/alerts_test.yaml" >"$work/alerts_test.yaml"
	promtool test rules "$work/alerts_test.yaml" || fail "promtool test rules"
}

test_the_dashboard_asks_what_prometheus_understands() {
	need_promtool
	jq '{groups: [{name: "dashboard", rules: [.panels[].targets // [] | .[].expr | gsub("\\$__rate_interval"; "5m") | {record: "x", expr: .}] |
		to_entries | map(.value + {record: "panel_\(.key)"})}]}' "$dashboard" >"$work/dashboard_rules.yaml"
	promtool check rules "$work/dashboard_rules.yaml" || fail "expressions of the dashboard"
}

# With their labels: an alert on a label that is never there would never fire.
test_metrics_that_alerts_and_dashboard_name_are_there() {
	local name label count=0
	scrape
	sed -nE 's/^ *expr: (.*)/\1/p' "$rules" >"$work/expressions"
	jq -r '.panels[].targets // [] | .[].expr' "$dashboard" >>"$work/expressions"
	for name in $(grep -oE '\b(cbctd|process)_[a-z_]+' "$work/expressions" | sort -u); do
		name=${name%_bucket}
		grep -q "^# TYPE $name " "$body" || fail "/metrics has $name"
		count=$((count + 1))
	done
	expect_number $count '>' 25 "names checked"
	for label in $(grep -oE '(cbctd|process)_[a-z_]+\{[^}]*\}' "$work/expressions" | grep -oE '^[a-z_]+|[a-z]+(=|!)' |
		awk '/[=!]$/ { print name "," substr($0, 1, length($0) - 1); next } { name = $0 }' | sort -u); do
		case ${label#*,} in instance | job) continue ;; esac
		grep -q "^${label%,*}{.*\b${label#*,}=" "$body" || fail "the label ${label#*,} of ${label%,*}"
	done
}

printf '61 1000000 3 2\n48 5000 -1 -1\n' >"$work/cards"
LD_LIBRARY_PATH=$BUILD/simulated-nvml${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH} CBCT_TEST_NVML=$work/cards program=cbctd-held start_daemon || exit 1
run_tests
