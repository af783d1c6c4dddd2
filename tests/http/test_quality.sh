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
	expect_json '.volumes[0].quality | has("noise_hu") and has("streak_hu") and has("ring_hu") and has("edge_mm")'
	json '.volumes[0].quality' >"$work/$1.json"
}

# The arm that took the second scan sags, its document says that it stood on a circle.
test_a_job_tells_whether_the_geometry_fits() {
	local name sag fits
	for name in circle sagging; do
		sag=() fits=true
		[ $name = circle ] || sag=(--sag daly) fits=false
		cbct simulate --phantom asymmetric --scale 70 --density 0.0192 --views 60 --arc 200 --columns 80 --rows 64 --pixel 4.8 \
			--source-to-isocentre 620 --source-to-detector 1100 "${sag[@]}" -o "$work/$name" >/dev/null || fail "cbct simulate"
		post_scan "$work/$name"
		post_projections "$work/$name"
		post_job '{"scan": "SCAN", "grid": {"size": [24, 24, 16], "spacing_mm": [6, 6, 6]}, "fdk": {}}'
		wait_job succeeded
		expect_json ".geometry_agreement | .views == 60 and .sigma_mm > 0 and (.mm < 0.1) == $fits and (.mm > 0.5) != $fits"
		expect_json "[.warnings[] | select(.code == \"geometry_wrong\" and .severity == \"serious\")] | (length == 0) == $fits"
		expect_json '.warnings | all(.code != "geometry_doubtful")'
	done
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

start_daemon || exit 1
run_tests
