#!/usr/bin/env bash
# DICOM's own protocol: C-STORE, C-FIND, storage commitment; the worklist; runs of projections that are received.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}
. "$(dirname "$0")/archive.sh"
stop_after_each=1
program=cbctd-held
[ -e "$BUILD/cbctd-held" ] || program=cbctd

need_dcmtk() {
	need_archive
	ldd "$BUILD/cbct-dicom" | grep libdcmnet >/dev/null || skip "cbct-dicom was built without libdcmtk-dev"
}
job_of() { # PATIENT [SEND]: reconstructed
	mkdir -p "$work/posted"
	ln -sf "$work/scan/projections.raw" "$work/posted/projections.raw"
	jq -c --argjson patient "$1" '.patient = $patient | .study = {uid: "1.2.3.4.5", accession_number: "A17"}' "$work/scan/scan.json" >"$work/posted/scan.json"
	reconstruct "$work/posted" "{\"scan\": \"SCAN\", $recipe${2:+, \"send\": $2}}"
}
who='{"position": "HFS", "name": "Doe^Jane", "id": "4711"}'
listening() { echo '{"port": '$commit', "address": "127.0.0.1", "peers": ["ARCHIVE", "CARM"]'"${1:-}"'}'; }

test_a_series_is_stored_found_and_committed() {
	need_dcmtk
	start_archive
	jq -n --argjson listen "$(listening)" '{listen: $listen, destinations: [
		{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "ARCHIVE", send: "last"},
		{name: "whole", kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "ARCHIVE", objects: "enhanced", commitment_s: 0},
		{name: "other", kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "NOBODY"}]}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json" --send-pause 0.2
	req GET "/v1/destinations?wait=10"
	expect_status 200
	expect_json '.destinations | map(.reachable) == [true, true, false]'
	expect_json '.destinations[0] | .kind == "dimse" and .address == "ARCHIVE@127.0.0.1:'$dimse'"'
	expect_json '.destinations[2].detail | contains("refuses the association")'
	job_of "$who"
	sending_becomes committed
	expect_json '.sendings[0] | .attempts == 1 and .instances == 50 and .stored == 50 and .error == null and .ended != null'
	cbct send "$job" --to whole --wait | grep 'whole.*sent' >/dev/null || fail "cbct send to whole"
	fetched "$work/back"
	[ "$(ls "$work/back" | wc -l)" = 51 ] || fail "51 objects"
	mkdir -p "$work/back/slices" "$work/back/frames"
	"$python" "$top/tests/http/dicom.py" uids "$work/back/"*.dcm | paste -d' ' - <(ls "$work/back/"*.dcm) | while read -r class _ _ _ _ file; do
		[ "$class" = 1.2.840.10008.5.1.4.1.1.2 ] && mv "$file" "$work/back/slices" || mv "$file" "$work/back/frames"
	done
	get_volume final "$work/voxels.raw" "format=raw&type=int16"
	echo '{"PatientName": "Doe^Jane", "PatientID": "4711", "AccessionNumber": "A17", "StudyInstanceUID": "1.2.3.4.5"}' >"$work/members.json"
	"$python" "$top/tests/http/dicom.py" check HFS "$work/voxels.raw" "$work/members.json" "$work/back/slices/"*.dcm -- "$work/back/frames/"*.dcm || fail "what came back"
}

test_peers_that_do_wrong() {
	local mode
	need_dcmtk
	for mode in keeps lies refuses regrets unasked silent drips hangs-up; do
		start_peer $mode dimse
		jq -n --arg mode $mode '{destinations: [{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '"$peer_port"', title: "PEER", commitment_s: 1,
			timeout_s: 1}]}' >"$work/destinations.json"
		start_daemon --destinations "$work/destinations.json" --send-pause 0.1 \
			--send-limit $([[ $mode == regrets || $mode == keeps || $mode == hangs-up || $mode == unasked ]] && echo 60 || echo 0.1)
		job_of "$who" '["pacs"]'
		case $mode in
		keeps) # It answers where it was asked: no listener is needed.
			sending_becomes committed
			[ "$(grep -c ^0001 "$work/peer.log")" = 50 ] || fail "each object once"
			;;
		lies)
			sending_becomes failed
			expect_json '.sendings[0].error | contains("it has 0 of 50")'
			;;
		refuses)
			sending_becomes failed
			expect_json '.sendings[0].error | contains("0xa700")'
			;;
		regrets) # It says that it has all, and would not keep them: they are sent again.
			sending_becomes committed
			expect_json '.sendings[0].attempts == 2'
			[ "$(grep -c ^0001 "$work/peer.log")" = 100 ] || fail "each object twice, got $(grep -c ^0001 "$work/peer.log")"
			;;
		unasked)
			until req GET "/v1/jobs/$job/send" && jq -e '.sendings[0].error != null' "$body" >/dev/null; do sleep 0.05; done
			expect_json '.sendings[0].error | contains("takes its word")'
			jq '.destinations[0].unproven = true' "$work/destinations.json" >"$work/taken.json"
			cp "$work/taken.json" "$work/destinations.json"
			kill -HUP "$(cat "$work/daemon.pid")"
			sending_becomes sent
			;;
		silent | drips)
			sending_becomes failed
			expect_json '.sendings[0].error | contains("too slowly") or contains("C-STORE") or contains("C-FIND")'
			;;
		hangs-up)
			sending_becomes committed 60
			expect_json '.sendings[0] | .stored == 50 and .attempts > 1'
			;;
		esac
		stop_daemon
		kill -9 $peer
	done
	! grep -q Doe "$work/cbctd.err" || fail "no patient in the log"
}

