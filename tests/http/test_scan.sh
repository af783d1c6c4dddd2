#!/usr/bin/env bash
# Scans and their projections over HTTP: the rules of the contract's section 3.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

columns=24 rows=10 count=12
one=$((columns * rows * 4)) # bytes of one projection

scan_json() { # [jq filter on the document]
	jq -n --argjson c $columns --argjson r $rows --argjson n $count '{name: "test", detector: {columns: $c, rows: $r, pixel_mm: [2, 2]},
	  projections: {count: $n, sample: "float32", quantity: "line_integral"},
	  geometry: {kind: "circular", source_to_isocentre_mm: 600, source_to_detector_mm: 1000, first_angle_deg: 0, angle_step_deg: 30}}' |
		jq "${1:-.}"
}
new_scan() {
	scan_json "${1:-.}" >"$work/scan.json"
	post_scan "$work"
}
# fill BYTE COUNT: COUNT projections of one byte value, repeated; 0x40 makes the float 3.0039
fill() { head -c $((one * $2)) /dev/zero | tr '\0' "\\$1"; }
put() { req PUT "/v1/scans/$scan/projections$1" "${@:2}"; }

test_document_says_what_was_understood() {
	new_scan
	req GET "/v1/scans/$scan"
	expect_status 200
	expect_json '.id and .name == "test" and .received == [] and .missing == [[0, 11]]'
	expect_json '.derived.arc_deg == 360 and .derived.short_scan == false'
	expect_json '(.derived.source_radius_mm - 600 | fabs) < 1e-6'
	expect_json '.derived.direction == "counter-clockwise" and (.warnings | type) == "array"'
	# 24 columns of 2 mm at 1000 mm: the rays reach +-23 mm at the outer centres, 24 at the edges
	expect_json '.derived.fan_angle_deg > 2.6 and .derived.fan_angle_deg < 2.8'
	new_scan '.geometry.angle_step_deg = -17'
	req GET "/v1/scans/$scan"
	expect_json '.derived.direction == "clockwise" and .derived.short_scan == true and .derived.arc_deg == 187'
	expect_json '[.warnings[].code] | length > 0'
	new_scan '.geometry.angle_step_deg = 5'
	req GET "/v1/scans/$scan"
	expect_json '[.warnings[] | select(.code | test("arc"))] | length == 1'
}

# By such a name a taker of a fleet would take it for another host's, and remove it.
test_a_name_of_the_fleet_is_refused() {
	scan_json '.name = "fleet:gpu1/1m7yaj2sssx8c7cg"' >"$work/fleet.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "@$work/fleet.json"
	expect_problem 422
	expect_json '.pointer == "/name" and (.detail | contains("hosts of a fleet"))'
	req POST /v1/scans -H 'Content-Type: application/json' -H 'Idempotency-Key: fleet:gpu2/other' --data-binary "@$work/fleet.json"
	expect_problem 422
}

test_idempotency_key_of_a_scan() {
	local first n pids=()
	scan_json >"$work/scan.json"
	keyed() { req POST /v1/scans -H 'Content-Type: application/json' -H "Idempotency-Key: $1" --data-binary "@$2"; }
	keyed key-1 "$work/scan.json"
	expect_status 201
	first=$(json .id)
	keyed key-1 "$work/scan.json"
	expect_status 201
	[ "$(json .id)" = "$first" ] && header Location | grep -q "$first" || fail "the same scan"
	scan_json '.name = "other"' >"$work/other.json"
	keyed key-1 "$work/other.json"
	expect_problem 409
	keyed key-2 "$work/scan.json"
	[ "$(json .id)" != "$first" ] || fail "another scan for another key"
	keyed "$(printf 'k%.0s' {1..256})" "$work/scan.json"
	expect_problem 400
	# eight at once with a new key make one scan
	for n in 1 2 3 4 5 6 7 8; do
		curl -s -o "$work/keyed.$n" -H 'Content-Type: application/json' -H 'Idempotency-Key: at-once' \
			--data-binary "@$work/scan.json" "$url/v1/scans" &
		pids+=($!)
	done
	wait "${pids[@]}"
	[ "$(jq -r .id "$work"/keyed.? | sort -u | wc -l)" = 1 ] || fail "one scan: $(jq -c '[.id, .detail]' "$work"/keyed.?)"
	# its key goes with a scan
	req DELETE "/v1/scans/$first"
	expect_status 204
	keyed key-1 "$work/other.json"
	expect_status 201
}

