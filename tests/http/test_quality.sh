#!/usr/bin/env bash
# What a job's document says of the geometry, and a volume's of its quality, beside what numpy finds in volumes that
# differ by noise and rings alone.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}

# made NAME [OPTION ...]: a ball's projections in $work/NAME
made() {
	local name=$1
	shift
	cbct simulate --phantom ball --scale 40 --density 0.0192 --views 120 --arc 360 --columns 96 --rows 64 --pixel 2 \
		--source-to-isocentre 600 --source-to-detector 1000 -o "$work/$name" "$@" >/dev/null || fail "cbct simulate"
}
# reconstructed NAME: its FDK volume as NAME.raw, its quality as NAME.json
reconstructed() {
	post_scan "$work/$1"
	post_projections "$work/$1"
	post_job '{"scan": "SCAN", "grid": {"size": [80, 80, 32], "spacing_mm": [1.25, 1.25, 1.25]}, "fdk": {}}'
	wait_job succeeded
	get_volume final "$work/$1.raw" format=raw
	req GET "/v1/jobs/$job/volumes"
	expect_json '.volumes[0].quality | has("noise_hu") and has("streak_hu") and has("ring_hu") and has("edge_mm") and .metal_share == 0 and .held_out == null'
	json '.volumes[0].quality' >"$work/$1.json"
}

