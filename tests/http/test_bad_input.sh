#!/usr/bin/env bash
# Bad input gets a problem document that names the field, and loses nothing.
. "$(dirname "$0")/lib.sh"

base='{"name": "t", "detector": {"columns": 16, "rows": 12, "pixel_mm": [4, 4]},
  "projections": {"count": 6, "sample": "float32", "quantity": "line_integral"},
  "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "first_angle_deg": 0, "angle_step_deg": 60}}'
good_job='{"scan": "SCAN", "grid": {"size": [8, 8, 8], "spacing_mm": [2, 2, 2]}, "fdk": {}}'

refused_scan() { # STATUS POINTER TEXT
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$3"
	expect_problem "$1" "$2"
}
changed() { jq -c "$1" <<<"$base"; }
refused_job() { # STATUS POINTER TEXT
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${3//SCAN/$scan}"
	expect_problem "$1" "$2"
}
new_scan() {
	echo "$base" >"$work/scan.json"
	post_scan "$work"
}

test_scans() {
	while IFS='|' read -r status pointer filter; do
		[ -n "$status" ] || continue
		echo "$status $pointer $filter"
		refused_scan "$status" "$pointer" "$(changed "$filter")"
	done <<'TABLE'
400|/detector|del(.detector)
400|/geometry|del(.geometry)
400|/geometri|.geometri = .geometry | del(.geometry)
400|/detector/colums|.detector.colums = .detector.columns | del(.detector.columns)
400|/projections/samples|.projections.samples = .projections.sample | del(.projections.sample)
400|/geometry/type|.geometry.type = .geometry.kind | del(.geometry.kind)
400|/geometry/angle_step|.geometry.angle_step = .geometry.angle_step_deg | del(.geometry.angle_step_deg)
400|/projections/count|.projections.count = "six"
422|/projections/count|.projections.count = 0
422|/projections/count|.projections.count = -3
400|/projections/count|.projections.count = 2.5
422|/detector/columns|.detector.columns = 0
422|/detector/rows|.detector.rows = -1
422|/detector/columns|.detector.columns = 1000000000
422|/detector/pixel_mm/0|.detector.pixel_mm = [0, 1]
422|/detector/pixel_mm/1|.detector.pixel_mm = [1, -1]
400|/detector/pixel_mm|.detector.pixel_mm = [1]
400|/projections/sample|.projections.sample = "float64"
400|/projections/quantity|.projections.quantity = "magic"
400|/geometry/kind|.geometry.kind = "spiral"
422|/geometry/source_to_isocentre_mm|.geometry.source_to_isocentre_mm = -600
422|/geometry/source_to_detector_mm|.geometry.source_to_detector_mm = 0
400|/geometry/angles_deg|.geometry.angles_deg = [0, 60, 120] | del(.geometry.first_angle_deg, .geometry.angle_step_deg)
400|/colour|.colour = "red"
400|/geometry/tilt|.geometry.tilt = 3
400|/geometry/matrices|.geometry = {kind: "matrices", matrices: [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]]}
422|/geometry/matrices/2|.geometry = {kind: "matrices", matrices: [range(6) | if . == 2 then [1, 2, 3, 4, 2, 4, 6, 8, 0, 0, 1, 5] else [-8, 250, 0, 4800, -6, 0, 250, 3600, -1, 0, 0, 600] end]}
400|/geometry/matrices/1|.geometry = {kind: "matrices", matrices: [range(6) | if . == 1 then [1, 2, 3] else [-8, 250, 0, 4800, -6, 0, 250, 3600, -1, 0, 0, 600] end]}
400|/geometry/matrix|.geometry = {kind: "matrices", matrix: []}
400|/geometry/views/0/source|.geometry = {kind: "views", views: [range(6) | {source: [600, 0, 0]}]}
422|/geometry/views/4|.geometry = {kind: "views", views: [range(6) | {source_mm: [600, 0, 0], pixel0_mm: [-400, -30, -22], column_step_mm: [0, 4, 0], row_step_mm: (if . == 4 then [0, 8, 0] else [0, 0, 4] end)}]}
TABLE
}