test_every_kind_of_geometry_is_the_same_scan() {
	local kinds=0
	new_scan
	req GET "/v1/scans/$scan"
	jq -S '.derived | map_values(if type == "number" then . * 1000 | round else . end)' "$body" >"$work/derived.circular"
	new_scan '.geometry.angles_deg = [range(12) | . * 30] | del(.geometry.first_angle_deg, .geometry.angle_step_deg)'
	req GET "/v1/scans/$scan"
	jq -S '.derived | map_values(if type == "number" then . * 1000 | round else . end)' "$body" >"$work/derived.angles"
	diff "$work/derived.circular" "$work/derived.angles" || fail "the same derived values for a list of angles"
	# S = 600 (cos, sin, 0), the detector's centre at -400 (cos, sin, 0)
	new_scan '.geometry = {kind: "views", views: [range(12) | . * 30 * 3.14159265358979312 / 180 | {c: cos, s: sin} |
	  {source_mm: [600 * .c, 600 * .s, 0], pixel0_mm: [-400 * .c + 23 * .s, -400 * .s - 23 * .c, -9],
	   column_step_mm: [-2 * .s, 2 * .c, 0], row_step_mm: [0, 0, 2]}]}'
	req GET "/v1/scans/$scan"
	jq -S '.derived | map_values(if type == "number" then . * 1000 | round else . end)' "$body" >"$work/derived.views"
	diff "$work/derived.circular" "$work/derived.views" || fail "the same derived values for views"
	# u = 500 (-s x + c y) + 11.5 depth, v = 500 z + 4.5 depth, depth = 600 - c x - s y; an odd scale and sign
	new_scan '.geometry = {kind: "matrices", matrices: [range(12) | . * 30 * 3.14159265358979312 / 180 | {c: cos, s: sin} |
	  [-500 * .s - 11.5 * .c, 500 * .c - 11.5 * .s, 0, 6900, -4.5 * .c, -4.5 * .s, 500, 2700, -.c, -.s, 0, 600] | map(. * -0.37)]}'
	req GET "/v1/scans/$scan"
	jq -S '.derived | map_values(if type == "number" then . * 1000 | round else . end)' "$body" >"$work/derived.matrices"
	diff "$work/derived.circular" "$work/derived.matrices" || fail "the same derived values for matrices"
}

test_what_fdk_cannot_mend_is_warned_of() {
	# a detector on its side: its rows run along the rotation axis, rows and columns are exchanged for FDK
	new_scan '.geometry = {kind: "views", views: [range(12) | . * 30 * 3.14159265358979312 / 180 | {c: cos, s: sin} |
	  {source_mm: [600 * .c, 600 * .s, 0], pixel0_mm: [-400 * .c + 9 * .s, -400 * .s - 9 * .c, -23],
	   column_step_mm: [0, 0, 2], row_step_mm: [-2 * .s, 2 * .c, 0]}]}'
	expect_json '[.warnings[].code] == ["rotated_detector"]'
	# 10 rows of 2 mm across the axis, at 1000 mm
	expect_json '(.derived.fan_angle_deg - 1.146 | fabs) < 0.01 and (.derived.field_of_view_mm - 12 | fabs) < 0.01'
	# displaced by a third of its width on a short scan
	new_scan '.geometry.angle_step_deg = 18 | .geometry.detector_offset_mm = [16, 0]'
	expect_json '[.warnings[] | select(.code == "displaced_short_scan")] | length == 1'
	new_scan '.geometry.angle_step_deg = 18 | .geometry.detector_offset_mm = [0.3, 0]'
	expect_json '[.warnings[] | select(.code == "displaced_short_scan")] | length == 0'
}