# The arm that took the second scan sags, its document says that it stood on a circle.
test_a_job_tells_whether_the_geometry_fits() {
	local name sag fits
	# How an arm sags is explained by views that lie aside; a detector that is far aside is not.
	for name in circle sagging aside; do
		sag=() fits=true
		[ $name = circle ] || fits=false
		[ $name != sagging ] || sag=(--sag daly)
		cbct simulate --phantom asymmetric --scale 70 --density 0.0192 --views 64 --arc 200 --columns 80 --rows 64 --pixel 4.8 \
			--source-to-isocentre 620 --source-to-detector 1100 "${sag[@]}" -o "$work/$name" >/dev/null || fail "cbct simulate"
		if [ $name = aside ]; then
			jq '.geometry.detector_offset_mm = [60, 0]' "$work/$name/scan.json" >"$work/aside.json" && mv "$work/aside.json" "$work/$name/scan.json"
		fi
		post_scan "$work/$name"
		post_projections "$work/$name"
		req GET "/v1/scans/$scan"
		expect_json '.derived | has("geometry_agreement") and .geometry_agreement == null'
		post_job '{"scan": "SCAN", "grid": {"size": [24, 24, 16], "spacing_mm": [6, 6, 6]}, "fdk": {}}'
		wait_job succeeded
		expect_json ".geometry_agreement | .views == 64 and .sigma_mm > 0 and (.mm < 0.1) == $fits"
		[ $name != sagging ] || expect_json '.geometry_agreement.mm > 0.5'
		if [ $name = aside ]; then
			expect_json '.geometry_agreement.unexplained | . > 0.1 and . <= 1'
		else
			expect_json '.geometry_agreement.unexplained | . >= 0 and . < 0.05'
		fi
		expect_json "[.warnings[] | select(.code == \"geometry_wrong\" and .severity == \"serious\")] | (length == 0) == $fits"
		expect_json '.warnings | all(.code != "geometry_doubtful")'
		json .geometry_agreement >"$work/$name.agreement"
		# FDK's volume does not wait for what takes long to find.
		req GET "/v1/jobs/$job/events"
		grep -E -A 2 '^event: (volume|warning)' "$body" | grep -o -E 'volumes/final|geometry_wrong' | uniq >"$work/order"
		[ "$(cat "$work/order")" = "$($fits && echo volumes/final || printf 'volumes/final\ngeometry_wrong')" ] ||
			fail "the volume, then the warning, got: $(cat "$work/order")"
		req GET "/v1/scans/$scan"
		expect_json ".derived.geometry_agreement == $(cat "$work/$name.agreement")"
	done
	# The scan says it as long as a job is there that has found it, which one that is cancelled may not have.
	post_job '{"scan": "SCAN", "grid": {"size": [24, 24, 16], "spacing_mm": [6, 6, 6]}, "fdk": {}}'
	req DELETE "/v1/jobs/$job"
	stop_daemon
	port=${url##*:} start_daemon
	req GET "/v1/scans/$scan"
	expect_json ".derived.geometry_agreement == $(cat "$work/aside.agreement")"
	req GET "/v1/jobs?scan=$scan"
	for job in $(json '.jobs[].id'); do
		req DELETE "/v1/jobs/$job"
	done
	req GET "/v1/scans/$scan"
	expect_json '.derived.geometry_agreement == null'
}

# The same projections, said to be those of an arm that turned the other way: on part of a circle, too.
test_a_job_tells_that_the_arm_turned_the_other_way() {
	cbct simulate --phantom asymmetric --scale 70 --density 0.0192 --views 64 --arc 200 --columns 80 --rows 64 --pixel 4.8 \
		--source-to-isocentre 620 --source-to-detector 1100 -o "$work/turned" >/dev/null || fail "cbct simulate"
	jq '.geometry.angle_step_deg |= -.' "$work/turned/scan.json" >"$work/turned.json" && mv "$work/turned.json" "$work/turned/scan.json"
	post_scan "$work/turned"
	post_projections "$work/turned"
	post_job '{"scan": "SCAN", "grid": {"size": [24, 24, 16], "spacing_mm": [6, 6, 6]}, "fdk": {}}'
	wait_job succeeded
	expect_json '[.warnings[] | select(.code == "other_direction" and .severity == "serious")] | length == 1'
	expect_json '.warnings | all(.code != "geometry_wrong" and .code != "geometry_doubtful")'
}

test_quality_is_that_which_numpy_finds() {
	"$python" -c 'import numpy' 2>/dev/null || skip "numpy is not here"
	made clean
	made noisy --photons 20000 --seed 3
	cp -r "$work/clean" "$work/rings"
	"$python" - "$work/rings/projections.raw" <<-'END'
		import sys
		import numpy as np
		p = np.memmap(sys.argv[1], "<f4", "r+", shape=(120, 64, 96))
		for column, off in ((60, .012), (66, -.01), (71, .012), (36, -.012), (30, .01)):
		    p[:, :, column] += off
	END
	for name in clean noisy rings; do reconstructed $name; done
	jq -n --slurpfile a "$work/clean.json" --slurpfile b "$work/noisy.json" --slurpfile c "$work/rings.json" \
		'{clean: $a[0], noisy: $b[0], rings: $c[0]}' >"$work/quality.json"
	"$python" "$here/quality.py" "$work/quality.json" "$work/clean.raw" "$work/noisy.raw" "$work/rings.raw" 80 80 32 1.25 ||
		fail "the quality that numpy finds: $(cat "$work/quality.json")"
}

# quality_of JOB: the member of its last volume, $work/quality.json
quality_of() {
	reconstruct "$work/$1" "$2"
	get_volume final "$work/$1.raw" format=raw
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[-1].quality' >"$work/$1.json"
}

# A whole ball in projections whose noise is known: they are exact integrals with and without it. What iterations take
# up of the noise is missing from the residual of the projections that were used, and is on top of it in the others.
test_projections_that_are_held_out_tell_what_was_made_of_noise() {
	"$python" -c 'import numpy' 2>/dev/null || skip "numpy is not here"
	local ball=(--phantom ball --scale 34 --density 0.0192 --views 60 --arc 360 --columns 64 --rows 64 --pixel 2
		--source-to-isocentre 600 --source-to-detector 1000) grid='"grid": {"size": [60, 60, 60], "spacing_mm": [1.25, 1.25, 1.25]}' noise
	cbct simulate "${ball[@]}" -o "$work/exact" >/dev/null || fail "cbct simulate"
	cbct simulate "${ball[@]}" --photons 200 --seed 5 -o "$work/held" >/dev/null || fail "cbct simulate"
	noise=$("$python" - "$work"/{exact,held}/projections.raw <<-'END'
		import sys
		import numpy as np
		exact, noisy = (np.fromfile(name, "<f4").astype(float) for name in sys.argv[1:])
		print(np.linalg.norm(noisy - exact) / np.linalg.norm(noisy))
	END
	) || fail "numpy"
	quality_of held "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 12}, \"hold_out\": true}"
	req GET "/v1/jobs/$job"
	expect_json '.hold_out and ([.warnings[] | select(.code == "blank_views")] | length == 0)'
	expect_number "$(jq .held_out.views "$work/held.json")" '==' 3 "projections of 60 that are held out"
	expect_number "$(jq '.held_out | .used_residual / .residual' "$work/held.json")" '<' 0.97 "residual of those that were used"
	expect_number "$(jq ".held_out.residual / $noise" "$work/held.json")" '>' 1.015 "residual of those that were held out, in noise, half a percent of which is chance"
	quality_of held "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 12}, \"tv\": {}, \"hold_out\": true}"
	# TV takes up next to none: what is left over is the noise, and a ball's surface in voxels.
	expect_number "$(jq ".held_out.residual / $noise" "$work/held.json")" '>' 0.95 "with TV, in noise"
	expect_number "$(jq ".held_out.residual / $noise" "$work/held.json")" '<' 1.1 "with TV, in noise"
	expect_number "$(jq .estimated_share "$work/held.json")" '<' 0.001 "share of estimates in a ball that all projections see"
}

# A detector too narrow for the ball: rays through a point at rho from the axis leave more than 20 degrees out from
# r / sin(80 degrees) on, r being the radius of the field of view.
test_what_the_projections_do_not_measure_is_told() {
	"$python" -c 'import numpy' 2>/dev/null || skip "numpy is not here"
	made narrow --columns 40
	quality_of narrow '{"scan": "SCAN", "grid": {"size": [80, 80, 32], "spacing_mm": [1.25, 1.25, 1.25]}, "fdk": {}}'
	"$python" - "$work/narrow.raw" "$(jq .estimated_share "$work/narrow.json")" <<-'END' || fail "the share that numpy finds"
		import sys
		import numpy as np
		volume = np.fromfile(sys.argv[1], "<f4").reshape(32, 80, 80)
		x = 1.25 * (np.arange(80) - 39.5)
		rho = np.hypot(x[:, None], x[None, :])[None]
		r = 600 * np.sin(np.arctan(40 / 1000)) / np.sin(np.radians(81))
		whole = volume >= 0.0096
		share = (whole & (rho > r)).sum() / whole.sum()
		print(f"estimated_share: {float(sys.argv[2]):.3g}, numpy {share:.3g}")
		sys.exit(not (share > 0.1 and abs(share - float(sys.argv[2])) < 0.03))
	END
}

# Views from one side, a single voxel, and a grid where nothing is: told in plain words, each once.
test_what_can_be_no_image_is_told() {
	local ball=(--phantom ball --scale 40 --density 0.0192 --columns 40 --rows 32 --pixel 5)
	ends_with() { # CODE SEVERITY NAME JOB: told by the scan or by its job
		reconstruct "$work/$3" "{\"scan\": \"SCAN\", \"sart\": {\"iterations\": 2}, $4}"
		req GET "/v1/jobs/$job"
		json .warnings >"$work/of-job"
		req GET "/v1/scans/$scan"
		json .warnings | jq -e -s --arg code "$1" --arg severity "$2" \
			'add | [.[] | select(.code == $code)] | length == 1 and .[0].severity == $severity and (.[0].summary | length > 20)' - "$work/of-job" >/dev/null ||
			fail "$1 ($2) of $3: $(json '[.warnings[].code] | join(" ")'), $(jq -r '[.[].code] | join(" ")' "$work/of-job")"
	}
	cbct simulate "${ball[@]}" --views 2 --arc 90 -o "$work/two" >/dev/null
	cbct simulate "${ball[@]}" --views 2 --arc 360 -o "$work/opposite" >/dev/null
	cbct simulate "${ball[@]}" --views 30 -o "$work/thirty" >/dev/null
	ends_with few_views serious two '"grid": {"size": [20, 20, 20], "spacing_mm": [4, 4, 4]}'
	ends_with few_views serious opposite '"grid": {"size": [20, 20, 20], "spacing_mm": [4, 4, 4]}'
	ends_with grid_too_small caution thirty '"grid": {"size": [1, 1, 1], "spacing_mm": [9, 9, 9]}'
	ends_with residual_high serious thirty '"fdk": {}, "grid": {"size": [20, 20, 20], "spacing_mm": [1, 1, 1], "origin_mm": [60, 60, -10]}'
}

start_daemon || exit 1
run_tests
