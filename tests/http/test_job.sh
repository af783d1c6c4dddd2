#!/usr/bin/env bash
# Jobs and volumes over HTTP: the rules of the contract's section 4, on a small scan.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
small='{"scan": "SCAN", "grid": {"size": [32, 24, 16], "spacing_mm": [3, 4, 5]}, '
simulate_ball() {
	[ -e "$scan_dir/scan.json" ] || cbct simulate --phantom ball --scale 30 --density 0.02 --shift 5,-8,6 --views 60 --arc 360 \
		--columns 64 --rows 48 --pixel 4 --source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir"
}
uploaded_scan() {
	simulate_ball
	post_scan "$scan_dir"
	post_projections "$scan_dir"
}
slow='"sart": {"iterations": 100000, "subsets": "views"}'

test_pipeline_keeps_the_volumes_asked_for() {
	uploaded_scan
	post_job "$small"'"fdk": {}, "sart": {"iterations": 5, "subsets": 6}, "tv": {}, "emit": ["fdk", "fdk-tv", 1, 3]}'
	[ "$(header location)" = "/v1/jobs/$job" ] || fail "Location /v1/jobs/$job"
	wait_job succeeded
	expect_json 'has("stage") and .iteration == 5 and .iterations == 5 and .progress == 1 and .attempts == 1 and .error == null'
	expect_json '.backend == "cpu" and (.device | length > 0) and (.timings | type) == "object" and (.warnings | type) == "array"'
	expect_json '[.history[].iteration] == [1, 2, 3, 4, 5]'
	expect_json '.history | all(.residual > 0 and .residual < 1 and .change >= 0 and .tv > 0 and .seconds > 0)'
	expect_json '.history[4].residual < .history[0].residual'
	req GET "/v1/jobs/$job/volumes"
	expect_status 200
	expect_json '[.volumes[].name] == ["final", "iter-3", "iter-1", "fdk-tv", "fdk"]'
	expect_json '.volumes | all(.size == [32, 24, 16] and (.href | startswith("/v1/jobs/")) and (.digest | length > 20))'
	expect_json '[.volumes[].iteration] == [5, 3, 1, 0, 0]'
	expect_json '.volumes[0].statistics | .minimum < .mean and .mean < .maximum'
	req GET "/v1/jobs/$job/volumes?limit=2"
	expect_json '[.volumes[].name] == ["final", "iter-3"] and (.next | length > 0)'
	req GET "/v1/jobs/$job/volumes?limit=9&after=$(json .next)"
	expect_json '[.volumes[].name] == ["iter-1", "fdk-tv", "fdk"] and .next == null'
}

# Each preset of the schema, in numbers in the job's document; stages of the request in place of the preset's.
test_presets_become_numbers() {
	uploaded_scan
	local preset names
	req GET /v1/openapi.json
	names=$(json '.components.schemas.JobRequest.properties.preset.enum | map(values) | join(" ")')
	for preset in $names; do
		post_job "$small"'"preset": "'"$preset"'"}'
		expect_json 'has("preset") | not'
		expect_json '.fdk.window != null and (.sart == null) == ("'"$preset"'" == "preview")'
		json '{fdk, sart, tv, metal}' >"$work/preset-$preset.json"
	done
	expect_json '.metal.threshold_hu == 2500'
	jq -e '.sart.momentum and .sart.iterations < 10' "$work/preset-fast.json" >/dev/null || fail "fast"
	jq -e '.tv.strength == "strong"' "$work/preset-low-noise.json" >/dev/null || fail "low-noise"
	post_job "$small"'"preset": null}'
	[ "$(json '{fdk, sart, tv, metal}')" = "$(cat "$work/preset-balanced.json")" ] || fail "balanced is not what a job without stages has"
	post_job "$small"'"preset": "fast", "cgls": {"iterations": 2}, "tv": null}'
	expect_json '.cgls.iterations == 2 and .sart == null and .tv == null and .fdk.window == "hann"'
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"preset\": \"best\"}"
	expect_problem 422 /preset
	expect_json "(.detail | split(\": \")[1] | split(\", \")) == (\"$names\" | split(\" \"))"
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"preset\": 3}"
	expect_problem 400 /preset
	[ "$(cbct submit X --print --preset bone | jq -c .)" = '{"scan":"X","preset":"bone"}' ] || fail "the option of cbct"
}

