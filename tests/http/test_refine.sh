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
	expect_json "[.warnings[].code | select(IN(\"geometry_refined\", \"geometry_by_reference\", \"motion_followed\", \"not_refined\"))] == [\"$1\"]"
}

keep() { # JOB: what it has refined becomes a calibration
	req POST /v1/calibrations -H 'Content-Type: application/json' -d "{\"job\": \"$1\", \"arm\": \"left\"}"
}
test_a_geometry_that_fits_stays() {
	local plain
	reconstruct "$work/fits" "$recipe"'"fdk": {}}'
	expect_json '.refine == {"geometry": false, "motion": false} and .refinement == null'
	req GET "/v1/jobs/$job/refinement"
	expect_problem 404
	keep "$job"
	expect_problem 422 /job
	keep nothing
	expect_problem 404 /job
	plain=$(digest)
	post_job "$recipe"'"fdk": {}, "refine": {"geometry": true}}'
	wait_job succeeded
	expect_json '.refine.geometry'
	told not_refined
	expect_json '.refinement == .href + "/refinement"'
	[ "$(digest)" = "$plain" ] || fail "nothing was changed, and the volume is another one"
	req GET "/v1/jobs/$job/refinement"
	expect_json '.accepted == false and .views == [] and .geometry == null and .rms_mm == 0 and .held_out.views == 8'
	req GET "/v1/jobs/$job/refinement?format=png"
	expect_problem 409
	req GET "/v1/jobs/$job/refinement?format=gif"
	expect_problem 400
	keep "$job"
	expect_problem 409 /job
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
	# A job that yields amid its refinement and behind it goes on, and ends with the same bits.
	post_job "$recipe$iterations"
	yielded=$job
	until req GET "/v1/jobs/$job" && member '.state == "running"' "$body" >/dev/null; do sleep 0.02; done
	post_job "$recipe"'"fdk": {}, "priority": "stat"}'
	wait_job succeeded
	job=$yielded
	until req GET "/v1/jobs/$job" && member '.iteration >= 2' "$body" >/dev/null; do sleep 0.02; done
	post_job "$recipe"'"fdk": {}, "priority": "stat"}'
	wait_job succeeded
	job=$yielded
	wait_job succeeded
	told geometry_refined
	[ "$(digest)" = "$first" ] || fail "the digest of the undisturbed run"
	[ ! -e "$state/jobs/$job/refining" ] || fail "what a refinement has reached stays behind its end"
}

# rmse_of SCAN: error of its FDK volume against the head's truth
rmse_of() {
	reconstruct "$1" "${recipe/40, 32/40, 40}"'"fdk": {}}'
	cbct get "$job" final -o "$work/head.nii" >/dev/null || fail "its volume"
	cbct compare --json "$work/head.nii" "$work/head-truth.nii" | jq .rmse
}

