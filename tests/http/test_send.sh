#!/usr/bin/env bash
# Volumes sent to archives: once, whole, with their own patient; archives that are away, that refuse, that lie; kill -9.
. "$(dirname "$0")/lib.sh"
. "$(dirname "$0")/archive.sh"

send() { # BODY
	req POST "/v1/jobs/$job/send" -H 'Content-Type: application/json' --data-binary "$1"
}

test_a_volume_arrives_once_whole_and_in_its_place() {
	need_archive
	start_archive
	destinations '{"name": "pacs", "kind": "dicomweb", "url": "http://127.0.0.1:'$web'/dicom-web/"}'
	start_daemon --destinations "$work/destinations.json"
	req GET "/v1/destinations?wait=10"
	expect_status 200
	expect_json '.destinations[0] | .name == "pacs" and .reachable and .send == "none" and .unsent == 0'
	job_of "$who" '["pacs"]'
	sending_becomes sent
	expect_json '.sendings[0] | .attempts == 1 and .instances == 50 and .stored == 50 and .volume == "final" and .error == null'
	req GET "/v1/jobs/$job"
	expect_json '.send == [{"to": "pacs", "volumes": "last"}] and (.sendings | length) == 1'
	fetched "$work/back"
	[ "$(ls "$work/back" | wc -l)" = 50 ] || fail "50 objects"
	get_volume final "$work/voxels.raw" "format=raw&type=int16"
	echo '{"PatientName": "Doe^Jane", "PatientID": "4711", "AccessionNumber": "A17", "StudyInstanceUID": "1.2.3.4.5"}' >"$work/members.json"
	"$python" "$top/tests/http/dicom.py" check HFS "$work/voxels.raw" "$work/members.json" "$work/back/"*.dcm || fail "what came back"
	# Asked again, nothing is sent again; by another name of the same volume, neither.
	send '{"to": "pacs"}'
	expect_status 200
	send '{"to": "pacs", "volumes": "all"}'
	expect_status 200
	expect_json '.sendings | length == 1'
	cbct send "$job" --to pacs --wait | grep 'sent.* 50 of 50' >/dev/null || fail "cbct send"
	cbct destinations | grep 'pacs.*answers' >/dev/null || fail "cbct destinations"
	[ "$(curl -sSf "$rest/instances" | jq length)" = 50 ] || fail "50 objects still"
	req GET "/v1/events?after=0" --max-time 1 || true
	[ "$(grep -A1 '^event: sending' "$body" | grep -o '"state":"[a-z]*"' | paste -sd' ')" = '"state":"queued" "state":"sending" "state":"sent"' ] ||
		fail "events queued, sending, sent, got $(grep -A1 '^event: sending' "$body")"
	grep -qx 'cbctd_sendings_ended_total{state="sent"} 1' <(curl -s "$url/metrics") || fail "a metric of what was sent"
}

test_kills_in_the_middle() {
	need_archive
	kills 6
}

test_an_archive_that_is_away_and_comes_back() {
	need_archive
	start_archive
	kill_archive
	destinations '{"name": "pacs", "kind": "dicomweb", "url": "http://127.0.0.1:'$web'/dicom-web", "send": "last"}' \
		'{"name": "nowhere", "kind": "dicomweb", "url": "http://127.0.0.1:9/dicom-web"}'
	start_daemon --destinations "$work/destinations.json" --send-pause 0.2
	# By rule, since the job says nothing.
	job_of "$who"
	send '{"to": "nowhere", "volumes": ["fdk", 1]}'
	expect_problem 422 /volumes
	send '{"to": "nowhere"}'
	expect_status 202
	until req GET "/v1/jobs/$job/send" && member 'all(.sendings[]; .attempts >= 2)' "$body" >/dev/null; do sleep 0.05; done
	expect_json '.sendings | length == 2 and all(.state == "queued" or .state == "sending")'
	sending_becomes queued
	expect_json 'all(.sendings[]; (.error | contains("cannot be reached")) and .next != null and .stored == 0)'
	req GET "/v1/destinations?wait=10"
	expect_json 'all(.destinations[]; .reachable == false and .unsent == 1)'
	req DELETE "/v1/jobs/$job/send/nowhere"
	expect_status 204
	req DELETE "/v1/jobs/$job/send/other"
	expect_problem 404
	stop_daemon
	start_daemon --destinations "$work/destinations.json" --send-pause 0.2
	req GET "/v1/jobs/$job/send"
	expect_json '[.sendings[] | [.to, .state]] | sort == [["nowhere", "stopped"], ["pacs", "queued"]] or . == [["nowhere", "stopped"], ["pacs", "sending"]]'
	grep -Eq '^cbctd_oldest_unsent_seconds [0-9.]*[1-9]' <(curl -s "$url/metrics") || fail "the age of what is unsent"
	start_archive
	until req GET "/v1/jobs/$job/send" && member 'any(.sendings[]; .to == "pacs" and .state == "sent" and .stored == 50)' "$body" >/dev/null; do sleep 0.2; done
	[ "$(curl -sSf "$rest/instances" | jq length)" = 50 ] || fail "50 objects"
	# What was stopped begins anew when it is asked for, and ends with its job.
	send '{"to": "nowhere"}'
	expect_status 202
	req DELETE "/v1/jobs/$job"
	expect_status 204
	until req GET "/v1/destinations" && member 'all(.destinations[]; .unsent == 0)' "$body" >/dev/null; do sleep 0.1; done
}

