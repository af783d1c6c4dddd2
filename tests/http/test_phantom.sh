#!/usr/bin/env bash
# Reconstructions through the HTTP API against exact phantoms: the thresholds are
# RTK's own for the same set-ups, and 0.5 % for uniform objects. Projections are
# exact line integrals, never the project's own projector.
. "$(dirname "$0")/lib.sh"
[ "${SANITIZED:-0}" = 0 ] || slow="too slow under a sanitizer"

# rtk DIR OPTION ...: the set-up of RTK's tests, phantom x116 mm, SID 600, SDD 1200
rtk() {
	local dir=$1
	shift
	cbct simulate -o "$dir" --phantom shepp-logan --scale 116 --density 1 --samples 1 --source-to-isocentre 600 --source-to-detector 1200 \
		--columns 128 --rows 128 --pixel 4 --truth "$dir/truth.nii" --grid 128 --spacing 2 "$@"
}
rtk_grid='"grid": {"size": [128, 128, 128], "spacing_mm": [2, 2, 2]}'

# gate DIR MEAN-ERROR PSNR: the FDK volume of $job, set to zero outside the field of view, against DIR/truth.nii
gate() {
	get_volume "${4:-final}" "$1/volume.nii"
	cbct compare --json --peak "${5:-2}" --scan "$1/scan.json" --zero-outside-fov "$1/volume.nii" "$1/truth.nii" >"$1/compare.json"
	expect_number "$(jq .mean_absolute_error "$1/compare.json")" '<' "$2" "mean error"
	expect_number "$(jq .psnr_db "$1/compare.json")" '>' "$3" "PSNR"
}

test_fdk_full_turn() {
	rtk "$work/full" --views 180 --arc 360
	reconstruct "$work/full" "{\"scan\": \"SCAN\", $rtk_grid, \"fdk\": {\"window\": \"ram-lak\"}}"
	gate "$work/full" 0.03 26
}

test_fdk_full_turn_reversed() {
	rtk "$work/reversed" --views 180 --arc 360 --clockwise --first-angle 77
	reconstruct "$work/reversed" "{\"scan\": \"SCAN\", $rtk_grid, \"fdk\": {\"window\": \"ram-lak\"}}"
	gate "$work/reversed" 0.03 26
}

test_fdk_short_scan() {
	rtk "$work/short" --views 110 --arc 240
	reconstruct "$work/short" "{\"scan\": \"SCAN\", $rtk_grid, \"fdk\": {\"window\": \"ram-lak\"}}"
	gate "$work/short" 0.09 22
}

test_fdk_short_scan_reversed() {
	rtk "$work/short-reversed" --views 110 --arc 240 --clockwise --first-angle 200
	reconstruct "$work/short-reversed" "{\"scan\": \"SCAN\", $rtk_grid, \"fdk\": {\"window\": \"ram-lak\"}}"
	gate "$work/short-reversed" 0.09 22
}

test_fdk_displaced_detector() {
	rtk "$work/displaced" --views 180 --arc 360 --detector-offset 120,0
	reconstruct "$work/displaced" "{\"scan\": \"SCAN\", $rtk_grid, \"fdk\": {\"window\": \"ram-lak\"}}"
	gate "$work/displaced" 0.061 24
}

test_sart_one_iteration() {
	cbct simulate -o "$work/sart" --phantom ball --scale 90 --density 1 --source-to-isocentre 600 --source-to-detector 1200 \
		--columns 64 --rows 64 --pixel 8 --views 180 --arc 360 --truth "$work/sart/truth.nii" --grid 64 --spacing 4
	reconstruct "$work/sart" '{"scan": "SCAN", "grid": {"size": [64, 64, 64], "spacing_mm": [4, 4, 4]},
	    "sart": {"iterations": 1, "relaxation": 0.5, "subsets": "views"}}'
	get_volume final "$work/sart/volume.nii"
	cbct compare --json --peak 2 "$work/sart/volume.nii" "$work/sart/truth.nii" >"$work/sart/compare.json"
	expect_number "$(jq .mean_absolute_error "$work/sart/compare.json")" '<' 0.032 "mean error"
	expect_number "$(jq .psnr_db "$work/sart/compare.json")" '>' 28.6 "PSNR"
}

# uniform PHANTOM OPTIONS...: the mean of the central voxels within 0.5 % of 0.02/mm
uniform() {
	local dir=$work/$1 phantom=$1
	shift
	cbct simulate -o "$dir" --phantom "$phantom" --scale 80 --density 0.02 --source-to-isocentre 620 --source-to-detector 1100 \
		--columns 200 --rows 160 --pixel 1.8 "$@"
	reconstruct "$dir" '{"scan": "SCAN", "grid": {"size": [64, 64, 40], "spacing_mm": [3, 3, 3]}, "fdk": {}}'
	get_volume final "$dir/volume.nii"
	expect_number "$(cbct compare --json --region 24-39,24-39,16-23 --value 0.02 "$dir/volume.nii" | jq '.mean / 0.02')" '>' 0.995 "density over truth"
	expect_number "$(cbct compare --json --region 24-39,24-39,16-23 --value 0.02 "$dir/volume.nii" | jq '.mean / 0.02')" '<' 1.005 "density over truth"
}

test_ball_full_turn() { uniform ball --views 240 --arc 360; }
test_ball_short_scan() { uniform ball --views 210 --arc 210 --first-angle 33; }
test_cylinder_full_turn() { uniform cylinder --views 240 --arc 360; }
test_cylinder_reversed() { uniform cylinder --views 240 --arc 360 --clockwise; }

