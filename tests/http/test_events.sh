#!/usr/bin/env bash
# Server-sent events of a job and of all jobs: nothing is missed, nothing comes twice, and nobody is kept waiting.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
grid='"grid": {"size": [32, 24, 16], "spacing_mm": [3, 4, 5]}'
slow="{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 100000, \"subsets\": \"views\"}}"
stop_after_each=1

uploaded_scan() {
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
}
# events FILE [CURL OPTION ...]: of $job, to the end of the stream
events() {
	local file=$1
	shift
	curl -sS -N --max-time 60 -o "$file" "$@" "$url/v1/jobs/$job/events"
}
# "kind data" of each event of a file, and their ids
told() { awk '/^event: /{ kind = $2 } /^data: /{ sub(/^data: /, ""); print kind, $0 }' "$1"; }
kinds() { awk '/^event: /{ printf "%s%s", sep, $2; sep = " " }' "$1"; }
ids() { sed -n 's/^id: //p' "$1"; }
data_of() { told "$2" | sed -n "s/^$1 //p"; }
rows() { data_of progress "$1" | jq -s -c '[.[].iteration]'; }
wait_for() { # FILE PATTERN
	local i
	for ((i = 0; i < 2400; i++)); do
		grep -q "$2" "$1" 2>/dev/null && return 0
		sleep 0.05
	done
	fail "$2 in $(tail -c 600 "$1")"
}
threads_and_files() { echo "$(ls "/proc/$(cat "$work/daemon.pid")/task" | wc -l) $(ls "/proc/$(cat "$work/daemon.pid")/fd" | wc -l)"; }
connections() { curl -s "$url/metrics" | awk '/^cbctd_connections /{ print $2 }'; }

test_a_job_is_told_from_its_first_state_to_its_end() {
	uploaded_scan
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 3}, \"emit\": [\"fdk\", 2]}"
	# watched while it runs, and again when it is over
	events "$work/live" -D "$headers"
	[[ $(header content-type) == text/event-stream* ]] || fail "text/event-stream"
	# a volume is told of when it is on the disk, and the iterations do not wait for that
	[[ $(kinds "$work/live") == "state state "*" volume state end" ]] || fail "states around all, got $(kinds "$work/live")"
	[ "$(kinds "$work/live" | tr ' ' '\n' | sort | uniq -c | xargs)" = "1 end 3 progress 3 state 3 volume" ] ||
		fail "every event once, got $(kinds "$work/live")"
	events "$work/late"
	cmp "$work/live" "$work/late" || fail "the same for one who comes late"
	[ "$(ids "$work/live")" = "$(ids "$work/live" | sort -nu)" ] || fail "numbers that grow"
	[ "$(data_of state "$work/live" | jq -r .state | paste -sd' ')" = "queued running succeeded" ] || fail "the states"
	[ "$(rows "$work/live")" = "[1,2,3]" ] || fail "a row for each iteration"
	wait_job succeeded
	diff <(data_of progress "$work/live" | jq -S 'del(.job)') <(jq -S '.history[]' "$body") || fail "the rows of the history"
	[ "$(data_of volume "$work/live" | jq -r .name | paste -sd' ')" = "fdk iter-2 final" ] || fail "the volumes"
	for href in $(data_of volume "$work/live" | jq -r .href); do
		req HEAD "$href"
		expect_status 200
	done
	told "$work/live" | while read -r _ data; do
		[ "$(jq -r .job <<<"$data")" = "$job" ] || fail "the job in $data"
	done
}

