#!/usr/bin/env bash
# /v1/calibrations: an arm that sags is calibrated by the daemon, and other scans of that arm use what was found.
. "$(dirname "$0")/lib.sh"
program=cbctd-held

arm=(--columns 300 --rows 240 --pixel 1.27 --sag daly)
phantom='{"kind": "circles", "balls": 12, "diameter_mm": 110, "distance_mm": 90, "ball_mm": 6, "first_angle_deg": 10, "shift_deg": 15}'
json=(-H 'Content-Type: application/json' --data-binary)

# balls [OPTION ...]: a scan directory of the phantom, sent to the daemon; sets $balls, its id
balls() {
	printf '%s' "$phantom" >"$work/phantom.json"
	rm -rf "$work/balls"
	cbct simulate -o "$work/balls" --balls "$work/phantom.json" --density .6 "${arm[@]}" --views 24 --photons 20000 --raw flat "$@"
	balls=$(cbct upload "$work/balls" | head -1)
}
# calibrated: has the daemon calibrate $balls; sets $calibration
calibrated() {
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"arm\": \"arm in room 2\", \"phantom\": $phantom}"
	expect_status 202
	calibration=$(jq -r .id "$body")
	[ "$(sed -n 's/^[Ll]ocation: \([^\r]*\).*/\1/p' "$headers")" = "/v1/calibrations/$calibration" ] || fail "its Location"
	req GET "/v1/calibrations/$calibration?wait=60"
	expect_status 200
}
# scan GEOMETRY [VIEWS]: announces a scan of this arm by the calibration
scan() {
	req POST /v1/scans "${json[@]}" "{\"detector\": {\"columns\": 300, \"rows\": 240, \"pixel_mm\": [1.27, 1.27]},
		\"projections\": {\"count\": ${2:-24}, \"sample\": \"float32\", \"quantity\": \"line_integral\"}, \"geometry\": $1}"
}
expect_warning() { # CODE: the last reply has it
	jq -e --arg code "$1" 'any(.warnings[]; .code == $code)' "$body" >/dev/null || fail "$1 among: $(jq -c .warnings "$body")"
}

