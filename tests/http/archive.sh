# Archives for the tests that send to them: Orthanc with its DICOMweb plugin, and some that do wrong. Sourced behind lib.sh.
python=${PYTHON:-/usr/bin/python3}
stop_after_each=1
program=cbctd-held
[ -e "$BUILD/cbctd-held" ] || program=cbctd

need_archive() {
	trap stop_peers EXIT # of the test
	rm -rf "$work/archive"
	plugin=$(ls /usr/share/orthanc/plugins/libOrthancDicomWeb.so 2>/dev/null) && command -v Orthanc >/dev/null ||
		skip "Orthanc of the package orthanc-dicomweb is not here"
	"$python" -c 'import gdcm, numpy, pydicom' 2>/dev/null || skip "python3-pydicom or python3-gdcm is not here"
	[ -e "$work/scan/scan.json" ] || { mkdir -p "$work/scan" && "$python" "$top/tests/http/sides.py" make "$work/scan"; }
}
# start_archive: with what it had, and settings of $more; sets $archive (its process), $rest (its address), $web and $dimse (its ports).
start_archive() {
	local i
	mkdir -p "$work/archive"
	[ -n "${web:-}" ] || read -r web dimse commit < <("$python" "$top/tests/http/ports.py" 3)
	mkdir -p "$work/worklist"
	jq -n --argjson more "${more:-{\}}" --arg plugin "$plugin" --arg worklists "${plugin%/*}/libModalityWorklists.so" --arg worklist "$work/worklist" --arg work "$work/archive" --argjson web "$web" --argjson dimse "$dimse" --argjson commit "$commit" '{
		Name: "ARCHIVE", DicomAet: "ARCHIVE", DicomCheckCalledAet: true, DicomPort: $dimse, HttpPort: $web, HttpBindAddresses: ["127.0.0.1"],
		RemoteAccessAllowed: false, AuthenticationEnabled: false, StorageDirectory: $work, IndexDirectory: $work, Plugins: [$plugin, $worklists],
		Worklists: {Enable: true, Database: $worklist},
		DicomModalities: {cbctd: ["CBCTD", "127.0.0.1", $commit]}, DicomAlwaysAllowFind: true, DicomAlwaysAllowStore: true,
		StorageCompression: false, OverwriteInstances: false} + $more' >"$work/archive.json"
	Orthanc "$work/archive.json" >>"$work/archive.log" 2>&1 &
	archive=$!
	echo $archive >>"$work/peers"
	rest=http://127.0.0.1:$web
	for ((i = 0; i < 300; i++)); do
		curl -sf "$rest/system" >/dev/null && return 0
		kill -0 "$archive" || fail "Orthanc runs, got $(tail -3 "$work/archive.log")"
		sleep 0.05
	done
	fail "Orthanc answers"
}
kill_archive() {
	kill -9 "$archive"
	wait "$archive" 2>/dev/null || true
}
# start_peer MODE [dimse]: an archive of send.py, or of peer.py; sets $peer_port, its requests are in $work/peer.log
start_peer() {
	local i with=("$top/tests/http/send.py" web)
	[ "${2:-}" != dimse ] || with=("$top/tests/http/peer.py")
	: >"$work/peer.log"
	: >"$work/peer.port"
	"$python" "${with[@]}" "$1" "$work/peer.log" >"$work/peer.port" &
	peer=$!
	echo $peer >>"$work/peers"
	for ((i = 0; i < 200; i++)); do
		peer_port=$(cat "$work/peer.port")
		[ -z "$peer_port" ] || return 0
		sleep 0.05
	done
	fail "an archive that does wrong"
}
stop_peers() {
	local pid
	[ ! -e "$work/peers" ] || while read -r pid; do kill -9 "$pid" 2>/dev/null || true; done <"$work/peers"
	rm -f "$work/peers"
}

