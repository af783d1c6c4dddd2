#!/usr/bin/env bash
# Volumes as DICOM: by two readers voxel for voxel and place for place, in each of the patient's positions; whose they are.
. "$(dirname "$0")/lib.sh"

python=${PYTHON:-/usr/bin/python3}
dicom() { "$python" "$top/tests/http/dicom.py" "$@"; }
need_readers() {
	"$python" -c 'import gdcm, numpy, pydicom' 2>/dev/null || skip "python3-pydicom or python3-gdcm is not here"
	command -v dciodvfy >/dev/null || skip "dciodvfy of the package dicom3tools is not here"
	[ -e "$work/scan/scan.json" ] || { mkdir -p "$work/scan" && "$python" "$top/tests/http/sides.py" make "$work/scan"; }
}
stop_after_each=1
positions="HFS HFP FFS FFP HFDL HFDR FFDL FFDR"
tilted='{"world_to_patient": [0.766044443, -0.642787610, 0, 12, 0.620885352, 0.739941976, -0.258819045, -7, 0.166365675, 0.198266889, 0.965925826, 150, 0, 0, 0, 1]}'
recipe='"grid": {"size": [41, 36, 50], "spacing_mm": [2, 2.4, 1.7], "origin_mm": [-40, -42, -41.65]}, "fdk": {}'
who='{"name": "D\u00f6e^Jane", "id": "4711", "birth_date": "1970-02-28", "sex": "F"}'
study='{"uid": "1.2.3.4.5", "accession_number": "A17", "description": "Knie", "referring_physician": "House^G", "date": "2026-11-23", "time": "04:30:00", "id": "S1"}'

job_of() { # PATIENT: the object, with that patient, reconstructed
	mkdir -p "$work/posted"
	ln -sf "$work/scan/projections.raw" "$work/posted/projections.raw"
	jq -c --argjson patient "$1" --argjson study "$study" '.patient = $patient | .study = $study' "$work/scan/scan.json" >"$work/posted/scan.json"
	reconstruct "$work/posted" "{\"scan\": \"SCAN\", $recipe}"
}
fetch() { # NAME [QUERY [SLICES]]: the slices, and the one object, in $work/NAME
	rm -rf "$work/$1"
	mkdir "$work/$1"
	req GET "/v1/jobs/$job/volumes/final?format=dicom${2:-}"
	expect_status 200
	[[ $(header content-type) == application/zip* && $(header content-disposition) == *"final.zip"* ]] || fail "a zip"
	"$python" -m zipfile -e "$body" "$work/$1/slices" || fail "a zip that is whole"
	[ "$(ls "$work/$1/slices" | wc -l)" = "${3:-50}" ] || fail "${3:-50} slices, got $(ls "$work/$1/slices" | wc -l)"
	req GET "/v1/jobs/$job/volumes/final?format=dicom&dicom=xray-3d${2:-}"
	expect_status 200
	cp "$body" "$work/$1/xray.dcm"
	req GET "/v1/jobs/$job/volumes/final?format=dicom&dicom=enhanced${2:-}"
	expect_status 200
	[[ $(header content-type) == application/dicom* && $(header content-disposition) == *"final.dcm"* ]] || fail "an object"
	cp "$body" "$work/$1/frames.dcm"
}
conforms() { # FILE
	dciodvfy "$1" >"$work/flaws" 2>&1 || true
	! grep -q '^Error\|^Abort' "$work/flaws" || fail "no error of dciodvfy in $1: $(grep '^Error\|^Abort' "$work/flaws" | head -5)"
}

