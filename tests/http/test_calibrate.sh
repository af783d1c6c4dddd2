#!/usr/bin/env bash
# cbct calibrate: an arm that sags, from a scan of balls to a scan of a head with the geometry that was found.
. "$(dirname "$0")/lib.sh"

arm=(--columns 400 --rows 320 --pixel 0.95 --sag daly)
sweep=(--views 120 --photons 20000)
phantom='{"kind": "circles", "balls": 12, "diameter_mm": 110, "distance_mm": 90, "ball_mm": 4, "first_angle_deg": 10, "shift_deg": 15}'

# refused WORDS COMMAND ...: it ends with status 1 and says these words
refused() {
	local words=$1 status=0
	shift
	"$@" >"$work/said" 2>&1 || status=$?
	[ $status = 1 ] || fail "exit status 1 of $*, got $status: $(cat "$work/said")"
	grep -qF -- "$words" "$work/said" || fail "'$words' in: $(cat "$work/said")"
}
# rmse_of SCAN: error of its FDK volume against the head's truth, in the head (its air and cavities, which are nothing, aside)
rmse_of() {
	cbct recon "$1" "$work/job.json" --backend cpu -o "$1.out" --quiet >/dev/null 2>&1
	cbct compare --json --body 0.0001 "$1.out/final.nii" "$work/truth.nii" | jq .rmse
}

# Raw counts with flat and dark; .15 mm of jitter, another one in each sweep; other angles the other way round.
test_a_head_is_as_good_as_with_the_true_matrices() {
	local head=(--phantom head --scale 70 --density 0.02 --views 120 --first-angle 4 --clockwise --jitter .15 --wobble-seed 2)
	local calibrated true nominal
	printf '%s' "$phantom" >"$work/phantom.json"
	cbct simulate -o "$work/balls" --balls "$work/phantom.json" --density .6 "${arm[@]}" "${sweep[@]}" --raw flat --jitter .15
	cbct simulate -o "$work/head" "${arm[@]}" "${head[@]}" --truth "$work/truth.nii" --grid 96 --spacing 1.6
	cbct simulate -o "$work/true" "${arm[@]}" "${head[@]}" --kind matrices
	cp -r "$work/head" "$work/nominal"
	cbct calibrate "$work/balls" "$work/phantom.json" -o "$work/calibration.json" --apply "$work/head" 2>"$work/said"
	grep -q '^120 of 120 views, residual 0\.0' "$work/said" || fail "all views and their residual: $(cat "$work/said")"
	jq -e '.residual_pixels < .2 and .used == 120 and (.other_turn_deg | fabs | . > 20) and (.views | length) == 120 and (.geometry.matrices | length) == 120 and
		(.views | all(.used and .refused == null and .balls >= 12))' "$work/calibration.json" >/dev/null ||
		fail "a calibration's document: $(head -c 600 "$work/calibration.json")"

	# whoever reads what it says may leave: the file is written all the same
	cbct calibrate "$work/balls" "$work/phantom.json" -o "$work/unread.json" 2>&1 | true || :
	cmp "$work/calibration.json" "$work/unread.json" || fail "the file of a calibration that nobody reads"

	echo '{"scan": "directory", "grid": {"size": [96, 96, 96], "spacing_mm": [1.6, 1.6, 1.6]}, "fdk": {}}' >"$work/job.json"
	[ "$(jq -r .geometry.kind "$work/head/scan.json")" = matrices ] || fail "matrices in the head's scan.json"
	calibrated=$(rmse_of "$work/head") true=$(rmse_of "$work/true") nominal=$(rmse_of "$work/nominal")
	expect_number "$(jq -n "$calibrated / $true")" '<' 1.05 "the calibrated head's error over the true matrices'"
	expect_number "$(jq -n "$nominal / $true")" '>' 2 "the nominal circle's error over the true matrices'"
}

# Its two sizes of balls tell how it was put down: 130 degrees from where the nominal geometry has it.
test_a_helix_with_a_code_is_found_however_it_is_turned() {
	jq -nc '{kind: "helix", balls: 40, diameter_mm: 110, pitch_mm: 40, angle_step_deg: 24, first_angle_deg: 130, ball_mm: 3, large_ball_mm: 5,
		code: "1101001110100010110010100110111100001001"}' >"$work/stands.json"
	jq -c '.first_angle_deg = 0' "$work/stands.json" >"$work/helix.json"
	cbct simulate -o "$work/balls" --balls "$work/stands.json" --density .6 "${arm[@]}" --views 12 --photons 20000 --raw flat
	cbct calibrate "$work/balls" "$work/helix.json" -o "$work/helix.out" 2>"$work/said" || fail "$(cat "$work/said")"
	jq -e '.used == 12 and .residual_pixels < .1 and (.other_turn_deg == null) and (.views | all(.balls >= 30))' "$work/helix.out" >/dev/null ||
		fail "a helix, found: $(head -c 400 "$work/helix.out") $(cat "$work/said")"
}