test_momentum_is_asked_for_and_told() {
	uploaded_scan
	post_job "$small"'"fdk": {}, "sart": {"iterations": 4, "momentum": true}, "tv": {}, "emit": [1]}'
	expect_json '.sart.momentum == true'
	wait_job succeeded
	expect_json '[.history[].residual] | length == 4 and .[3] < .[0]'
	post_job "$small"'"fdk": {}, "sart": {"iterations": 1}}'
	expect_json '.sart.momentum == false'
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"sart\": {\"momentum\": 2}}"
	expect_problem 400 /sart/momentum
}

# Another algorithm by its name, preempted on its way: its stage, its iterates, its history, and the bits of an undisturbed run.
# A pixel is 2.4 mm at the isocentre. Of 64 x 48 pixels, 2 x 2 as one leave a quarter of the projections' memory.
test_pixels_are_taken_as_one() {
	uploaded_scan
	local coarse='"scan": "SCAN", "grid": {"size": [20, 20, 16], "spacing_mm": [5, 5, 5]}, "fdk": {}, "sart": {"iterations": 2}' all
	post_job "{$coarse}"
	expect_json '.binning == 1'
	wait_job succeeded
	all=$(json .memory.projections)
	post_job "{$coarse, "'"binning": "auto"}'
	expect_json '.binning == 2'
	wait_job succeeded
	# Buffers are padded by some bytes.
	expect_json ".memory.projections * 4 / $all | . > 0.99 and . < 1.01"
	post_job '{"scan": "SCAN", "fdk": {}, "binning": "auto"}'
	expect_json '.binning == 1'
	post_job '{"scan": "SCAN", "fdk": {}, "binning": 8}'
	expect_json '.binning == 8 and .grid.size[0] <= 9'
	wait_job succeeded
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"fdk\": {}, \"binning\": 9}"
	expect_status 422
	expect_json '.pointer == "/binning"'
}

test_conjugate_gradients_in_place_of_sart() {
	uploaded_scan
	post_job "$small"'"fdk": {}, "cgls": {"iterations": 6}, "emit": ["fdk", 2]}'
	wait_job succeeded
	expect_json '.cgls.iterations == 6 and .sart == null and .projector == "matched" and .iterations == 6'
	expect_json '[.history[].residual] | length == 6 and . == (sort | reverse)'
	expect_json '.timings.cgls > 0'
	req GET "/v1/jobs/$job/volumes"
	expect_json '[.volumes[] | [.name, .stage, .iteration]] == [["final", "cgls", 6], ["iter-2", "cgls", 2], ["fdk", "fdk", 0]]'
	post_job "$small"'"cgls": {}, "projector": "interpolating", "tv": {"after": "sart"}}'
	wait_job succeeded
	expect_json '.cgls.iterations == 4 and .cgls.nonnegative and .projector == "interpolating"'
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"sart\": {}, \"cgls\": {}}"
	expect_problem 422 /cgls

	local recipe="$small"'"cgls": {"iterations": 130}}' undisturbed preempted
	post_job "$recipe"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes"
	undisturbed=$(json '.volumes[0].digest')
	post_job "$recipe"
	preempted=$job
	until req GET "/v1/jobs/$job" && member '.iteration >= 3' "$body" >/dev/null; do sleep 0.02; done
	post_job "$small"'"fdk": {}, "priority": "stat"}'
	wait_job succeeded
	job=$preempted
	req GET "/v1/jobs/$job"
	expect_json '.state | IN("queued", "running")' # there is one worker, and the other job has had it
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes"
	[ "$(json '.volumes[0].digest')" = "$undisturbed" ] || fail "the digest of the undisturbed run"
}