test_every_position_resumes_without_loss_or_repeats() {
	local id all
	uploaded_scan
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 2}}"
	wait_job succeeded
	events "$work/all"
	all=$(ids "$work/all")
	for id in $all; do
		: >"$work/rest"
		events "$work/rest" -H "Last-Event-ID: $id"
		[ "$(ids "$work/rest")" = "$(awk -v id="$id" '$1 > id' <<<"$all")" ] || fail "the events behind $id"
	done
	req GET "/v1/jobs/$job/events?after=$(head -1 <<<"$all")"
	[ "$(ids "$body")" = "$(tail -n +2 <<<"$all")" ] || fail "?after="
	req GET "/v1/jobs/$job/events?after=0" -H "Last-Event-ID: $(head -1 <<<"$all")"
	[ "$(ids "$body")" = "$(tail -n +2 <<<"$all")" ] || fail "the header before ?after="
	# a browser that comes again after the end is told to stop
	req GET "/v1/jobs/$job/events" -H "Last-Event-ID: $(tail -1 <<<"$all")"
	expect_status 204
}

test_positions_that_cannot_be_are_refused() {
	local position
	uploaded_scan
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	wait_job succeeded
	for position in 999999 -1 x 1.5 10000000000000000000 99999999999999999999; do
		req GET "/v1/jobs/$job/events" -H "Last-Event-ID: $position"
		expect_problem 400
		expect_json '.detail | contains("Last-Event-ID")'
		req GET "/v1/events?after=$position"
		expect_problem 400
	done
	req GET /v1/jobs/0000000000000000/events
	expect_problem 404
	req POST "/v1/jobs/$job/events"
	expect_problem 405
	req HEAD "/v1/jobs/$job/events"
	expect_status 200
}

test_a_restart_repeats_nothing_and_loses_nothing() {
	local last
	uploaded_scan
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 60, \"subsets\": 20}, \"emit\": [1, 5, 60]}"
	: >"$work/before"
	events "$work/before" &
	wait_for "$work/before" '"iteration":9,'
	stop_daemon KILL
	wait $! || true
	last=$(ids "$work/before" | tail -1)
	start_daemon
	events "$work/after" -H "Last-Event-ID: $last"
	cat "$work/before" "$work/after" >"$work/both"
	[ "$(ids "$work/both")" = "$(ids "$work/both" | sort -nu)" ] || fail "numbers that grow over the restart"
	[ "$(rows "$work/both")" = "$(seq -s, 1 60 | sed 's/.*/[&]/')" ] || fail "each row once, got $(rows "$work/both")"
	[ "$(data_of volume "$work/both" | jq -r .name | paste -sd' ')" = "iter-1 iter-5 iter-60 final" ] || fail "each volume once"
	[ "$(data_of state "$work/both" | jq -r .state | paste -sd' ')" = "queued running queued running succeeded" ] || fail "the states"
	[ "$(kinds "$work/both" | awk '{ print $NF }')" = end ] || fail "the end"
	events "$work/whole"
	diff <(told "$work/both") <(told "$work/whole") || fail "the same for one who comes late"
}

test_all_jobs_are_told_to_one_watcher() {
	local first second
	uploaded_scan
	: >"$work/all"
	curl -sS -N --max-time 60 -o "$work/all" "$url/v1/events?after=latest" &
	wait_for "$work/all" '^retry'
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	first=$job
	wait_job succeeded
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 2}}"
	second=$job
	wait_job succeeded
	wait_for "$work/all" "^data: {\"job\":\"$second\",\"state\":\"succeeded\""
	sleep 0.3
	[ "$(awk '/^event: end/{ n++ } END { print n }' "$work/all")" = 2 ] || fail "both ends"
	[ "$(told "$work/all" | grep -c "\"job\":\"$first\"")" -ge 5 ] || fail "the first job's"
	stop_daemon
	wait $! || true
	start_daemon
	curl -sS -N --max-time 2 -o "$work/again" "$url/v1/events?after=$(($(ids "$work/all" | head -1) - 1))" || true
	[ "$(told "$work/again")" = "$(told "$work/all")" ] || fail "the same from the catalogue"
	# what is removed is told, now and later; the rest of its events is gone
	: >"$work/all"
	curl -sS -N --max-time 60 -o "$work/all" "$url/v1/events?after=latest" &
	wait_for "$work/all" '^retry'
	req DELETE "/v1/jobs/$first"
	expect_status 204
	wait_for "$work/all" "^data: {\"job\":\"$first\"}"
	stop_daemon
	wait $! || true
	[ "$(kinds "$work/all")" = removed ] || fail "the removal alone, got $(kinds "$work/all")"
	start_daemon
	req GET "/v1/events?after=0" --max-time 1
	expect_status 200
	[ "$(told "$body" | grep "\"job\":\"$first\"")" = "removed {\"job\":\"$first\"}" ] || fail "the removal from the catalogue"
	[ "$(ids "$body")" = "$(ids "$body" | sort -nu)" ] || fail "numbers that grow"
	[ "$(ids "$body" | tail -1)" = "$(ids "$work/all")" ] || fail "the removal last"
}