# step NAME PATIENT ID DATE ACCESSION [LINE ...]: an entry of the archive's worklist; lines of dump2dcm beside its own
step() {
	local name=$1 patient=$2 id=$3 date=$4 accession=$5
	shift 5
	{
		printf '%s\n' "(0008,0005) CS [ISO_IR 100]" "(0008,0050) SH [$accession]" "(0008,0090) PN [House^Gregory]" "(0010,0010) PN [$patient]" \
			"(0010,0020) LO [$id]" "(0010,0030) DA [19700228]" "(0010,0040) CS [F]" "(0020,000d) UI [1.2.3.$id]" "$@" \
			"(0040,0100) SQ" "(fffe,e000) na" "(0008,0060) CS [XA]" "(0040,0001) AE [CBCTD]" "(0040,0002) DA [$date]" "(0040,0003) TM [103000]" \
			"(0040,0007) LO [Knee, 3D]" "(0040,0009) SH [$name]" "(fffe,e00d) na" "(fffe,e0dd) na" "(0040,1001) SH [RP$name]"
	} >"$work/step.dump"
	dump2dcm --quiet --write-xfer-little +te "$work/step.dump" "$work/worklist/$name.wl"
}

test_todays_patients_come_from_the_worklist() {
	local today
	need_dcmtk
	today=$(date +%Y%m%d)
	mkdir -p "$work/worklist"
	step S1 $'M\xfcller^Jane' 11 $today A11
	step S2 'Smith^John' 12 $today A12
	step S3 'Tomorrow^Tim' 13 $(date -d '+1 day' +%Y%m%d) A13
	step S4 'Nobody^Known' 14 $today A14
	step S5 'Twin^One' 15 $today A12
	start_archive
	jq -n '{title: "CBCTD", destinations: [], worklist: {host: "127.0.0.1", port: '$dimse', title: "ARCHIVE", station: "CBCTD"}}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json"
	req GET /v1/worklist
	expect_status 200
	expect_json '.detail == null and .not_shown == 0 and (.steps | map(.id) | sort) == ["S1", "S2", "S4", "S5"]'
	expect_json '.steps[] | select(.id == "S1") | .patient == {name: "Müller^Jane", id: "11", birth_date: "1970-02-28", sex: "F"} and .study ==
		{uid: "1.2.3.11", accession_number: "A11", referring_physician: "House^Gregory"} and .procedure == "RPS1" and .description == "Knee, 3D"
		and .time == "10:30:00" and .not_read == []'
	cbct worklist | grep 'S2 .*A12.*Smith^John' >/dev/null || fail "cbct worklist"
	scan=$(cbct upload "$work/scan" --quiet --worklist S1)
	req GET "/v1/scans/$scan"
	expect_json '.patient.name == "Müller^Jane" and .study.uid == "1.2.3.11"'
	# A name that two steps have, one that none has, and a scan that is another's.
	! cbct upload "$work/scan" --quiet --worklist A12 2>"$work/said" || fail "no scan of two steps"
	grep -q '2 steps of the worklist' "$work/said" || fail "two steps, got $(cat "$work/said")"
	! cbct upload "$work/scan" --quiet --worklist S9 2>"$work/said" || fail "no scan of no step"
	mkdir -p "$work/others"
	ln -sf "$work/scan/projections.raw" "$work/others/projections.raw"
	jq '.patient.id = "99"' "$work/scan/scan.json" >"$work/others/scan.json"
	! cbct upload "$work/others" --quiet --worklist S1 2>"$work/said" || fail "no scan of another patient"
	grep -q 'another id than the step' "$work/said" || fail "another patient, got $(cat "$work/said")"
	kill_archive
	req GET /v1/worklist
	expect_json '(.detail | contains("cannot be reached")) and (.steps | length) == 4'
	! cbct worklist 2>"$work/said" || fail "what was told before is not told as today's"
	! grep -E 'Jane|Smith' "$work/cbctd.err" || fail "no patient in the log"
}