members() { # POSITION: what every object must say
	jq -n --arg position "$1" '{PatientName: "Döe^Jane", PatientID: "4711", PatientBirthDate: "19700228", PatientSex: "F",
		StudyInstanceUID: "1.2.3.4.5", AccessionNumber: "A17", StudyDescription: "Knie", ReferringPhysicianName: "House^G",
		StudyDate: "20261123", StudyTime: "043000", StudyID: "S1", PatientPosition: $position, LossyImageCompression: "00",
		Modality: "CT"}' >"$work/members.json"
	jq '.Modality = "XA"' "$work/members.json" >"$work/xray.json"
}
test_every_position_is_read_back_voxel_for_voxel_and_place_for_place() {
	local position
	need_readers
	start_daemon
	# One volume for all positions, which the requests tell; a matrix and a position that the scan tells.
	job_of "$who"
	get_volume final "$work/voxels.raw" "format=raw&type=int16"
	for position in $positions; do
		fetch here "&position=$position"
		members $position
		dicom check $position "$work/voxels.raw" "$work/members.json" "$work/here/slices/"*.dcm -- "$work/here/frames.dcm" || fail "$position"
		dicom check $position "$work/voxels.raw" "$work/xray.json" "$work/here/xray.dcm" || fail "X-Ray 3D in $position"
		conforms "$work/here/slices/CT00050.dcm"
		conforms "$work/here/xray.dcm"
		conforms "$work/here/frames.dcm"
	done
	for position in tilted HFDR; do
		job_of "$(jq -c --argjson who "$who" '. + $who' <<<"$([ $position = tilted ] && echo "$tilted" || echo "{\"position\": \"$position\"}")")"
		get_volume final "$work/voxels.raw" "format=raw&type=int16"
		fetch here
		members "${position/tilted/}"
		dicom check $position "$work/voxels.raw" "$work/members.json" "$work/here/slices/"*.dcm -- "$work/here/frames.dcm" || fail "$position"
		dicom check $position "$work/voxels.raw" "$work/xray.json" "$work/here/xray.dcm" || fail "X-Ray 3D in $position"
		conforms "$work/here/slices/CT00001.dcm"
		conforms "$work/here/xray.dcm"
		conforms "$work/here/frames.dcm"
	done
}

test_the_same_volume_has_the_same_uids_and_another_has_others() {
	need_readers
	start_daemon
	job_of '{"position": "HFS"}'
	fetch first
	etag=$(header etag)
	req GET "/v1/jobs/$job/volumes/final?format=dicom&dicom=enhanced" -H "If-None-Match: $etag"
	expect_status 304
	req DELETE "/v1/scans/$scan"
	expect_status 204
	stop_daemon
	start_daemon
	fetch again
	diff -r "$work/first" "$work/again" || fail "the same bytes after a restart, without the scan"
	fetch half "&scale=2" 25
	{ dicom uids "$work/first/slices/"*.dcm "$work/first/frames.dcm" "$work/half/slices/"*.dcm "$work/half/frames.dcm"; } >"$work/uids"
	[ "$(cut -d' ' -f2 "$work/uids" | sort -u | wc -l)" = 77 ] || fail "an instance's UID for each of the 77 objects"
	[ "$(cut -d' ' -f3 "$work/uids" | sort -u | wc -l)" = 4 ] || fail "4 series"
	[ "$(cut -d' ' -f4,5 "$work/uids" | sort -u | wc -l)" = 1 ] || fail "one study and frame of reference"
}

# Volumes reference the objects that their projections were, also when the scan is gone; a scan of no objects references none.
test_the_objects_of_the_projections_are_referenced() {
	local source='{"class": "1.2.840.10008.5.1.4.1.1.12.1", "series": "1.2.9", "instances": ["1.2.9.1", "1.2.9.2", "1.2.9.3"]}' bad file
	need_readers
	start_daemon
	job_of '{"position": "HFS"}'
	fetch without
	! dicom sources "$work/without/slices/CT00001.dcm" 2>/dev/null || fail "no sources"
	jq -c --argjson source "$source" '.source = $source' "$work/posted/scan.json" >"$work/with.json"
	for bad in '.source.class = "x"' '.source.instances = []' '.source.instances[1] = "01.2"' 'del(.source.series)' '.source.more = 1' '.source = 1'; do
		jq -c "$bad" "$work/with.json" >"$work/bad.json"
		req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/bad.json"
		expect_status 400
		expect_json '.pointer | startswith("/source")'
	done
	mv "$work/with.json" "$work/posted/scan.json"
	reconstruct "$work/posted" "{\"scan\": \"SCAN\", $recipe}"
	req GET "/v1/scans/$scan"
	expect_json ".source == $source"
	req DELETE "/v1/scans/$scan"
	expect_status 204
	fetch with
	[ "$(dicom sources "$work/with/slices/CT00001.dcm" "$work/with/slices/CT00050.dcm" "$work/with/frames.dcm" "$work/with/xray.dcm" | sort -u)" = \
		"1.2.840.10008.5.1.4.1.1.12.1 1.2.9.1 1.2.9.2 1.2.9.3" ] || fail "the sources"
	for file in slices/CT00001.dcm frames.dcm xray.dcm; do
		conforms "$work/with/$file"
		# A viewer that is told no window takes the first slice's own range, which is of air.
		[ "$(dcmdump +s +P 0028,1050 +P 0028,1051 "$work/with/$file" | grep -oE '\[[0-9]+\]' | paste -sd' ')" = "[400] [2000]" ] || fail "a window in $file"
	done
}