test_the_strength_of_tv_is_found_from_the_noise_and_told() {
	local noisy=$work/noisy alpha medium recipe="$small"'"fdk": {}, "sart": {"iterations": 2, "subsets": 6}, "tv": '
	cbct simulate --phantom ball --scale 30 --density 0.02 --shift 5,-8,6 --views 60 --columns 44 --rows 32 --pixel 6 \
		--source-to-isocentre 600 --source-to-detector 1000 --photons 2000 -o "$noisy"
	post_scan "$noisy"
	post_projections "$noisy"
	post_job "$recipe"'{"after": "sart"}}'
	wait_job succeeded
	expect_json '.tv.method == "proximal" and .tv.alpha == "auto" and .tv.strength == "medium"'
	expect_json '.denoising | .noise_hu > 5 and .noise_hu < 200 and .alpha > 0'
	medium=$(json .denoising.alpha)
	expect_json '.warnings | all(.code != "averaged_pixels")'
	get_volume final "$work/found.raw" format=raw
	# The number that was found, given as a number, gives the same volume: a voxel spans too few pixels for means of them.
	post_job "$recipe"'{"method": "proximal", "alpha": '"$medium"', "iterations": 30, "after": "sart"}}'
	wait_job succeeded
	expect_json ".tv.alpha == $medium and .denoising.alpha == $medium and (.tv | has(\"strength\") | not)"
	get_volume final "$work/given.raw" format=raw
	cmp "$work/found.raw" "$work/given.raw" || fail "the same voxels"
	for alpha in light:2 strong:0.5; do
		post_job "$recipe"'{"strength": "'"${alpha%:*}"'"}}'
		wait_job succeeded
		expect_json ".denoising.alpha / $medium / ${alpha#*:} - 1 | fabs < 1e-9"
	done
	# Ten steps of 0.1 gray levels cannot take out noise of tens.
	post_job "$recipe"'{"method": "gradient"}}'
	wait_job succeeded
	expect_json '.tv.alpha == 0.1 and .tv.step == 0.1 and .tv.iterations == 10'
	expect_json '[.warnings[] | select(.code == "tv_without_effect" and .severity == "caution")] | length == 1'
	post_job "$small"'"fdk": {}}'
	wait_job succeeded
	expect_json '.tv == null and .denoising == null'
}

test_every_stage_may_be_left_out() {
	uploaded_scan
	local stages
	for stages in '"fdk": {}' '"sart": {"iterations": 2}' '"fdk": null, "sart": {"iterations": 1}, "tv": {"method": "proximal"}' \
		'"fdk": {}, "tv": {"after": "sart"}' '"fdk": {"window": "ram-lak", "cutoff": 0.8}, "sart": null'; do
		post_job "$small$stages}"
		wait_job succeeded
		req GET "/v1/jobs/$job/volumes"
		expect_json '[.volumes[].name] | index("final") != null'
	done
}

test_grid_is_chosen_when_none_is_given() {
	uploaded_scan
	post_job '{"scan": "SCAN", "fdk": {}}'
	wait_job succeeded
	expect_json '.grid.size | length == 3 and all(. > 10)'
	expect_json '.grid.spacing_mm | length == 3 and all(. > 0)'
}

