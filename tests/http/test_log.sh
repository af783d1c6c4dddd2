#!/usr/bin/env bash
# The daemon's log as JSON: which request did what to which job, under the ids that clients give.
. "$(dirname "$0")/lib.sh"

trace=4bf92f3577b34da6a3ce929d0e0e4736
parent=00-$trace-00f067aa0ba902b7-01
simulate() { [ -e "$work/scan/scan.json" ] || cbct simulate -o "$work/scan" --phantom head --views 20 --columns 16 --rows 12 --pixel 8 >/dev/null; }
# logged FILTER: a line of which that is true
logged() {
	local i
	for ((i = 0; i < 2400; i++)); do
		jq -e -s "map(select($1)) | length > 0" "$work/cbctd.err" >/dev/null 2>&1 && return 0
		sleep 0.05
	done
	fail "a line with $1: $(tail -5 "$work/cbctd.err")"
}

test_a_client_s_ids_come_back_and_stand_in_the_log() {
	simulate
	req POST /v1/scans -H 'Content-Type: application/json' -H 'X-Request-Id: console-7.1' -H "traceparent: $parent" --data-binary @"$work/scan/scan.json"
	expect_status 201
	[ "$(header x-request-id)" = console-7.1 ] || fail "the id comes back, got $(header x-request-id)"
	[ "$(header traceparent)" = "$parent" ] || fail "traceparent comes back, got $(header traceparent)"
	scan=$(json .id)
	logged ".scan == \"$scan\" and .request == \"console-7.1\" and .trace == \"$trace\" and .level == \"info\""
	req POST /v1/jobs -H 'Content-Type: application/json' -H 'X-Request-Id: console-8' --data-binary "{\"scan\": \"$scan\"}"
	expect_status 202
	job=$(json .id)
	logged ".job == \"$job\" and .request == \"console-8\" and (has(\"trace\") | not)"
	req PUT "/v1/scans/$scan/projections" -H 'X-Request-Id: console-9' -T "$work/scan/projections.raw"
	expect_status 201
	[ "$(header x-request-id)" = console-9 ] || fail "also of an upload"
	wait_job succeeded
	logged ".job == \"$job\" and (.message | test(\"running -> succeeded\")) and (has(\"request\") | not)" # the supervisor's
	logged '.worker == "0"'
	req GET /v1/jobs/none -H 'X-Request-Id: console-10'
	expect_problem 404
	expect_json '.request_id == "console-10"'
}

test_ids_that_are_none_are_not_taken() {
	local id
	for id in 'a b' "$(printf 'x%.0s' {1..65})" 'a"b' '<script>' 'é'; do
		req GET /livez -H "X-Request-Id: $id"
		expect_status 200
		[[ $(header x-request-id) =~ ^[0-9a-f]{8}-[0-9a-f]+$ ]] || fail "an id of the daemon's own for \"$id\", got $(header x-request-id)"
	done
	for id in "00-$trace-00f067aa0ba902b7" "00-$trace-0000000000000000-01" "00-00000000000000000000000000000000-00f067aa0ba902b7-01" "ff-$trace-00f067aa0ba902b7-01" \
		"00-${trace^^}-00f067aa0ba902b7-01" "$parent-x" "0-$trace"; do
		req GET /livez -H "traceparent: $id"
		expect_status 200
		[ -z "$(header traceparent)" ] || fail "nothing for $id, got $(header traceparent)"
	done
	req GET /livez -H "traceparent: 01-$trace-00f067aa0ba902b7-01-more" # of a version to come
	[ "$(header traceparent)" = "01-$trace-00f067aa0ba902b7-01" ] || fail "what is known of it, got $(header traceparent)"
}

test_every_line_is_an_object() {
	jq -e -s 'map(select((.time | test("^[0-9]{4}-.*Z$")) and (.level | length > 0) and (.message | length > 0) | not)) | length == 0' "$work/cbctd.err" >/dev/null ||
		fail "time, level and message in each line"
	! grep -v '^{' "$work/cbctd.err" || fail "nothing else"
}

start_daemon --log-format json --log-level debug || exit 1
run_tests
