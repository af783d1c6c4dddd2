#!/usr/bin/env bash
# What everybody gets, the default recipe beside FDK: a noisy head and wrist, and a skull that is wider than the detector;
# exact integrals (tests/http/bodies.py).
. "$(dirname "$0")/lib.sh"

python=${PYTHON:-/usr/bin/python3}
bodies() { "$python" "$top/tests/http/bodies.py" "$@"; }

# BODY KEPT: $work/BODY-NAME.raw of FDK, of what is kept, and the last one, all by default
by_default() {
	local body=$1 name
	"$python" -c 'import numpy' 2>/dev/null || skip "python3-numpy is not here"
	bodies make "$body" "$work/$body"
	reconstruct "$work/$body" "{\"scan\": \"SCAN\", \"grid\": $(bodies grid "$body"), \"emit\": [\"fdk\"${2:+, $2}]}"
	for name in fdk ${2:+iter-$2} final; do get_volume "$name" "$work/$body-$name.raw" format=raw; done
}

# 200 views of 3000 photons. With explicit TV of a fixed strength the tenth iteration was worse than the third, and than FDK.
noisy() {
	by_default "$1" 3
	bodies rmse "$1" "$work/$1"-{fdk,iter-3,final}.raw >"$work/$1.json"
	expect_number "$(jq '.[2]' "$work/$1.json")" '<' "$(jq '.[0]' "$work/$1.json")" "HU of the default in the $1, FDK beside it"
	expect_number "$(jq '.[1]' "$work/$1.json")" '<' "$(jq '.[0]' "$work/$1.json")" "HU of its third iteration"
	expect_number "$(jq '.[2] / .[1]' "$work/$1.json")" '<=' 1.05 "tenth iteration over the third"
	req GET "/v1/jobs/$job"
	expect_json '.denoising | .noise_hu > 10 and .alpha > 0'
}
test_a_noisy_head() { noisy head; }
test_a_noisy_wrist() { noisy wrist; }

# Rows that are cut within bone lowered all of the field of view: -109 HU in its centre, -247 at its rim.
test_a_skull_wider_than_the_detector() {
	local name told
	by_default skull
	for name in fdk final; do
		bodies rings "$work/skull-$name.raw" >"$work/skull-$name.json"
		expect_number "$(jq '.centre | fabs' "$work/skull-$name.json")" '<' 18 "HU in the centre, $name"
		expect_number "$(jq '.middle | fabs' "$work/skull-$name.json")" '<' 20 "HU half way out, $name"
		expect_number "$(jq '.rim | fabs' "$work/skull-$name.json")" '<' 29 "HU at the rim, $name"
	done
	# How far it reaches, and no less than it does.
	req GET "/v1/jobs/$job"
	expect_json '[.warnings[] | select(.code == "truncated") | .severity] == ["caution"]'
	told=$(jq -c '.warnings[] | select(.code == "truncated") | .detail | capture("All of the field of view is uncertain by that: by up to (?<inner>[0-9]+) HU within (?<within>[0-9]+) mm of its axis, and from there outwards by more, up to (?<rim>[0-9]+) HU at its rim, at (?<radius>[0-9]+) mm, or [0-9]+ HU where bone is cut there$") | map_values(tonumber)' "$body")
	expect_number "$(jq .within <<<"$told")" '==' 39 "mm of the axis that are told"
	expect_number "$(jq '.radius - 64.5 | fabs' <<<"$told")" '<' 1 "mm of the rim that is told, from the field of view's"
	for name in fdk final; do
		expect_number "$(jq '[.centre, .middle] | map(fabs) | max' "$work/skull-$name.json")" '<' "$(jq .inner <<<"$told")" "HU inside, at most what is told"
		expect_number "$(jq '.rim | fabs' "$work/skull-$name.json")" '<' "$(jq .rim <<<"$told")" "HU at the rim, at most what is told"
	done
}

if [ "${SANITIZED:-0}" != 0 ]; then
	echo "SKIP test_bodies.sh: too slow under a sanitizer"
	echo "skip test_bodies.sh: too slow under a sanitizer" >>"$RESULTS"
	exit 0
fi
start_daemon || exit 1
run_tests
