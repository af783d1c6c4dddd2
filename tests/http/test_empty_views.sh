#!/usr/bin/env bash
# Views that show nothing, or do not follow those beside them, among those of a head, four of 60: told, and left out, in
# a job of all defaults; and a scan that shows nothing at all: told. Views between two steps of the signal: told, and made
# whole.
. "$(dirname "$0")/lib.sh"

head=(--phantom head --scale 60 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4
	--source-to-isocentre 620 --source-to-detector 1100 --raw air --sample float32 --photons 50000)
cbct simulate "${head[@]}" -o "$work/good" >/dev/null || exit 1
cp -r "$work/good" "$work/empty"
cp -r "$work/good" "$work/air"
cp -r "$work/good" "$work/outliers"
cbct simulate "${head[@]}" --views 120 -o "$work/dense" >/dev/null || exit 1
cp -r "$work/dense" "$work/part"
cp -r "$work/dense" "$work/dark"
cp -r "$work/dense" "$work/dose"
cp -r "$work/dense" "$work/band"
cp -r "$work/dense" "$work/aside"
cp -r "$work/dense" "$work/columns"
cp -r "$work/dense" "$work/rows"
/usr/bin/env python3 - "$work"/{good,empty,air,outliers,dense,part,dark,dose,band,aside,columns,rows}/projections.raw <<'EOF' || exit 1
import array, random, sys
random.seed(5)
pixels, views = 64 * 48, 60
good = array.array('f', open(sys.argv[1], 'rb').read())
empty = array.array('f', good)
air = array.array('f', good)
outliers = array.array('f', good)
for view in range(views):
    for i in range(pixels):
        air[view * pixels + i] = random.gauss(60000, 270)
        if view in (7, 8, 30):
            empty[view * pixels + i] = air[view * pixels + i]
        elif view == 52:
            empty[view * pixels + i] = 30000
        if view in (7, 8):
            outliers[view * pixels + i] *= 0.5
        elif view == 30:
            outliers[view * pixels + i] *= i % 64 < 32
        elif view == 52:
            outliers[view * pixels + i] = good[51 * pixels + i]
dense = array.array('f', open(sys.argv[5], 'rb').read())
part, dark, dose, band, aside, columns, rows = (array.array('f', dense) for _ in range(7))
for at in range(50 * pixels, 80 * pixels):
    dose[at] *= 0.5
    if at < 62 * pixels and at % 64 < 32:
        part[at] *= 0.01
        dark[at] = 0
    if at < 70 * pixels and 40 <= at % 64 < 52:
        band[at] *= 0.5
    if at < 70 * pixels and 40 <= at % 64 < 44:
        columns[at] *= 0.5
    if at < 70 * pixels and 20 <= at // 64 % 48 < 24:
        rows[at] *= 0.1
    if at < 65 * pixels:
        aside[at] = dense[at - min(at % 64, 5)]
for name, data in zip(sys.argv[6:], (part, dark, dose, band, aside, columns, rows)):
    open(name, 'wb').write(data.tobytes())
open(sys.argv[2], 'wb').write(empty.tobytes())
open(sys.argv[3], 'wb').write(air.tobytes())
open(sys.argv[4], 'wb').write(outliers.tobytes())
EOF
grid='"grid": {"size": [40, 40, 28], "spacing_mm": [2.8, 2.8, 2.8]}'

test_views_that_show_nothing_are_told_and_left_out() {
	reconstruct "$work/good" "{\"scan\": \"SCAN\", $grid}"
	expect_json '.warnings | all(.code != "blank_views" and .code != "no_object")'
	get_volume final "$work/good.nii"
	reconstruct "$work/empty" "{\"scan\": \"SCAN\", $grid}"
	expect_json '[.warnings[] | select(.code == "blank_views") | .severity, (.detail | test("^4 projections show nothing, the first of them is 7"))] == ["caution", true]'
	expect_json '.warnings | all(.code != "no_object")'
	expect_json '[.warnings[] | select(.code == "blank_views") | .views, .view_count, .left_out, .mended] == [[[7, 8], [30, 30], [52, 52]], 4, 4, 0]'
	expect_json '.views == {received: 60, reconstructed: 56, of: 60, left_out: 4, mended: 0}'
	req GET "/v1/jobs?scan=$scan"
	expect_json '[.jobs[].views] == [{received: 60, reconstructed: 56, of: 60, left_out: 4, mended: 0}]'
	get_volume final "$work/empty.nii"
	# What four views of 60 take away; 40 HU where they are believed.
	expect_number "$(cbct compare --json "$work/empty.nii" "$work/good.nii" | jq '.rmse / 0.0192 * 1000')" '<' 12 "RMSE in HU"
}

# Two views at half dose, one whose left half is dark, a copy of the view before.
test_views_that_do_not_follow_are_told_and_left_out() {
	reconstruct "$work/outliers" "{\"scan\": \"SCAN\", $grid}"
	for told in 'dose_steps ^2 projections, the first of them is 7,' 'dark_parts ^1 projections, the first of them is 30,' \
		'frozen_views ^1 projections, the first of them is 52,'; do
		expect_json "[.warnings[] | select(.code == \"${told%% *}\") | .severity, (.detail | test(\"${told#* }\"))] == [\"caution\", true]"
	done
	get_volume final "$work/outliers.nii"
	expect_number "$(cbct compare --json "$work/outliers.nii" "$work/good.nii" | jq '.rmse / 0.0192 * 1000')" '<' 12 "RMSE in HU"
}