test_a_sagging_arm_is_calibrated_and_its_scans_use_it() {
	start_daemon
	balls
	calibrated
	member '.state == "succeeded" and .used == 24 and .residual_pixels < .2 and .residual_isocentre_mm < .1 and .arm == "arm in room 2" and
		.sweep.views == 24 and .detector.columns == 300 and .age_s >= 0 and (.geometry.matrices | length) == 24 and
		(.views | length) == 24 and all(.views[]; .used and .balls >= 7)' "$body" >/dev/null || fail "a result: $(head -c 900 "$body")"
	jq -c .geometry.matrices "$body" >"$work/matrices"
	expect_warning calibration_turn
	expect_json '[.warnings[].code] | index("calibration_balls") | not'
	expect_json '.interpolated_pixels > .05 and .interpolated_pixels < 20 and .interpolated_isocentre_mm > .02'
	jq -c '{balls_mm: .balls_mm[1:]}' "$body" >"$work/fewer.json"
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $(cat "$work/fewer.json")}"
	req GET "$(json .href)?wait=60"
	expect_warning calibration_balls
	expect_json 'any(.warnings[]; .severity == "caution" and (.detail | test("^[0-9]+ shadows of balls, in [0-9]+ of 24 views, are of no ball of the drawing")))'
	req DELETE "$(json .href)"
	expect_status 204
	req GET /v1/calibrations
	jq -e --arg id "$calibration" '.calibrations | length == 1 and .[0].id == $id and .[0].balls == 24 and (.[0] | has("geometry") | not)' "$body" >/dev/null ||
		fail "a list: $(head -c 300 "$body")"

	# view by view; the scan has the matrices, and keeps them when the calibration goes
	scan "{\"kind\": \"calibration\", \"id\": \"$calibration\"}"
	expect_status 201
	local taken
	taken=$(jq -r .id "$body")
	jq -e --slurpfile found "$work/matrices" '[.geometry.matrices, $found[0] | map(map(. * 1))] | transpose |
		all(.[0] as $a | .[1] as $b | [range(12) | ($a[.] / $a[11] - $b[.] / $b[11]) | fabs] | max < 1e-6)' "$body" >/dev/null ||
		fail "the calibration's matrices in the scan"
	member '.geometry.kind == "calibration" and .warnings == []' "$body" >/dev/null || member '[.warnings[].code] | index("calibration_interpolated") | not' "$body" >/dev/null ||
		fail "no word of interpolation: $(jq -c .warnings "$body")"

	# other views of the same sweep, by their angles
	scan "{\"kind\": \"calibration\", \"id\": \"$calibration\", \"first_angle_deg\": 3, \"angle_step_deg\": 10}" 36
	expect_status 201
	expect_warning calibration_interpolated
	member '(.geometry.matrices | length) == 36' "$body" >/dev/null || fail "36 matrices"
	scan "{\"kind\": \"calibration\", \"id\": \"$calibration\"}" 36
	expect_status 422
	expect_json '.pointer == "/geometry/angles_deg"'
	scan "{\"kind\": \"calibration\", \"id\": \"$calibration\", \"first_angle_deg\": 3, \"angle_step_deg\": -10}" 36
	expect_warning calibration_other_sweep
	# numbers that leap to and fro say nothing of the way that the arm went, whichever end is the first
	local leaping
	leaping=$(jq -nc '[range(36) | if . % 2 == 0 then . * 5 else 360 - . * 5 end]')
	for leaping in "$leaping" "$(jq -c reverse <<<"$leaping")"; do
		scan "{\"kind\": \"calibration\", \"id\": \"$calibration\", \"angles_deg\": $leaping}" 36
		expect_status 201
		expect_json '[.warnings[].code] | index("calibration_other_sweep") | not'
	done
	# a detector of larger pixels, whose middle is in the same place
	req POST /v1/scans "${json[@]}" "{\"detector\": {\"columns\": 150, \"rows\": 120, \"pixel_mm\": [2.54, 2.54]},
		\"projections\": {\"count\": 24, \"sample\": \"float32\", \"quantity\": \"line_integral\"}, \"geometry\": {\"kind\": \"calibration\", \"id\": \"$calibration\"}}"
	expect_status 201
	expect_warning calibration_other_detector
	expect_json 'any(.warnings[]; .code == "calibration_other_detector" and (.detail | test("300 x 240 pixels of 1.27 x 1.27 mm, the scan of one of 150 x 120 of 2.54 x 2.54 mm")))'
	jq -e --slurpfile found "$work/matrices" '[.geometry.matrices, $found[0]] | transpose | all((.[0] | . as $m | map(. / $m[11])) as $a | (.[1] | . as $m | map(. / $m[11])) as $b |
		[range(4) | ($a[.] - ($b[.] - 149.5 * $b[8 + .]) / 2 - 74.5 * $b[8 + .], $a[4 + .] - ($b[4 + .] - 119.5 * $b[8 + .]) / 2 - 59.5 * $b[8 + .],
		$a[8 + .] - $b[8 + .]) | fabs] | max < 1e-6)' "$body" >/dev/null || fail "the same middle in larger pixels"
	scan '{"kind": "calibration", "id": "00000000000000000"}'
	expect_status 404
	expect_json '.pointer == "/geometry/id"'

	# a picture, while the phantom's scan is there
	req GET "/v1/calibrations/$calibration/views/3"
	expect_status 200
	cp "$body" "$work/view.png"
	cbct simulate -o "$work/true" --phantom ball --scale 2 "${arm[@]}" --views 24 --kind matrices
	/usr/bin/python3 "$here/circles.py" "$work/view.png" "$work/phantom.json" "$work/true/scan.json" 3 || fail "circles where the balls are"
	! /usr/bin/python3 "$here/circles.py" "$work/view.png" "$work/phantom.json" "$work/true/scan.json" 4 2>/dev/null || fail "circles of this view alone"
	req GET "/v1/calibrations/$calibration/views/24"
	expect_status 404
	req DELETE "/v1/scans/$balls"
	expect_status 204
	req GET "/v1/calibrations/$calibration/views/3"
	expect_status 404
	req GET "/v1/calibrations/$calibration"
	expect_json '.state == "succeeded"'

	# it outlives the daemon and the catalogue, and a scan outlives it
	stop_daemon
	"$BUILD/cbctd" --state-dir "$state" --rebuild-catalogue >/dev/null 2>&1 || fail "a catalogue made again"
	start_daemon --calibration-age 1
	req GET "/v1/calibrations/$calibration"
	expect_json '.state == "succeeded"'
	jq -c .geometry.matrices "$body" | cmp - "$work/matrices" || fail "the same matrices"

	# two days later it is too old where a day is allowed, and not where half a year is
	local own="{\"kind\": \"calibration\", \"id\": \"$calibration\"}" allowed
	scan "$own"
	expect_json '[.warnings[].code] | index("calibration_old") | not'
	for allowed in 1 180; do
		stop_daemon
		LD_PRELOAD="$BUILD/clock.so" CBCT_TEST_CLOCK=$((2 * 86400 + 3600)) start_daemon --calibration-age $allowed
		scan "$own"
		expect_status 201
		[ $allowed = 180 ] || expect_json 'any(.warnings[]; .code == "calibration_old" and .severity == "caution" and (.detail | test("2 days old when this scan began, 1 are allowed")))'
		[ $allowed = 1 ] || expect_json '[.warnings[].code] | index("calibration_old") | not'
	done
	req DELETE "/v1/calibrations/$calibration"
	expect_status 204
	req GET "/v1/calibrations/$calibration"
	expect_status 404
	req GET "/v1/scans/$taken"
	expect_status 200
	member '(.geometry.matrices | length) == 24' "$body" >/dev/null || fail "matrices of a deleted calibration"
	stop_daemon
}