# The same arm (the seed of its wander) takes another object, with fewer views, by the calibration that was kept.
test_a_refined_geometry_is_kept_for_the_arm_s_next_scan() {
	local head=(--phantom head --scale 85 --density 0.02 --arc 210 --columns 48 --rows 40 --pixel 8 --views 64)
	local calibration nominal kept true
	post_scan "$work/wanders"
	post_projections "$work/wanders"
	post_job "$recipe"'"fdk": {}, "refine": {"geometry": true}}'
	wait_job succeeded
	req GET "/v1/jobs/$job/refinement"
	expect_json '.kind == "geometry" and .accepted and (.views | length) == 64 and (.geometry.matrices | length) == 64 and .rms_mm > 0.5 and
		.most_mm >= .rms_mm and .held_out.better > 4 and (.views | map(.projection)) == [range(64)]'
	keep "$job"
	expect_status 202
	calibration=$(jq -r .id "$body")
	expect_json ".state == \"succeeded\" and .job == \"$job\" and .scan == \"$scan\" and .arm == \"left\" and .phantom == null and .balls_mm == null and .warnings == [] and
		(.geometry.matrices | length) == 64 and .sweep.views == 64"
	req GET "/v1/calibrations/$calibration/views/0"
	expect_problem 404
	cbct refinement "$job" >"$work/table" 2>"$work/said" || fail "$(cat "$work/said")"
	[ "$(wc -l <"$work/table")" = 65 ] || fail "a line for each view: $(cat "$work/table")"
	cbct refinement "$job" --plot "$work/plot.png" || fail "a plot"
	req GET "/v1/jobs/$job/refinement?format=png"
	expect_status 200
	[ "$(header content-type)" = image/png ] || fail "its type: $(header content-type)"
	cmp "$body" "$work/plot.png" || fail "the daemon's plot is that of the client"
	cbct refinement "$job" --keep --arm right >"$work/kept" || fail "what it has kept"
	/usr/bin/python3 - "$url" "$job" <<-'END' || fail "what Python has asked for"
		import sys
		sys.path.insert(0, "clients/python")
		import cbctd
		url, job = sys.argv[1:]
		with cbctd.Client(url) as client:
		    assert client.refinement(job)["accepted"] and client.refinement_plot(job)[:4] == b"\x89PNG"
		    kept = client.keep_refinement(job, arm="middle")
		    assert kept["job"] == job and client.calibration(kept["id"])["geometry"] == client.refinement(job)["geometry"]
	END
	cbct calibrations | grep "^$(cat "$work/kept") .* right$" >/dev/null || fail "$(cbct calibrations)"
	# A file that is gone is told as that, not as something that was never done.
	mv "$state/jobs/$job/refinement.json" "$work/"
	req GET "/v1/jobs/$job/refinement"
	expect_problem 500
	expect_json '.type == "urn:cbctd:problem:damaged"'
	keep "$job"
	expect_problem 500
	# Nor does anybody wait for a pipe in its place.
	mkfifo "$state/jobs/$job/refinement.json"
	req GET "/v1/jobs/$job/refinement" --max-time 20
	expect_problem 500
	expect_json '.type == "urn:cbctd:problem:damaged"'
	mv "$work/refinement.json" "$state/jobs/$job/"

	cbct simulate "${head[@]}" --wobble 3 --kind matrices --truth "$work/head-truth.nii" --grid 40 --spacing 4 -o "$work/head" >/dev/null
	cbct simulate "${head[@]}" -o "$work/head-nominal" >/dev/null
	true=$(rmse_of "$work/head")
	cp "$work/head-nominal/scan.json" "$work/head/scan.json"
	nominal=$(rmse_of "$work/head")
	jq -c ".geometry = {kind: \"calibration\", id: \"$calibration\"}" "$work/head-nominal/scan.json" >"$work/head/scan.json"
	kept=$(rmse_of "$work/head")
	expect_number "$(jq -n "($kept - $true) / ($nominal - $true)")" '<' 0.5 "the share of the circle's error above the true views' that stays"
}

