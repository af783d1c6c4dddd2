#!/usr/bin/env bash
# Requests that two readers could understand otherwise are refused, and nothing of them is obeyed, kept or lost.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}
command -v "$python" >/dev/null || python=python3
small_scan() {
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary '{"detector": {"columns": 16, "rows": 12, "pixel_mm": [4, 4]},
	  "projections": {"count": 6, "sample": "float32", "quantity": "line_integral"},
	  "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "first_angle_deg": 0, "angle_step_deg": 60}}'
	expect_status 201
}
raw() { "$python" "$here/raw_http.py" "${url##*:}" "$@"; }

test_malformed_requests_are_refused_with_a_problem() { raw malformed; }
test_what_is_well_formed_is_understood() { raw fine; }
test_no_request_is_smuggled_in_another() { raw smuggling; }
test_requests_back_to_back_cut_anywhere() { raw pipelining; }
test_replies_without_a_body_end_with_their_head() {
	cbct simulate -o "$work/scan" --phantom ball --views 20 --columns 16 --rows 16 --pixel 12 >/dev/null
	reconstruct "$work/scan" '{"scan": "SCAN", "grid": {"size": [12, 12, 12], "spacing_mm": [8, 8, 8]}, "fdk": {}}'
	raw bodiless "$scan" "$job"
}
test_an_early_refusal_costs_no_reply_before_it() { raw refused_early; }
test_a_digest_behind_a_body_is_refused() {
	small_scan
	raw digest_behind "$(json .id)" $((16 * 12 * 4))
	req GET "/v1/scans/$(json .id)"
	expect_json '.received == []'
}
test_a_client_that_is_done_is_let_go() { raw left; }
test_bad_requests_leave_nothing_behind() {
	# a sanitizer keeps what is freed for a while
	[ "${SANITIZED:-0}" = 0 ] || skip "memory is not counted under a sanitizer"
	raw leaks "$(cat "$work/daemon.pid")"
}
test_a_broken_body_keeps_the_projections_before_it() {
	small_scan
	raw broken_body "$(json .id)" $((16 * 12 * 4))
	req GET "/v1/scans/$(json .id)"
	# chunked: its length was not told before, so nothing counts until the end
	expect_json '.received == []'
}

start_daemon || exit 1
run_tests