# A CT image says where the patient's left is: without that, there is none, unless the request says it.
test_slices_without_a_side_are_refused() {
	need_readers
	start_daemon
	job_of null
	for kind in slices enhanced; do
		req GET "/v1/jobs/$job/volumes/final?format=dicom&dicom=$kind"
		expect_problem 409
		expect_json '.detail | contains("how the patient lies")'
	done
	fetch told "&position=FFP"
	get_volume final "$work/voxels.raw" "format=raw&type=int16"
	echo '{"PatientPosition": "FFP", "PatientName": ""}' >"$work/members.json"
	dicom check FFP "$work/voxels.raw" "$work/members.json" "$work/told/slices/"*.dcm
	cbct get "$job" final --format dicom --position FFP -o "$work/got.zip"
	"$python" -m zipfile -e "$work/got.zip" "$work/got"
	diff -r "$work/got" "$work/told/slices" || fail "the same slices by cbct"
	cbct get "$job" final --format dicom --dicom enhanced --position FFP -o "$work/got.dcm"
	cmp "$work/got.dcm" "$work/told/frames.dcm" || fail "the same object by cbct"
	! cbct get "$job" final --format dicom -o "$work/never" 2>"$work/said" || fail "no side, no object"
	grep -q "how the patient lies" "$work/said" || fail "the reason, got $(cat "$work/said")"
	for query in "format=dicom&position=HFX" "position=HFS" "format=mha&dicom=slices" "format=dicom&type=float32" "format=dicom&dicom=both"; do
		req GET "/v1/jobs/$job/volumes/final?$query"
		expect_problem 400
	done
	req GET "/v1/jobs/$job/stream?format=dicom"
	expect_problem 400
	job_of '{"position": "HFS"}'
	req GET "/v1/jobs/$job/volumes/final?format=dicom&position=HFP"
	expect_problem 409
}