# Two of its views never come: those that did are kept, and a scan has the places of the others between them.
test_a_scan_that_lacks_views_is_kept_with_those_it_has() {
	local bytes=$((48 * 40 * 4)) run calibration
	post_scan "$work/wanders"
	for run in 0-9 11-40 42-63; do
		dd if="$work/wanders/projections.raw" of="$work/run" bs=$bytes skip=${run%-*} count=$((${run#*-} - ${run%-*} + 1)) status=none
		req PUT "/v1/scans/$scan/projections/$run" --data-binary @"$work/run"
		expect_status 201
	done
	req POST "/v1/scans/$scan/complete"
	post_job "$recipe"'"fdk": {}, "refine": {"geometry": true}}'
	wait_job succeeded
	told geometry_refined
	keep "$job"
	expect_status 202
	calibration=$(jq -r .id "$body")
	expect_json '.state == "succeeded" and .sweep.views == 62 and (.geometry.matrices | length) == 62'
	jq -c ".geometry = {kind: \"calibration\", id: \"$calibration\", first_angle_deg: 0, angle_step_deg: (210 / 63)}" "$work/fits/scan.json" >"$work/by-angle.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/by-angle.json"
	expect_status 201
	expect_json '(.geometry.matrices | length) == 64 and any(.warnings[]; .code == "calibration_interpolated")'
}

refer() { # JOB [GRID]: a job of $scan that refines with that one's volume
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", ${2:-$grid}, \"fdk\": {}, \"refine\": {\"geometry\": true, \"reference\": {\"job\": \"$1\"}}}"
}
# 30 noisy views are too few to be refined alone; the volume of a good scan of the same object says where they stood.
test_few_noisy_views_are_refined_with_the_volume_of_another_job() {
	local few=("${shape[@]/64/30}" --photons 3000) good plain refined waiting
	grid='"grid": {"size": [40, 40, 40], "spacing_mm": [4, 4, 4]}' recipe="{\"scan\": \"SCAN\", $grid, "
	cbct simulate "${few[@]}" --wobble 3 --kind matrices --truth "$work/head-truth.nii" --grid 40 --spacing 4 -o "$work/few" >/dev/null
	cbct simulate "${few[@]}" -o "$work/few-nominal" >/dev/null
	cp "$work/few-nominal/scan.json" "$work/few/scan.json"
	plain=$(rmse_of "$work/few")
	reconstruct "$work/fits" "$recipe"'"fdk": {}}'
	good=$job
	post_scan "$work/few"
	refer nothing
	expect_problem 404 /refine/reference/job
	refer "$good" '"grid": {"size": [40, 40, 40], "spacing_mm": [4, 4, 4], "origin_mm": [10, 10, -10]}'
	expect_problem 422 /refine/reference/job
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"fdk\": {}, \"refine\": {\"reference\": {\"job\": \"$good\"}}}"
	expect_problem 422 /refine/reference
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"fdk\": {}, \"refine\": {\"geometry\": true, \"reference\": {\"volume\": 1}}}"
	expect_problem 400 /refine/reference/volume
	refer "$good"
	expect_status 202
	expect_json ".state == \"waiting\" and .refine == {geometry: true, motion: false, reference: {job: \"$good\"}}"
	waiting=$(jq -r .id "$body")
	refer "$waiting"
	expect_problem 409 /refine/reference/job
	req DELETE "/v1/jobs/$good"
	expect_problem 409
	post_projections "$work/few"
	job=$waiting
	wait_job succeeded
	told geometry_by_reference
	expect_json '.warnings[] | select(.code == "geometry_by_reference") | .severity == "caution" and (.detail | test("the world by [0-9.]+ mm and [0-9.]+ degrees"))'
	cbct get "$job" final -o "$work/head.nii" >/dev/null || fail "its volume"
	refined=$(cbct compare --json "$work/head.nii" "$work/head-truth.nii" | jq .rmse)
	expect_number "$refined" '<' "$(jq -n "$plain * .99")" "the error with the reference, below that without"
	req GET "/v1/jobs/$job/refinement"
	expect_json '.reference > 0.7 and .accepted'

	# What was found is kept: a job that goes on from its checkpoint, or began again without any, does not look for it again.
	local reference=$state/jobs/$good/final.nii found
	[ -e "$reference" ] || fail "the reference's voxels: $(ls "$state/jobs/$good"/*)"
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 300},
		\"refine\": {\"geometry\": true, \"reference\": {\"job\": \"$good\"}}}"
	expect_status 202
	waiting=$(jq -r .id "$body")
	until req GET "/v1/jobs/$waiting" && member '.iteration >= 2' "$body" >/dev/null; do sleep 0.02; done
	req GET "/v1/jobs/$waiting/refinement"
	found=$(jq -cS . "$body")
	mv "$reference" "$work/"
	kill -9 "$(worker_of)"
	until req GET "/v1/jobs/$waiting" && member '.attempts == 2 and .iteration >= 2' "$body" >/dev/null; do
		[ "$(json .state)" != failed ] || fail "a job that had refined its geometry: $(json .error)"
		sleep 0.02
	done
	post_job "$recipe"'"fdk": {}, "priority": "stat"}'
	wait_job succeeded
	job=$waiting
	wait_job succeeded
	req GET "/v1/jobs/$waiting/refinement"
	[ "$(jq -cS . "$body")" = "$found" ] || fail "what was found before"
	mv "$work/final.nii" "$reference"

	# That of another job, of the same scan, is no job's own: it looks again, for which it wants the reference.
	local other
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 300},
		\"refine\": {\"geometry\": true, \"reference\": {\"job\": \"$good\"}}}"
	expect_status 202
	other=$(jq -r .id "$body")
	until req GET "/v1/jobs/$other" && member '.iteration >= 2' "$body" >/dev/null; do sleep 0.02; done
	cp "$state/jobs/$waiting/refinement.json" "$state/jobs/$other/"
	mv "$reference" "$work/"
	kill -9 "$(worker_of)"
	job=$other
	wait_job failed
	expect_json '.error.detail | test("reference")'
	mv "$work/final.nii" "$reference"
	req DELETE "/v1/jobs/$good"
	expect_status 204
}

# A ball goes up and down by 12 mm nine times in the sweep within what rests, as a diaphragm does: nothing rigid mends that.
test_what_breathes_is_told_and_no_motion_mends_it() {
	local at sweep=(--density 0.02 --views 96 --arc 210 --columns 48 --rows 40 --pixel 8)
	cbct simulate --phantom asymmetric --scale 90 "${sweep[@]}" -o "$work/rests" >/dev/null || fail "cbct simulate"
	for at in 0 3 6 9 12; do
		cbct simulate --phantom ball --scale 30 --shift "15,5,$at" "${sweep[@]}" -o "$work/ball-$at" >/dev/null || fail "cbct simulate"
	done
	cp -r "$work/rests" "$work/breathes"
	cp -r "$work/rests" "$work/stops" # its ventilator half way
	/usr/bin/python3 - "$work" <<-'END' || fail "the ball's projections in turn, added to the others"
		import array, math, sys
		work = sys.argv[1]
		def read(name):
		    values = array.array("f")
		    with open(f"{work}/{name}/projections.raw", "rb") as file:
		        values.frombytes(file.read())
		    return values
		balls = [read(f"ball-{at}") for at in (0, 3, 6, 9, 12)]
		for name, depth, until in (("rests", 0, 96), ("breathes", 4, 96), ("stops", 4, 48)):
		    all = read(name)
		    for i in range(len(all)):
		        view = i // (48 * 40)
		        all[i] += balls[round(depth * math.cos(math.pi * 9 * view / 96) ** 4) if view < until else 0][i]
		    with open(f"{work}/{name}/projections.raw", "wb") as file:
		        all.tofile(file)
	END
	reconstruct "$work/rests" "$recipe"'"fdk": {}}'
	expect_json '.warnings | all(.code != "breathing")'
	for at in stops breathes; do
		reconstruct "$work/$at" "$recipe"'"fdk": {}}'
		expect_json '[.warnings[] | select(.code == "breathing" and .severity == "caution" and
			(.detail | test("or for a part of it, as often as about (8|9|10) times in a whole one")))] | length == 1'
	done
	post_job "$recipe"'"fdk": {}, "refine": {"motion": true}}'
	wait_job succeeded
	expect_json '[.warnings[] | select(.code == "breathing")] | length == 1'
}