# Pixels of 2.54 mm, the means of 16 rays each: shadows of 2 to 4 pixels, most of which touch or cover others'.
test_shadows_that_touch_are_told_apart() {
	local fine=(--columns 600 --rows 480 --pixel .635 --sag daly) row found wrong
	start_daemon
	for row in "12 3.2 13" "12 6 16" "8 4 13"; do
		set -- $row
		jq -nc --argjson balls "$1" --argjson ball "$2" '{kind: "circles", balls: $balls, diameter_mm: 110, distance_mm: 90, ball_mm: $ball, shift_deg: 15}' >"$work/touching.json"
		cbct simulate -o "$work/fine" --balls "$work/touching.json" --density .6 "${fine[@]}" --views "$3"
		cbct simulate -o "$work/truth" --phantom ball --scale 2 "${fine[@]}" --views "$3" --kind matrices
		/usr/bin/python3 "$here/rays.py" "$work/fine" "$work/touching" 4 20000
		balls=$(cbct upload "$work/touching" | head -1)
		req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $(cat "$work/touching.json")}"
		expect_status 202
		req GET "$(jq -r .href "$body")?wait=60"
		expect_json ".state == \"succeeded\" and .used == $3 and .residual_pixels < .1 and (.diameter_ratio - 1 | fabs) < .01"
		expect_json '[.warnings[].code] - ["calibration_turn"] == []'
		found=$(/usr/bin/python3 "$here/rays.py" compare "$body" "$work/truth/scan.json" 4)
		expect_number "$found" '<' .2 "pixels by which $row are wrong"
	done
	# drawings that are 2 % wrong: another scale leaves no residual, another shape does
	for wrong in '.diameter_mm *= 1.02 | .distance_mm *= 1.02' '.diameter_mm *= .98 | .distance_mm *= .98 | .ball_mm *= .98' '.diameter_mm *= 1.02'; do
		req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $(jq -c "$wrong" "$work/touching.json")}"
		req GET "$(jq -r .href "$body")?wait=60"
		expect_json '.state == "succeeded"'
		expect_warning calibration_scale
		expect_json 'any(.warnings[]; .code == "calibration_scale" and (.detail | test("times as wide .*expected within [0-9.]+ %.* times as far .*within [0-9.]+ %")))'
		case $wrong in
		*distance*) expect_json '[.warnings[].code] | index("calibration_shape") | not' ;;
		*) expect_json 'any(.warnings[]; .code == "calibration_shape" and (.detail | test("lie 0.[2-9][0-9]* mm from where the drawing has them")))' ;;
		esac
	done
	stop_daemon
}