test_volumes_come_in_every_format() {
	local voxels=$((32 * 24 * 16)) etag full first range size coding
	uploaded_scan
	post_job "$small"'"fdk": {}}'
	wait_job succeeded
	get_volume final "$work/v.nii"
	[ "$(stat -c %s "$work/v.nii")" = $((4096 + voxels * 4)) ] || fail "a NIfTI of $((4096 + voxels * 4)) bytes"
	get_volume final "$work/v.raw" format=raw
	tail -c +4097 "$work/v.nii" | cmp - "$work/v.raw" || fail "the same voxels in raw"
	get_volume final "$work/v.mha" format=mha
	grep -a -q '^ElementType = MET_FLOAT' "$work/v.mha" || fail "a MetaImage header"
	grep -a -q '^Offset = -46.5 -46 -37.5' "$work/v.mha" || fail "the centre of voxel 0,0,0 as Offset"
	tail -c $((voxels * 4)) "$work/v.mha" | cmp - "$work/v.raw" || fail "the same voxels in mha"
	get_volume final "$work/hu.raw" "format=raw&type=int16"
	[ "$(stat -c %s "$work/hu.raw")" = $((voxels * 2)) ] || fail "int16"
	# zstd
	req GET "/v1/jobs/$job/volumes/final" -H 'Accept-Encoding: zstd'
	[ "$(header content-encoding)" = zstd ] || fail "Content-Encoding: zstd"
	zstd -q -d -c <"$body" | cmp - "$work/v.nii" || fail "the same bytes through zstd"
	etag=$(header etag)
	# what a client would rather have
	for coding in "zstd;q=0.5, identity" "identity;q=0.2, zstd;q=0.1" "zstd;q=0" "*" "zstd;q=0.3, *" "*;q=0" "zstd;q=nan" "zstd;q=2" "zstd;q=0.1234" "zstd;p=1" "zstd q=1"; do
		req GET "/v1/jobs/$job/volumes/final" -H "Accept-Encoding: $coding"
		[ -z "$(header content-encoding)" ] || fail "plain bytes for $coding"
		cmp "$body" "$work/v.nii" || fail "the plain bytes for $coding"
	done
	for coding in "zstd, identity" "zstd;q=0.5, identity;q=0.5" "identity;q=0, zstd;q=0.001" "*, identity;q=0" "identity;q=0.5, *" "gzip;q=0, Zstd ; q=1.000"; do
		req GET "/v1/jobs/$job/volumes/final" -H "Accept-Encoding: $coding"
		[ "$(header content-encoding)" = zstd ] || fail "zstd for $coding"
	done
	# several lines are one list
	req GET "/v1/jobs/$job/volumes/final" -H 'Accept-Encoding: gzip' -H 'Accept-Encoding: zstd'
	[ "$(header content-encoding)" = zstd ] || fail "zstd of the second line"
	req GET "/v1/jobs/$job/volumes/final" -H 'Accept-Encoding: zstd;q=0.5' -H 'Accept-Encoding: identity'
	[ -z "$(header content-encoding)" ] || fail "plain bytes, which the second line would rather have"
	req GET "/v1/jobs/$job/volumes/final"
	[ "$(header etag)" != "$etag" ] || fail "another ETag for another encoding"
	etag=$(header etag)
	[[ $etag == '"'*'"' ]] || fail "a strong ETag, got $etag"
	req GET "/v1/jobs/$job/volumes/final" -H "If-None-Match: $etag"
	expect_status 304
	[ "$(header cache-control)" = 'private, no-cache' ] || fail "the Cache-Control of a 200, got $(header cache-control)"
	req GET "/v1/jobs/$job/volumes/final" -H 'If-None-Match: "other"'
	expect_status 200
	req HEAD "/v1/jobs/$job/volumes/final"
	expect_status 200
	[ "$(header content-length)" = $((4096 + voxels * 4)) ] || fail "HEAD with the length"
	[ "$(header accept-ranges)" = bytes ] || fail "Accept-Ranges: bytes"
	# ranges, of a file and of one converted on the way out
	for full in v.nii: v.mha:format=mha hu.raw:"format=raw&type=int16"; do
		# from the middle of a voxel, too
		for first in 300 301; do
			req GET "/v1/jobs/$job/volumes/final?${full#*:}" -r $first-1099
			expect_status 206
			dd if="$work/${full%%:*}" iflag=skip_bytes,count_bytes skip=$first count=$((1100 - first)) status=none | cmp - "$body" ||
				fail "bytes $first-1099 of ${full%%:*}"
			[[ $(header content-range) == "bytes $first-1099/$(stat -c %s "$work/${full%%:*}")" ]] || fail "Content-Range"
		done
		req GET "/v1/jobs/$job/volumes/final?${full#*:}" -r -500
		expect_status 206
		tail -c 500 "$work/${full%%:*}" | cmp - "$body" || fail "the last 500 bytes of ${full%%:*}"
	done
	req GET "/v1/jobs/$job/volumes/final" -r 99999999-
	expect_problem 416
	[ "$(header content-range)" = "bytes */$((4096 + voxels * 4))" ] || fail "Content-Range: bytes */N"
	req GET "/v1/jobs/$job/volumes/final" -H 'Range: bytes=-0'
	expect_problem 416
	# what is no range is passed over (RFC 9110, 14.2)
	for range in bytes=9-3 bytes=x- bytes= pages=1-2; do
		req GET "/v1/jobs/$job/volumes/final" -H "Range: $range"
		expect_status 200
	done
	req GET "/v1/jobs/$job/volumes/final" -r 0-9 -H 'If-Range: "other"'
	expect_status 200
	# and of what is packed by its format, whose length is known when it is made
	for full in format=nifti.gz "format=nifti.gz&type=int16" format=shuffled; do
		get_volume final "$work/packed" "$full"
		etag=$(header etag) size=$(stat -c %s "$work/packed")
		[ "$(header accept-ranges)" = bytes ] || fail "Accept-Ranges: bytes of $full"
		req GET "/v1/jobs/$job/volumes/final?$full" -r 301-1099 -H 'Accept-Encoding: zstd'
		expect_status 206
		[ "$(header etag)" = "$etag" ] || fail "the tag of the whole"
		[ "$(header content-range)" = "bytes 301-1099/$size" ] || fail "Content-Range, got $(header content-range)"
		dd if="$work/packed" iflag=skip_bytes,count_bytes skip=301 count=799 status=none | cmp - "$body" || fail "bytes 301-1099 of $full"
		req GET "/v1/jobs/$job/volumes/final?$full" -r -500 -H "If-Range: $etag"
		expect_status 206
		tail -c 500 "$work/packed" | cmp - "$body" || fail "the last 500 bytes of $full"
		req GET "/v1/jobs/$job/volumes/final?$full" -r 0-9 -H 'If-Range: "other"'
		expect_status 200
		cmp "$work/packed" "$body" || fail "all of it"
		req GET "/v1/jobs/$job/volumes/final?$full" -r 99999999-
		expect_problem 416
		[ "$(header content-range)" = "bytes */$size" ] || fail "Content-Range: bytes */N"
		req GET "/v1/jobs/$job/volumes/final?$full" -r 0-9 -H "If-None-Match: $etag"
		expect_status 304
		req HEAD "/v1/jobs/$job/volumes/final?$full" -H 'Range: bytes=0-9'
		expect_status 200
		[ "$(header etag)" = "$etag" ] || fail "the tag for HEAD"
		[ "$(header accept-ranges)" = bytes ] || fail "Accept-Ranges: bytes for HEAD"
	done
	# A range is of the plain bytes, where the client takes them.
	for coding in zstd "zstd, identity" "zstd;q=1, *;q=0, identity;q=0.5"; do
		req GET "/v1/jobs/$job/volumes/final" -r 301-1099 -H "Accept-Encoding: $coding"
		expect_status 206
		[ -z "$(header content-encoding)" ] || fail "no coding of a range, got $(header content-encoding)"
		dd if="$work/v.nii" iflag=skip_bytes,count_bytes skip=301 count=799 status=none | cmp - "$body" || fail "plain bytes beside $coding"
	done
	for coding in "zstd, identity;q=0" "zstd, *;q=0"; do
		req GET "/v1/jobs/$job/volumes/final" -r 301-1099 -H "Accept-Encoding: $coding"
		expect_status 200
		[ "$(header content-encoding)" = zstd ] || fail "a coding that $coding allows"
		etag=$(header etag)
	done
	req GET "/v1/jobs/$job/volumes/final" -r 301-1099 -H 'Accept-Encoding: zstd' -H "If-Range: $etag"
	expect_status 200
	cmp "$work/v.nii" "$body" || fail "all of the plain bytes for the tag of the compressed ones"
	req GET "/v1/jobs/$job/volumes/final?format=jpeg"
	expect_problem 400
	req GET "/v1/jobs/$job/volumes/final?type=float16"
	expect_problem 400
	req GET "/v1/jobs/$job/volumes/iter-9"
	expect_problem 404
}