test_projections_in_any_order_one_run_all() {
	new_scan
	fill 100 1 >"$work/a"
	fill 101 3 >"$work/b"
	put /5 -T "$work/a"
	expect_status 201
	put /8-10 -T "$work/b"
	expect_status 201
	req GET "/v1/scans/$scan"
	expect_json '.received == [[5, 5], [8, 10]] and .missing == [[0, 4], [6, 7], [11, 11]]'
	put /5 -T "$work/a"
	expect_status 200
	put /8-10 -T "$work/b"
	expect_status 200
	fill 102 1 >"$work/c"
	put /5 -T "$work/c"
	expect_problem 409
	req GET "/v1/scans/$scan/projections/5"
	expect_status 200
	cmp "$body" "$work/a" || fail "the bytes that were stored first"
	req GET "/v1/scans/$scan/projections/6"
	expect_problem 404
	# all of them: what is there already is the same, the rest is new
	{ fill 103 5; cat "$work/a"; fill 103 2; cat "$work/b"; fill 103 1; } >"$work/all"
	put "" -T "$work/all"
	expect_status 201
	req GET "/v1/scans/$scan"
	expect_json '.received == [[0, 11]] and .missing == []'
	put "" -T "$work/all"
	expect_status 200
}

test_chunked_and_compressed_bodies() {
	new_scan
	fill 100 4 >"$work/a"
	put /0-3 -T - -H 'Transfer-Encoding: chunked' <"$work/a"
	expect_status 201
	zstd -q -f "$work/a" -o "$work/a.zst"
	put /4-7 -H 'Content-Encoding: zstd' -T "$work/a.zst"
	expect_status 201
	put /4-7 -T "$work/a"
	expect_status 200
	put /8 -H 'Content-Encoding: br' -T "$work/a.zst"
	expect_problem 415
	head -c 8 "$work/a.zst" >"$work/cut.zst"
	put /8-11 -H 'Content-Encoding: zstd' -T "$work/cut.zst"
	expect_problem 400
	put /8-11 -H 'Content-Encoding: zstd' -T "$work/a"
	expect_problem 400
	req GET "/v1/scans/$scan"
	expect_json '.missing == [[8, 11]]'
}

test_digest_is_checked_and_a_wrong_one_stores_nothing() {
	local right wrong
	new_scan
	fill 100 2 >"$work/a"
	right=$(openssl dgst -sha256 -binary "$work/a" | base64)
	wrong=$(printf x | openssl dgst -sha256 -binary | base64)
	put /0-1 -H "Content-Digest: sha-256=:$wrong:" -T "$work/a"
	expect_problem 400
	req GET "/v1/scans/$scan"
	expect_json '.received == []'
	put /0-1 -H "Content-Digest: sha-256=:$right:" -T "$work/a"
	expect_status 201
	req GET "/v1/scans/$scan"
	expect_json '.received == [[0, 1]]'
	# What is no dictionary of digests (RFC 8941, RFC 9530) is refused, not passed over.
	local field
	for field in "sha-256=oops" "sha-256=$wrong" "SHA-256=:$right:" "sha-256 = :$right:" "sha-256=:$right" "sha-256=\"$right\"" xx "sha-256" \
		"sha-256=:$right:," "sha-256=:$right: x=:AAAA:" "sha-512=(:AAAA:)" "sha-512=:AAAA:, sha-256=:short:" "sha-256=:$right:;=1" "?"; do
		put /2-3 -H "Content-Digest: $field" -T "$work/a"
		expect_problem 400
	done
	for field in "sha-256=:$wrong:;x=1" "sha-512=:AAAA:, sha-256=:$wrong:" "sha-256=:$right:,sha-256=:$wrong:"; do
		put /2-3 -H "Content-Digest: $field" -T "$work/a"
		expect_problem 400
		expect_json '.detail | test("does not fit")'
	done
	# Other algorithms are ignored.
	put /2-3 -H "Content-Digest: sha-512=:AAAA:;why=\"a\\\"b\";n , *x=:AA==:" -T "$work/a"
	expect_status 201
	put /2-3 -H "Content-Digest: sha-512=:AAAA:, sha-256=:$right:" -T "$work/a"
	expect_status 200
	put /2-3 -H "Content-Digest;" -T "$work/a"
	expect_status 200
}