test_what_does_not_fit_is_told_with_numbers() {
	printf '%s' "$phantom" >"$work/phantom.json"
	local few=("${arm[@]}" --views 8 --photons 20000)
	cbct simulate -o "$work/balls" --balls "$work/phantom.json" --density .6 "${few[@]}" --raw flat
	echo '{"balls_mm": [[0, 0, 0, 3], [10, 0, 0, 3], [0, 10, 0, 3]]}' >"$work/three.json"
	refused 'a phantom of 3 balls, expected 8 to 512' cbct calibrate "$work/balls" "$work/three.json"
	jq -n '{balls_mm: [range(9) | [10 * ., 5 * ., 2, 3]]}' >"$work/line.json"
	refused 'all balls lie on a line: their places spread by' cbct calibrate "$work/balls" "$work/line.json"
	jq -c '.ball_mm = 2.4' "$work/phantom.json" >"$work/small.json"
	refused 'times the given diameter' cbct calibrate "$work/balls" "$work/small.json"
	# a drawing a tenth too large: the poses are, too
	jq -c '.diameter_mm *= 1.1 | .distance_mm *= 1.1' "$work/phantom.json" >"$work/tenth.json"
	cbct calibrate "$work/balls" "$work/tenth.json" -o "$work/tenth.out" 2>"$work/said" || fail "$(cat "$work/said")"
	grep -q '^caution: the shadows are 1\.[01].. times as wide' "$work/said" || fail "a caution in: $(cat "$work/said")"
	jq -e '.distance_ratio > 1.08 and .distance_ratio < 1.12' "$work/tenth.out" >/dev/null || fail "the distances' ratio"
	# a drawing with a ball more than the phantom, and one with a ball less
	jq -c '.balls_mm += [[3, -2, 5, 4]] | {balls_mm}' "$work/tenth.out" >"$work/more.json"
	jq -c '{balls_mm: .balls_mm[1:]}' "$work/tenth.out" >"$work/fewer.json"
	cbct calibrate "$work/balls" "$work/more.json" -o /dev/null 2>"$work/said" || fail "$(cat "$work/said")"
	grep -qE '^caution: ball 24 of the drawing \(counted from 0\) is not where the drawing has it, in [3-8] views that would show it alone' "$work/said" ||
		fail "a ball more, in: $(cat "$work/said")"
	cbct calibrate "$work/balls" "$work/fewer.json" -o /dev/null 2>"$work/said" || fail "$(cat "$work/said")"
	grep -qE '^caution: [5-9] shadows of balls, in [5-8] of 8 views, are of no ball of the drawing: the drawing may have fewer balls' "$work/said" ||
		fail "a ball less, in: $(cat "$work/said")"
	jq -c '.balls = 10 | .distance_mm = 70' "$work/phantom.json" >"$work/wrong.json"
	refused '8 of 8 views do not fit this phantom, and no pose could be fitted to any of them' cbct calibrate "$work/balls" "$work/wrong.json"
	grep -qE ': the best leaves a residual of [1-9][0-9]*\.[0-9]{2} pixels over (1[0-9]|[7-9]) balls; view' "$work/said" || fail "the best residual in: $(cat "$work/said")"
	jq -c '.bals = 12' "$work/phantom.json" >"$work/misspelt.json"
	refused 'bals' cbct calibrate "$work/balls" "$work/misspelt.json"
	jq -nc '{kind: "helix", balls: 40, diameter_mm: 110, pitch_mm: 40, angle_step_deg: 24, ball_mm: 3, large_ball_mm: 5,
		code: "101"}' >"$work/code.json"
	refused '40 characters 0 (small) or 1 (large) are expected' cbct calibrate "$work/balls" "$work/code.json"
	cbct simulate -o "$work/empty" --phantom ball --density 0 "${few[@]}"
	refused 'shadows of a ball are in a view, expected 7 or more' cbct calibrate "$work/empty" "$work/phantom.json"
	jq -c '.projections.quantity = "line_integral" | .projections.sample = "uint16"' "$work/balls/scan.json" >"$work/counts.json"
	cp "$work/counts.json" "$work/balls/scan.json"
	rm "$work/balls/flat.f32" "$work/balls/dark.f32"
	refused 'no line integral: these are counts without their air' cbct calibrate "$work/balls" "$work/phantom.json"
}

test_only_a_scan_of_the_same_sweep_and_detector_takes_a_calibration() {
	printf '%s' "$phantom" >"$work/phantom.json"
	cbct simulate -o "$work/balls" --balls "$work/phantom.json" --density .6 "${arm[@]}" --views 40 --arc 195
	cbct simulate -o "$work/long" --phantom ball --scale 20 "${arm[@]}" --views 8 --arc 240
	refused 'degrees from the nearest calibrated one' \
		cbct calibrate "$work/balls" "$work/phantom.json" -o /dev/null --apply "$work/long"
	cbct simulate -o "$work/other" --phantom ball --scale 20 --columns 200 --rows 160 --pixel 1.9 --views 8
	refused 'the calibration is of a detector of 400 x 320 pixels' \
		cbct calibrate "$work/balls" "$work/phantom.json" -o /dev/null --apply "$work/other"
	[ "$(jq -r .geometry.kind "$work/other/scan.json")" = circular ] || fail "a scan.json that was left alone"
	cbct simulate -o "$work/wide" --phantom ball --scale 20 --columns 400 --rows 320 --pixel 0.95 --views 8 --arc 150 \
		--source-to-isocentre 700 --source-to-detector 1180
	refused 'from the detector, the scan of one with 700 and 1180 mm; --other-arm' \
		cbct calibrate "$work/balls" "$work/phantom.json" -o /dev/null --apply "$work/wide"
	[ "$(jq -r .geometry.kind "$work/wide/scan.json")" = circular ] || fail "a scan.json that was left alone"
	cbct calibrate "$work/balls" "$work/phantom.json" -o /dev/null --apply "$work/wide" --other-arm 2>/dev/null
	[ "$(jq -r .geometry.kind "$work/wide/scan.json")" = matrices ] || fail "matrices where they are asked for"
}

run_tests