# fetched DIRECTORY: every object that the archive has
fetched() {
	local i
	rm -rf "$1"
	mkdir -p "$1"
	for i in $(curl -sSf "$rest/instances" | jq -r '.[]'); do curl -sSf -o "$1/$i.dcm" "$rest/instances/$i/file"; done
}
# destinations JSON ...: the file, one object each
destinations() { printf '%s\n' "$@" | jq -s '{destinations: .}' >"$work/destinations.json"; }
# sending_becomes STATE [SECONDS [VOLUME]]: of $job
sending_becomes() {
	local end=$((SECONDS + ${2:-30}))
	until req GET "/v1/jobs/$job/send" && jq -e --arg state "$1" --arg volume "${3:-}" '[.sendings[] | select($volume == "" or .volume == $volume)] |
		length > 0 and all(.state == $state)' "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "sendings of $job are $1: $(cat "$body")"
		sleep 0.2
	done
}

# job_of PATIENT [SEND]: reconstructed
job_of() {
	mkdir -p "$work/posted"
	ln -sf "$work/scan/projections.raw" "$work/posted/projections.raw"
	jq -c --argjson patient "$1" '.patient = $patient | .study = {uid: "1.2.3.4.5", accession_number: "A17"}' "$work/scan/scan.json" >"$work/posted/scan.json"
	reconstruct "$work/posted" "{\"scan\": \"SCAN\", $recipe${2:+, \"send\": $2}}"
}
who='{"position": "HFS", "name": "Doe^Jane", "id": "4711"}'
recipe='"grid": {"size": [41, 36, 50], "spacing_mm": [2, 2.4, 1.7], "origin_mm": [-40, -42, -41.65]}, "fdk": {}'
# kills COUNT [dimse]: so many series sent, with a kill -9 of daemon, cbct-dicom or archive in the middle of each; all arrive
# once. By DICOM's own protocol each is committed, too.
kills() {
	local k i pid kind=${2:-dicomweb}
	: >"$work/jobs"
	start_archive
	if [ $kind = dicomweb ]; then
		destinations '{"name": "pacs", "kind": "dicomweb", "url": "http://127.0.0.1:'$web'/dicom-web"}'
	else
		jq -n '{listen: {port: '$commit', address: "127.0.0.1", peers: ["ARCHIVE"]}, destinations: [
			{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "ARCHIVE", commitment_s: 2}]}' >"$work/destinations.json"
	fi
	start_daemon --destinations "$work/destinations.json" --send-pause 0.1
	for ((k = 1; k <= $1; k++)); do
		jq -c --arg k $k '.patient = {position: "HFS", name: "Name\($k)^x", id: "id-\($k)"} | .study = {accession_number: "acc\($k)", uid: "1.2.\($k)"}' "$work/scan/scan.json" >"$work/posted.json"
		scan=$(curl -sSf "$url/v1/scans" -H 'Content-Type: application/json' -d @"$work/posted.json" | jq -r .id)
		post_job "{\"scan\": \"SCAN\", $recipe, \"send\": [\"pacs\"]}"
		echo "$k $scan $job" >>"$work/jobs"
		curl -sSf -T "$work/scan/projections.raw" "$url/v1/scans/$scan/projections" >/dev/null
		for ((i = 0; i < 400; i++)); do
			[ "$(curl -s "$url/v1/jobs/$job/send" | jq -r '.sendings[0].state')" != waiting ] && break
			sleep 0.01
		done
		sleep 0.0$((k * 17 % 10))
		case $((k % 3)) in
		0)
			kill -9 "$(cat "$work/daemon.pid")"
			sleep 0.2
			start_daemon --destinations "$work/destinations.json" --send-pause 0.1
			;;
		1) for pid in $(pgrep -P "$(cat "$work/daemon.pid")" cbct-dicom || true); do kill -9 "$pid" 2>/dev/null || true; done ;;
		2)
			kill_archive
			start_archive
			;;
		esac
	done
	while read -r k scan job; do sending_becomes $([ $kind = dicomweb ] && echo sent || echo committed) 60; done <"$work/jobs"
	fetched "$work/back"
	"$python" "$top/tests/http/send.py" whose "$work/back" "$work/jobs" >"$work/whose" || fail "each object has its own patient"
	[ "$(cat "$work/whose")" = "$(for ((k = 1; k <= $1; k++)); do echo "$k 50 "; done)" ] || fail "50 objects of each, once, got $(grep -v " 50 $" "$work/whose")"
}
