#!/usr/bin/env bash
# DICOM's own protocol: C-STORE, C-FIND, storage commitment; the worklist; runs of projections that are received.
. "$(dirname "$0")/lib.sh"
. "$(dirname "$0")/archive.sh"

need_dcmtk() {
	need_archive
	ldd "$BUILD/cbct-dicom" | grep libdcmnet >/dev/null || skip "cbct-dicom was built without libdcmtk-dev"
}
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

# certificate NAME AUTHORITY [SUBJECT ALTERNATIVE NAME]: $work/NAME.pem and .key; an authority's own AUTHORITY is itself
certificate() {
	local by=(-CA "$work/$2.pem" -CAkey "$work/$2.key")
	[ "$1" != "$2" ] || by=()
	openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj "/CN=$1" -keyout "$work/$1.key" -out "$work/$1.pem" \
		${3:+-addext "subjectAltName=$3" -addext basicConstraints=CA:FALSE} "${by[@]}" 2>"$work/openssl.log" || fail "a certificate: $(cat "$work/openssl.log")"
}

test_an_archive_behind_tls() {
	local more row
	need_dcmtk
	certificate authority authority
	certificate stranger stranger
	certificate archive authority IP:127.0.0.1
	certificate ours authority DNS:cart
	more=$(jq -n --arg work "$work" '{DicomTlsEnabled: true, DicomTlsCertificate: "\($work)/archive.pem", DicomTlsPrivateKey: "\($work)/archive.key",
		DicomTlsTrustedCertificates: "\($work)/authority.pem"}')
	mkdir -p "$work/worklist"
	step S1 'Smith^John' 11 "$(date +%Y%m%d)" A11
	start_archive
	row='{kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "ARCHIVE", ca_file: "\($work)/authority.pem", certificate_file: "\($work)/ours.pem",
		key_file: "\($work)/ours.key", timeout_s: 5}'
	jq -n --arg work "$work" --argjson listen "$(listening)" "$row"' as $row | {listen: $listen, worklist: ($row | del(.kind)), destinations: [
		$row + {name: "pacs"}, $row + {name: "stranger", ca_file: "\($work)/stranger.pem"}, $row + {name: "name", host: "localhost"},
		($row + {name: "nobody"} | del(.certificate_file, .key_file)), ($row + {name: "plain"} | del(.ca_file, .certificate_file, .key_file))]}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json" --send-pause 0.2
	req GET "/v1/destinations?wait=20"
	expect_json '.destinations | map(.reachable) == [true, false, false, false, false]'
	expect_json '.destinations[1].detail | contains("certificate is refused")'
	expect_json '.destinations[2].detail | contains("certificate is refused")'
	job_of "$who" '["pacs"]'
	sending_becomes committed
	fetched "$work/back"
	[ "$(ls "$work/back" | wc -l)" = 50 ] || fail "50 objects"
	req GET /v1/worklist
	expect_json '.detail == null and (.steps | map(.id)) == ["S1"]'
	# Files that are none, and one without the other.
	for row in '.certificate_file = "/nowhere"' 'del(.key_file)' 'del(.ca_file)'; do
		jq '.destinations |= [.[0] | '"$row"'] | del(.worklist)' "$work/destinations.json" >"$work/wrong.json"
		! "$BUILD/cbctd" --state-dir "$work/none" --destinations "$work/wrong.json" --listen 127.0.0.1:0 2>"$work/said" || fail "refused: $row"
		grep -q '_file' "$work/said" || fail "the member is named: $(cat "$work/said")"
	done
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
			until req GET "/v1/jobs/$job/send" && member '.sendings[0].error != null' "$body" >/dev/null; do sleep 0.05; done
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
		{uid: "1.2.3.11", accession_number: "A11", referring_physician: "House^Gregory", step_id: "S1", procedure_id: "RPS1"} and .procedure == "RPS1" and .description == "Knee, 3D"
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

