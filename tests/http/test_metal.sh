#!/usr/bin/env bash
# Metal, the whole way: raw counts of a body with screws, rods, a wire and a vessel, against the same body without them.
. "$(dirname "$0")/lib.sh"

python=${PYTHON:-/usr/bin/python3}
metal() { "$python" "$top/tests/http/metal.py" "$@"; }
need_numpy() { "$python" -c 'import numpy' 2>/dev/null || skip "python3-numpy is not here"; }
stop_after_each=1

prepare() { # the volume of the body alone, once
	need_numpy
	start_daemon
	[ ! -e "$work/clean.raw" ] || return 0
	metal make clean "$work/clean"
	reconstruct "$work/clean" "{\"scan\": \"SCAN\", \"grid\": $(metal grid), \"fdk\": {}, \"metal\": {}}"
	expect_json '[.warnings[].code] | index("no_metal") and (index("metal") | not)'
	get_volume final "$work/clean.raw" format=raw
	req GET "/v1/jobs/$job/volumes"
	expect_json '.volumes | all(has("metal") | not)'
}

# volumes CASE [METAL]: $work/CASE-fdk.raw and -final.raw, with METAL as the job's "metal"
volumes() {
	local case=$1 name
	[ -e "$work/$case" ] || metal make "$case" "$work/$case"
	reconstruct "$work/$case" "{\"scan\": \"SCAN\", \"grid\": $(metal grid), \"fdk\": {}, \"sart\": {\"iterations\": 2}, \"emit\": [\"fdk\"], \"metal\": ${2:-null}}"
	for name in fdk final; do
		get_volume "$name" "$work/$case-$name.raw" format=raw
		metal beside "$case" "$work/clean.raw" "$work/$case-$name.raw" >"$work/$case-$name-${2:+with}.json"
	done
}
of() { jq ".$1" "$work/$2.json"; } # of FIGURE CASE-NAME-with

# CASE MOST: with "metal" at most so many times the error of without it, FDK and SART
not_worse() {
	local name
	for name in fdk final; do
		expect_number "$(of rmse "$1-$name-with")" '<' "$(jq ".rmse * $2" "$work/$1-$name-.json")" "$1, $name: HU beside the metal"
	done
}
told() { # once, with severity and a sentence, and in the document of each volume
	req GET "/v1/jobs/$job"
	expect_json '[.warnings[] | select(.code == "metal")] | length == 1 and .[0].severity == "caution" and (.[0].summary | test("within 10 mm of it is an estimate"))'
	req GET "/v1/jobs/$job/volumes"
	expect_json '(.volumes | length == 2) and (.volumes | all(.metal == {"estimate_within_mm": 10}))'
	expect_json '.volumes | all(.quality | .metal_share > 0 and .metal_share < 0.05 and .estimated_share > 3 * .metal_share and .estimated_share < 0.5)'
	req GET "/v1/jobs/$job/events" --max-time 5
	grep -q '"metal":{"estimate_within_mm":10}' "$body" || fail "the event of a volume with metal"
	req GET "/plain/$job"
	grep -q 'Within 10 mm of metal this volume is an estimate' "$body" || fail "the page without scripts"
}

test_rods_are_not_made_worse() {
	prepare
	volumes rods
	volumes rods '{}'
	told
	not_worse rods 1.1
	expect_number "$(of 'bone | fabs' rods-fdk-with)" '<' 60 "HU of bone in the mean"
	expect_number "$(of 'bone | fabs' rods-final-with)" '<' 60 "HU of bone in the mean after SART"
}

# Some samples between them have no counts at all.
test_screws_leave_bone_as_it_is() {
	local name
	prepare
	volumes screws
	expect_number "$(metal dark "$work/screws")" '>' 100 "samples without counts"
	volumes screws '{}'
	told
	not_worse screws .35
	for name in fdk final; do
		expect_number "$(of 'bone | fabs' "screws-$name-with")" '<' 60 "$name: HU of bone in the mean"
	done
}

# 40 % of the wire and a third of the vessel were gone.
test_what_is_thin_stays_whole() {
	local case name
	prepare
	for case in 'wire {"threshold_hu":1400}' 'vessel {"threshold_hu":2000}'; do
		volumes "${case% *}"
		volumes "${case% *}" "${case#* }"
		told
		not_worse "${case% *}" 1.1
		for name in fdk final; do
			expect_number "$(jq -s '.[1].mass / .[0].mass' "$work/${case% *}-fdk-.json" "$work/${case% *}-$name-with.json")" '>' .9 "${case% *}, $name: of its mass"
		done
	done
}

# By default, on a grid whose sides cut two of four screws.
test_a_grid_may_cut_the_metal() {
	local name with
	export SIZE=40,30,30
	need_numpy
	start_daemon
	metal make clean "$work/within"
	metal make screws "$work/cut"
	reconstruct "$work/within" "{\"scan\": \"SCAN\", \"grid\": $(metal grid), \"fdk\": {}}"
	get_volume final "$work/within.raw" format=raw
	for with in null '{}'; do
		reconstruct "$work/cut" "{\"scan\": \"SCAN\", \"grid\": $(metal grid), \"emit\": [\"fdk\"], \"metal\": $with}"
		for name in fdk final; do
			get_volume "$name" "$work/cut-$name.raw" format=raw
			[ "$with" = null ] && with=
			metal beside screws "$work/within.raw" "$work/cut-$name.raw" >"$work/cut-$name-${with:+with}.json"
		done
	done
	told
	not_worse cut .35
	for name in fdk final; do
		expect_number "$(of 'bone | fabs' "cut-$name-with")" '<' 60 "$name: HU of bone in the mean"
	done
}

run_tests
