#!/usr/bin/env bash
# Who may speak to the daemon: Host, Origin, types of bodies; what its log and its answers do not tell.
. "$(dirname "$0")/lib.sh"

document='{"name": "DOE^JANE knee", "detector": {"columns": 16, "rows": 12, "pixel_mm": [4, 4]},
  "projections": {"count": 6, "sample": "float32", "quantity": "line_integral"},
  "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "first_angle_deg": 0, "angle_step_deg": 60}}'
json=(-H 'Content-Type: application/json')

# refused STATUS TYPE METHOD PATH [CURL OPTION ...]
refused() {
	local wanted=$1 type=$2
	shift 2
	echo "$wanted $*"
	req "$@"
	expect_problem "$wanted"
	expect_json ".type == \"urn:cbctd:problem:$type\""
}
served() { # STATUS METHOD PATH [CURL OPTION ...]
	local wanted=$1
	shift
	echo "$wanted $*"
	req "$@"
	expect_status "$wanted"
}

test_host_is_the_listening_address_localhost_or_a_configured_name() {
	local port=${url##*:} host
	for host in evil.example "evil.example:$port" 127.0.0.1.evil.example "127.0.0.2:$port" localhost.evil.example xlocalhost '[::1]' \
		0.0.0.0 2130706433 ct.example.org; do
		refused 421 misdirected GET /v1/scans -H "Host: $host"
	done
	refused 421 misdirected DELETE /v1/scans/1m00000000000000 -H 'Host: evil.example'
	refused 421 misdirected POST /v1/scans "${json[@]}" -H 'Host: evil.example' --data-binary "$document"
	for host in 'a b' 'localhost:x' 'localhost:65536' 'user@localhost' '[::1' 'localhost/' 'local%68ost'; do
		refused 400 invalid GET /v1/scans -H "Host: $host"
	done
	# what a proxy may add gives nobody another name
	refused 421 misdirected GET /livez -H 'Host: evil.example' -H 'X-Forwarded-Host: localhost' -H 'Forwarded: host=localhost'
	served 200 GET /livez -H 'X-Forwarded-Host: evil.example' -H 'Forwarded: host=evil.example'
	# the port may be that of a tunnel
	for host in "127.0.0.1:$port" 127.0.0.1 "localhost:$port" LocalHost localhost:9000 localhost: ct-1.hospital.example CT-1.Hospital.Example:8443 ct2; do
		served 200 GET /livez -H "Host: $host"
	done
	served 200 GET /livez --http1.0 -H 'Host:' # no Host at all
}

test_pages_of_other_sites_change_nothing() {
	local port=${url##*:} own origin
	own="http://127.0.0.1:$port"
	req POST /v1/scans "${json[@]}" -H "Origin: $own" -H 'Sec-Fetch-Site: same-origin' --data-binary "$document"
	expect_status 201
	scan=$(json .id)
	for origin in http://evil.example null "http://localhost:$port" "http://127.0.0.1:$((port + 1))" http://127.0.0.1 "https://127.0.0.1:$port.evil.example" \
		'file://' "ftp://127.0.0.1:$port"; do
		refused 403 foreign-origin POST "/v1/scans/$scan/complete" -H "Origin: $origin"
	done
	refused 403 foreign-origin POST "/v1/scans/$scan/complete" -H 'Origin;'
	refused 403 foreign-origin DELETE "/v1/scans/$scan" -H 'Origin: http://evil.example'
	refused 403 foreign-origin POST /v1/scans "${json[@]}" -H 'Origin: http://evil.example' --data-binary "$document"
	refused 403 foreign-origin PUT "/v1/scans/$scan/projections" -H 'Origin: http://evil.example' --data-binary x
	refused 403 foreign-origin POST "/v1/scans/$scan/complete" -H 'Sec-Fetch-Site: cross-site'
	refused 403 foreign-origin POST "/v1/scans/$scan/complete" -H 'Origin: http://evil.example' -H 'Content-Type: text/plain' --data-binary x
	req GET "/v1/scans/$scan"
	expect_json '.state == "receiving"'
	# reading is the browser's to refuse: it shows the answer to the daemon's own page only
	served 200 GET "/v1/scans/$scan" -H 'Origin: http://evil.example' -H 'Sec-Fetch-Site: cross-site'
	[ -z "$(header access-control-allow-origin)" ] || fail "no Access-Control-Allow-Origin"
	# behind a proxy under a configured name, whatever Host it sends on; and through a tunnel
	served 409 POST "/v1/scans/$scan/complete" -H 'Origin: https://ct2' -H 'Sec-Fetch-Site: same-origin'
	served 409 POST "/v1/scans/$scan/complete" -H 'Origin: https://ct2:8443' -H 'Host: ct2:8443'
	served 409 POST "/v1/scans/$scan/complete" -H 'Origin: http://localhost:9000' -H 'Host: localhost:9000'
	served 409 POST "/v1/scans/$scan/complete" -H 'Origin: http://localhost' -H 'Host: localhost:80'
	served 204 DELETE "/v1/scans/$scan" -H "Origin: $own"
}

test_json_says_that_it_is_json() {
	local type
	for type in text/plain application/x-www-form-urlencoded 'multipart/form-data; boundary=x' application/jsonp application/octet-stream \
		'text/plain; application/json' 'application/json, text/plain' json +json; do
		refused 415 unsupported-media-type POST /v1/scans -H "Content-Type: $type" --data-binary "$document"
		refused 415 unsupported-media-type POST /v1/jobs -H "Content-Type: $type" --data-binary '{}'
	done
	refused 415 unsupported-media-type POST /v1/scans -H 'Content-Type:' --data-binary "$document"
	for type in application/json 'Application/JSON; charset=utf-8' application/vnd.ct.scan+json; do
		served 201 POST /v1/scans -H "Content-Type: $type" --data-binary "$document"
		scan=$(json .id)
	done
	# a body where none is wanted
	refused 415 unsupported-media-type POST "/v1/scans/$scan/complete" -H 'Content-Type: text/plain' --data-binary '{}'
	served 409 POST "/v1/scans/$scan/complete" "${json[@]}" --data-binary '{}'
	served 409 POST "/v1/scans/$scan/complete"
	served 409 POST "/v1/scans/$scan/complete" -H 'Content-Type: text/plain' --data-binary ''
}

test_a_put_sends_the_whole() {
	local one=$((16 * 12 * 4))
	req POST /v1/scans "${json[@]}" --data-binary "$document"
	scan=$(json .id)
	head -c $((one / 2)) /dev/zero >"$work/half"
	head -c $one /dev/zero >"$work/one"
	refused 400 invalid PUT "/v1/scans/$scan/projections/0" -H "Content-Range: bytes 0-$((one / 2 - 1))/$one" -T "$work/half"
	refused 400 invalid PUT "/v1/scans/$scan/projections/0" -H "Content-Range: bytes 0-$((one - 1))/$one" -T "$work/one"
	refused 400 invalid PUT "/v1/scans/$scan/defects" -H "Content-Range: bytes 0-0/1" -T "$work/one"
	req GET "/v1/scans/$scan"
	expect_json '.received == []'
}

test_a_unix_socket_has_no_name() {
	local host
	for host in localhost d evil.example; do
		served 200 GET /livez --unix-socket "$work/socket" -H "Host: $host"
	done
	served 200 GET /livez --unix-socket "$work/socket" -H 'Host;'
	served 400 GET /livez --unix-socket "$work/socket" -H "Host: a b"
}

test_the_log_has_no_names_of_patients_and_answers_no_paths() {
	req POST /v1/scans "${json[@]}" --data-binary "$document"
	expect_status 201
	scan=$(json .id)
	grep -q "scan $scan" "$work/cbctd.err" || fail "the scan in the log"
	if grep -q 'DOE\|JANE' "$work/cbctd.err"; then fail "no name in the log"; fi
	# something in the way of the scan's files
	rm "$state/scans/$scan/projections.raw"
	mkdir "$state/scans/$scan/projections.raw"
	head -c $((16 * 12 * 4)) /dev/zero >"$work/one"
	req PUT "/v1/scans/$scan/projections/0" -T "$work/one"
	expect_problem 500
	if grep -qF "$state" "$body"; then fail "no path in $(cat "$body")"; fi
	expect_json '.detail | contains("projections.raw")'
	grep -F "$(json .request_id)" "$work/cbctd.err" | grep -qF "$state/scans/$scan/projections.raw" || fail "the path in the log, beside the request's id"
	rmdir "$state/scans/$scan/projections.raw"
}

test_names_that_are_none_are_refused_at_the_start() {
	local name
	for name in 'a b/' 'ct:80' 'http://ct' '*.example'; do
		if cbctd --listen 127.0.0.1:0 --state-dir "$work/other" --server-name "$name" >/dev/null 2>"$work/refused"; then fail "$name refused"; fi
		grep -q 'server-name' "$work/refused" || fail "the setting's name, got $(cat "$work/refused")"
	done
	cbctd --print-config --server-name ct1 --server-name ct2 >"$work/config"
	grep -qx 'server-name = ct1, ct2' "$work/config" || fail "both names"
}

start_daemon --listen "unix:$work/socket" --server-name ct-1.hospital.example --server-name ct2 || exit 1
run_tests