test_they_count_among_the_jobs_and_the_bytes() {
	local phantom='{"kind": "circles", "balls": 12, "diameter_mm": 110, "distance_mm": 90, "ball_mm": 3.2, "shift_deg": 15}' before ask
	rm -rf "$state"
	start_daemon --client-jobs 1 --keep 2
	balls
	ask="{\"scan\": \"$balls\", \"phantom\": $phantom}"
	req GET /v1/limits
	before=$(json .own.bytes.used)
	req POST /v1/calibrations "${json[@]}" "$ask"
	expect_status 202
	expect_json '.client == "127.0.0.1"'
	calibration=$(json .id)
	req POST /v1/calibrations "${json[@]}" "$ask"
	expect_problem 429
	expect_json '.detail | contains("jobs of 127.0.0.1 that have not ended: 1; one client may have 1")'
	req POST /v1/jobs "${json[@]}" "{\"scan\": \"$balls\"}"
	expect_problem 429
	req GET "/v1/calibrations/$calibration?wait=60"
	expect_json '.state == "succeeded"'
	req GET /v1/limits
	expect_json ".own.jobs.used == 0 and .own.bytes.used > $before + 1000"
	before=$(json .own.bytes.used)
	# One that fails goes for its age, one that succeeded does not. What is there is counted again.
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": {\"kind\": \"circles\", \"balls\": 12, \"diameter_mm\": 40, \"distance_mm\": 20, \"ball_mm\": 9, \"shift_deg\": 15}}"
	expect_status 202
	req GET "$(header location)?wait=60"
	expect_json '.state == "failed"'
	stop_daemon
	start_daemon --keep 2 --client-bytes $((before + 100))
	for _ in $(seq 100); do
		req GET /v1/calibrations
		[ "$(json '.calibrations | length')" != 1 ] || break
		sleep 0.2
	done
	expect_json ".calibrations | length == 1 and .[0].id == \"$calibration\""
	req GET /v1/limits
	expect_json ".own.bytes.used == $before"
	req POST /v1/calibrations "${json[@]}" "$ask"
	expect_problem 507
	stop_daemon
}

test_what_does_not_fit_is_told() {
	start_daemon
	balls
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": {\"balls_mm\": [[0, 0, 0, 3], [10, 0, 0, 3], [0, 10, 0, 3]]}}"
	expect_status 400
	expect_json '.pointer == "/phantom/balls_mm"'
	grep -q '3 balls, expected 8 to 512' "$body" || fail "the numbers: $(cat "$body")"
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $(jq -nc '{balls_mm: [range(9) | [10 * ., 5 * ., 2, 3]]}')}"
	expect_status 422
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"1m7yaj2sssx8c7cg\", \"phantom\": $phantom}"
	expect_status 404
	expect_json '.pointer == "/scan"'
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $phantom, \"bals\": 3}"
	expect_status 400
	expect_json '.pointer == "/bals"'
	# another phantom is known only from the pictures
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $(jq -c '.ball_mm = 3.6' <<<"$phantom")}"
	expect_status 202
	req GET "$(jq -r .href "$body")?wait=60"
	expect_json '.state == "failed"'
	expect_json '.error.type == "urn:cbctd:problem:impossible"'
	grep -q 'times the given diameter' "$body" || fail "the ratio: $(jq -c .error "$body")"
	req GET "$(jq -r .href "$body")/views/0"
	expect_status 409
	# projections and air that are not there
	jq -c 'del(.projections.air)' "$work/balls/scan.json" >"$work/request.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "@$work/request.json"
	expect_status 201
	local empty
	empty=$(jq -r .id "$body")
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$empty\", \"phantom\": $phantom}"
	expect_status 409
	curl -sf -T "$work/balls/projections.raw" "$url/v1/scans/$empty/projections" >/dev/null
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$empty\", \"phantom\": $phantom}"
	expect_status 409
	grep -q 'neither an air value nor a flat image' "$body" || fail "$(cat "$body")"
	stop_daemon
}

