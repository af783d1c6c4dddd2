#!/usr/bin/env bash
# Real input through the running daemon: measured projections of a cone-beam
# scanner with the published truth, and a real C-arm's calibrated matrices with
# a real abdomen. Skipped aloud where the data is absent.
. "$(dirname "$0")/lib.sh"

test_measured_projections_of_one_detector_row() {
	need_data htc_tb_real.f32.zst htc_tb_truth.f32.zst
	local dir=$work/htc n
	mkdir -p "$dir"
	zstd -q -d -f "$DATA/htc_tb_real.f32.zst" -o "$dir/projections.raw"
	zstd -q -d -f "$DATA/htc_tb_truth.f32.zst" -o "$dir/truth.raw"
	jq '{name: "htc_tb", detector: {columns: 560, rows: 1, pixel_mm: [0.2, 0.2]},
	    projections: {count: (.angles_deg | length), sample: "float32", quantity: "line_integral"},
	    geometry: {kind: "circular", source_to_isocentre_mm: .sod_mm, source_to_detector_mm: .sdd_mm, angles_deg: .angles_deg}}' \
		"$DATA/htc_tb_real.json" >"$dir/scan.json"
	reconstruct "$dir" '{"scan": "SCAN", "grid": {"size": [512, 512, 1], "spacing_mm": [0.1483223173330444, 0.1483223173330444, 0.2]},
	    "fdk": {}, "sart": {"iterations": 10, "subsets": 20}, "tv": {"after": "sart"}, "emit": ["fdk"]}'
	local pair name least
	for pair in fdk:0.90 final:0.963; do
		name=${pair%:*} least=${pair#*:}
		get_volume "$name" "$dir/$name.raw" format=raw
		cbct compare --json --size 512,512,1 --spacing 0.1483,0.1483,0.2 "$dir/$name.raw" "$dir/truth.raw" >"$dir/$name.json"
		expect_number "$(jq .correlation "$dir/$name.json")" '>=' "$least" "correlation of $name with the published mask"
	done
}

# The matrices of the sweep, row by row, from the .npy file (a 128-byte header, then little-endian doubles): every
# second one and rows from the panel's 120th on, or all of it.
sweep() {
	local header
	header=$((10 + $(od -An -tu2 -j8 -N2 "$DATA/carm_kct_248.npy")))
	od -An -v -tf8 -w96 -j "$header" "$DATA/carm_kct_248.npy" | tr -s ' ' | sed 's/^ //; s/ /,/g; s/.*/[&]/' | paste -sd, | sed 's/.*/[&]/' |
		jq -c --argjson every "$every" --argjson first $(((480 - rows) / 2)) \
			'[.[range(0; 248; $every)]] | map([.[:4], [range(4) as $i | .[4 + $i] - $first * .[8 + $i]], .[8:]] | add)'
}

# Half of the panel's rows over half of the body, and of the views with twice the photons: the same errors in HU as those
# of the whole, which takes four times as long and is among the long tests.
test_abdomen_through_a_calibrated_c_arm() {
	local every=2 rows=240 slices=56 seen=40
	[ "${ABDOMEN:-}" != whole ] || every=1 rows=480 slices=112 seen=80
	need_data carm_kct_248.npy abdomen_ts3mm.f32.zst
	local dir=$work/abdomen
	mkdir -p "$dir"
	zstd -q -d "$DATA/abdomen_ts3mm.f32.zst" --stdout |
		tail -c +$((122 * 101 * 4 * (112 - slices) / 2 + 1)) | head -c $((122 * 101 * 4 * slices)) >"$dir/hu.raw" || true
	sweep >"$dir/matrices.json"
	jq --argjson rows $rows '{name: "abdomen", detector: {columns: 616, rows: $rows, pixel_mm: [0.616, 0.616]},
	    projections: {count: length, sample: "float32", quantity: "line_integral"},
	    geometry: {kind: "matrices", matrices: .}}' "$dir/matrices.json" >"$dir/scan-in.json"
	cbct simulate -o "$dir" --scan "$dir/scan-in.json" --volume "$dir/hu.raw" --size 122,101,$slices --spacing 1.5 --hu \
		--step 1.5 --photons $((20000 * every)) --seed 7 --truth "$dir/truth.nii"
	reconstruct "$dir" '{"scan": "SCAN", "grid": {"size": [122, 101, '$slices'], "spacing_mm": [1.5, 1.5, 1.5]},
	    "fdk": {"window": "hann"}, "sart": {}, "tv": {"after": "sart"}, "emit": ["fdk"]}'
	local name
	for name in fdk final; do
		get_volume "$name" "$dir/$name.nii"
		# inside the body (above -500 HU), in the slices that every view sees: |z| <= 60 mm of the whole
		cbct compare --json --hu --body -500 --slices $(((slices - seen) / 2))-$(((slices + seen) / 2 - 1)) "$dir/$name.nii" "$dir/truth.nii" >"$dir/$name.json"
		expect_number "$(jq '.mean_difference | fabs' "$dir/$name.json")" '<=' 10 "mean error of $name in HU"
		echo "  RMSE of $name in HU = $(jq .rmse "$dir/$name.json")"
	done
	expect_number "$(jq -n --slurpfile a "$dir/final.json" --slurpfile b "$dir/fdk.json" '$a[0].rmse / $b[0].rmse')" '<=' 0.75 "RMSE of SART + TV over FDK"
}

if [ "${SANITIZED:-0}" != 0 ]; then
	echo "SKIP test_real.sh: too slow under a sanitizer"
	echo "skip test_real.sh: too slow under a sanitizer" >>"$RESULTS"
	exit 0
fi
start_daemon || exit 1
run_tests