test_a_broken_connection_keeps_the_whole_projections_before_it() {
	local i
	new_scan
	fill 100 12 >"$work/all"
	# two projections and a half, then the connection closes
	{
		printf 'PUT /v1/scans/%s/projections HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n' "$scan" $((one * 12))
		head -c $((one * 5 / 2)) "$work/all"
	} | timeout 5 bash -c 'exec 3<>"/dev/tcp/127.0.0.1/$0"; cat >&3; exec 3>&-' "${url##*:}" || true
	for ((i = 0; i < 100; i++)); do
		req GET "/v1/scans/$scan"
		[ "$(jq -c .received "$body")" = '[[0,1]]' ] && break
		sleep 0.05
	done
	expect_json '.received == [[0, 1]] and .missing == [[2, 11]]'
	put /2-11 --data-binary @<(fill 100 10)
	expect_status 201
	# chunked, and so fast that the end of the connection comes together with the last bytes
	new_scan '.detector.columns = 96 | .detector.rows = 84'
	timeout 5 bash -c 'exec 3<>"/dev/tcp/127.0.0.1/$0"
		printf "PUT /v1/scans/%s/projections HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n" "$1" >&3
		printf -v chunk "1000\r\n%04096d\r\n" 0
		for ((i = 0; i < 40; i++)); do printf %s "$chunk" >&3; done
		exec 3>&-' "${url##*:}" "$scan"
	for ((i = 0; i < 200; i++)); do
		req GET "/v1/scans/$scan"
		[ "$(jq -c .received "$body")" = '[[0,4]]' ] && break
		sleep 0.05
	done
	expect_json '.received == [[0, 4]]'
	put '' --data-binary @<(head -c $((96 * 84 * 4 * count)) /dev/zero | tr '\0' 0)
	expect_status 201
}

test_several_connections_at_once_with_repeats() {
	local k pids=() codes
	new_scan
	fill 100 1 >"$work/a"
	for k in 0 1 2 3 4 5 6 7 8 9 10 11 0 1 2 3 4 5 6 7 8 9 10 11; do
		curl -s -o /dev/null -w '%{http_code}\n' -T "$work/a" "$url/v1/scans/$scan/projections/$k" >>"$work/codes" &
		pids+=($!)
	done
	wait "${pids[@]}"
	codes=$(sort "$work/codes" | uniq -c | tr -s ' \n' ' ')
	[ "$codes" = " 12 200 12 201 " ] || fail "12 times 201 and 12 times 200, got $codes"
	req GET "/v1/scans/$scan"
	expect_json '.missing == []'
}

test_uint16_intensities_with_flat_and_dark() {
	new_scan '.projections.sample = "uint16" | .projections.quantity = "intensity"'
	fill 100 1 | head -c $((one / 2)) >"$work/half"
	put /0 -T "$work/half"
	expect_status 201
	fill 100 1 >"$work/whole"
	put /1 -T "$work/whole"
	expect_problem 400
	req PUT "/v1/scans/$scan/flat" -T "$work/whole" # float32
	[[ $status == 20[01] ]] || fail "flat stored, got $status"
	fill 0 1 | head -c $((one / 2)) >"$work/half"
	req PUT "/v1/scans/$scan/dark" -T "$work/half" # the sample's type
	[[ $status == 20[01] ]] || fail "dark stored, got $status"
	req PUT "/v1/scans/$scan/flat" --data-binary 123
	expect_problem 400
}