# ---- what poses that were found are worth in the image ----

# An object that is seen from other poses than the circle's that the scan tells of (tests/http/poses.py): exact integrals,
# 100,000 photons, pixels of 2.5 mm at the isocentre.
poses() { /usr/bin/python3 "$here/poses.py" "$@" || fail "poses.py $*"; }
moved=(--phantom asymmetric --scale 90 --density 0.0192)
sweep=(--views 96 --arc 210 --columns 84 --rows 66 --pixel 4.5 --kind views)
fine='"grid": {"size": [84, 84, 72], "spacing_mm": [2.2, 2.2, 2.2]}, "fdk": {"window": "ram-lak"}'

take() { # NAME, of the poses in NAME.json
	cbct simulate "${moved[@]}" --photons 100000 --scan "$work/$1.json" -o "$work/$1" >/dev/null || fail "cbct simulate"
}
show() { # NAME POSES.json OF [MEMBERS]: NAME.raw, the volume of the projections of OF by these poses
	mkdir -p "$work/$1"
	cp "$work/$3/projections.raw" "$work/$1/"
	cp "$2" "$work/$1/scan.json"
	reconstruct "$work/$1" "{\"scan\": \"SCAN\", $fine${4:-}}"
	get_volume final "$work/$1.raw" format=raw
}
# follow OF KIND: the volumes by the true poses, by those told, and refined; the last two also where they fit the true ones
# best, as a whole, since no scan tells where the object lay. mm_told and mm_found: how far points lie aside there.
follow() {
	show still "$work/circle/scan.json" circle
	show true "$work/$1.json" "$1"
	show told "$work/circle/scan.json" "$1"
	show refined "$work/circle/scan.json" "$1" ", \"refine\": {\"$2\": true}"
	req GET "/v1/jobs/$job/refinement"
	expect_json .accepted
	cp "$body" "$work/found"
	mm_told=$(poses place "$work/$1.json" "$work/circle/scan.json" - "$work/told.json" | cut -d' ' -f1)
	mm_found=$(poses place "$work/$1.json" "$work/circle/scan.json" "$work/found" "$work/found.json" | cut -d' ' -f1)
	show told-best "$work/told.json" "$1"
	show refined-best "$work/found.json" "$1"
	poses compare "$work/body.nii" "$work"/{true,told,refined,told-best,refined-best,still}.raw >"$work/hu"
}
hu() { # VOLUME truth|first: its error, or its difference from the volume by the true poses
	jq ".[\"$1\"].$2" "$work/hu"
}
simulate_circle() {
	cbct simulate "${moved[@]}" "${sweep[@]}" --truth "$work/body.nii" --grid 84,84,72 --spacing 2.2 -o "$work/circle" >/dev/null || fail "cbct simulate"
}

