#!/usr/bin/env bash
# Where the patient's left is: an object with a mark on each side, in each of DICOM's positions, through every format.
. "$(dirname "$0")/lib.sh"

python=${PYTHON:-/usr/bin/python3}
sides() { "$python" "$top/tests/http/sides.py" "$@"; }
need_nibabel() {
	"$python" -c 'import nibabel, numpy' 2>/dev/null || skip "python3-nibabel is not here"
	[ -e "$work/scan/scan.json" ] || { mkdir -p "$work/scan" && sides make "$work/scan"; }
}
stop_after_each=1
positions="HFS HFP FFS FFP HFDL HFDR FFDL FFDR"
tilted='{"world_to_patient": [0.766044443, -0.642787610, 0, 12, 0.620885352, 0.739941976, -0.258819045, -7, 0.166365675, 0.198266889, 0.965925826, 150, 0, 0, 0, 1]}'
recipe='"grid": {"size": [41, 42, 43], "spacing_mm": [2, 2, 2], "origin_mm": [-40, -42, -41]}, "fdk": {}'

value_of_patient() { # POSITION: the value of "patient"
	case $1 in
	unknown) echo null ;;
	tilted) echo "$tilted" ;;
	*) echo "{\"position\": \"$1\"}" ;;
	esac
}
scan_of() { # POSITION DIR: the object, with that patient
	mkdir -p "$2"
	ln -sf "$work/scan/projections.raw" "$2/projections.raw"
	jq -c --argjson patient "$(value_of_patient "$1")" '.patient = $patient' "$work/scan/scan.json" >"$2/scan.json"
}
job_of() { # POSITION: a scan of it and a job that has ended
	scan_of "$1" "$work/$1"
	reconstruct "$work/$1" "{\"scan\": \"SCAN\", $recipe}"
}