test_a_map_of_defects() {
	new_scan
	{ fill 17 1 | head -c $columns; fill 0 1 | head -c $((one / 4 - columns)); } >"$work/map"
	req GET "/v1/scans/$scan"
	expect_json '.defects == false'
	req PUT "/v1/scans/$scan/defects" -T "$work/map"
	expect_status 201
	req PUT "/v1/scans/$scan/defects" -T "$work/map"
	expect_status 200
	req GET "/v1/scans/$scan"
	expect_json '.defects == true'
	{ fill 18 1 | head -c $columns; fill 0 1 | head -c $((one / 4 - columns)); } >"$work/map"
	req PUT "/v1/scans/$scan/defects" -T "$work/map"
	expect_problem 409
	fill 18 1 >"$work/map"
	req PUT "/v1/scans/$scan/defects" -T "$work/map" # as long as a float32 image
	expect_problem 400
}

# What every job would be refused for is not stored, and the right image may follow.
test_images_that_nothing_can_be_made_of() {
	refused() { # IMAGE FILE TEXT
		req PUT "/v1/scans/$scan/$1" -T "$2"
		expect_problem 422
		[[ $(json .detail) == *"$3"* ]] || fail "$1: $(json .detail)"
		req GET "/v1/scans/$scan"
		expect_json ".$1 == false"
	}
	new_scan '.projections.quantity = "intensity"'
	fill 0 1 >"$work/zero"
	fill 377 1 >"$work/nan"
	fill 300 1 >"$work/negative" # -6.0
	fill 100 1 >"$work/three"
	fill 101 1 >"$work/twelve"
	deep=$(printf '\\%03o' 0x28 0x6b 0x6e 0xce) # -1e9
	for i in $(seq $((one / 4))); do printf "$deep"; done >"$work/deep"
	for i in $(seq $((one / 4))); do printf '\312\002\0\0'; done >"$work/faint" # 1e-42
	{ fill 101 1 | head -c 4; fill 0 1 | tail -c +5; } >"$work/single"
	{ fill 101 1 | head -c $((one / 2)); fill 377 1 | tail -c +$((one / 2 + 1)); } >"$work/half"
	refused flat "$work/zero" "not above 0"
	refused flat "$work/negative" "not above 0"
	refused flat "$work/nan" "not finite in 100 %"
	refused dark "$work/nan" "not finite"
	refused flat "$work/faint" "less than 1e-06"
	refused flat "$work/single" "not above 0"
	head -c $((one / 4)) "$work/nan" >"$work/map"
	refused defects "$work/map" "100 %"
	req PUT "/v1/scans/$scan/flat" -T "$work/three"
	expect_status 201
	refused dark "$work/three" "exchanged?"
	refused dark "$work/twelve" "not above the dark image in 100 %"
	refused dark "$work/deep" "too far below 0"
	req PUT "/v1/scans/$scan/dark" -T "$work/zero"
	expect_status 201
	expect_json '.warnings == []'
	new_scan '.projections.quantity = "intensity"'
	req PUT "/v1/scans/$scan/dark" -T "$work/three"
	expect_status 201
	refused flat "$work/three" "exchanged?"
	req PUT "/v1/scans/$scan/flat" -T "$work/twelve"
	expect_status 201
	# the same for air; a detector that is saturated everywhere; a flat and a map that leave nothing, whichever comes first
	new_scan '.projections.quantity = "intensity" | .projections.air = 40000'
	refused dark "$work/deep" "too far below 0"
	new_scan '.projections.quantity = "intensity" | .projections.sample = "uint16"'
	fill 377 1 | head -c $((one / 2)) >"$work/saturated"
	refused flat "$work/saturated" "saturated"
	{ fill 0 1 | head -c $((one / 8)); fill 1 1 | head -c $((one / 8)); } >"$work/rest"
	{ fill 1 1 | head -c $((one / 8)); fill 0 1 | head -c $((one / 8)); } >"$work/other"
	for order in "flat half defects other" "defects other flat half"; do
		set -- $order
		new_scan '.projections.quantity = "intensity"'
		req PUT "/v1/scans/$scan/$1" -T "$work/$2"
		expect_status 201
		refused "$3" "$work/$4" "are defects"
	done
	req PUT "/v1/scans/$scan/defects" -T "$work/other"
	expect_status 200
}

