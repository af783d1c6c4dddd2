#!/usr/bin/env bash
# Where a volume comes from: what its document and its files say, and that `cbct reproduce` makes it again from that, bit
# by bit, or names what is not the same.
. "$(dirname "$0")/lib.sh"

scan_dir=$work/head
cbct simulate --phantom head --scale 40 --density 0.0192 --views 30 --arc 360 --columns 48 --rows 40 --pixel 4 --photons 20000 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
recipe='"grid": {"size": [24, 24, 16], "spacing_mm": [4, 4, 4]}, "fdk": {}, "sart": {"iterations": 3, "subsets": 5}, "tv": {}'

start_daemon || exit 1
post_scan "$scan_dir"
post_projections "$scan_dir"
post_job "{\"scan\": \"SCAN\", $recipe, \"emit\": [\"fdk\", \"fdk-tv\", 2]}"
wait_job succeeded
made=$job
for name in fdk fdk-tv iter-2 final; do get_volume "$name" "$work/$name.nii"; done

# said WORDS: cbct reproduce's last words have them
again() { cbct reproduce "$@" >"$work/said" 2>"$work/said.err"; }
said() { grep -qF -- "$1" "$work/said" || fail "$1 in: $(cat "$work/said" "$work/said.err")"; }
# in_header FILE FROM TO, of one length
in_header() {
	[ ${#2} = ${#3} ] && grep -qaF -- "$2" "$1" || fail "$2 in the header of $1"
	LC_ALL=C sed -i "1,/$2/ s/$2/$3/" "$1"
}

test_a_volume_says_what_it_was_made_from() {
	req GET "/v1/jobs/$made/volumes/iter-2/provenance"
	expect_status 200
	expect_json ".volume == \"iter-2\" and .stage == \"sart\" and .iteration == 2 and .job == \"$made\" and .scan == \"$scan\""
	expect_json '.backend == "cpu" and (.device | length > 0) and (.made | endswith("Z")) and .recipe.sart.iterations == 3'
	[ "$(json .program)" = "cbctd $(cbctd --version | awk '{ print $2 }')" ] || fail "the program's version"
	[ ! -e "$top/.git" ] || ! command -v git >/dev/null || [ -n "$(json .commit)" ] || fail "a commit"
	# Anybody can make the digest: that of the projections' own digests, one after the other.
	local bytes=$((48 * 40 * $(jq 'if .projections.sample == "uint16" then 2 else 4 end' "$scan_dir/scan.json"))) digest
	digest=$(for ((k = 0; k < 30; k++)); do
		dd if="$scan_dir/projections.raw" bs=$bytes skip=$k count=1 status=none | openssl dgst -sha256 -binary
	done | openssl dgst -sha256 -binary | base64)
	[ "$(json .projections_digest)" = "sha-256=:$digest:" ] || fail "$digest, got $(json .projections_digest)"
	local scan_digest
	scan_digest=$(json .scan_digest)
	req GET "/v1/scans/$scan"
	expect_json ".digests == {\"scan\": \"$scan_digest\", \"projections\": \"sha-256=:$digest:\"}"
	req GET "/v1/jobs/$made/volumes"
	expect_json ".volumes[0].provenance == \"/v1/jobs/$made/volumes/\" + .volumes[0].name + \"/provenance\""
	req GET "/v1/jobs/$made/volumes/iter-1/provenance"
	expect_problem 404
}

test_names_of_patients_change_no_digest() {
	local before
	req GET "/v1/scans/$scan"
	before=$(json .digests.scan)
	jq '.name = "another" | .patient = {"position": "HFS", "name": "Doe^Jane"} | .labels = {"a": "b"}' "$scan_dir/scan.json" >"$work/named.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/named.json"
	expect_status 201
	expect_json ".digests == {\"scan\": \"$before\", \"projections\": null}"
}

test_each_volume_is_made_again_to_the_same_bits() {
	for name in fdk fdk-tv iter-2 final; do
		again "$work/$name.nii" || fail "$name made again: $(cat "$work/said" "$work/said.err")"
		said "the same bits: $((24 * 24 * 16)) voxels"
		[ "$(wc -l <"$work/said")" = 1 ] || fail "no difference, got $(cat "$work/said")"
	done
	req GET /v1/jobs
	[ "$(json '.jobs | length')" = 1 ] || fail "no job is left behind"
}

test_every_format_and_a_url_will_do() {
	local format
	for format in "mha&type=int16" nrrd "nifti.gz" "mha" "nrrd&type=int16"; do
		get_volume iter-2 "$work/other" "format=$format"
		again "$work/other" || fail "$format: $(cat "$work/said" "$work/said.err")"
		said "the same bits"
	done
	CBCT_URL=http://127.0.0.1:1 again "$url/v1/jobs/$made/volumes/iter-2" || fail "by its URL"
	said "the same bits"
	get_volume iter-2 "$work/scaled.nii" "scale=2"
	! again "$work/scaled.nii" || fail "a scaled volume is another"
	grep -q "it was scaled" "$work/said.err" || fail "that it was scaled"
	get_volume iter-2 "$work/raw" "format=raw"
	! again "$work/raw" || fail "a raw file says nothing"
}

test_a_scan_directory_will_do() {
	again "$work/final.nii" --from "$state/scans/$scan" --url http://127.0.0.1:1 || fail "$(cat "$work/said" "$work/said.err")"
	said "the same bits"
	get_volume final "$work/hu.mha" "format=mha&type=int16"
	again "$work/hu.mha" --from "$state/scans/$scan" || fail "in HU: $(cat "$work/said" "$work/said.err")"
	cp -r "$scan_dir" "$work/plain"
	again "$work/final.nii" --from "$work/plain" || fail "a directory without records"
	said "the same bits"
}

test_a_changed_projection_is_named() {
	cp -r "$scan_dir" "$work/changed"
	printf '\1\2' | dd of="$work/changed/projections.raw" bs=1 seek=30000 conv=notrunc status=none
	local first=$scan
	post_scan "$work/changed"
	post_projections "$work/changed"
	! again "$work/final.nii" --scan "$scan" || fail "another projection"
	said "projections: was sha-256="
	said "not the same bits"
	! grep -q "^scan:" "$work/said" || fail "the scan's document is the same"
	jq '.geometry.source_to_isocentre_mm = 601' "$scan_dir/scan.json" >"$work/changed/scan.json"
	cp "$scan_dir/projections.raw" "$work/changed/"
	post_scan "$work/changed"
	post_projections "$work/changed"
	! again "$work/final.nii" --scan "$scan" || fail "another geometry"
	said "scan: was sha-256="
	! grep -q "^projections:" "$work/said" || fail "the projections are the same"
}

# gives_up WORDS: cbct reproduce ends by itself, with these words and without a job of its own
gives_up() {
	local status=0 before
	req GET /v1/jobs
	before=$(json '.jobs | length')
	timeout 60 cbct reproduce "$work/final.nii" --scan "$scan" >"$work/said" 2>"$work/said.err" || status=$?
	[ $status -ne 0 ] && [ $status -ne 124 ] || fail "status $status: $(tail -3 "$work/said.err")"
	grep -qF -- "$1" "$work/said.err" || fail "$1 in: $(cat "$work/said.err")"
	req GET /v1/jobs
	[ "$(json '.jobs | length')" = "$before" ] || fail "a job is left behind: $(json '.jobs[0]')"
}

test_what_the_disk_has_damaged_is_named() {
	local bytes=$((48 * 40 * $(jq 'if .projections.sample == "uint16" then 2 else 4 end' "$scan_dir/scan.json"))) k
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	for k in 4 11 12; do
		printf '\125\252' | dd of="$state/scans/$scan/projections.raw" bs=1 seek=$((k * bytes + 700)) conv=notrunc status=none
	done
	gives_up "projections: 4, 11-12 of the scan $scan are not there, or damaged"
	gives_up "projections: 4, 11-12 of the scan $scan are not there, or damaged" # known by now
	timeout 60 cbct reproduce "$work/final.nii" --scan "$scan" --keep >"$work/said" 2>"$work/said.err" && fail "made of what is not there"
	req GET "/v1/jobs?state=waiting"
	expect_json '.jobs == []'
	post_projections "$scan_dir"
	again "$work/final.nii" --scan "$scan" || fail "sent again: $(cat "$work/said" "$work/said.err")"
	said "the same bits"
}

test_a_command_that_is_ended_leaves_no_job() {
	local signal pid status long end
	req GET "/v1/scans?limit=1"
	post_job "{\"scan\": \"$(json '.scans[0].id')\", \"grid\": {\"size\": [24, 24, 16], \"spacing_mm\": [4, 4, 4]}, \"sart\": {\"iterations\": 100000, \"subsets\": 5}}"
	long=$job
	state_becomes running
	for signal in INT TERM; do
		cbct reproduce "$work/final.nii" >"$work/said" 2>"$work/said.err" &
		pid=$!
		end=$((SECONDS + 30))
		until req GET "/v1/jobs?state=queued" && [ "$(json '.jobs | length')" = 1 ]; do
			[ $SECONDS -lt $end ] || fail "a queued job"
			sleep 0.05
		done
		kill -$signal $pid
		status=0
		wait $pid || status=$?
		[ $status = $((128 + $(kill -l $signal))) ] || fail "status $status of $signal"
		req GET /v1/jobs
		expect_json ".jobs | map(select(.id != \"$long\" and .id != \"$made\")) == []"
	done
	req DELETE "/v1/jobs/$long?wait=20"
	expect_status 202
	req DELETE "/v1/jobs/$long"
	expect_status 204
}

test_a_changed_version_is_named() {
	cp "$work/final.nii" "$work/version.nii"
	in_header "$work/version.nii" "cbctd 1.0.0" "cbctd 1.0.9"
	again "$work/version.nii" || fail "the same bits"
	said "version: was 1.0.9, is 1.0.0"
	said "the same bits"
}

test_a_changed_recipe_is_named() {
	cp "$work/final.nii" "$work/recipe.nii"
	in_header "$work/recipe.nii" '"subsets":5' '"subsets":3'
	again "$work/recipe.nii" || fail "by the job's recipe"
	said "recipe: the file's is not the one that it was made with"
	said "the same bits"
	! again "$work/recipe.nii" --from "$state/scans/$scan" || fail "by the changed recipe"
	said "recipe: was sha-256="
	said "not the same bits"
}

test_voxels_that_lie_elsewhere_are_named() {
	curl -sf "$url/v1/jobs/$made/volumes/final?format=mha" -o "$work/place.mha"
	in_header "$work/place.mha" "ElementSpacing = 4" "ElementSpacing = 3"
	! again "$work/place.mha" || fail "another spacing"
	grep -qF "voxels: were 3 mm wide along axis 0, are 4" "$work/said.err" || fail "the spacing's name, got $(cat "$work/said.err")"
	curl -sf "$url/v1/jobs/$made/volumes/final?format=mha" -o "$work/place.mha"
	in_header "$work/place.mha" "Offset = -" "Offset =  "
	! again "$work/place.mha" || fail "another place"
	grep -qF "place: the first voxel was at" "$work/said.err" || fail "the place's name, got $(cat "$work/said.err")"
}

test_another_device_is_told_with_the_bound_of_its_precision() {
	cp "$work/final.nii" "$work/device.nii"
	in_header "$work/device.nii" '"backend":"cpu"' '"backend":"gpu"'
	printf '\1' | dd of="$work/device.nii" bs=1 seek=$((4096 + 4 * (24 * 24 * 8 + 24 * 12 + 12))) conv=notrunc status=none
	! again "$work/device.nii" || fail "other bits"
	said "backend: was gpu, is cpu"
	said "not the same bits: 1 of"
	said "another device rounds otherwise, by up to 0.5 HU RMS: this is within that"
}

run_tests
