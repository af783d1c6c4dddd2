#!/usr/bin/env bash
# Limits for each client and for all, and shares of the devices' time.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 20 --arc 360 --columns 64 --rows 48 --pixel 4 -o "$scan_dir" >/dev/null || exit 1
bytes=$((20 * 64 * 48 * 4)) # of its projections
grid='"grid": {"size": [16, 16, 16], "spacing_mm": [4, 4, 4]}' # volumes of 16384 bytes

make_tokens() { # NAME ...: tokens for acquisition
	local name
	for name; do
		[ -s "$work/$name.token" ] || cbct token new "$name" --role acquire --file "$work/tokens" >"$work/$name.token" || return 1
	done
}
as() { # NAME: who asks from now on
	who=(-H "Authorization: Bearer $(grep -o 'cbct_[A-Za-z0-9_-]*' "$work/$1.token" | head -1)")
}
ask() { req "$1" "$2" "${who[@]}" "${@:3}"; }
new_scan() { # STATUS
	ask POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$scan_dir/scan.json"
	expect_status "$1"
	[ "$1" != 201 ] || scan=$(json .id)
}
fill() { # STATUS: of a PUT of all projections
	ask PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
	expect_status "$1"
}
new_job() { # STATUS RECIPE
	ask POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${2//SCAN/$scan}"
	expect_status "$1"
	[ "$1" != 202 ] || job=$(json .id)
}
limited() { # OPTION ...
	rm -rf "$state"
	start_daemon --tokens "$work/tokens" "$@"
	as a
}
retry_after() { [ "$(header retry-after)" -ge 1 ] || fail "Retry-After"; }

make_tokens a b || exit 1

test_scans_of_a_client() {
	limited --client-scans 2
	new_scan 201
	new_scan 201
	new_scan 429
	retry_after
	expect_json '.type == "urn:cbctd:problem:limit-reached" and (.detail | contains("scans of a: 2; one client may have 2"))'
	as b
	new_scan 201
	expect_json '.client == "b"'
	as a
	ask GET /v1/limits
	expect_json '.client == "a" and .own.scans == {"used": 2, "most": 2} and .own.jobs == {"used": 0, "most": null}'
	ask GET /v1/scans
	ask DELETE "/v1/scans/$(json '[.scans[] | select(.client == "a")][0].id')"
	new_scan 201
}

test_jobs_that_have_not_ended() {
	limited --client-jobs 2 --max-jobs 3
	new_scan 201
	new_job 202 "{\"scan\": \"SCAN\", $grid}"
	new_job 202 "{\"scan\": \"SCAN\", $grid}"
	new_job 429 "{\"scan\": \"SCAN\", $grid}"
	retry_after
	as b
	new_job 202 "{\"scan\": \"SCAN\", $grid}"
	expect_json '.client == "b"'
	new_job 503 "{\"scan\": \"SCAN\", $grid}"
	retry_after
	ask GET /v1/limits
	expect_json '.own.jobs == {"used": 1, "most": 2} and .all.jobs == {"used": 3, "most": 3}'
	ask DELETE "/v1/jobs/$job"
	new_job 202 "{\"scan\": \"SCAN\", $grid}"
	# The limit is one of the file's jobs, too.
	stop_daemon
	start_daemon --tokens "$work/tokens" --client-jobs 2 --max-jobs 3
	new_job 503 "{\"scan\": \"SCAN\", $grid}"
}

test_each_client_has_its_own_keys() {
	local first kind text made
	limited
	for kind in scans jobs; do
		send() { # STATUS BODY
			ask POST /v1/$kind -H 'Content-Type: application/json' -H 'Idempotency-Key: 1' --data-binary "$2"
			expect_status "$1"
		}
		[ $kind = scans ] && text=$(cat "$scan_dir/scan.json") made=201 || text="{\"scan\": \"$scan\", $grid}" made=202
		as a
		send $made "$text"
		first=$(json .id)
		as b
		send $made "$text"
		[ "$(json .id)" != "$first" ] || fail "the other client's"
		expect_json '.client == "b"'
		as a
		send $made "$text"
		expect_json ".id == \"$first\""
		scan=$first
	done
}

test_images_are_counted() {
	limited --client-bytes $((bytes + 64 * 48))
	new_scan 201
	head -c $((64 * 48)) /dev/zero >"$work/map"
	ask PUT "/v1/scans/$scan/defects" -T "$work/map"
	expect_status 201
	ask GET /v1/limits
	expect_json ".own.bytes.used == $((64 * 48))"
	new_scan 201
	fill 201
	ask PUT "/v1/scans/$scan/defects" -T "$work/map"
	expect_status 507
	retry_after
	expect_json '.detail | contains("defect map of 3072 bytes")'
	# and so are images of scatter
	jq '.projections += {quantity: "intensity", air: 50000, scatter: {kind: "images", columns: 20, rows: 16, every: 5}}' "$scan_dir/scan.json" >"$work/scattering.json"
	ask POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/scattering.json"
	expect_status 201
	head -c 1280 /dev/zero >"$work/scatter"
	ask PUT "/v1/scans/$(json .id)/scatter/5" -T "$work/scatter"
	expect_status 507
	retry_after
	expect_json "$(printf '.detail | contains("projection 5\x27s scatter of 1280 bytes")')"
}

test_bytes_are_taken_when_they_come() {
	local first second option
	limited --client-bytes $((2 * bytes))
	new_scan 201 && first=$scan
	new_scan 201 && second=$scan
	new_scan 201
	ask GET /v1/limits
	expect_json '.own.bytes.used == 0'
	[ "$(stat -c %b "$state/scans/$scan/projections.raw")" = 0 ] || fail "no room for a scan that was announced alone"
	fill 201
	scan=$first && fill 201
	scan=$second && fill 507
	retry_after
	expect_json '.type == "urn:cbctd:problem:limit-of-bytes" and (.detail | contains("are too many for a"))'
	ask GET "/v1/scans/$second"
	expect_json '.received_count == 0'
	ask GET /v1/limits
	expect_json ".own.bytes.used == $((2 * bytes))"
	as b
	new_scan 201
	fill 201
	as a
	ask DELETE "/v1/scans/$first"
	expect_status 204
	scan=$second && fill 201
	# What can never have room is refused when it is announced.
	stop_daemon
	start_daemon --tokens "$work/tokens" --client-bytes $((bytes - 1))
	new_scan 422
	expect_problem 422 /projections/count
	for option in --client-bytes --max-bytes; do
		! "$BUILD/cbctd" $option 0.5 --print-config >/dev/null 2>&1 || fail "$option 0.5 refused: that is no limit"
	done
}

# A checkpoint that comes from another host has no more room than anything else.
test_pieces_of_a_checkpoint_keep_within_the_limits() {
	local piece=$((4 << 20))
	limited --client-bytes $((bytes + piece + 100000))
	new_scan 201
	fill 201
	head -c $piece /dev/zero >"$work/piece"
	ask POST '/v1/jobs?resume=2' -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", $grid, \"sart\": {\"iterations\": 4}}"
	expect_status 202
	expect_json '.state == "waiting" and .waiting_for == ["checkpoint"]'
	job=$(json .id)
	ask PUT "/v1/jobs/$job/checkpoint/1" -T "$work/piece"
	expect_problem 409
	head -c $((piece + 1)) /dev/zero >"$work/large"
	ask PUT "/v1/jobs/$job/checkpoint/0" -T "$work/large"
	expect_problem 413
	ask PUT "/v1/jobs/$job/checkpoint/0" -T "$work/piece"
	expect_status 204
	ask PUT "/v1/jobs/$job/checkpoint/0" -T "$work/piece"
	expect_status 204
	ask PUT "/v1/jobs/$job/checkpoint/1" -T "$work/piece"
	expect_problem 507
	expect_json '.type == "urn:cbctd:problem:limit-of-bytes"'
	ask PUT "/v1/jobs/$job/checkpoint/1" -H 'Content-Type: application/octet-stream' --data-binary ''
	expect_problem 400
	ask GET "/v1/jobs/$job"
	expect_json '.waiting_for == ["checkpoint"]'
	ask DELETE "/v1/jobs/$job"
	expect_status 202
	ask PUT "/v1/jobs/$job/checkpoint/0" -T "$work/piece"
	expect_problem 409
	[ "$(du -sk "$state/jobs" | cut -f1)" -lt 1000 ] || fail "the pieces go with the job: $(find "$state/jobs" -type f)"
}

test_volumes_leave_room_for_acquisition() {
	# Nine tenths of it are this scan and two volumes, kept by one job; the whole is room for another scan.
	limited --max-bytes $((2 * bytes + 40000))
	new_scan 201
	fill 201
	new_job 202 "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	for _ in $(seq 100); do
		ask GET "/v1/jobs/$job?wait=30"
		[ "$(json .state)" != succeeded ] || break
	done
	ask GET /v1/limits
	expect_json ".all.bytes.used == $((bytes + 16384)) and .all.reserve == ($((2 * bytes + 40000)) * 0.1 | ceil) and .keep_s == null"
	CBCT_TOKEN=${who[1]##* } cbct limits >"$work/said"
	grep -qE '^all +0.3 of 0.5 MB, 0.3 left$' "$work/said" && grep -q 'are reserved for what is being acquired' "$work/said" || fail "limits in words: $(cat "$work/said")"
	new_job 507 "{\"scan\": \"SCAN\", \"grid\": {\"size\": [48, 48, 48], \"spacing_mm\": [2, 2, 2]}, \"fdk\": {}}"
	retry_after
	expect_json '.detail | contains("the rest is reserved for what is being acquired")'
	# For what could never be there is nothing to wait.
	new_job 422 "{\"scan\": \"SCAN\", \"grid\": {\"size\": [80, 80, 80], \"spacing_mm\": [1, 1, 1]}, \"fdk\": {}}"
	expect_problem 422 /grid
	new_scan 201
	fill 201
	new_scan 201
	fill 507
	# Counted again from what is there.
	stop_daemon
	start_daemon --tokens "$work/tokens" --max-bytes $((2 * bytes + 40000))
	ask GET /v1/limits
	expect_json ".all.bytes.used == $((2 * bytes + 16384))"
}

test_equal_jobs_take_turns_by_clients() {
	local recipe="{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 60, \"subsets\": \"views\"}}" i jobs=()
	limited
	new_scan 201
	fill 201
	for ((i = 0; i < 6; i++)); do new_job 202 "$recipe"; done
	as b
	new_job 202 "$recipe"
	# Of seven it came last, and is not the last to be made: its client has used less.
	expect_json '.queue_position == null or .queue_position <= 2'
	for ((i = 0; i < 60; i++)); do
		ask GET "/v1/jobs/$job?wait=30"
		[ "$(json .state)" != succeeded ] || break
	done
	expect_json '.state == "succeeded"'
	ask GET /v1/jobs
	expect_json '[.jobs[] | select(.client == "a" and .state == "queued")] | length >= 2'
}

test_a_put_that_is_refused_leaves_its_room() {
	local i
	limited --client-bytes $bytes
	new_scan 201
	ask PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw" -H "Content-Digest: sha-256=:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=:"
	expect_status 400
	for i in $(seq 100); do
		ask GET /v1/limits
		[ "$(json .own.bytes.used)" != 0 ] || break
		sleep 0.05
	done
	expect_json '.own.bytes.used == 0'
	[ "$(stat -c %b "$state/scans/$scan/projections.raw")" = 0 ] || fail "nor on the disk"
	new_scan 201
	fill 201
	ask GET "/v1/scans/$scan/projections/19"
	cmp "$body" <(tail -c $((64 * 48 * 4)) "$scan_dir/projections.raw") || fail "the bytes of a scan that has room"
}

# A refused and a good upload of one scan at once: nothing of the good one is lost when room is given back.
test_room_is_given_back_under_other_uploads() {
	local i refused
	limited
	for ((i = 0; i < 12; i++)); do
		new_scan 201
		curl -s -o /dev/null "${who[@]}" -T "$scan_dir/projections.raw" -H "Content-Digest: sha-256=:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=:" "$url/v1/scans/$scan/projections" &
		refused=$!
		[ $((i % 2)) = 0 ] || sleep 0.02
		ask PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
		expect_status 201
		wait $refused
		cmp "$state/scans/$scan/projections.raw" "$scan_dir/projections.raw" || fail "the bytes of round $i"
		ask GET "/v1/scans/$scan"
		expect_json '.missing == []'
	done
}

test_a_job_for_which_nothing_comes_gives_its_place() {
	local idle=() pinned fed i
	limited --max-jobs 4 --job-patience 3600
	new_scan 201
	for i in 1 2 3; do new_job 202 "{\"scan\": \"SCAN\", $grid}" && idle+=("$job"); done
	pinned=${idle[0]}
	ask PUT "/v1/jobs/$pinned/pin"
	new_scan 201 && fed=$scan
	new_job 202 "{\"scan\": \"SCAN\", $grid}"
	as b
	new_scan 201
	new_job 503 "{\"scan\": \"SCAN\", $grid}"
	retry_after
	# However long that took: none is idle before the next daemon, whose patience is short.
	stop_daemon
	start_daemon --tokens "$work/tokens" --max-jobs 4 --job-patience 3
	head -c $((64 * 48 * 4)) "$scan_dir/projections.raw" >"$work/one"
	feed() { # VIEW: of the fourth
		as a
		ask PUT "/v1/scans/$fed/projections/$1" -T "$work/one"
	}
	for i in 1 2 3 4 5 6; do # they come now and then
		feed "$i"
		sleep 0.6
	done
	as b
	new_scan 201
	for i in 1 2; do
		new_job 202 "{\"scan\": \"SCAN\", $grid}"
	done
	for i in 1 2; do
		ask GET "/v1/jobs/${idle[i]}"
		expect_json '.state == "cancelled"'
	done
	# Neither one that is pinned nor one that is fed gives way.
	feed 7
	as b
	new_job 503 "{\"scan\": \"SCAN\", $grid}"
	grep -q "job ${idle[1]}: .*another one takes its place: nothing came for it for" "$work/cbctd.err" || fail "told in the log"
	ask GET /v1/limits
	expect_json '.all.jobs == {"used": 4, "most": 4} and .own.jobs.used == 2'
	# A client that has more than another one takes no place of that one.
	feed 8
	new_job 503 "{\"scan\": \"SCAN\", $grid}"
}

gone() { # PATH
	local end=$((SECONDS + 60))
	until ask GET "$1" && [ "$status" = 404 ]; do
		[ $SECONDS -lt $end ] || fail "$1 removed"
		sleep 0.2
	done
}

test_a_scan_that_the_disk_has_damaged_stays() {
	local damaged
	limited --keep 3600
	new_scan 201 && damaged=$scan
	fill 201
	stop_daemon
	start_daemon --tokens "$work/tokens" --keep 1
	printf '\377' | dd of="$state/scans/$damaged/projections.raw" bs=1 seek=100 conv=notrunc 2>/dev/null
	ask GET "/v1/scans/$damaged/projections/0"
	expect_status 500
	new_scan 201
	gone "/v1/scans/$scan"
	ask GET "/v1/scans/$damaged"
	expect_json '.missing == [[0, 0]] and .received_count == 19'
	stop_daemon
	start_daemon --tokens "$work/tokens" --keep 1
	new_scan 201
	gone "/v1/scans/$scan"
	ask GET "/v1/scans/$damaged"
	expect_json '.missing == [[0, 0]] and .received_count == 19'
}

# Nothing is old before the second daemon, however long the first part takes: its time is short.
test_what_is_old_goes_unless_it_is_pinned() {
	need_sqlite
	local old pinned complete open announced unfinished cancelled # its scan is pinned with it
	limited --keep 3600
	new_scan 201 && complete=$scan
	fill 201
	new_job 202 "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}" && old=$job
	new_job 202 "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}" && pinned=$job
	for _ in 1 2; do
		ask PUT "/v1/jobs/$pinned/pin"
		expect_status 204
	done
	new_scan 201 && unfinished=$scan
	new_job 202 "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}" && cancelled=$job
	ask PUT "/v1/jobs/$cancelled/pin"
	ask DELETE "/v1/jobs/$cancelled"
	new_scan 201 && announced=$scan
	new_scan 201 && open=$scan
	expect_json '.pinned == false'
	expect_json '((.kept_until | sub("[.][0-9]+Z"; "Z") | fromdate) - (now | floor)) as $s | $s >= 3000 and $s <= 3601'
	export CBCT_TOKEN=${who[1]##* }
	cbct pin "$open"
	ask GET "/v1/scans/$open"
	expect_json '.pinned and .kept_until == null'
	! cbct pin nothing 2>"$work/said" || fail "nothing to pin"
	grep -q 'neither a job nor a scan "nothing"' "$work/said" || fail "why: $(cat "$work/said")"
	cbct limits >"$work/said"
	grep -q '^of a$' "$work/said" && grep -qE '^own +[0-9]+ scans$' "$work/said" || fail "limits in words: $(cat "$work/said")"
	stop_daemon
	start_daemon --tokens "$work/tokens" --keep 1
	gone "/v1/jobs/$old"
	[ ! -e "$state/jobs/$old" ] || fail "no files of a job that was removed"
	gone "/v1/scans/$announced"
	ask GET "/v1/jobs/$pinned?wait=60"
	expect_json '.state == "succeeded" and .pinned and .kept_until == null'
	ask GET "/v1/jobs/$cancelled"
	expect_json '.state == "cancelled"'
	ask GET "/v1/scans/$unfinished"
	expect_status 200
	for scan in "$complete" "$open"; do
		ask GET "/v1/scans/$scan"
		expect_status 200
	done
	# Pins outlive a restart, and a catalogue that is made again.
	stop_daemon
	rm "$state"/catalogue.sqlite*
	start_daemon --tokens "$work/tokens"
	ask GET "/v1/scans/$open"
	expect_json '.pinned and .client == "a"'
	ask GET "/v1/jobs/$pinned"
	expect_json '.pinned and .client == "a"'
	for _ in 1 2; do # once more is no mistake; this daemon removes nothing
		ask DELETE "/v1/scans/$complete/pin"
		expect_status 204
	done
	stop_daemon
	start_daemon --tokens "$work/tokens" --keep 1
	ask PUT "/v1/scans/$open/pin"
	expect_status 204
	cbct unpin "$open"
	ask DELETE "/v1/jobs/$pinned/pin"
	expect_status 204
	gone "/v1/scans/$open"
	gone "/v1/jobs/$pinned"
	ask GET "/v1/scans/$complete"
	expect_status 200
	ask PUT "/v1/jobs/$pinned/pin"
	expect_problem 404
	ask PUT "/v1/scans/$open/pin"
	expect_problem 404
}

stop_after_each=1 run_tests