test_a_silent_job_is_kept_alive_and_dead_clients_are_let_go() {
	local before i pids=()
	start_daemon
	post_scan "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	until [ "$(json '.stage // ""')" = fdk ]; do req GET "/v1/jobs/$job"; done # a worker has been given to it
	before=$(threads_and_files)
	: >"$work/quiet"
	curl -sS -N --max-time 13 -o "$work/quiet" "$url/v1/jobs/$job/events" &
	for ((i = 0; i < 20; i++)); do
		curl -sS -N --max-time 40 -o /dev/null "$url/v1/jobs/$job/events" 2>/dev/null &
		pids+=($!)
	done
	wait_for "$work/quiet" '^event: state'
	for ((i = 0; i < 200 && $(connections) < 21; i++)); do sleep 0.05; done
	[ "$(connections)" -ge 21 ] || fail "21 watchers, got $(connections)"
	kill -9 "${pids[@]}"
	wait "${pids[@]}" 2>/dev/null || true
	wait_for "$work/quiet" '^:$'
	for ((i = 0; i < 60; i++)); do
		[ "$(threads_and_files)" = "$before" ] && break
		sleep 0.5
	done
	[ "$(threads_and_files)" = "$before" ] || fail "threads and descriptors as before ($before), got $(threads_and_files)"
}

test_peers_that_vanish_are_let_go() {
	command -v ip >/dev/null && unshare -rn ip link set lo up 2>/dev/null || skip "no network of its own can be had here"
	timeout 180 unshare -rn bash "$here/vanish.sh" "$scan_dir"
}

# Each event is acknowledged by the client's kernel at once: a rate that no stream of events reaches is no reason to end it.
test_a_stream_that_says_little_is_not_called_slow() {
	uploaded_scan
	post_job '{"scan": "SCAN", "grid": {"size": [8, 8, 4], "spacing_mm": [8, 8, 8]}, "sart": {"iterations": 100000, "subsets": 1}}'
	until req GET "/v1/jobs/$job" && member '.state == "running"' "$body" >/dev/null; do sleep 0.1; done
	stop_daemon
	start_daemon --transfer-grace 0.1 --minimum-rate 1G
	local events=0 tries=0
	# A reply that is asked for may itself come too late for such a rate: until the stream is there.
	until [ $events -gt 0 ] || [ $((tries++)) = 100 ]; do
		events=$(curl -sN --max-time 60 "$url/v1/jobs/$job/events?after=latest" | grep -m 300 -c '^id:') || true
	done
	[ "$events" = 300 ] || fail "300 events, the stream was ended behind $events"
	stop_daemon
	start_daemon
	req DELETE "/v1/jobs/$job"
}

test_a_cancelled_job_ends_its_watchers() {
	uploaded_scan
	post_job "$slow"
	: >"$work/live"
	events "$work/live" &
	wait_for "$work/live" '^event: progress'
	req DELETE "/v1/jobs/$job"
	expect_status 202
	wait $! || fail "the end of the stream"
	[ "$(data_of end "$work/live" | jq -r .state)" = cancelled ] || fail "an end that says cancelled"
}

run_tests