test_waiting_until_the_projections_are_complete() {
	simulate_ball
	post_scan "$scan_dir"
	post_job "$small"'"fdk": {}}'
	expect_json '.state == "waiting"'
	req GET "/v1/jobs/$job?wait=0"
	expect_json '.state == "waiting"'
	post_projections "$scan_dir"
	wait_job succeeded
}

test_wait_returns_early_and_not_too_late() {
	local before
	uploaded_scan
	post_job "$small$slow}"
	before=$SECONDS
	req GET "/v1/jobs/$job" -H 'Prefer: wait=1'
	expect_status 200
	expect_json '.state == "running" or .state == "queued"'
	[ $((SECONDS - before)) -le 10 ] || fail "an answer after about a second"
	(sleep 1; curl -s -o /dev/null -X DELETE "$url/v1/jobs/$job") &
	wait_job cancelled
	[ $((SECONDS - before)) -le 25 ] || fail "an answer when the job ends"
	req GET "/v1/jobs/$job?wait=soon"
	expect_problem 400
}

test_idempotency_key() {
	local first
	uploaded_scan
	local document="${small//SCAN/$scan}\"fdk\": {}}"
	req POST /v1/jobs -H 'Content-Type: application/json' -H 'Idempotency-Key: abc-1' --data-binary "$document"
	expect_status 202
	first=$(json .id)
	req POST /v1/jobs -H 'Content-Type: application/json' -H 'Idempotency-Key: abc-1' --data-binary "$document"
	[[ $status == 20[02] ]] || fail "2xx for a repeat, got $status"
	[ "$(json .id)" = "$first" ] || fail "the same job"
	req POST /v1/jobs -H 'Content-Type: application/json' -H 'Idempotency-Key: abc-1' --data-binary "${document/32/30}"
	[[ $status == 409 || $status == 422 ]] || fail "409 or 422 for the key with another request, got $status"
}