test_every_position_puts_each_mark_on_its_side_in_every_format() {
	local position format query unit at file files
	need_nibabel
	start_daemon
	for position in $positions tilted unknown; do
		job_of "$position"
		files=()
		for format in nifti nifti.gz mha nrrd; do
			for query in "" "&type=int16" "&type=int16&scale=2"; do
				unit=1/mm
				[[ $query != *int16* ]] || unit=HU
				file=$work/$unit${query##*=}.${format/nifti/nii}
				file=${file/1\/mm/mu}
				get_volume final "$file" "format=$format$query"
				files+=("$format,$unit,$file")
			done
		done
		sides check "$position" "$job" "$scan" "${files[@]}"
		get_volume final "$work/whole.nii.gz" format=nifti.gz
		[[ $(header content-disposition) == *"final.nii.gz"* && $(header content-type) == application/gzip* ]] || fail "its name and type"
		[ -z "$(header content-encoding)" ] || fail "compressed by what it is"
		# The default is the kept file itself, and what is made of parts of it is the same.
		get_volume final "$work/whole.nii"
		cmp "$work/whole.nii" <(head -c "$(stat -c %s "$work/whole.nii")" "$state/jobs/$job/final.nii") || fail "the file as it is kept"
		gzip -dc "$work/whole.nii.gz" | cmp - "$work/whole.nii" || fail "the same file, compressed"
		at=$(($(stat -c %s "$work/whole.nii") - 4000))
		req GET "/v1/jobs/$job/volumes/final" -H "Range: bytes=300-$at"
		expect_status 206
		cmp "$body" <(tail -c +301 "$work/whole.nii" | head -c $((at - 299))) || fail "a part of it"
		get_volume final "$work/raw" format=raw
		cmp "$work/raw" <(tail -c +4097 "$work/whole.nii") || fail "raw voxels behind the header"
	done
}

test_the_files_know_the_sides_when_the_scan_is_gone() {
	need_nibabel
	start_daemon
	job_of FFDR
	req DELETE "/v1/scans/$scan"
	expect_status 204
	get_volume final "$work/file" "format=mha&type=int16"
	sides check FFDR "$job" "$scan" "mha,HU,$work/file"
	req GET "/v1/jobs/$job"
	expect_json '.patient == {position: "FFDR"} and .axes == {x: "A", y: "R", z: "I"}'
}

test_documents_tell_the_patient_and_the_axes() {
	local position
	need_nibabel
	start_daemon
	for position in HFDL tilted unknown; do
		scan_of "$position" "$work/$position"
		post_scan "$work/$position"
		[ $position != HFDL ] || expect_json '.patient == {position: "HFDL"} and .axes == {x: "A", y: "L", z: "S"}'
		[ $position != tilted ] || expect_json '.axes == {x: "LP", y: "PR", z: "SA"} and (.patient.world_to_patient | length == 16)'
		[ $position != unknown ] || expect_json '.patient == null and .axes == null'
		post_job "{\"scan\": \"SCAN\", $recipe}"
		[ $position != HFDL ] || expect_json '.patient == {position: "HFDL"} and .axes == {x: "A", y: "L", z: "S"}'
		[ $position != unknown ] || expect_json '.patient == null and .axes == null'
		# What is posted again is the same job.
		req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "$(jq '{scan, grid, fdk, patient}' "$body")"
		expect_status 202
		[ $position != tilted ] || expect_json '.axes == {x: "LP", y: "PR", z: "SA"}'
	done
	# A job may know what the scan does not.
	post_job "{\"scan\": \"SCAN\", $recipe, \"patient\": {\"position\": \"HFP\"}}"
	expect_json '.patient == {position: "HFP"} and .axes == {x: "R", y: "A", z: "S"}'
	req GET /v1/jobs
	expect_json '.jobs[0].axes == {x: "R", y: "A", z: "S"}'
}

# Beside the patient: texts of the client's own.
test_labels_are_kept_and_shown() {
	local many
	start_daemon
	labels='{"case": "2231", "Seite \u00e9 \"x\"": "links, 3"}'
	document=$(jq -n --argjson labels "$labels" '{detector: {columns: 4, rows: 3, pixel_mm: [1, 1]}, projections: {count: 2, sample: "float32", quantity: "line_integral"},
		geometry: {kind: "circular", source_to_isocentre_mm: 600, source_to_detector_mm: 1000, angle_step_deg: 180}, labels: $labels}')
	post() { req POST "$1" -H 'Content-Type: application/json' --data-binary "$2"; }
	post /v1/scans "$document"
	expect_status 201
	expect_json ".labels == $labels"
	scan=$(json .id)
	post_job "{\"scan\": \"SCAN\", \"fdk\": {}, \"labels\": $labels}"
	expect_json ".labels == $labels"
	stop_daemon
	start_daemon
	req GET "/v1/jobs/$job"
	expect_json ".labels == $labels"
	req GET /v1/jobs
	expect_json ".jobs[0].labels == $labels"
	req GET "/v1/scans/$scan"
	expect_json ".labels == $labels"
	many=$(jq -nc '[range(33) | {key: "k\(.)", value: "v"}] | from_entries')
	for labels in '[]' '{"a": 3}' '{"": "x"}' '{"a": "b\u0007"}'; do
		post /v1/jobs "{\"scan\": \"$scan\", \"fdk\": {}, \"labels\": $labels}"
		expect_problem 400 /labels
	done
	for labels in "$many" "{\"a\": \"$(printf 'x%.0s' {1..257})\"}"; do
		post /v1/scans "$(jq -c --argjson labels "$labels" '.labels = $labels' <<<"$document")"
		expect_problem 422 /labels
	done
}

# Who it is: of the scan alone, kept with its jobs, never in a log, in metrics or in a file that does not ask for it.
test_who_was_removed_is_nowhere_on_the_disk() {
	start_daemon
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary '{"patient": {"name": "Vanishing^Vera", "id": "VAN-1"},
		"detector": {"columns": 4, "rows": 3, "pixel_mm": [1, 1]}, "projections": {"count": 2, "sample": "float32", "quantity": "line_integral"},
		"geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "angle_step_deg": 180}}'
	expect_status 201
	scan=$(json .id)
	post_job '{"scan": "SCAN", "fdk": {}}'
	grep -rq 'Vanishing^Vera' "$state" || fail "the name while the scan is there"
	req DELETE "/v1/jobs/$job"
	wait_job cancelled
	req DELETE "/v1/jobs/$job"
	expect_status 204
	req DELETE "/v1/scans/$scan"
	expect_status 204
	stop_daemon
	! grep -rl 'Vanishing^Vera\|VAN-1' "$state" || fail "no trace of the name"
}

test_who_the_patient_is_stays_with_the_scan_and_its_jobs() {
	need_sqlite
	local who='{"name": "Quarx^J\u00f6rg", "id": "ID-8315", "birth_date": "1970-02-28", "sex": "M"}' other='{"position": "FFS", "name": "Zwolle^Anna"}'
	local study='{"uid": "1.2.3.4", "accession_number": "ACC-4711", "referring_physician": "House^G"}' first document='{"detector": {"columns": 4, "rows": 3, "pixel_mm": [1, 1]},
		"projections": {"count": 2, "sample": "float32", "quantity": "line_integral"}, "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "angle_step_deg": 180}}'
	start_daemon
	post() { # PATIENT STUDY: a scan and a job of it, with its subject in the catalogue
		req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$(jq -c --argjson patient "$1" --argjson study "$2" '. + {patient: $patient, study: $study}' <<<"$document")"
		expect_status 201
		expect_json ".patient == $1"
		scan=$(json .id)
		post_job '{"scan": "SCAN", "fdk": {}}'
		! grep -q 'Quarx\|Zwolle\|8315' "$body" || fail "a name in the job's document"
	}
	kept() { sqlite3 "$state/catalogue.sqlite" "SELECT subject FROM jobs WHERE id = '$1'"; }
	post "$who" "$study"
	expect_json '.patient == null and .axes == null'
	first=$job
	post "$other" null
	expect_json '.patient == {position: "FFS"}'
	[ "$(kept "$first" | jq -cS .)" = "$(jq -cnS --argjson patient "$who" --argjson study "$study" '{patient: $patient, study: $study}')" ] || fail "the first job's, got $(kept "$first")"
	[ "$(kept "$job" | jq -cS .)" = '{"patient":{"name":"Zwolle^Anna"}}' ] || fail "the second job's, got $(kept "$job")"
	# A job cannot be given another's.
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"fdk\": {}, \"patient\": $who}"
	expect_problem 400
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"fdk\": {}, \"study\": $study}"
	expect_problem 400 /study
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$(jq -c '.patient = {name: "Quarx\\\\J"}' <<<"$document")"
	expect_problem 400 /patient/name
	! grep -q Quarx "$body" || fail "a name in a refusal"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$(jq -c '.study = {date: "2026-02-30"}' <<<"$document")"
	expect_problem 422 /study/date
	req GET /v1/scans
	! grep -q 'Quarx\|Zwolle' "$body" || fail "a name in the list"
	req GET /metrics
	! grep -q 'Quarx\|Zwolle\|8315' "$body" || fail "a name in the metrics"
	# The catalogue is an index: made again, it has them from the directories.
	stop_daemon
	! grep -q 'Quarx\|Zwolle\|8315\|4711' "$work/cbctd.err" "$work/cbctd.out" || fail "a name in the log"
	"$BUILD/cbctd" --state-dir "$state" --rebuild-catalogue >/dev/null 2>&1 || fail "the catalogue made again"
	start_daemon
	[ "$(kept "$first" | jq -c .patient.id)" = '"ID-8315"' ] || fail "made again, got $(kept "$first")"
	req GET "/v1/scans/$scan"
	expect_json ".patient == $other"
}

refused() { # STATUS POINTER PATIENT
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$(jq -c --argjson patient "$3" '.patient = $patient' "$work/scan/scan.json")"
	expect_problem "$1" "$2"
}
test_what_is_no_position_and_no_rigid_transform_is_refused() {
	need_nibabel
	start_daemon
	refused 400 /patient/position '{"position": "supine"}'
	refused 400 /patient/world_to_patient '{"position": "HFS", "world_to_patient": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}'
	refused 400 /patient/world_to_patient '{"world_to_patient": [1,0,0, 0,1,0, 0,0,1]}'
	refused 422 /patient/world_to_patient '{"world_to_patient": [-1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}'
	expect_json '.detail | contains("mirror")'
	refused 422 /patient/world_to_patient '{"world_to_patient": [1,0.1,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]}'
	refused 422 /patient/world_to_patient '{"world_to_patient": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,2]}'
}

# As of a console that always sends its fields, of somebody whom nobody knows yet.
test_a_patient_of_whom_nothing_is_told_is_none() {
	local patient
	need_nibabel
	start_daemon
	for patient in '{"name": "", "id": "", "birth_date": "", "sex": ""}' '{"sex": null, "id": null}' '{"position": null, "name": null}' '{}'; do
		req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$(jq -c --argjson patient "$patient" '.patient = $patient' "$work/scan/scan.json")"
		expect_status 201
		expect_json '.patient == null and .axes == null'
	done
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$(jq -c '.patient = {position: "FFS", name: "", id: ""}' "$work/scan/scan.json")"
	expect_status 201
	expect_json '.patient.position == "FFS" and .axes.z == "I"'
	# A name has no control characters, the second block of them included.
	for name in '\u007f' 'a\u0085b' '\u009f'; do
		req POST /v1/scans -H 'Content-Type: application/json' --data-binary "$(jq -c ".name = \"$name\"" "$work/scan/scan.json")"
		expect_problem 400 /name
	done
}