# One that was being made when the daemon was killed is made after the next start; a damaged one is set aside.
test_a_phantom_that_stood_turned_is_told_in_every_scan() {
	start_daemon
	# balls of no symmetry, and the same drawing turned by a quarter against where they are
	local phantom='{"balls_mm": [[40, 5, -38, 6], [-12, 44, -25, 6], [-42, -9, -14, 6], [8, -45, -30, 6], [31, 30, -6, 6], [-33, 27, 4, 6],
		[-20, -36, 12, 6], [41, -17, 19, 6], [14, 39, 27, 6], [-44, 3, 33, 6], [2, -30, 40, 6], [22, 12, 47, 6]]}' drawn id
	drawn=$phantom
	balls
	for id in straight turned; do
		phantom=$drawn
		[ $id = straight ] || phantom=$(jq -c '.balls_mm |= map([-.[1], .[0], .[2], .[3]])' <<<"$drawn")
		calibrated
		expect_json '.state == "succeeded"'
		jq -e --argjson turned "$([ $id = turned ] && echo true || echo false)" '(any(.warnings[]; .code == "calibration_turned" and .severity == "serious")) == $turned and
			((.turned_deg | fabs) > 80) == $turned' "$body" >/dev/null || fail "$id: $(jq -c '[.turned_deg, .warnings]' "$body")"
		scan "{\"kind\": \"calibration\", \"id\": \"$calibration\"}"
		expect_status 201
		jq -e --argjson turned "$([ $id = turned ] && echo true || echo false)" '(any(.warnings[]; .code == "calibration_turned")) == $turned' "$body" >/dev/null ||
			fail "$id, of a scan: $(jq -c .warnings "$body")"
	done
	# its pictures are still needed
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $phantom}"
	calibration=$(jq -r .id "$body")
	req DELETE "/v1/scans/$balls"
	expect_problem 409
	grep -q "$calibration" "$body" || fail "the calibration that is to be made: $(cat "$body")"
	req GET "/v1/calibrations/$calibration?wait=60"
	req DELETE "/v1/scans/$balls"
	expect_status 204
	stop_daemon
}

# Of a daemon whose calibrations take a minute to begin: $calibration.
post_slow_calibration() {
	printf '#!/bin/sh\n[ "$1" != --calibrate ] || exec sleep 60\nexec "%s" "$@"\n' "$BUILD/cbct-worker" >"$work/slow"
	chmod +x "$work/slow"
	start_daemon --worker "$work/slow"
	balls
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $phantom}"
	calibration=$(jq -r .id "$body")
}

test_calibrations_outlive_crashes_and_damage_is_told() {
	local file
	post_slow_calibration
	for ((i = 0; i < 2400; i++)); do
		req GET "/v1/calibrations/$calibration"
		[ "$(jq -r .state "$body")" = running ] && break
		sleep .05
	done
	expect_json '.state == "running"'
	expect_json '.geometry == null'
	# one that waits behind it can be deleted, and so can one that is being made
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"phantom\": $phantom}"
	expect_json '.state == "queued"'
	req DELETE "$(jq -r .href "$body")"
	expect_status 204
	stop_daemon KILL
	start_daemon
	req GET "/v1/calibrations/$calibration?wait=60"
	expect_json '.state == "succeeded"'
	# a file that is gone under the daemon is told as that: not no calibration, nor one without a geometry
	for file in request result; do
		mv "$state/calibrations/$calibration/$file.json" "$work/"
		req GET "/v1/calibrations/$calibration"
		expect_problem 500
		expect_json ".type == \"urn:cbctd:problem:damaged\" and (.detail | contains(\"$file.json\"))"
		scan "{\"kind\": \"calibration\", \"id\": \"$calibration\"}"
		expect_problem 500 /geometry/id
		mv "$work/$file.json" "$state/calibrations/$calibration/"
	done
	req GET "/v1/calibrations/$calibration"
	expect_json '.state == "succeeded" and (.geometry.matrices | length) == 24'
	stop_daemon
	printf x | dd of="$state/calibrations/$calibration/result.json" bs=1 seek=100 conv=notrunc status=none
	start_daemon
	req GET "/v1/calibrations/$calibration"
	expect_status 404
	req GET /v1/quarantine
	jq -e --arg from "calibrations/$calibration" 'any(.entries[]; .from == $from and (.why | test("checksums")))' "$body" >/dev/null ||
		fail "what was set aside: $(cat "$body")"
	stop_daemon
}

