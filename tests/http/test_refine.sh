#!/usr/bin/env bash
# With "refine" the views' poses are found from the projections alone, and a geometry that fits stays as it is.
. "$(dirname "$0")/lib.sh"

# A pixel is 4.5 mm at the isocentre; source and detector wander by up to 3 mm.
shape=(--phantom asymmetric --scale 90 --density 0.02 --views 64 --arc 210 --columns 48 --rows 40 --pixel 8)
cbct simulate "${shape[@]}" -o "$work/fits" >/dev/null || exit 1
cbct simulate "${shape[@]}" --wobble 3 --kind matrices -o "$work/known" >/dev/null || exit 1
cp -r "$work/known" "$work/wanders"
cp "$work/fits/scan.json" "$work/wanders/scan.json"
grid='"grid": {"size": [40, 40, 32], "spacing_mm": [4, 4, 4]}'
recipe="{\"scan\": \"SCAN\", $grid, "

digest() {
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | select(.name == "final") | .digest'
}
told() { # CODE: the job tells it once, and no other one of these
	req GET "/v1/jobs/$job"
	expect_json "[.warnings[].code | select(IN(\"geometry_refined\", \"motion_followed\", \"not_refined\"))] == [\"$1\"]"
}

test_a_geometry_that_fits_stays() {
	local plain
	reconstruct "$work/fits" "$recipe"'"fdk": {}}'
	expect_json '.refine == {"geometry": false, "motion": false}'
	plain=$(digest)
	post_job "$recipe"'"fdk": {}, "refine": {"geometry": true}}'
	wait_job succeeded
	expect_json '.refine.geometry'
	told not_refined
	[ "$(digest)" = "$plain" ] || fail "nothing was changed, and the volume is another one"
	req POST /v1/jobs -H 'Content-Type: application/json' \
		-d "{\"scan\": \"$scan\", \"fdk\": {}, \"refine\": {\"geometry\": true, \"motion\": true}}"
	expect_problem 422 /refine
}

test_an_arm_that_wanders_is_followed_and_gone_on_with() {
	local iterations='"sart": {"iterations": 40}, "refine": {"geometry": true}}' first yielded
	post_scan "$work/wanders"
	post_projections "$work/wanders"
	post_job "$recipe$iterations"
	wait_job succeeded
	told geometry_refined
	first=$(digest)
	# A job that yields finds the same poses again, and ends with the same bits.
	post_job "$recipe$iterations"
	yielded=$job
	until req GET "/v1/jobs/$job" && jq -e '.iteration >= 2' "$body" >/dev/null; do sleep 0.02; done
	post_job "$recipe"'"fdk": {}, "priority": "stat"}'
	wait_job succeeded
	job=$yielded
	wait_job succeeded
	told geometry_refined
	[ "$(digest)" = "$first" ] || fail "the digest of the undisturbed run"
}

start_daemon
run_tests