test_recon_without_a_daemon_and_the_tools_know_the_sides() {
	local position
	need_nibabel
	echo "{$recipe}" >"$work/recipe.json"
	for position in HFDR tilted unknown; do
		scan_of "$position" "$work/$position"
		cbct recon "$work/$position" "$work/recipe.json" -o "$work/out" --quiet >/dev/null
		sides check "$position" "" "" "nifti,1/mm,$work/out/final.nii"
		[ $position = unknown ] || mv "$work/out/final.nii" "$work/$position.nii"
	done
	# The same voxels in two positions are two volumes, and one as its own file is itself.
	cbct compare "$work/HFDR.nii" "$work/HFDR.nii" | grep . >/dev/null || fail "an exchange of axes that is read"
	cbct compare "$work/tilted.nii" "$work/tilted.nii" | grep . >/dev/null || fail "an oblique volume that is read"
	! cbct compare "$work/tilted.nii" "$work/out/final.nii" 2>"$work/why" || fail "oblique against straight refused"
	grep -q "turned against" "$work/why" || fail "the reason, got $(cat "$work/why")"
	cbct slice "$work/tilted.nii" -o "$work/tilted.png"
	gzip -k "$work/tilted.nii"
	cbct slice "$work/tilted.nii.gz" -o "$work/packed.png"
	cmp "$work/tilted.png" "$work/packed.png" || fail "the same slice of a compressed file"
	cbct compare "$work/tilted.nii.gz" "$work/tilted.nii" | grep . >/dev/null || fail "a compressed file compared"
	head -c 30000 "$work/tilted.nii.gz" >"$work/cut.nii.gz"
	! cbct slice "$work/cut.nii.gz" -o "$work/packed.png" 2>"$work/why" || fail "a file that was cut off refused"
	printf '\x55' | dd of="$work/tilted.nii.gz" bs=1 seek=40000 conv=notrunc status=none
	! cbct slice "$work/tilted.nii.gz" -o "$work/packed.png" 2>"$work/why" || fail "a damaged file refused"
	cbct simulate --phantom ball --scale 20 --views 3 --columns 8 --rows 8 --truth "$work/truth.nii.gz" --grid 20 --spacing 2 \
		--patient FFP -o "$work/simulated" 2>/dev/null
	"$python" -c 'import nibabel, sys
assert nibabel.aff2axcodes(nibabel.load(sys.argv[1]).affine) == ("L", "A", "I")' "$work/truth.nii.gz" || fail "the truth of a patient FFP"
}

# Files of state directories from before there was an extension begin their voxels earlier.
test_volumes_from_before_there_was_an_extension_are_served_right() {
	local slice raw
	need_nibabel
	start_daemon
	job_of unknown
	get_volume final "$work/before.raw" format=raw
	req GET "/v1/jobs/$job/volumes/final/slice?axis=y"
	cp "$body" "$work/before.png"
	stop_daemon
	sides old "$state/jobs/$job/final.nii"
	start_daemon
	get_volume final "$work/after.raw" format=raw
	cmp "$work/before.raw" "$work/after.raw" || fail "the same voxels"
	req GET "/v1/jobs/$job/volumes/final/slice?axis=y"
	cmp "$body" "$work/before.png" || fail "the same picture"
	get_volume final "$work/after.nii"
	cmp <(tail -c +4097 "$work/after.nii") "$work/after.raw" || fail "the same voxels as NIfTI"
	"$python" -c 'import nibabel, sys
image = nibabel.load(sys.argv[1])
assert nibabel.aff2axcodes(image.affine) == ("L", "P", "S"), image.affine
assert b"left and right are not known" in image.header["descrip"].item()' "$work/after.nii" || fail "a header that says what is not known"
}

run_tests