test_archives_that_lie_forget_and_refuse() {
	local mode
	need_archive
	for mode in lies forgets refuses drips drips-late; do
		start_peer $mode
		destinations '{"name": "pacs", "kind": "dicomweb", "url": "http://127.0.0.1:'$peer_port'", "timeout_s": 1}'
		start_daemon --destinations "$work/destinations.json" --send-pause 0.1 --send-limit $([ $mode = forgets ] && echo 60 || echo 0.1)
		job_of "$who" '["pacs"]'
		case $mode in
		lies)
			sending_becomes failed
			expect_json '.sendings[0] | .stored == 0 and (.error | contains("it has 0 of 50"))'
			;;
		# Every second object comes with each attempt: in the end it has all.
		forgets)
			sending_becomes sent 60
			expect_json '.sendings[0] | .stored == 50 and .attempts > 2'
			;;
		refuses)
			sending_becomes failed
			expect_json '.sendings[0].error | contains("STOW-RS with 403")'
			! grep -q "Doe" "$work/cbctd.err" || fail "no patient in the log"
			;;
		# A whole answer has a second, however much of it comes; what the request may take beside that is not the answer's.
		drips | drips-late)
			sending_becomes failed
			expect_json '.sendings[0].error | contains("answers too slowly") or contains("Timeout was reached")'
			[ $mode = drips ] || expect_json '.sendings[0].error | contains("answers too slowly")'
			;;
		esac
		stop_daemon
		kill -9 $peer
	done
}

test_a_token_comes_from_a_file_and_is_told_to_nobody() {
	need_archive
	start_peer token
	destinations '{"name": "pacs", "kind": "dicomweb", "url": "http://127.0.0.1:'$peer_port'", "token_file": "'"$work/token"'", "objects": "enhanced"}'
	echo wrong-token >"$work/token"
	start_daemon --destinations "$work/destinations.json" --send-pause 0.1
	job_of "$who" '[{"to": "pacs", "volumes": ["fdk", 1]}]'
	sending_becomes failed
	expect_json '.sendings[0].error | contains("kept no such volume")'
	send '{"to": "pacs"}'
	until req GET "/v1/jobs/$job/send" && member 'any(.sendings[]; .error != null and (.error | contains("401")))' "$body" >/dev/null; do sleep 0.05; done
	echo secret-token >"$work/token"
	sending_becomes sent 30 final
	expect_json '.sendings[] | select(.volume == "final") | .instances == 1'
	grep -q 'Bearer secret-token' "$work/peer.log" || fail "the token"
	curl -s "$url/v1/jobs/$job" "$url/v1/destinations" "$url/metrics" >"$work/told"
	! grep -q 'secret-token\|wrong-token' "$work/told" "$work/cbctd.err" || fail "the token is nowhere"
}

test_what_cannot_be_sent_is_refused_or_told() {
	local bad
	need_archive
	for bad in '{"destinations": 1}' '{"destinations": [{"name": "a"}]}' '{"destinations": [{"name": "a/b", "kind": "dicomweb", "url": "http://x"}]}' \
		'{"destinations": [{"name": "a", "kind": "dicomweb", "url": "http://user:word@x"}]}' 'nothing'; do
		echo "$bad" >"$work/destinations.json"
		! start_daemon --destinations "$work/destinations.json" 2>/dev/null || fail "no start with $bad"
	done
	destinations '{"name": "pacs", "kind": "dicomweb", "url": "http://127.0.0.1:9"}'
	start_daemon --destinations "$work/destinations.json" --send-pause 0.1
	job_of null
	send '{"to": "pacs"}'
	expect_problem 409
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"send\": [\"pacs\"]}"
	expect_problem 409 /send
	job_of "$who" '[]'
	req GET "/v1/jobs/$job/send"
	expect_json '.sendings == []'
	for bad in '[{"to": "other"}]' '["other"]' '["pacs", "pacs"]'; do
		req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"send\": $bad}"
		expect_status 422
	done
	for bad in '"pacs"' '[1]' '[{"to": "pacs", "volumes": []}]' '[{"to": "pacs", "volumes": "first"}]' '[{"to": "a b"}]' '[{"to": "pacs", "also": 1}]'; do
		req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"send\": $bad}"
		expect_status 400
	done
	send '["pacs"]'
	expect_problem 400
	send '{"to": "other"}'
	expect_problem 422 /to
	# A rule for jobs that nobody has told how their patient lies: the job is made, the sending fails and says why.
	destinations '{"name": "pacs", "kind": "dicomweb", "url": "http://127.0.0.1:'$("$python" "$top/tests/http/ports.py" 1)'", "send": "last"}'
	kill -HUP "$(cat "$work/daemon.pid")"
	until req GET /v1/destinations && member '.destinations[0].send == "last"' "$body" >/dev/null; do sleep 0.05; done
	job_of null
	sending_becomes failed
	expect_json '.sendings[0].error | contains("how the patient lies")'
	# What stands wrongly in the file later changes nothing.
	echo broken >"$work/destinations.json"
	kill -HUP "$(cat "$work/daemon.pid")"
	until grep -q "destinations that were read before stay" "$work/cbctd.err"; do sleep 0.05; done
	req GET /v1/destinations
	expect_json '.destinations | length == 1'
	post_scan "$work/posted"
	post_job "{\"scan\": \"SCAN\", $recipe, \"patient\": {\"position\": \"HFS\"}}"
	req GET "/v1/jobs/$job/send"
	expect_json '.sendings[0] | .state == "waiting" and .volume == null'
	req DELETE "/v1/jobs/$job"
	expect_status 202
	sending_becomes failed
	expect_json '.sendings[0].error | contains("cancelled")'
}

run_tests
