#!/usr/bin/env bash
# How long 512 slices of 512 x 512 take to Orthanc, from the request to the archive's promise (C-STORE) or proof (STOW-RS), in
# seconds. tests/bench/send.sh; needs the packages that `make check` installs for tests of archives.
. "$(dirname "$0")/../http/lib.sh"
. "$top/tests/http/archive.sh"
program=cbctd # without the checks of tests

measure() {
	local to began patient
	need_archive
	start_archive
	jq -n '{listen: {port: '$commit', address: "127.0.0.1", peers: ["ARCHIVE"]}, destinations: [
		{name: "dimse", kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "ARCHIVE"},
		{name: "dicomweb", kind: "dicomweb", url: "http://127.0.0.1:'$web'/dicom-web"}]}' >"$work/destinations.json"
	start_daemon --destinations "$work/destinations.json"
	jq -c '.patient = {position: "HFS"}' "$work/scan/scan.json" >"$work/posted.json"
	scan=$(curl -sSf "$url/v1/scans" -H 'Content-Type: application/json' -d @"$work/posted.json" | jq -r .id)
	post_job '{"scan": "SCAN", "grid": {"size": [512, 512, 512], "spacing_mm": [0.2, 0.2, 0.2]}, "fdk": {}, "send": []}'
	curl -sSf -T "$work/scan/projections.raw" "$url/v1/scans/$scan/projections" >/dev/null
	wait_job succeeded 600
	for to in dimse dicomweb; do
		began=$EPOCHREALTIME
		cbct send "$job" --to $to --wait
		echo "$to: $(jq -n "$EPOCHREALTIME - $began") s"
		for patient in $(curl -sSf "$rest/patients" | jq -r '.[]'); do curl -sSf -X DELETE "$rest/patients/$patient" >/dev/null; done
	done
	stop_daemon
}
trap stop_peers EXIT
measure
