#!/usr/bin/env bash
# Pixels that are stuck at 70 % of the flat, and edges of the detector behind a collimator: found from the views, told,
# and replaced or left out, whether the job comes before its projections or after them.
. "$(dirname "$0")/lib.sh"

ball=(--phantom head --scale 60 --density 0.02 --views 60 --arc 360 --columns 80 --rows 64 --pixel 3
	--source-to-isocentre 620 --source-to-detector 1100 --raw air --sample float32)
cbct simulate "${ball[@]}" -o "$work/good" >/dev/null || exit 1
cp -r "$work/good" "$work/stuck"
# 1 % of the pixels, in every view; 60000 is air
/usr/bin/env python3 - "$work/stuck/projections.raw" <<'EOF' || exit 1
import array, random, sys
random.seed(3)
pixels, views = 80 * 64, 60
data = array.array('f', open(sys.argv[1], 'rb').read())
for i in random.sample(range(pixels), pixels // 100):
    for view in range(views):
        data[view * pixels + i] = 42000
open(sys.argv[1], 'wb').write(data.tobytes())
EOF
# The first 4 and the last 6 columns lie behind a collimator that lets 3 % through, one pixel with an error of its own,
# as a ring has, in between; the same counts as line integrals.
cp -r "$work/good" "$work/collimated" && cp -r "$work/good" "$work/integrals" || exit 1
/usr/bin/env python3 - "$work" <<'EOF' || exit 1
import array, json, math, sys
work = sys.argv[1]
data = array.array('f', open(f'{work}/good/projections.raw', 'rb').read())
for i in range(len(data)):
    if i % 80 < 4 or i % 80 >= 74:
        data[i] *= 0.03
    if i % 80 == 30 and i // 80 % 64 % 3 == 1:
        data[i] *= 1.03
open(f'{work}/collimated/projections.raw', 'wb').write(data.tobytes())
open(f'{work}/integrals/projections.raw', 'wb').write(array.array('f', [-math.log(x / 60000) for x in data]).tobytes())
document = json.load(open(f'{work}/good/scan.json'))
document['projections']['quantity'] = 'line_integral'
del document['projections']['air']
json.dump(document, open(f'{work}/integrals/scan.json', 'w'))
EOF
grid='"grid": {"size": [48, 48, 36], "spacing_mm": [2.2, 2.2, 2.2]}'
recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"

digest() {
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | select(.name == "final") | .digest'
}
stuck_told() {
	req GET "/v1/jobs/$job"
	expect_json '[.warnings[] | select(.code == "stuck_pixels")] | length == 1 and .[0].severity == "caution"'
}
# HU between the volume of $job and that of the good detector, root mean square
distance() {
	get_volume final "$work/volume.nii"
	cbct compare --json "$work/volume.nii" "$work/good.nii" | jq '.rmse / 0.0192 * 1000'
}

test_stuck_pixels_are_found_told_and_replaced() {
	local after early
	reconstruct "$work/good" "$recipe"
	expect_json '[.warnings[] | select(.code == "stuck_pixels")] | length == 0'
	get_volume final "$work/good.nii"
	reconstruct "$work/stuck" "$recipe"
	stuck_told
	after=$(digest)
	# 400 HU where they are believed; what a pixel of 3 mm hides from its neighbours stays
	expect_number "$(distance)" '<' 40 "RMSE in HU"
	# The job comes first and takes the projections in as they arrive: the same bits.
	post_scan "$work/stuck"
	post_job "$recipe"
	post_projections "$work/stuck"
	wait_job succeeded
	stuck_told
	early=$(digest)
	[ "$early" = "$after" ] || fail "the bits of the job that came after its projections"
}

# A job that makes room for a more urgent one goes on with the pixels that it found before, and ends with the same bits.
test_stuck_pixels_stay_replaced_in_a_run_that_goes_on() {
	local sart="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 40}}" undisturbed first
	reconstruct "$work/stuck" "$sart"
	stuck_told
	undisturbed=$(digest)
	post_job "$sart"
	first=$job
	state_becomes running
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"priority\": \"stat\"}"
	wait_job succeeded
	job=$first
	wait_job succeeded
	[ "$(digest)" = "$undisturbed" ] || fail "the bits of the job that was not disturbed"
}

shadow_told() { # words of the detail
	req GET "/v1/jobs/$job"
	expect_json '[.warnings[] | select(.code == "detector_shadow")] | length == 1 and .[0].severity == "serious" and
		(.[0].detail | startswith("the first 4 and the last 6 of 80 columns are darker")) and
		(.[0].detail | contains("'"$1"'"))'
}
# 1,336 HU where the shadow is believed, and told as truncated alone. The ball ends within what is left.
test_edges_behind_a_collimator_are_told_and_left_out() {
	local rings="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"rings\": true}" after name
	local -A words=([collimated]='no flat image to divide by' [integrals]='as where line integrals were made with')
	reconstruct "$work/good" "$recipe"
	expect_json '[.warnings[] | select(.code == "detector_shadow")] | length == 0'
	get_volume final "$work/good.nii"
	for name in collimated integrals; do
		reconstruct "$work/$name" "$rings"
		shadow_told "${words[$name]}"
		expect_json '[.warnings[] | select(.code == "rings")] | length == 1'
		expect_json '[.warnings[] | select(.code == "truncated" or .code == "stuck_pixels")] | length == 0'
		after=$(digest)
		expect_number "$(distance)" '<' 20 "RMSE in HU"
		post_scan "$work/$name"
		post_job "$rings"
		post_projections "$work/$name"
		wait_job succeeded
		shadow_told "${words[$name]}"
		[ "$(digest)" = "$after" ] || fail "the bits of the job that came after its projections"
	done
}

start_daemon
run_tests