# xa NAME OPTION ...: a run of projections as an XA object
xa() {
	local name=$1
	shift
	[ -e "$work/counts/scan.json" ] || { mkdir -p "$work/counts" && "$python" "$top/tests/http/sides.py" make "$work/counts" counts; }
	"$python" "$top/tests/http/images.py" dicom "$work/counts" "$work/$name.dump" patient=HFS "$@"
	(cd "$work" && dump2dcm --quiet "$name.dump" "$name.dcm")
}

test_a_run_that_is_received_is_a_scan() {
	local one=(who:0010,0020,LO=4711 who:0020,000d,UI=1.2.3 who:0008,0050,SH=A17 who:0020,000e,UI=1.2.3.5)
	need_dcmtk
	[ -n "${commit:-}" ] || read -r web dimse commit < <("$python" "$top/tests/http/send.py" ports 3)
	jq -n --argjson listen "$(listening ', "receive": {"url": "unix:'"$work"'/sock", "quiet_s": 0.3, "import": {"air": 50000, "source-to-isocentre": 600}}')" \
		'{listen: $listen, destinations: []}' >"$work/destinations.json"
	start_daemon --listen "unix:$work/sock" --destinations "$work/destinations.json"
	until grep -q "listening for DICOM" "$work/cbctd.err"; do sleep 0.05; done
	xa run "${one[@]}"
	storescu -aet CARM -aec CBCTD 127.0.0.1 "$commit" "$work/run.dcm" 2>"$work/said" || fail "C-STORE, got $(cat "$work/said")"
	until grep -q "that was received is scan" "$work/cbctd.err"; do sleep 0.05; done
	req GET /v1/scans
	scan=$(jq -r '.scans[0].id' "$body")
	req GET "/v1/scans/$scan"
	expect_json '.patient.id == "4711" and .patient.position == "HFS" and .study == {uid: "1.2.3", accession_number: "A17"} and .missing == []'
	cbct import "$work/run.dcm" --air 50000 --source-to-isocentre 600 -o "$work/run.scan" --quiet 2>/dev/null
	req GET "/v1/scans/$scan/projections/7"
	dd if="$work/run.scan/projections.raw" bs="$(stat -c %s "$body")" skip=7 count=1 status=none | cmp - "$body" || fail "the projections"
	# Sent twice, it is the same scan; who is not known, calls another or sends something else is refused.
	storescu -aet CARM -aec CBCTD 127.0.0.1 "$commit" "$work/run.dcm" 2>"$work/said" || fail "C-STORE again"
	until [ "$(grep -c "that was received is scan $scan" "$work/cbctd.err")" = 2 ]; do sleep 0.05; done
	! storescu -aet STRANGER -aec CBCTD 127.0.0.1 "$commit" "$work/run.dcm" 2>/dev/null || fail "a stranger is refused"
	! storescu -aet CARM -aec OTHER 127.0.0.1 "$commit" "$work/run.dcm" 2>/dev/null || fail "another title is refused"
	echoscu -aet CARM -aec CBCTD 127.0.0.1 "$commit" || fail "C-ECHO"
	head -c 100000 /dev/urandom >/dev/tcp/127.0.0.1/"$commit" || true
	# What cannot be imported stays, and is told.
	xa bad "${one[@]}" who:0028,1041,SS=-1
	sed -i 's/\[1\.2\.3\.4\.5\.6\]/[1.2.3.6]/' "$work/bad.dump"
	(cd "$work" && dump2dcm --quiet bad.dump bad.dcm)
	storescu -aet CARM -aec CBCTD 127.0.0.1 "$commit" "$work/bad.dcm" 2>"$work/said" || fail "C-STORE of what is no scan"
	until grep -q "cannot be imported, and stays in received/" "$work/cbctd.err"; do sleep 0.05; done
	[ -e "$work/state/received/failed-1.2.3.6" ] || fail "the run that failed"
	[ "$(find "$work/state/received" -mindepth 1 -maxdepth 1 | wc -l)" = 1 ] || fail "nothing else is left"
	req GET /v1/scans
	expect_json '[.scans[] | select(.name == "1.2.3.4.5.6")] | length == 1'
	! grep -E '4711|A17|Müller' "$work/cbctd.err" || fail "no patient in the log"
}

run_tests
