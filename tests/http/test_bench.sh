#!/usr/bin/env bash
# What `make bench-gpu` says of times, without a card: of the kept result itself, and of one that was made slower.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}
kept=$(ls "$top"/tests/bench/results/*-h200-*.json | tail -1)
rows() { "$python" "$top/tests/bench/gpu_rows.py" "$@" >"$work/rows"; }
slower() { # FACTOR WHAT: the kept result with these rows of case D slower
	jq --argjson factor "$1" --arg what "$2" '.results |= map(if .case == "D" and .what == $what then .ms *= $factor else . end)' "$kept" >"$work/slower.json"
}

test_no_row_is_behind_itself() {
	rows "$kept" || fail "success: $(tail -3 "$work/rows")"
	[ "$(grep -c ' 1\.000$' "$work/rows")" = "$(jq '[.results[] | select(.ms)] | length' "$kept")" ] || fail "each row beside itself: $(head -5 "$work/rows")"
	! grep -q BEHIND "$work/rows" || fail "none behind"
}

test_a_row_that_falls_behind_the_kept_result_fails() {
	slower 1.09 "forward projection"
	rows "$work/slower.json" || fail "nine per cent to pass"
	slower 1.11 "forward projection"
	! rows "$work/slower.json" || fail "eleven per cent to fail"
	[ "$(grep -c BEHIND "$work/rows")" = 2 ] || fail "both geometries of the row are named: $(grep BEHIND "$work/rows")"
	jq '.device = "another card"' "$work/slower.json" >"$work/another.json"
	rows "$work/another.json" || fail "another kind of card not to be held against this one"
}

test_rows_stand_beside_goal_and_peer() {
	rows "$kept"
	# goal 70, TIGRE's 273 ms; what was measured lies between
	grep -E '^D any +forward projection .* 70 .*TIGRE 3\.1 +273 +3\.[0-9] x +9[0-9] %' "$work/rows" || fail "goal, peer and ceiling of a row: $(grep '^D any' "$work/rows" | head -2)"
	# each goal has a row that was measured
	[ "$(jq -r --slurpfile measured "$kept" '[.[] | . as $row | select([$measured[0].results[] | select(.case == $row.case and .what == $row.what)] | length == 0)] | length' \
		"$top/tests/bench/gpu_rows.json")" = 0 ] || fail "a measured row for each goal"
}

test_the_picture_shows_each_goal() {
	"$python" -c 'import matplotlib' 2>/dev/null || skip "python3-matplotlib is not here"
	rows "$kept" --picture "$work/rows.svg"
	grep -q "D untilted matched SIRT iteration" "$work/rows.svg" || fail "its rows by name"
}

run_tests