# A real archive takes them by C-STORE and by STOW-RS, finds as many as were sent, and gives back what it was given.
test_an_archive_takes_them_and_gives_back_the_same() {
	local web rest dimse aet=ARCHIVE i series plugin tool
	need_readers
	for tool in Orthanc storescu findscu; do
		command -v $tool >/dev/null || skip "$tool of the packages orthanc and dcmtk is not here"
	done
	plugin=$(ls /usr/share/orthanc/plugins/libOrthancDicomWeb.so 2>/dev/null) || skip "the plugin of the package orthanc-dicomweb is not here"
	mkdir -p "$work/archive"
	read -r web dimse < <("$python" "$top/tests/http/ports.py" 2)
	jq -n --arg plugin "$plugin" --arg work "$work/archive" --arg aet $aet --argjson web "$web" --argjson dimse "$dimse" '{Name: $aet, DicomAet: $aet,
		DicomPort: $dimse, HttpPort: $web, HttpBindAddresses: ["127.0.0.1"], RemoteAccessAllowed: false, AuthenticationEnabled: false,
		StorageDirectory: $work, IndexDirectory: $work, Plugins: [$plugin], DicomModalities: {}, DicomAlwaysAllowFind: true,
		DicomAlwaysAllowStore: true, StorageCompression: false}' >"$work/archive.json"
	Orthanc "$work/archive.json" >"$work/archive.log" 2>&1 &
	archive=$!
	trap 'kill "$archive" 2>/dev/null; wait "$archive" 2>/dev/null' EXIT
	start_daemon
	job_of "$(jq -c '. + {position: "HFDL"}' <<<"$who")"
	fetch sent
	rest=http://127.0.0.1:$web
	for ((i = 0; i < 300; i++)); do
		curl -sf "$rest/system" >/dev/null && break
		kill -0 "$archive" || fail "Orthanc runs, got $(tail -3 "$work/archive.log")"
		sleep 0.1
	done
	storescu -aec $aet --scan-directories 127.0.0.1 "$dimse" "$work/sent/slices" 2>"$work/said" || fail "C-STORE, got $(cat "$work/said")"
	curl -sSf "$rest/dicom-web/studies" -H 'Accept: application/dicom+json' -H 'Content-Type: multipart/related; type="application/dicom"; boundary=between' --data-binary @<(
		printf -- '--between\r\nContent-Type: application/dicom\r\n\r\n'
		cat "$work/sent/frames.dcm"
		printf '\r\n--between--\r\n'
	) >"$work/stow" || fail "STOW-RS, got $(cat "$work/stow")"
	series=$(dicom uids "$work/sent/slices/CT00001.dcm" | cut -d' ' -f3)
	findscu -S -aec $aet -k QueryRetrieveLevel=IMAGE -k StudyInstanceUID=1.2.3.4.5 -k "SeriesInstanceUID=$series" -k SOPInstanceUID 127.0.0.1 "$dimse" 2>&1 |
		grep -c 'SOPInstanceUID' >"$work/found" || true
	[ "$(curl -sSf "$rest/dicom-web/instances?StudyInstanceUID=1.2.3.4.5" -H 'Accept: application/dicom+json' | jq length)" = 51 ] || fail "51 instances by QIDO-RS"
	[ "$(cat "$work/found")" -ge 50 ] || fail "50 slices by C-FIND, got $(cat "$work/found")"
	mkdir -p "$work/back"
	for i in $(curl -sSf "$rest/instances" | jq -r '.[]'); do curl -sSf -o "$work/back/$i.dcm" "$rest/instances/$i/file"; done
	get_volume final "$work/voxels.raw" "format=raw&type=int16"
	members HFDL
	mkdir -p "$work/back/slices" "$work/back/frames"
	dicom uids "$work/back/"*.dcm | paste -d' ' - <(ls "$work/back/"*.dcm) | while read -r class _ _ _ _ file; do
		[ "$class" = 1.2.840.10008.5.1.4.1.1.2 ] && mv "$file" "$work/back/slices" || mv "$file" "$work/back/frames"
	done
	dicom check HFDL "$work/voxels.raw" "$work/members.json" "$work/back/slices/"*.dcm -- "$work/back/frames/"*.dcm || fail "what came back"
	# The archive knows them again: what is sent twice is there once.
	storescu -aec $aet --scan-directories 127.0.0.1 "$dimse" "$work/sent/slices" 2>"$work/said" || fail "C-STORE again, got $(cat "$work/said")"
	[ "$(curl -sSf "$rest/instances" | jq length)" = 51 ] || fail "51 instances after sending twice"
}

# Scans of many patients, posted, deleted and reconstructed at once, and the daemon killed: each job's objects are its scan's patient's.
test_a_job_never_has_another_scans_patient() {
	local k scan job pids=() count=6
	need_readers
	start_daemon
	one() { # K
		local scan job document
		document=$(jq -c --arg k "$1" '.patient = {position: "HFS", name: "Name\($k)^x", id: "id-\($k)"} | .study = {accession_number: "acc\($k)", uid: "1.2.\($k)"}' "$work/scan/scan.json")
		scan=$(curl -sS "$url/v1/scans" -H 'Content-Type: application/json' -d "$document" | jq -r .id)
		job=$(curl -sS "$url/v1/jobs" -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"grid\": {\"size\": [8, 8, 8], \"spacing_mm\": [9, 9, 9]}, \"fdk\": {}}" | jq -r .id)
		curl -sS -T "$work/scan/projections.raw" "$url/v1/scans/$scan/projections" >/dev/null
		echo "$1 $scan $job" >>"$work/jobs"
	}
	: >"$work/jobs"
	for ((k = 1; k <= count; k++)); do
		one $k &
		pids+=($!)
	done
	wait "${pids[@]}"
	kill -9 "$(cat "$work/daemon.pid")"
	sleep 0.2
	start_daemon
	while read -r k scan job; do
		wait_job succeeded
		[ $((k % 2)) = 0 ] || req DELETE "/v1/scans/$scan"
	done <"$work/jobs"
	while read -r k scan job; do
		fetch "whose$k" "" 8
	done <"$work/jobs"
	dicom who "$work"/whose*/slices/*.dcm "$work"/whose*/frames.dcm | sort >"$work/said"
	for ((k = 1; k <= count; k++)); do
		[ "$(grep -c "^whose$k " "$work/said")" = 1 ] || fail "one patient of scan $k, got $(grep "^whose$k " "$work/said")"
		grep -qxF "whose$k Name$k^x id-$k acc$k 1.2.$k" "$work/said" || fail "the patient of scan $k, got $(grep "^whose$k " "$work/said")"
	done
}

run_tests
