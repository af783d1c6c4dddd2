#!/usr/bin/env bash
# Annotations of a job: kept, refused by pointer, changed by one at a time, told to who watches, there after a kill and
# after the catalogue was made again, gone with the job.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

cbct simulate --phantom ball --scale 30 --views 20 --arc 360 --columns 24 --rows 16 --pixel 8 -o "$work/scan" >/dev/null || exit 1
start_daemon || exit 1
port=${url##*:} # the same after a restart in a test's own shell
post_scan "$work/scan"
post_projections "$work/scan"
post_job '{"scan": "SCAN", "grid": {"size": [8, 8, 8], "spacing_mm": [9, 9, 9]}, "fdk": {}}'
wait_job succeeded
path=/v1/jobs/$job/annotations
whole='{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 3], [12.5, -4, 3]], "label": "Schraube \u00fc"},
	{"id": "2", "kind": "angle", "points": [[1, 0, 0], [0, 0, 0], [0, 1, 0]]},
	{"id": "3", "kind": "ellipse", "points": [[0, 0, 0], [5, 0, 0], [0, 3, 0]]},
	{"id": "4", "kind": "freehand", "points": [[0, 0, 0], [5, 0, 0], [0, 3, 0], [-1, 1, 0]]}],
	"key_images": [{"id": "1", "volume": "final", "caption": "level L4", "created": "2026-01-02T03:04:05Z", "window": 2000, "level": 300, "normal": [0, 0, -1],
	"up": [0, -1, 0], "center": [0, 0, 3], "thickness": 10, "mode": "max"}]}'
put() { # BODY TAG
	req PUT "$path" -H 'Content-Type: application/json' ${2:+-H "If-Match: $2"} --data-binary "$1"
}
same() { jq -S . "$body" >"$work/a"; jq -S . <<<"$1" | diff - "$work/a" || fail "what was put"; }

test_what_is_put_comes_back_and_only_one_of_two_wins() {
	local first second
	req GET "$path"
	expect_status 200
	expect_json '.measurements == [] and .key_images == []'
	first=$(header etag)
	put "$whole"
	expect_problem 428
	put "$whole" '"0123"'
	expect_problem 412
	put "$whole" "$first"
	expect_status 200
	second=$(header etag)
	[ "$first" != "$second" ] || fail "another tag"
	same "$whole"
	put '{"measurements": []}' "$first"
	expect_problem 412
	req GET "$path"
	[ "$(header etag)" = "$second" ] || fail "the first one's"
	same "$whole"
	req GET "$path" -H "If-None-Match: $second"
	expect_status 304
	req GET /v1/jobs/0000000000000000/annotations
	expect_problem 404
	job=0000000000000000 path=/v1/jobs/0000000000000000/annotations put "$whole" '*'
	expect_problem 404
}

test_what_makes_no_sense_is_refused_by_its_place() {
	local pointer bad
	while IFS='|' read -r pointer bad; do
		put "$bad" '*'
		expect_problem "$([[ $bad == *1e9* || $bad == *'"window": 0'* ]] && echo 422 || echo 400)"
		expect_json ".pointer == \"$pointer\""
	done <<-'EOF'
		/colour|{"colour": 3}
		/measurements|{"measurements": {}}
		/measurements/0/kind|{"measurements": [{"id": "1", "kind": "volume", "points": [[0, 0, 0], [1, 1, 1]]}]}
		/measurements/0/points|{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 0]]}]}
		/measurements/0/points|{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 0], [1, 1, 1], [2, 2, 2]]}]}
		/measurements/0/points/1|{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 0], [1, 1]]}]}
		/measurements/0/points/1/2|{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 0], [1, 1, "x"]]}]}
		/measurements/0/points/1/2|{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 0], [1, 1, 1e9]]}]}
		/measurements/1/id|{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 0], [1, 1, 1]]}, {"id": "1", "kind": "ruler", "points": [[0, 0, 0], [1, 1, 1]]}]}
		/measurements/0/id|{"measurements": [{"id": "", "kind": "ruler", "points": [[0, 0, 0], [1, 1, 1]]}]}
		/measurements/0/who|{"measurements": [{"id": "1", "kind": "ruler", "points": [[0, 0, 0], [1, 1, 1]], "who": "me"}]}
		/key_images/0/window|{"key_images": [{"id": "1", "volume": "final", "window": 0, "level": 3, "normal": [0, 0, 1], "up": [0, 1, 0], "center": [0, 0, 0]}]}
		/key_images/0/up|{"key_images": [{"id": "1", "volume": "final", "window": 9, "level": 3, "normal": [0, 0, 1], "center": [0, 0, 0]}]}
	EOF
	put '{"measurements": [' '*'
	expect_problem 400
	head -c 5000000 /dev/zero | tr '\0' ' ' >"$work/long"
	put "@$work/long" '*'
	expect_problem 413
}

test_who_watches_hears_of_it() {
	local last
	req GET "/v1/events?after=latest" --max-time 1 || true
	curl -sN --max-time 20 "$url/v1/events?after=latest" >"$work/live" &
	sleep 0.5
	put '{"measurements": [{"id": "9", "kind": "ruler", "points": [[0, 0, 0], [1, 1, 1]]}]}' '*'
	expect_status 200
	last=$(header etag)
	for ((i = 0; i < 100; i++)); do grep -q '^event: annotations' "$work/live" && break; sleep 0.1; done
	kill $! 2>/dev/null || true
	sed -n '/^event: annotations/{n;s/^data: //p;}' "$work/live" | jq -e --arg tag "$last" --arg job "$job" '.etag == $tag and .job == $job' >/dev/null ||
		fail "job and tag: $(cat "$work/live")"
}

test_they_outlive_a_kill_and_the_catalogue() {
	put "$whole" '*'
	expect_status 200
	stop_daemon KILL
	start_daemon
	req GET "$path"
	same "$whole"
	stop_daemon
	"$BUILD/cbctd" --state-dir "$state" --rebuild-catalogue >/dev/null 2>&1
	start_daemon
	req GET "$path"
	expect_status 200
	same "$whole"
	req GET "/v1/jobs/$job/events"
	grep -q '^event: annotations' "$body" || fail "that they were changed, after the catalogue was made again"
}

test_damage_is_told_and_can_be_mended() {
	local file=$state/jobs/$job/annotations.json
	put "$whole" '*'
	sed -i 's/12.5/13.5/' "$file"
	req GET "$path"
	expect_problem 500
	expect_json '.type == "urn:cbctd:problem:damaged"'
	put "$whole" '*'
	expect_status 200
	req GET "$path"
	same "$whole"
	# one that is gone is not as if there had never been one, also for the next daemon
	rm "$file"
	for _ in 1 2; do
		req GET "$path"
		expect_problem 500
		expect_json '.type == "urn:cbctd:problem:damaged" and (.detail | contains("are gone"))'
		stop_daemon
		start_daemon
	done
	put "$whole" '*'
	expect_status 200
	req GET "$path"
	same "$whole"
}

test_they_go_with_the_job() {
	req DELETE "/v1/jobs/$job"
	expect_status 204
	[ ! -e "$state/jobs/$job" ] || fail "nothing left"
	req GET "$path"
	expect_problem 404
}

run_tests
stop_daemon