# {"scan": ID} alone: every stage with its defaults
test_a_scan_alone_is_a_whole_job() {
	uploaded_scan
	post_job '{"scan": "SCAN"}'
	expect_json '.fdk.window == "hann" and .sart.iterations == 10 and .tv.method and .grid.size and .metal == null'
	expect_json '.emit == [] and .priority == "routine"'
	wait_job succeeded
	expect_json '(.history | length) == 10 and .volumes == 1'
	# naming a stage, even as null, is choosing
	post_job '{"scan": "SCAN", "fdk": {}}'
	expect_json '.sart == null and .tv == null'
	wait_job succeeded
	req POST /v1/jobs -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"sart\": null}"
	expect_problem 422
}

test_iterations_may_end_by_themselves() {
	uploaded_scan
	local stage end
	for stage in '"sart": {"iterations": "auto"}, "tv": {}' '"sart": {"iterations": "auto", "momentum": true}' '"cgls": {"iterations": "auto"}'; do
		post_job "$small"'"fdk": {}, '"$stage"', "emit": [1]}'
		expect_json '.stopped == null and .iterations == 30 and ([.sart, .cgls][] | select(. != null) | .iterations == "auto" and .max_iterations == 30)'
		wait_job succeeded
		expect_json '.iteration == (.history | length) and .iteration < 30 and .progress == 1'
		expect_json '.stopped | .iteration > 1 and .noise >= 0 and (.reason | length > 0) and (.rule | IN("noise", "residual", "change"))'
		expect_json '.stopped.iteration == .iteration and .stopped.residual == .history[-1].residual'
		end=$(json .iteration)
		req GET "/v1/jobs/$job/volumes"
		expect_json "[.volumes[] | [.name, .iteration]] == [[\"final\", $end], [\"iter-1\", 1]]"
		req GET "/v1/jobs/$job/events" -N
		[ "$(grep -c '^event: stop' "$body")" = 1 ] || fail "one event of the stop"
		grep -A1 '^event: stop' "$body" | sed -n 's/^data: //p' | jq -e ".iteration == $end" >/dev/null || fail "its iteration"
	done
	post_job "$small"'"sart": {"iterations": "auto", "max_iterations": 1}}'
	wait_job succeeded
	expect_json '.iteration == 1 and .iterations == 1 and .stopped.rule == "ceiling"'
	post_job "$small"'"sart": {"iterations": 2}}'
	wait_job succeeded
	expect_json '.stopped == null and (.sart | has("max_iterations") | not)'
	req POST /v1/jobs -H 'Content-Type: application/json' -d "$(echo "$small" | sed "s/SCAN/$scan/")\"sart\": {\"max_iterations\": 5}}"
	expect_problem 400 /sart/max_iterations
	req POST /v1/jobs -H 'Content-Type: application/json' -d "$(echo "$small" | sed "s/SCAN/$scan/")\"sart\": {\"iterations\": \"auto\"}, \"emit\": [31]}"
	expect_problem 422 /emit/0
}

test_stop_rules() {
	uploaded_scan
	post_job "$small"'"sart": {"iterations": 500, "stop": {"residual": 0.2}}}'
	wait_job succeeded
	expect_json '(.history | length) < 500 and .history[-1].residual <= 0.2 and (.history[:-1] | all(.residual > 0.2))'
	post_job "$small"'"sart": {"iterations": 500, "stop": {"change": 0.05}}}'
	wait_job succeeded
	expect_json '(.history | length) < 500 and .history[-1].change <= 0.05'
}