# What somebody was told of is not made again without a word. One of a version that did not note it is noted at the start.
test_a_result_that_is_lost_while_the_daemon_is_down_is_told() {
	local case lost
	rm -rf "$state"
	printf '#!/bin/sh\n[ "$1" != --calibrate ] || cp "$2/request.json" "%s"\nexec "%s" "$@"\n' "$work/posted.json" "$BUILD/cbct-worker" >"$work/copies"
	chmod +x "$work/copies"
	for case in succeeded older failed; do
		start_daemon --worker "$work/copies"
		balls
		[ $case != failed ] || phantom=$(jq -c '.ball_mm = 3.6' <<<"$phantom")
		calibrated
		expect_json ".state == \"${case/older/succeeded}\""
		stop_daemon KILL
		lost=$state/calibrations/$calibration
		if [ $case = older ]; then
			cp "$work/posted.json" "$lost/request.json"
			start_daemon
			req GET "/v1/calibrations/$calibration"
			expect_json '.state == "succeeded"'
			stop_daemon KILL
		fi
		rm "$lost/result.json"
		start_daemon
		req GET "/v1/calibrations/$calibration?wait=60"
		expect_status 404
		req GET /v1/quarantine
		jq -e --arg from "calibrations/$calibration" 'any(.entries[]; .from == $from and (.why | test("result.json is gone")))' "$body" >/dev/null ||
			fail "$case: what was set aside: $(cat "$body")"
		grep -q "$calibration.*result.json is gone" "$work/cbctd.err" || fail "$case: the log"
		stop_daemon
	done
	phantom=$(jq -c '.ball_mm = 6' <<<"$phantom")
}

# A failure says which file is missing, not where the daemon keeps it.
test_a_failure_shows_no_path_of_the_server() {
	post_slow_calibration
	stop_daemon KILL
	rm -r "$state/scans/$balls"
	for _ in 1 2; do # as it is made, and as it is read again
		start_daemon
		req GET "/v1/calibrations/$calibration?wait=60"
		jq -e --arg state "$state" '.state == "failed" and (.error.detail | contains("scan.json") and (contains($state) | not))' "$body" >/dev/null ||
			fail "a failure: $(jq -c .error "$body")"
		stop_daemon
	done
}

# A process that ends without a result is tried three times, as a job's is; then it has failed, for good, by a reason in words.
test_a_process_that_crashes_is_tried_three_times() {
	local how words id
	cat >"$work/faulty" <<-END
		#!/bin/sh
		if [ "\$1" = --calibrate ]; then
			echo >>"$work/runs"
			[ \$(wc -l <"$work/runs") = "\$(cat "$work/good_run")" ] || eval "\$(cat "$work/how")"
		fi
		exec "$BUILD/cbct-worker" "\$@"
	END
	chmod +x "$work/faulty"
	echo never >"$work/good_run"
	start_daemon --worker "$work/faulty"
	balls
	for how in 'kill -SEGV $$' 'kill -KILL $$' 'exit 7' 'exit 0'; do
		echo "$how" >"$work/how"
		rm -f "$work/runs"
		case $how in
		*SEGV*) words='its process ended 3 times without a result, the last time by signal 11 (Segmentation fault): the program or this machine has a fault' ;;
		*KILL*) words='signal 9 (Killed): something outside ended it, as the kernel does where memory runs out' ;;
		*7) words='exit status 7: it gave up' ;;
		*0) words='exit status 0' ;;
		esac
		calibrated
		expect_json ".state == \"failed\" and .ended != null and .error.type == \"urn:cbctd:problem:internal\" and (.error.detail | contains(\"$words\"))"
		[ "$(wc -l <"$work/runs")" = 3 ] || fail "$how: three runs, got $(wc -l <"$work/runs")"
		id=$calibration
		stop_daemon
		start_daemon --worker "$work/faulty"
		req GET "/v1/calibrations/$id?wait=5"
		expect_json ".state == \"failed\" and (.error.detail | contains(\"$words\"))"
		[ "$(wc -l <"$work/runs")" = 3 ] || fail "$how: begun anew after a restart"
	done
	# one crash is no failure, and a restart between two does not forget it
	echo 'kill -SEGV $$' >"$work/how"
	echo 3 >"$work/good_run"
	rm -f "$work/runs"
	calibrated
	expect_json '.state == "succeeded" and .used == 24'
	[ "$(wc -l <"$work/runs")" = 3 ] || fail "the third run is the good one"
	stop_daemon
}