# Of 120 views twelve of which a half has a hundredth of its signal, or none, and thirty with half of the dose: some 180, 30 and 70
# HU where they are believed; and twenty with a band of the columns at half of its signal.
test_views_between_two_steps_are_made_whole() {
	local row name code
	reconstruct "$work/dense" "{\"scan\": \"SCAN\", $grid}"
	expect_json '.warnings | all(.code != "dark_parts" and .code != "dose_steps")'
	json '[.warnings[].code] | sort | join(" ")' >"$work/codes"
	get_volume final "$work/dense.nii"
	for row in 'part dark_parts ^12' 'dark dark_parts ^12' 'dose dose_steps ^30' 'band dark_parts ^20'; do
		read -r name code told <<<"$row"
		reconstruct "$work/$name" "{\"scan\": \"SCAN\", $grid}"
		expect_json "[.warnings[] | select(.code == \"$code\") | .severity, (.detail | test(\"$told projections, the first of them is 50,\"))] == [\"caution\", true]"
		expect_json ".views | .reconstructed == 120 and .left_out == 0 and .mended == ${told#^}"
		expect_json "[.warnings[] | select(.code == \"$code\") | .views, .mended] == [[[50, 49 + ${told#^}]], ${told#^}]"
		# and by that warning alone
		[ "$(json "[.warnings[].code | select(. != \"$code\")] | sort | join(\" \")")" = "$(cat "$work/codes")" ] ||
			fail "$name: other warnings than those of the good scan"
		get_volume final "$work/$name.nii"
		expect_number "$(cbct compare --json "$work/$name.nii" "$work/dense.nii" | jq '.rmse / 0.0192 * 1000')" '<' 5 "$name: RMSE in HU"
	done
}

# A job of FDK alone keeps no projections, and does as well: all of them are kept once it is known that views are spoiled.
test_fdk_alone_makes_views_whole() {
	local row name code told
	reconstruct "$work/dense" "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	get_volume final "$work/fdk.nii"
	for row in 'part dark_parts ^12' 'dose dose_steps ^30' 'band dark_parts ^20' 'aside shifted_views ^15' \
		'columns dark_parts ^20' 'rows dark_parts ^20'; do
		read -r name code told <<<"$row"
		reconstruct "$work/$name" "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
		expect_json "[.warnings[] | select(.code == \"$code\") | .detail | test(\"$told projections, the first of them is 50,\")] == [true]"
		expect_json '.warnings | all(.code != "spoiled_views" and .code != "geometry_wrong")'
		get_volume final "$work/$name.nii"
		expect_number "$(cbct compare --json "$work/$name.nii" "$work/fdk.nii" | jq '.rmse / 0.0192 * 1000')" '<' "$([ "$name" = aside ] && echo 30 || echo 5)" "$name: RMSE in HU"
	done
}

# Fifteen of 120 views that lie five columns aside.
test_a_run_of_views_aside_is_told_and_left_out() {
	reconstruct "$work/aside" "{\"scan\": \"SCAN\", $grid}"
	expect_json '[.warnings[] | select(.code == "shifted_views") | .severity, (.detail | test("^15 projections, the first of them is 50, lie aside .* They are left out"))] == ["serious", true]'
	[ -f "$work/dense.nii" ] || fail "the good scan was not reconstructed"
	get_volume final "$work/aside.nii"
	expect_number "$(cbct compare --json "$work/aside.nii" "$work/dense.nii" | jq '.rmse / 0.0192 * 1000')" '<' 20 "RMSE in HU"
}

# put_view N of the spoiled scan
put_view() {
	local bytes=$((64 * 48 * 4))
	dd if="$work/outliers/projections.raw" of="$work/view" bs=$bytes skip="$1" count=1 status=none
	req PUT "/v1/scans/$scan/projections/$1" --data-binary @"$work/view"
	expect_status 201
}
outcome() {
	req GET "/v1/jobs/$job"
	json '.warnings | sort_by(.code)[] | .code, .detail'
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | .name, .digest'
}

# Spoiled views are found, and left out, to the same bits in any order of arrival, and when the worker is killed.
test_spoiled_views_give_the_same_bits_however_they_come() {
	local whole="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 4}, \"emit\": [\"fdk\"]}" late i
	reconstruct "$work/outliers" "$whole"
	outcome >"$work/expected"
	# backwards, while the job waits for them
	post_scan "$work/outliers"
	post_job "$whole"
	for ((i = 59; i >= 0; i--)); do put_view $i; done
	wait_job succeeded
	outcome | diff "$work/expected" - || fail "other bits of views that come backwards"
	# every second one first, and the worker killed between
	post_scan "$work/outliers"
	post_job "$whole"
	for ((i = 0; i < 60; i += 2)); do put_view $i; done
	kill -9 "$(worker_of)"
	for ((i = 1; i < 60; i += 2)); do put_view $i; done
	wait_job succeeded
	outcome | diff "$work/expected" - || fail "other bits behind a killed worker"
	# killed while the job runs, which then waits for a more urgent one
	post_job "$whole"
	late=$job
	state_becomes running
	kill -9 "$(worker_of)"
	post_job "{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"priority\": \"stat\"}"
	wait_job succeeded
	job=$late
	wait_job succeeded
	outcome | diff "$work/expected" - || fail "other bits of a job that began anew"
}

test_a_scan_of_air_is_told() {
	reconstruct "$work/air" "{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"
	expect_json '[.warnings[] | select(.code == "no_object") | .severity] == ["serious"]'
	expect_json '.warnings | all(.code != "blank_views")'
}

start_daemon
run_tests