# start_system: a department's system that knows of no steps; what it is told is in $work/steps
start_system() {
	[ -n "${ris:-}" ] || ris=$("$python" "$top/tests/http/ports.py" 1)
	"$python" "$top/tests/http/steps.py" "$ris" "$work/steps" >>"$work/system.log" 2>&1 &
	system=$!
	echo $system >>"$work/peers"
	until echoscu 127.0.0.1 "$ris" 2>/dev/null; do sleep 0.1; done
}
stop_system() {
	kill -9 $system
	wait $system 2>/dev/null || true
}
# told: of the step of $job
told() { jq -s --arg job "$job" '(map(select(.[0] == "create" and .[2]."00400253" == $job) | .[1])[0]) as $uid | map(select(.[1] == $uid))' "$work/steps"; }
expect_told() { told | jq -e "$1" >/dev/null || fail "of the step, $1, got $(told)"; }
# step_becomes CONDITION: what the job says of its step
step_becomes() {
	local end=$((SECONDS + 30))
	until req GET "/v1/jobs/$job/send" && member "any(.sendings[]; .to == \"ris\" and $1)" "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "of the step of $job, $1: $(cat "$body")"
		sleep 0.1
	done
}

test_performed_steps_are_told() {
	need_dcmtk
	"$python" -c 'import odil' 2>/dev/null || skip "python3-odil is not here"
	rm -rf "$work/worklist"
	mkdir -p "$work/worklist"
	step S1 $'M\xfcller^Jane' 11 "$(date +%Y%m%d)" A11
	start_archive
	: >"$work/steps"
	start_system
	jq -n '{worklist: {host: "127.0.0.1", port: '$dimse', title: "ARCHIVE"}, destinations: [
		{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "ARCHIVE", send: "last", commitment_s: 0},
		{name: "ris", kind: "mpps", host: "127.0.0.1", port: '$ris', title: "RIS", timeout_s: 5}]}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json" --send-pause 0.2
	req GET "/v1/destinations?wait=10"
	expect_json '.destinations[1] | .kind == "mpps" and .reachable and .objects == null and .send == "none"'
	mkdir -p "$work/lying"
	ln -sf "$work/scan/projections.raw" "$work/lying/projections.raw"
	jq '.patient = {position: "HFS"}' "$work/scan/scan.json" >"$work/lying/scan.json"
	scan=$(cbct upload "$work/lying" --quiet --worklist S1)
	req GET "/v1/scans/$scan"
	expect_json '.study.step_id == "S1" and .study.procedure_id == "RPS1"'
	jq '{detector, projections, geometry, patient, study}' "$body" >"$work/another.json"
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary '{"scan": "'$scan'", "fdk": {}, "send": ["ris"]}'
	expect_problem 422
	post_job "{\"scan\": \"SCAN\", $recipe}"
	wait_job succeeded
	step_becomes '.state == "sent" and .volumes == "step" and .volume == null and .instances == 50 and .stored == 50'
	expect_told 'map(.[0]) == ["create", "set"]'
	expect_told '.[0][2] | ."00100010" == "Müller^Jane" and ."00100020" == "11" and ."00400241" == "CBCTD" and ."00080060" == "CT" and
		(."00400270"[0] | ."0020000d" == "1.2.3.11" and ."00080050" == "A11" and ."00400009" == "S1" and ."00401001" == "RPS1")'
	expect_told '.[1][2] | ."00400252" == "COMPLETED" and (."00400340" | length) == 1 and ."00400340"[0]."00080054" == "ARCHIVE"'
	# The objects that it names are those that the archive has, which name the step.
	told | jq -r '.[1][2]."00400340"[0] | ."0020000e" as $series | ."00081140"[] | "\($series) \(."00081155")"' | sort >"$work/named"
	fetched "$work/back"
	"$python" - "$work/back/"*.dcm <<-'END' | sort | diff - "$work/named" || fail "the objects that the archive has"
		import sys, pydicom
		for name in sys.argv[1:]:
		    data = pydicom.dcmread(name, stop_before_pixels=True)
		    asked = data.RequestAttributesSequence[0]
		    assert (asked.ScheduledProcedureStepID, asked.RequestedProcedureID) == ("S1", "RPS1")
		    print(data.SeriesInstanceUID, data.SOPInstanceUID)
	END
	# One that is cancelled while it waits for projections.
	post_scan_of "$work/another.json"
	post_job "{\"scan\": \"SCAN\", $recipe, \"send\": []}"
	step_becomes '.state == "waiting" and .attempts == 1'
	req DELETE "/v1/jobs/$job"
	step_becomes '.state == "sent"'
	expect_told 'map(.[0]) == ["create", "set"]'
	expect_told '.[1][2] | ."00400252" == "DISCONTINUED" and ."00400340" == [] and ."00400281"[0]."00080100" == "110513"'
	# An end is told over the system's absence, which has then lost the beginning, and over a kill. Nothing was sent.
	post_job "{\"scan\": \"SCAN\", $recipe, \"send\": []}"
	step_becomes '.state == "waiting" and .attempts == 1'
	stop_system
	curl -sSf -T "$work/scan/projections.raw" "$url/v1/scans/$scan/projections" >/dev/null
	wait_job succeeded
	step_becomes '.state == "queued" and (.error | contains("cannot be reached"))'
	kill -9 "$(cat "$work/daemon.pid")"
	start_daemon --destinations "$work/destinations.json" --send-pause 0.2
	start_system
	step_becomes '.state == "sent"'
	expect_told 'map(.[0]) == ["create", "create", "set"]'
	expect_told '.[2][2] | ."00400252" == "COMPLETED" and (."00400340"[0] | ."00080054" == "" and ."00081140" == [])'
	# A job does not go before its end is told, unless that is given up.
	stop_system
	post_job "{\"scan\": \"SCAN\", $recipe, \"send\": []}"
	wait_job succeeded
	req DELETE "/v1/jobs/$job"
	expect_problem 409
	req DELETE "/v1/jobs/$job/send/ris"
	expect_status 204
	req DELETE "/v1/jobs/$job"
	expect_status 204
	! grep -E 'Müller|Jane' "$work/cbctd.err" || fail "no patient in the log"
}