# A projection that a calibration finds damaged is missing, and one that is made once it was sent again succeeds.
test_a_projection_that_it_finds_damaged_is_missing() {
	local file one end=$((SECONDS + 20))
	start_daemon
	balls
	file=$state/scans/$balls/projections.raw
	one=$(($(stat -c %s "$file") / 24))
	dd if="$file" of="$work/view" bs=$one skip=11 count=1 status=none
	head -c 64 /dev/urandom | dd of="$file" bs=1 seek=$((11 * one + 500)) conv=notrunc status=none
	calibrated
	expect_json '.state == "failed" and .error.type == "urn:cbctd:problem:damaged"'
	until req GET "/v1/scans/$balls" && member '.missing == [[11, 11]]' "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "a damaged projection that is not missing: $(jq -c .missing "$body")"
		sleep .05
	done
	req PUT "/v1/scans/$balls/projections/11" --data-binary @"$work/view"
	expect_status 201
	calibrated
	expect_json '.state == "succeeded" and .used == 24'
	stop_daemon
}

# One whose files cannot be written has not failed, which nothing could record: it waits, and is made once they can be.
test_a_directory_that_cannot_be_written_is_waited_for() {
	local end
	[ "${SANITIZED:-0}" = 0 ] || skip "a sanitizer must be the first library of a process"
	cat >"$work/faulty" <<-END
		#!/bin/sh
		if [ "\$1" = --calibrate ]; then
			[ -e "$work/mended" ] || { sleep 1; echo "open 30 /calibrations/ 1000000 0" >"$work/faults"; } # once the reply has gone
			echo >>"$work/runs"
		fi
		exec "$BUILD/cbct-worker" "\$@"
	END
	chmod +x "$work/faulty"
	rm -f "$work/runs" "$work/mended" "$work/faults"
	CBCT_TEST_FAULTS=$work/faults LD_PRELOAD=$(realpath "$BUILD")/faults.so start_daemon --worker "$work/faulty"
	balls
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"arm\": \"arm in room 2\", \"phantom\": $phantom}"
	expect_status 202
	calibration=$(jq -r .id "$body")
	end=$((SECONDS + 60))
	until [ -e "$work/runs" ] && [ "$(wc -l <"$work/runs")" -ge 2 ]; do
		req GET "/v1/calibrations?limit=1"
		expect_json '.calibrations[0] | .error == null and .state != "failed"'
		[ $SECONDS -lt $end ] || fail "a second try"
		sleep .2
	done
	touch "$work/mended"
	rm -f "$work/faults"
	req GET "/v1/calibrations/$calibration?wait=60"
	expect_json '.state == "succeeded" and .ended != null'
	stop_daemon
}

# One that is stopped, or hangs, keeps nobody waiting: it is killed, tried again, and the next calibration has its turn.
test_a_process_that_gets_nowhere_is_ended() {
	local how id
	cat >"$work/faulty" <<-END
		#!/bin/sh
		if [ "\$1" = --calibrate ]; then
			echo >>"$work/runs"
			eval "\$(cat "$work/how")"
		fi
		exec "$BUILD/cbct-worker" "\$@"
	END
	chmod +x "$work/faulty"
	start_daemon --worker "$work/faulty"
	balls
	echo "[ \$(wc -l <\"$work/runs\") = 2 ] && exec sleep 3600; kill -STOP \$\$" >"$work/how"
	rm -f "$work/runs"
	req POST /v1/calibrations "${json[@]}" "{\"scan\": \"$balls\", \"arm\": \"arm in room 2\", \"phantom\": $phantom}"
	expect_status 202
	id=$(jq -r .id "$body")
	req GET "/v1/calibrations/$id?wait=60"
	member '.state == "failed"' "$body" >/dev/null || req GET "/v1/calibrations/$id?wait=60"
	expect_json '.ended != null and (.error.detail | test("^its process ended 3 times without a result, the last time by signal 9 .Killed.: it gave no sign of life for [0-9]+ s and was killed$"))'
	# Its start had the patience of a step, and the words say how long it was silent, not by how much for too long.
	expect_json '(.error.detail | capture("for (?<s>[0-9]+) s").s | tonumber) >= 13'
	[ "$(wc -l <"$work/runs")" = 3 ] || fail "three runs, got $(wc -l <"$work/runs")"
	echo true >"$work/how"
	calibrated
	expect_json '.state == "succeeded"'
	stop_daemon
}