# The image is that of the true poses but for where the object lies, of which no scan tells; and there it is no farther
# off than with the circle.
test_a_tenth_of_the_sag_is_taken_off_the_image() {
	local mm_told mm_found
	simulate_circle
	cbct simulate "${moved[@]}" "${sweep[@]}" --sag daly -o "$work/sags" >/dev/null || fail "cbct simulate"
	poses tenth "$work/circle/scan.json" "$work/sags/scan.json" "$work/tenth.json"
	take tenth
	follow tenth geometry
	expect_number "$mm_found" '<' "$(jq -n "$mm_told * .5")" "mm aside"
	expect_number "$(hu refined-best first)" '<' "$(jq -n "$(hu told-best first) * .5")" "HU that the image differs from that by the true poses"
	expect_number "$(hu refined-best truth)" '<' "$(jq -n "$(hu true truth) * 1.05")" "HU, its error"
	expect_number "$(hu refined first)" '<=' "$(hu told first)" "HU that it differs where the object lies"
}

# Its error is at most 1.15 times that of the object at rest: 1.25 where nothing says how large the object is, and a path
# makes it larger by a quarter of a percent.
test_a_nod_is_taken_off_the_image() {
	local mm_told mm_found
	simulate_circle
	poses nod "$work/circle/scan.json" "$work/nod.json"
	take nod
	follow nod motion
	expect_number "$(hu told truth)" '>' "$(jq -n "$(hu still truth) * 1.5")" "HU, the error with the nod"
	expect_number "$mm_found" '<' "$(jq -n "$mm_told * .3")" "mm aside"
	expect_number "$(hu refined-best first)" '<' "$(jq -n "$(hu told-best first) * .33")" "HU that the image differs from that by the true poses"
	expect_number "$(hu refined-best truth)" '<' "$(jq -n "$(hu still truth) * 1.15")" "HU, its error"
}

start_daemon --checkpoint-seconds 3600
run_tests