test_text_that_is_not_strict_json() {
	local text
	for text in '' '{' '[]' 'null' '"scan"' "$base x" "$base$base" "${base/\"t\"/NaN}" "${base/600/NaN}" "${base/600/Infinity}" \
		"${base/600/1e999}" "${base/600/0600}" "${base/\"name\": \"t\"/\"name\": \"t\", \"name\": \"u\"}" "${base/\"t\"/\"a	b\"}" \
		"$(printf '%s' "${base/\"t\"/\"x\"}" | sed $'s/x"/\xff"/')" "{\"a\": $(printf '[%.0s' {1..200})1$(printf ']%.0s' {1..200})}"; do
		req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$text"
		expect_problem 400
	done
	req POST /v1/scans -H 'Content-Type: application/json' -H 'Content-Encoding: gzip' --data-binary "$base"
	expect_problem 415
	req GET /livez
	expect_status 200
}

test_a_hundred_megabytes_of_json() {
	local before after
	before=$(awk '/VmRSS/ { print $2 }' "/proc/$(cat "$work/daemon.pid")/status")
	{ printf '{"name": ['; head -c 100000000 /dev/zero | tr '\0' 1; printf ']}'; } >"$work/big"
	req POST /v1/scans -H 'Content-Type: application/json' -T "$work/big"
	expect_problem 413
	req POST /v1/scans -H 'Content-Type: application/json' -H 'Transfer-Encoding: chunked' -T "$work/big"
	[ "$status" = 413 ] || [ "$status" = 000 ] || fail "413 for a chunked body, got $status"
	{ printf '['; head -c 7500000 /dev/zero | sed 's/\x0/1,/g'; printf '1]'; } >"$work/many"
	req POST /v1/scans -H 'Content-Type: application/json' -T "$work/many"
	[[ $status == 4* ]] || fail "4xx for millions of values, got $status"
	after=$(awk '/VmRSS/ { print $2 }' "/proc/$(cat "$work/daemon.pid")/status")
	expect_number $((after - before)) '<' 200000 "growth of the daemon in KiB"
	rm -f "$work/big" "$work/many"
	req GET /livez
	expect_status 200
}

test_projections() {
	local one=$((16 * 12 * 4))
	new_scan
	head -c $((one - 1)) /dev/zero >"$work/short"
	head -c $((one + 4)) /dev/zero >"$work/long"
	head -c $one /dev/zero >"$work/right"
	head -c $((one * 6)) /dev/zero >"$work/all"
	req PUT "/v1/scans/$scan/projections/0" -T "$work/short"
	expect_problem 400
	json .detail | grep -q "$((one - 1))" || fail "the length found in the detail"
	json .detail | grep -q "$one" || fail "the length expected in the detail"
	req PUT "/v1/scans/$scan/projections/0" -T "$work/long"
	[[ $status == 400 || $status == 413 ]] || fail "400 or 413, got $status"
	req PUT "/v1/scans/$scan/projections/0" -H 'Transfer-Encoding: chunked' -T "$work/short"
	expect_problem 400
	req PUT "/v1/scans/$scan/projections/6" -T "$work/right"
	[[ $status == 404 || $status == 422 ]] || fail "404 or 422 for an index out of range, got $status"
	expect_problem "$status"
	for path in 4-2 2-6 -1 x 1-x 99999999999999999999 0-99999999999999999999; do
		req PUT "/v1/scans/$scan/projections/$path" -T "$work/right"
		[[ $status == 4* ]] || fail "4xx for projections/$path, got $status"
		expect_problem "$status"
	done
	req PUT "/v1/scans/unknown/projections/0" -T "$work/right"
	expect_problem 404
	# NaN and infinity: float32 0x7fc00000 and 0xff800000 at pixel 5 of view 3
	printf '\0\0\300\177' | dd of="$work/all" bs=1 seek=$((3 * one + 20)) conv=notrunc status=none
	req PUT "/v1/scans/$scan/projections" -T "$work/all"
	expect_problem 422
	json .detail | grep -q 3 || fail "the view named in the detail"
	head -c $one /dev/zero >"$work/inf"
	printf '\0\0\200\377' | dd of="$work/inf" bs=1 seek=40 conv=notrunc status=none
	req PUT "/v1/scans/$scan/projections/3" -T "$work/inf"
	expect_problem 422
	req GET "/v1/scans/$scan"
	expect_json '[.missing[] | select(.[0] <= 3 and .[1] >= 3)] | length == 1'
	req PUT "/v1/scans/$scan/projections/3" -T "$work/right"
	expect_status 201
}

test_jobs() {
	new_scan
	post_job "$good_job"
	while IFS='|' read -r status pointer filter; do
		[ -n "$status" ] || continue
		echo "$status $pointer $filter"
		refused_job "$status" "$pointer" "$(jq -c "$filter" <<<"$good_job")"
	done <<'TABLE'
400|/scan|del(.scan)
400|/scans|.scans = .scan | del(.scan)
400|/grid/spacing|.grid.spacing = .grid.spacing_mm | del(.grid.spacing_mm)
404|/scan|.scan = "nowhere"
400|/colour|.colour = 1
400|/fdk/colour|.fdk.colour = 1
400|/fdk/window|.fdk.window = "kaiser"
422|/fdk/cutoff|.fdk.cutoff = 0
422|/fdk/cutoff|.fdk.cutoff = -1
400|/grid/size|.grid.size = [8, 8]
422|/grid/size/1|.grid.size = [8, 0, 8]
422|/grid/size/2|.grid.size = [8, 8, -8]
400|/grid/size/0|.grid.size = [8.5, 8, 8]
422|/grid/spacing_mm/0|.grid.spacing_mm = [0, 2, 2]
422|/grid/spacing_mm/2|.grid.spacing_mm = [2, 2, -2]
422|/sart/iterations|.sart = {iterations: -1}
400|/sart/iterations|.sart = {iterations: "many"}
422|/sart/relaxation|.sart = {relaxation: 0}
422|/sart/subsets|.sart = {subsets: 7}
422|/sart/subsets|.sart = {subsets: 0}
400|/sart/subsets|.sart = {subsets: "some"}
422|/sart/stop/residual|.sart = {stop: {residual: -1}}
400|/tv/method|.tv = {method: "magic"}
422|/tv/step|.tv = {step: -0.1}
422|/tv/unit|.tv = {unit: 0}
400|/priority|.priority = "now"
400|/where|.where = "here"
400|/where/host|.where = {host: ""}
400|/where/host|.where = {host: "a/b"}
422|/where/memory|.where = {memory: -1}
400|/where/memory|.where = {memory: 0.5}
422|/where/devices|.where = {devices: 0}
422|/where/devices|.where = {devices: 65}
400|/where/rack|.where = {rack: 7}
400|/emit/0|.emit = ["everything"]
TABLE
	# the job before all of these is still there, untouched
	req GET "/v1/jobs/$job"
	expect_json '.state == "waiting"'
}

test_impossible_grids() {
	new_scan
	refused_job 422 /grid "$(jq -c '.grid = {size: [700, 700, 8], spacing_mm: [2, 2, 2]}' <<<"$good_job")" # the source is inside
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "$(jq -c --arg s "$scan" '.scan = $s | .grid = {size: [8192, 8192, 8192], spacing_mm: [0.01, 0.01, 0.01]}' <<<"$good_job")"
	expect_problem 422
	json .pointer | grep -q '^/grid' || fail "a pointer to the grid"
	[ "$(json .detail | grep -oE '[0-9][0-9.]*' | wc -l)" -ge 2 ] || fail "both numbers in the detail"
}

test_requests_that_are_no_requests() {
	local port=${url##*:} reply
	# In one piece: the daemon closes such a connection at once, and what comes later would reset it.
	send() {
		printf "$1" >"$work/request"
		timeout 5 bash -c 'exec 3<>"/dev/tcp/127.0.0.1/$0"; cat "$1" >&3; read -r line <&3; echo "$line"' "$port" "$work/request" || true
	}
	reply=$(send 'POST /v1/scans HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n')
	[[ $reply == "HTTP/1.1 400"* ]] || fail "400 for a length beside chunks, got $reply"
	reply=$(send 'POST /v1/scans HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\nContent-Length: 3\r\n\r\n{}x')
	[[ $reply == "HTTP/1.1 400"* ]] || fail "400 for two lengths, got $reply"
	send 'GARBAGE\r\n\r\n' >/dev/null
	send '\0\0\0\0' >/dev/null
	req GET /livez
	expect_status 200
}

start_daemon || exit 1
run_tests