test_cancel_and_delete() {
	uploaded_scan
	post_job "$small$slow}"
	req DELETE "/v1/jobs/$job"
	expect_status 202
	wait_job cancelled
	req DELETE "/v1/jobs/$job"
	expect_status 204
	req GET "/v1/jobs/$job"
	expect_problem 404
	[ ! -e "$state/jobs/$job" ] || fail "the job's directory gone"
}

# Iterations of so small a job end faster than their rows can be taken in.
test_cancel_among_many_short_iterations() {
	cbct simulate --phantom ball --scale 3 --views 2 --columns 4 --rows 4 --pixel 4 -o "$work/tiny" >/dev/null
	post_scan "$work/tiny"
	post_projections "$work/tiny"
	post_job '{"scan": "SCAN", "grid": {"size": [4, 4, 2], "spacing_mm": [2, 2, 2]}, "sart": {"iterations": 100000, "subsets": 1}}'
	until req GET "/v1/jobs/$job" && [ "$(json '.iteration')" -gt 100 ]; do sleep 0.02; done
	req DELETE "/v1/jobs/$job?wait=10"
	expect_json '.state == "cancelled" and (.history | length > 100)'
}

test_higher_priority_goes_first_and_the_lower_one_goes_on() {
	local long urgent
	uploaded_scan
	post_job "$small"'"sart": {"iterations": 150, "subsets": "views"}}'
	long=$job
	for ((i = 0; i < 2400; i++)); do
		req GET "/v1/jobs/$long"
		[ "$(json '.iteration // 0')" -ge 2 ] && break
		sleep 0.05
	done
	post_job "$small"'"fdk": {}, "priority": "stat"}'
	urgent=$job
	wait_job succeeded
	req GET "/v1/jobs/$long"
	expect_json '.state != "succeeded"'
	job=$long
	wait_job succeeded
	expect_json '[.history[].iteration] == [range(1; 151)]'
}

test_lists() {
	uploaded_scan
	post_job "$small"'"fdk": {}}'
	wait_job succeeded
	req GET '/v1/jobs?limit=1'
	expect_json "[.jobs[].id] == [\"$job\"] and (.next | length > 0)"
	req GET "/v1/jobs?limit=1&after=$(json .next)"
	expect_json ".jobs | length == 1 and .[0].id != \"$job\""
}

test_the_same_inputs_give_the_same_bits() {
	uploaded_scan
	local recipe="$small"'"fdk": {}, "sart": {"iterations": 3, "subsets": 7}, "tv": {}}' first
	post_job "$recipe"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes"
	first=$(json '.volumes[0].digest')
	post_job "$recipe"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes"
	[ "$(json '.volumes[0].digest')" = "$first" ] || fail "the digest of the first run"
	stop_daemon
	start_daemon --threads 1
	post_job "$recipe"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes"
	[ "$(json '.volumes[0].digest')" = "$first" ] || fail "the digest of the first run with another number of threads"
}

# Whatever a job does beside its iterations: metal, the region outside of the grid, the search for stuck pixels, noise.
test_a_worker_keeps_to_its_number_of_threads() {
	[ "$(nproc)" -gt 1 ] || skip "one processor: no second thread could be seen"
	local inside='{"scan": "SCAN", "grid": {"size": [12, 12, 12], "spacing_mm": [2, 2, 2]}, ' worker threads count
	for count in 1 2; do
		stop_daemon
		start_daemon --threads "$count"
		uploaded_scan
		post_job "$inside"'"fdk": {}, "sart": {"iterations": 2}, "tv": {}, "metal": {"threshold_hu": 500}}'
		wait_job succeeded
		worker=$(pgrep -P "$(cat "$work/daemon.pid")" cbct-worker)
		sleep 1; for t in /proc/$worker/task/*; do echo "$(basename $t) $(cat $t/comm) $(cat $t/wchan 2>/dev/null)"; done >&2; threads=$(grep -l "^cbct-worker" /proc/"$worker"/task/*/comm | wc -l)
		echo "  threads of a worker with --threads $count = $threads"
		eval "threads_$count=$threads"
	done
	expect_number "$threads_2" '==' $((threads_1 + 1)) "threads of a worker with one more"
}

start_daemon || exit 1
run_tests