# An answer that is none of ours counts for nothing: it is told again.
test_an_answer_about_another_step_is_none() {
	need_dcmtk
	start_peer mixes-up dimse
	jq -n '{destinations: [{name: "ris", kind: "mpps", host: "127.0.0.1", port: '"$peer_port"', title: "PEER", timeout_s: 5}]}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json" --send-pause 0.2
	jq '.study = {uid: "1.2.3.11", step_id: "S1", procedure_id: "RPS1"} | .patient = {position: "HFS"}' "$work/scan/scan.json" >"$work/stepped.json"
	post_scan_of "$work/stepped.json"
	post_job "{\"scan\": \"SCAN\", $recipe, \"send\": []}"
	step_becomes '.state == "waiting" and .attempts == 3'
	[ "$(grep -c ^0140 "$work/peer.log")" = 3 ] || fail "it is told until it is answered, got $(cat "$work/peer.log")"
}
post_scan_of() {
	scan=$(curl -sSf "$url/v1/scans" -H 'Content-Type: application/json' -d @"$1" | jq -r .id)
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
	local again one=(who:0010,0020,LO=4711 who:0020,000d,UI=1.2.3 who:0008,0050,SH=A17 who:0020,000e,UI=1.2.3.5)
	need_dcmtk
	[ -n "${commit:-}" ] || read -r web dimse commit < <("$python" "$top/tests/http/ports.py" 3)
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
	expect_json '.source == {class: "1.2.840.10008.5.1.4.1.1.12.1", series: "1.2.3.5", instances: ["1.2.3.4.5.6"]}'
	cbct import "$work/run.dcm" --air 50000 --source-to-isocentre 600 -o "$work/run.scan" --quiet 2>/dev/null
	req GET "/v1/scans/$scan/projections/7"
	dd if="$work/run.scan/projections.raw" bs="$(stat -c %s "$body")" skip=7 count=1 status=none | cmp - "$body" || fail "the projections"
	# By configuration it is reconstructed, too: its volume goes where the job says, once, however often it is sent.
	start_peer keeps dimse
	jq '.listen.receive.job = {preset: "preview", labels: {from: "the arm"}, send: ["pacs"]} |
		.destinations = [{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '"$peer_port"', title: "PEER"}]' "$work/destinations.json" >"$work/with.json"
	cp "$work/with.json" "$work/destinations.json"
	: >"$work/cbctd.err"
	kill -HUP "$(cat "$work/daemon.pid")"
	until grep -q "listening for DICOM" "$work/cbctd.err"; do sleep 0.05; done
	for again in 1 2; do
		storescu -aet CARM -aec CBCTD 127.0.0.1 "$commit" "$work/run.dcm" 2>"$work/said" || fail "C-STORE with a job"
		until [ "$(grep -c "is scan $scan, reconstructed by job" "$work/cbctd.err")" = $again ]; do sleep 0.05; done
	done
	req GET "/v1/jobs?scan=$scan"
	expect_json '.jobs | length == 1'
	job=$(jq -r '.jobs[0].id' "$body")
	wait_job succeeded
	req GET "/v1/jobs/$job"
	expect_json '.scan == "'"$scan"'" and .labels == {from: "the arm"} and .patient.position == "HFS"'
	sending_becomes committed
	jq 'del(.listen.receive.job)' "$work/destinations.json" >"$work/with.json"
	cp "$work/with.json" "$work/destinations.json"
	: >"$work/cbctd.err"
	kill -HUP "$(cat "$work/daemon.pid")"
	until grep -q "listening for DICOM" "$work/cbctd.err"; do sleep 0.05; done
	# Sent twice, it is the same scan; who is not known, calls another or sends something else is refused.
	storescu -aet CARM -aec CBCTD 127.0.0.1 "$commit" "$work/run.dcm" 2>"$work/said" || fail "C-STORE again"
	until grep -q "that was received is scan $scan" "$work/cbctd.err"; do sleep 0.05; done
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

# What stands wrongly in the file is refused by its place in it, at the start and by SIGHUP: later nobody is there to see.
test_mistakes_in_the_file_of_destinations_are_refused() {
	local good bad pointer pid
	need_dcmtk
	[ -n "${commit:-}" ] || read -r web dimse commit < <("$python" "$top/tests/http/ports.py" 3)
	good=$(jq -nc --argjson listen "$(listening ', "receive": {"url": "unix:/sock", "import": {"air": 5}, "job": {"fdk": {}, "send": ["a"]}}')" '{title: "CBCTD", listen: $listen,
		worklist: {host: "ris.example", port: 104, title: "RIS"}, destinations: [{name: "a", kind: "dimse", host: "127.0.0.1", port: 9, title: "A"},
		{name: "b", kind: "dicomweb", url: "http://127.0.0.1:9"}]}')
	echo "$good" >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json"
	while IFS='|' read -r pointer bad; do
		jq -c "$bad" <<<"$good" >"$work/destinations.json"
		: >"$work/refused"
		! timeout 20 cbctd --listen 127.0.0.1:0 --state-dir "$work/other" --destinations "$work/destinations.json" >/dev/null 2>"$work/refused" || fail "no start with $bad"
		grep -qF "$pointer: " "$work/refused" || fail "$pointer, got $(cat "$work/refused")"
		: >"$work/cbctd.err"
		kill -HUP "$(cat "$work/daemon.pid")"
		until grep -q "destinations that were read before stay" "$work/cbctd.err"; do sleep 0.05; done
		grep -qF "$pointer: " "$work/cbctd.err" || fail "$pointer by SIGHUP, got $(cat "$work/cbctd.err")"
	done <<-'END'
		/title|.title = ""
		/destinations/0/host|.destinations[0].host = ""
		/destinations/0/host|.destinations[0].host = "pacs example"
		/destinations/0/title|.destinations[0].title = ""
		/destinations/1/name|.destinations[1].name = "a"
		/destinations/1/token_file|.destinations[1].token_file = "/nowhere/token"
		/destinations/1/ca_file|.destinations[1].ca_file = "/nowhere/ca"
		/destinations/0/send|.destinations[0] = {name: "r", kind: "mpps", host: "ris.example", port: 9, title: "RIS", send: "last"}
		/destinations|.destinations += (["r", "s"] | map({name: ., kind: "mpps", host: "ris.example", port: 9, title: "RIS"}))
		/worklist/host|.worklist.host = "-x"
		/listen/address|.listen.address = "localhost"
		/listen/address|.listen.address = ""
		/listen/peers/1|.listen.peers[1] = ""
		/listen/peers/1|.listen.peers[1] = "A\\\\B"
		/listen/receive/url|.listen.receive.url = "ftp://host/"
		/listen/receive/token-file|.listen.receive."token-file" = "/nowhere/token"
		/listen/receive/import/url|.listen.receive.import.url = "http://elsewhere"
		/listen/receive/import/output|.listen.receive.import.output = "/tmp"
		/listen/receive/import/aire|.listen.receive.import.aire = 5
		/listen/receive/import/air|.listen.receive.import.air = false
		/listen/receive/job|.listen.receive.job.scan = "S"
		/listen/receive/job/fdk|.listen.receive.job.fdk = 7
		/listen/receive/job/send/0|.listen.receive.job.send = ["nobody"]
	END
	# The options of import are those that the program has, but for what it connects to and writes.
	sed -n '/^static const char \*const import_options/,/^};/p' "$top/daemon/sendings/application.c" | grep -o '"[a-z-]*"' | tr -d '"' | sort >"$work/known"
	cbct import --help | sed -n '/^images/,$p' | grep -o '^  --[a-z-]*' | tr -d ' ' | sed 's/^--//' | sort >"$work/has"
	echo name | sort - "$work/has" | diff - "$work/known" || fail "the options of cbct import"
}

# One address has its share of the places, and who says nothing does not keep them.
test_idle_connections_shut_nobody_out() {
	local k
	need_dcmtk
	[ -n "${commit:-}" ] || read -r web dimse commit < <("$python" "$top/tests/http/ports.py" 3)
	jq -n --argjson listen "$(listening)" '{listen: $listen, destinations: []}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json"
	until grep -q "listening for DICOM" "$work/cbctd.err"; do sleep 0.05; done
	coproc idle { exec "$python" "$top/tests/http/peer.py" idle "$commit" 127.0.0.1 20; }
	echo "$idle_PID" >>"$work/peers"
	exec {said}<&"${idle[0]}"
	read -r k <&$said
	[ "$("$python" "$top/tests/http/peer.py" echo "$commit" 127.0.0.2 CARM)" = accepted ] || fail "a peer of another address is heard"
	until grep -q "an association from 127.0.0.1, without a title, is refused: there are too many" "$work/cbctd.err"; do sleep 0.05; done
	read -r k <&$said
	[ "$k" = closed ] || fail "who says nothing is cut off"
	until echoscu -aet CARM -aec CBCTD 127.0.0.1 "$commit"; do sleep 0.2; done
	# A refusal is told with its reason and the title that called; many are one line.
	[ "$("$python" "$top/tests/http/peer.py" echo "$commit" 127.0.0.3 STRANGER)" = refused ] || fail "a stranger is refused"
	for k in 1 2 3 4 5; do "$python" "$top/tests/http/peer.py" echo "$commit" 127.0.0.3 STRANGER >/dev/null; done
	until grep -q "an association from 127.0.0.3, STRANGER, is refused: it is none of the peers that may call" "$work/cbctd.err"; do
		"$python" "$top/tests/http/peer.py" echo "$commit" 127.0.0.3 STRANGER >/dev/null
		sleep 0.5
	done
	[ "$(grep -c 'is refused' "$work/cbctd.err")" -lt 8 ] || fail "one line for many, got $(grep 'is refused' "$work/cbctd.err")"
}

# A worklist that hangs says so, and one that comes in its place is asked at once.
test_a_worklist_that_hangs_is_told_and_replaced() {
	need_dcmtk
	start_peer hangs dimse
	rm -rf "$work/worklist"
	mkdir -p "$work/worklist"
	step S2 'Smith^John' 12 "$(date +%Y%m%d)" A12
	start_archive
	jq -n '{destinations: [], worklist: {host: "127.0.0.1", port: '"$peer_port"', title: "PEER", timeout_s: 600}}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json"
	! cbct destinations >"$work/said" 2>&1 || fail "there are no destinations"
	grep -q "no destinations" "$work/said" || fail "no destinations, got $(cat "$work/said")"
	req GET "/v1/worklist?wait=1"
	expect_status 200
	expect_json '.steps == [] and .checked == null and (.detail | contains("has not answered yet"))'
	jq -n '{destinations: [], worklist: {host: "127.0.0.1", port: '"$dimse"', title: "ARCHIVE"}}' >"$work/destinations.json"
	kill -HUP "$(cat "$work/daemon.pid")"
	until req GET "/v1/worklist?wait=1" && member '.detail == null and (.steps | map(.id)) == ["S2"]' "$body" >/dev/null; do sleep 0.2; done
	# What another worklist told is not shown as this one's.
	jq -n '{destinations: [], worklist: {host: "127.0.0.1", port: '"$peer_port"', title: "PEER"}}' >"$work/destinations.json"
	kill -HUP "$(cat "$work/daemon.pid")"
	until req GET "/v1/worklist?wait=0" && member '.steps == []' "$body" >/dev/null; do sleep 0.05; done
}

# What one row's archive does says nothing of another's of the same name.
test_a_changed_destination_is_another_archive() {
	need_dcmtk
	start_peer hangs dimse
	start_archive
	jq -n '{destinations: [{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '"$peer_port"', title: "PEER", timeout_s: 600}]}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json"
	until grep -q ^0030 "$work/peer.log"; do sleep 0.05; done
	jq -n '{destinations: [{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '"$dimse"', title: "ARCHIVE"}]}' >"$work/destinations.json"
	kill -HUP "$(cat "$work/daemon.pid")"
	until req GET /v1/destinations && member '.destinations[0] | .reachable and .detail == null' "$body" >/dev/null; do sleep 0.05; done
	! grep -q "answers again" "$work/cbctd.err" || fail "it never was away"
}

run_tests
