#!/usr/bin/env bash
# Pixels whose gain has changed by a per cent since the flat image: with "rings": true they are found from all views and
# mended, from counts and from line integrals, whether the job comes before its projections or after them.
. "$(dirname "$0")/lib.sh"

head=(--phantom head --scale 60 --density 0.02 --views 90 --arc 360 --columns 160 --rows 96 --pixel 1.5
	--source-to-isocentre 620 --source-to-detector 1100)
for quantity in counts integrals; do
	raw=()
	[ $quantity = integrals ] || raw=(--raw air --sample float32)
	cbct simulate "${head[@]}" "${raw[@]}" -o "$work/$quantity" >/dev/null || exit 1
	cp -r "$work/$quantity" "$work/$quantity-drifted"
	# 1 % more or less in every view, of one pixel of two hundred
	/usr/bin/env python3 - "$work/$quantity-drifted/projections.raw" $quantity <<'EOF' || exit 1
import array, math, random, sys
random.seed(3)
pixels, views = 160 * 96, 90
data = array.array('f', open(sys.argv[1], 'rb').read())
for i in random.sample(range(pixels), pixels // 200):
    gain = random.choice((0.99, 1.01))
    for view in range(views):
        at = view * pixels + i
        data[at] = data[at] * gain if sys.argv[2] == 'counts' else data[at] - math.log(gain)
open(sys.argv[1], 'wb').write(data.tobytes())
EOF
done
grid='"grid": {"size": [72, 72, 24], "spacing_mm": [1.5, 1.5, 1.5]}'
recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}"

digest() {
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | select(.name == "final") | .digest'
}
# told N: so many warnings of rings
told() {
	req GET "/v1/jobs/$job"
	expect_json "[.warnings[] | select(.code == \"rings\")] | length == $1 and all(.severity == \"info\")"
}
# HU between the volume of $job and $work/true.nii, root mean square
distance() {
	get_volume final "$work/volume.nii"
	cbct compare --json "$work/volume.nii" "$work/true.nii" | jq '.rmse / 0.0192 * 1000'
}

mends() { # QUANTITY
	local plain drifted left after
	reconstruct "$work/$1" "$recipe}"
	expect_json '.rings == false'
	plain=$(digest)
	get_volume final "$work/true.nii"
	reconstruct "$work/$1" "$recipe, \"rings\": true}"
	expect_json '.rings'
	told 0
	[ "$(digest)" = "$plain" ] || fail "nothing was wrong, and the volume is another one"
	reconstruct "$work/$1-drifted" "$recipe}"
	told 0
	drifted=$(distance)
	reconstruct "$work/$1-drifted" "$recipe, \"rings\": true}"
	told 1
	left=$(distance)
	expect_number "$(jq -n "$left / $drifted")" '<=' 0.2 "share of the rings' RMS of $drifted HU that is left"
	after=$(digest)
	# The job comes first and takes the projections in as they arrive: the same bits.
	post_scan "$work/$1-drifted"
	post_job "$recipe, \"rings\": true}"
	post_projections "$work/$1-drifted"
	wait_job succeeded
	told 1
	[ "$(digest)" = "$after" ] || fail "the bits of the job that came after its projections"
}

test_rings_of_counts_are_mended() {
	mends counts
}

test_rings_of_line_integrals_are_mended() {
	mends integrals
}

# A job that makes room for a more urgent one goes on with what it found before, and ends with the same bits.
test_a_run_that_goes_on_has_the_same_pixels() {
	local sart="$recipe, \"sart\": {\"iterations\": 30}, \"rings\": true}" undisturbed first
	reconstruct "$work/counts-drifted" "$sart"
	told 1
	undisturbed=$(digest)
	post_job "$sart"
	first=$job
	state_becomes running
	post_job "$recipe, \"priority\": \"stat\"}"
	wait_job succeeded
	job=$first
	wait_job succeeded
	told 1
	[ "$(digest)" = "$undisturbed" ] || fail "the bits of the job that was not disturbed"
}

start_daemon
run_tests