test_cbct_and_python_calibrate() {
	start_daemon
	balls
	calibration=$(cbct calibrate-scan "$balls" "$work/phantom.json" --arm left 2>"$work/said") || fail "$(cat "$work/said")"
	grep -q '^24 of 24 views, residual' "$work/said" || fail "$(cat "$work/said")"
	cbct calibrations | grep "^$calibration  *succeeded .* left$" >/dev/null || fail "a line: $(cbct calibrations)"
	/usr/bin/python3 - "$url" "$balls" "$calibration" "$phantom" <<-'END' || fail "what Python has asked for"
		import json, sys
		sys.path.insert(0, "clients/python")
		import cbctd
		url, balls, calibration, phantom = sys.argv[1:]
		with cbctd.Client(url) as client:
		    made = client.calibrate(balls, json.loads(phantom), arm="left", adjust_balls=True)
		    assert made["used"] == 24 and made["balls_moved_mm"] < 0.1, made
		    assert [c["id"] for c in client.calibrations()][:2] == [made["id"], calibration]
		    assert client.calibration_view(made["id"], 0)[:4] == b"\x89PNG"
		    geometry = cbctd.Geometry.calibration(made["id"], (1.27, 1.27), angles_deg=[0, 7, 14])
		    scan = client.create_scan(geometry, (3, 240, 300))
		    assert len(scan["geometry"]["matrices"]) == 3
		    client.delete_calibration(made["id"])
		    try:
		        client.calibrate(balls, {"kind": "circles", "balls": 10, "diameter_mm": 90, "distance_mm": 70, "ball_mm": 6})
		        raise SystemExit("another phantom was taken")
		    except cbctd.CalibrationFailed as error:
		        assert "do not fit" in str(error) and "leaves a residual of" in str(error), error
	END
	cbct rm "$calibration"
	[ -z "$(cbct calibrations | grep "$calibration")" ] || fail "a calibration that was removed"
	stop_daemon
}

# A view of a panel that jumped has a place between its neighbours', and the scans that use it are told, too.
test_a_view_that_is_not_used_is_told_of_the_calibration_and_of_its_scans() {
	local bytes
	start_daemon
	balls
	bytes=$(($(stat -c %s "$work/balls/projections.raw") / 24))
	dd if="$work/balls/projections.raw" of="$work/view" bs=$bytes skip=5 count=1 status=none
	# forty columns further on
	(tail -c 80 "$work/view" && head -c -80 "$work/view") >"$work/jumped"
	dd if="$work/jumped" of="$work/balls/projections.raw" bs=$bytes seek=5 conv=notrunc status=none
	balls=$(cbct upload "$work/balls" | head -1)
	calibrated
	expect_json '.used == 23 and (.views[5].used | not)'
	expect_json 'any(.warnings[]; .code == "calibration_views" and (.detail | test("^1 of 24 views are not used, .* off where the arm moves as evenly as elsewhere, and by the jump where it jumps: ")))'
	scan "{\"kind\": \"calibration\", \"id\": \"$calibration\"}"
	expect_status 201
	expect_json '[.warnings[] | select(.code == "calibration_interpolated").detail] == ["1 of the 24 calibrated views were not used: their places are between their neighbours'"'"', off by the jump where the panel jumped"]'
	scan "{\"kind\": \"calibration\", \"id\": \"$calibration\", \"first_angle_deg\": 3, \"angle_step_deg\": 10}" 36
	expect_status 201
	expect_json 'any(.warnings[]; .code == "calibration_interpolated" and (.detail | test("^24 views were calibrated, .* by angle; 1 of the 24 calibrated views were not used")))'
	stop_daemon
}

run_tests