# What is doubtful is told with the answer.
test_images_that_are_doubtful() {
	new_scan '.projections.quantity = "intensity"'
	fill 101 1 >"$work/twelve"
	fill 300 1 >"$work/six" # -6.0
	req PUT "/v1/scans/$scan/flat" -T "$work/twelve"
	expect_status 201
	expect_json '.warnings == []'
	req PUT "/v1/scans/$scan/dark" -T "$work/six"
	expect_status 201
	expect_json '.stored == 1 and [.warnings[] | .code, .severity] == ["implausible_images", "serious"]'
	put /0 -T "$work/twelve"
	expect_status 201
	expect_json 'has("warnings") | not'
}

# Other bytes are refused; what was sent by mistake is removed and sent again, unless a job runs with it.
test_an_image_can_be_removed_and_put_again() {
	local image
	new_scan '.projections.quantity = "intensity" | .projections.air = 40000'
	fill 100 1 >"$work/three"
	fill 101 1 >"$work/twelve"
	fill 1 1 | head -c 40 >"$work/marks"
	{ cat "$work/marks"; fill 0 1 | head -c $((one / 4 - 40)); } >"$work/map"
	for image in "flat twelve three" "dark three zero" "defects map none"; do
		set -- $image
		fill 0 1 >"$work/zero"
		fill 0 1 | head -c $((one / 4)) >"$work/none"
		req DELETE "/v1/scans/$scan/$1"
		expect_problem 404
		req PUT "/v1/scans/$scan/$1" -T "$work/$2"
		expect_status 201
		req PUT "/v1/scans/$scan/$1" -T "$work/$3"
		expect_problem 409
		json .detail | grep -q DELETE || fail "a way out: $(json .detail)"
		req DELETE "/v1/scans/$scan/$1"
		expect_status 204
		req GET "/v1/scans/$scan"
		expect_json ".$1 == false and ([.warnings[] | select(.code == \"damaged_image\")] == [])"
		req PUT "/v1/scans/$scan/$1" -T "$work/$3"
		expect_status 201
		req DELETE "/v1/scans/$scan/$1"
		expect_status 204
		if [ "$1" = flat ]; then
			req PUT "/v1/scans/$scan/flat" -T "$work/twelve"
			expect_status 201
		fi
	done
	# a job that runs with it keeps it
	req PUT "/v1/scans/$scan/projections" --data-binary @<(fill 100 $count)
	expect_status 201
	post_job '{"scan": "SCAN", "grid": {"size": [32, 32, 16], "spacing_mm": [2, 2, 2]}, "sart": {"iterations": 1000, "subsets": 12}}'
	state_becomes running
	req DELETE "/v1/scans/$scan/flat"
	expect_problem 409
	json .detail | grep -q "$job" || fail "the job's name: $(json .detail)"
	req DELETE "/v1/jobs/$job"
	expect_status 202
	wait_job cancelled
	stop_daemon KILL
	port=${url##*:} start_daemon
	req GET "/v1/scans/$scan"
	expect_json '.flat and (.dark | not) and (.defects | not) and ([.warnings[] | select(.code == "damaged_image")] == [])'
	req GET /v1/quarantine
	expect_json '.entries == []'
	req PUT "/v1/scans/$scan/flat" -T "$work/twelve"
	expect_status 200
}

# As long as the schema says, in its own measure: characters, not bytes. Lengths that no arm has, at their pointers.
test_names_and_lengths_within_the_schema() {
	local umlauts
	umlauts=$(printf 'ä%.0s' {1..256})
	new_scan ".name = \"${umlauts:1}\" | .labels = {\"${umlauts:0:64}\": \"$umlauts\"}"
	req GET "/v1/scans/$scan"
	expect_json ".name == \"${umlauts:1}\" and .labels.\"${umlauts:0:64}\" == \"$umlauts\""
	refused_at() { # FILTER STATUS POINTER
		scan_json "$1" >"$work/scan.json"
		req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/scan.json"
		expect_problem "$2" "$3"
	}
	refused_at ".name = \"$umlauts\"" 400 /name
	refused_at ".labels = {x: \"ä$umlauts\"}" 422 /labels
	refused_at '.detector.pixel_mm = [2, 1e7]' 422 /detector/pixel_mm/1
	refused_at '.geometry.source_to_detector_mm = 1e7' 422 /geometry/source_to_detector_mm
	refused_at '.geometry.source_offset_mm = [0, -1e7]' 422 /geometry/source_offset_mm/1
	matrices='.geometry = {kind: "matrices", matrices: [range(12) | [-500, 10, 0, 0, 0, 0, 500, 5, -1, 0, 0, 600]]}'
	refused_at "$matrices | .geometry.matrices[3][7] = 1e100" 422 /geometry/matrices/3/7
	refused_at "$matrices | .geometry.matrices[3][11] = 1e9" 422 /geometry/matrices/3
}

test_lists_newest_first_in_pages() {
	local first second third
	new_scan && first=$scan
	new_scan && second=$scan
	new_scan && third=$scan
	req GET '/v1/scans?limit=2'
	expect_status 200
	expect_json "[.scans[].id] == [\"$third\", \"$second\"] and (.next | length > 0)"
	req GET "/v1/scans?limit=1&after=$(json .next)"
	expect_json "[.scans[].id] == [\"$first\"]"
	req GET '/v1/scans?limit=nonsense'
	expect_problem 400
}

test_delete() {
	new_scan
	req DELETE "/v1/scans/$scan"
	expect_status 204
	req GET "/v1/scans/$scan"
	expect_problem 404
	req DELETE "/v1/scans/$scan"
	expect_problem 404
	[ ! -e "$state/scans/$scan" ] || fail "the scan's directory gone"
	new_scan
	post_job '{"scan": "SCAN", "fdk": {}}'
	req DELETE "/v1/scans/$scan"
	expect_problem 409
	req DELETE "/v1/jobs/$job"
	expect_status 202
	wait_job cancelled
	req DELETE "/v1/scans/$scan"
	expect_status 204
}

test_delete_under_an_upload() {
	local address=${url#http://} line i
	new_scan
	exec 3<>"/dev/tcp/${address%:*}/${address##*:}"
	printf 'PUT /v1/scans/%s/projections HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n' "$scan" $((one * count)) >&3
	fill 0100 1 >&3
	for ((i = 0; i < 200; i++)); do # until the upload is under way
		req GET "/v1/scans/$scan"
		[ "$(json .received_count)" = 0 ] || break
		sleep 0.05
	done
	req DELETE "/v1/scans/$scan"
	expect_status 204
	fill 0100 $((count - 1)) >&3
	read -r line <&3
	exec 3>&-
	[[ $line == 'HTTP/1.1 404 '* ]] || fail "404, got $line"
	req GET /livez
	expect_status 200
}

test_methods_and_paths() {
	new_scan
	req PUT /v1/scans
	expect_problem 405
	[[ $(header allow) == *POST* ]] || fail "Allow with POST"
	req DELETE /livez
	expect_problem 405
	req GET /v1/nothing
	expect_problem 404
	req GET "/v1/scans/../../etc/passwd" --path-as-is
	expect_problem 404
	req HEAD "/v1/scans/$scan"
	expect_status 200
	req GET /livez
	expect_status 200
	req GET /v1/devices
	expect_json '.devices | length >= 1'
	req GET /metrics
	expect_status 200
	grep -q '^# TYPE ' "$body" || fail "Prometheus text"
}

test_a_projection_as_a_picture() {
	new_scan
	fill 100 1 >"$work/a"
	put /0 -T "$work/a"
	req GET "/v1/scans/$scan/projections/0?format=png"
	expect_status 200
	[ "$(header content-type)" = image/png ] || fail "image/png"
	[ "$(head -c 8 "$body" | od -An -tx1 | tr -d ' ')" = 89504e470d0a1a0a ] || fail "a PNG"
}

start_daemon || exit 1
run_tests