# Off-centre in x, y and z, unequal pitches and spacings, odd offsets: every mirror or swap shows.
asymmetric() {
	local dir=$work/asymmetric-$1
	shift
	cbct simulate -o "$dir" --phantom asymmetric --scale 60 --density 0.02 --shift 6,-11,8 --source-to-isocentre 600 \
		--source-to-detector 1000 --columns 180 --rows 100 --pixel 1.6,2.4 --truth "$dir/truth.nii" \
		--grid 90,70,50 --spacing 2,2.5,3 "$@"
	reconstruct "$dir" '{"scan": "SCAN", "grid": {"size": [90, 70, 50], "spacing_mm": [2, 2.5, 3]}, "fdk": {},
	    "sart": {"iterations": 4, "subsets": 12}, "emit": ["fdk"]}'
	get_volume fdk "$dir/fdk.nii"
	get_volume final "$dir/final.nii"
	cbct compare --json "$dir/fdk.nii" "$dir/truth.nii" >"$dir/fdk.json"
	cbct compare --json "$dir/final.nii" "$dir/truth.nii" >"$dir/final.json"
	expect_number "$(jq .correlation "$dir/fdk.json")" ">" 0.99 "correlation of FDK"
	expect_number "$(jq .correlation "$dir/final.json")" '>' 0.99 "correlation of SART"
}
test_asymmetric() { asymmetric plain --views 180 --arc 360; }
test_asymmetric_reversed() { asymmetric reversed --views 180 --arc 360 --clockwise --first-angle 41; }
test_asymmetric_short_with_offsets() {
	asymmetric short --views 200 --arc 215 --first-angle -60 --detector-offset 5,-7 --source-offset 3,2
}

# A trunk of 500 mm under a panel that covers +-84, and grids that end inside of that: with nothing done about what lies
# beyond the grid, thousands of HU in their last slices. With and without rows extended before the ramp, by each algorithm.
test_slices_at_the_ends_of_a_long_body() {
	local dir=$work/trunk half stages grid python=${PYTHON:-/usr/bin/python3}
	"$python" -c 'import numpy' 2>/dev/null || skip "python3-numpy is not here"
	trunk() { "$python" "$top/tests/http/trunk.py" "$@"; }
	trunk make "$dir"
	for half in 68 72 76; do
		grid="\"scan\": \"SCAN\", \"grid\": $(trunk grid $half 4)"
		for stages in '' ', "fdk": {"truncation": "off"}, "sart": {"iterations": 6}' ', "fdk": {}, "cgls": {}' ', "fdk": {}, "fista": {}'; do
			# On shorter grids than the longest the default alone is looked at.
			[ $half = 76 ] || [ -z "$stages" ] || continue
			reconstruct "$dir" "{$grid$stages}"
			get_volume final "$dir/final.raw" format=raw
			trunk slices "$dir/final.raw" $half 4 >"$dir/slices.json"
			expect_number "$(jq .seen "$dir/slices.json")" '<' 20 "HU of the worst slice that all views see, +-$half mm, ${stages:-default}"
			expect_number "$(jq .any "$dir/slices.json")" '<' 40 "HU of the worst slice, +-$half mm, ${stages:-default}"
			req GET "/v1/jobs/$job"
			expect_json '[.warnings[].code] | index("outside_grid") != null and index("end_slices") == null'
		done
	done
}

# A ball that ends 1 mm beyond the grid's faces, on voxels that are higher than the rows are apart: iterations overshoot.
test_end_slices_where_a_body_ends() {
	local dir=$work/ends algorithm volume
	cbct simulate -o "$dir" --phantom ball --scale 55 --density 0.0192 --source-to-isocentre 620 --source-to-detector 1100 \
		--columns 72 --rows 56 --pixel 4 --views 36 --arc 360 --truth "$dir/truth.nii" --grid 56,56,36 --spacing 3
	for algorithm in sart cgls; do
		reconstruct "$dir" "{\"scan\": \"SCAN\", \"grid\": {\"size\": [56, 56, 36], \"spacing_mm\": [3, 3, 3]}, \"fdk\": {},
		    \"$algorithm\": {}, \"emit\": [\"fdk\"]}"
		for volume in fdk final; do
			get_volume "$volume" "$dir/$volume.nii"
			cbct compare --json --region 0-55,0-55,0-3 "$dir/$volume.nii" "$dir/truth.nii" | jq .rmse >"$dir/$volume.rmse"
		done
		expect_number "$(cat "$dir/final.rmse")" '<' "$(cat "$dir/fdk.rmse")" "error of the first slices, $algorithm against FDK"
		req GET "/v1/jobs/$job"
		expect_json '[.warnings[] | select(.code == "end_slices") | .severity] == ["caution"]'
	done
}

test_raw_counts_become_the_same_volume() {
	local dir=$work/raw
	cbct simulate -o "$dir" --phantom asymmetric --scale 60 --density 0.01 --source-to-isocentre 600 --source-to-detector 1000 \
		--columns 120 --rows 90 --pixel 2.4 --views 120 --arc 360 --raw flat --sample uint16 --photons 1000000 \
		--truth "$dir/truth.nii" --grid 64 --spacing 3
	[ -e "$dir/flat.f32" ] && [ -e "$dir/dark.f32" ] || fail "a flat and a dark image"
	reconstruct "$dir" '{"scan": "SCAN", "grid": {"size": [64, 64, 64], "spacing_mm": [3, 3, 3]}, "fdk": {}}'
	get_volume final "$dir/volume.nii"
	cbct compare --json "$dir/volume.nii" "$dir/truth.nii" >"$dir/compare.json"
	expect_number "$(jq .correlation "$dir/compare.json")" '>' 0.99 "correlation"
}

if [ -n "${slow:-}" ]; then
	echo "SKIP test_phantom.sh: $slow"
	echo "skip test_phantom.sh: $slow" >>"$RESULTS"
	exit 0
fi
start_daemon || exit 1
run_tests
