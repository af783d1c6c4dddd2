#!/usr/bin/env bash
# The audit log: who, what, when, from where, with which result, in a chain.
. "$(dirname "$0")/lib.sh"
tokens=$work/tokens
log=$work/state/audit.jsonl
for role in view acquire; do declare "$role=$(cbct token new "the-$role" --role $role --file "$tokens" 2>/dev/null)"; done
json=(-H 'Content-Type: application/json')
document='{"name": "DOE^JANE knee", "detector": {"columns": 16, "rows": 12, "pixel_mm": [4, 4]},
  "projections": {"count": 6, "sample": "float32", "quantity": "line_integral"},
  "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "first_angle_deg": 0, "angle_step_deg": 60}}'

# told FILTER: a line within 5 s of which the condition holds
told() {
	local i
	for ((i = 0; i < 2400; i++)); do
		jq -es "any(.[]; $1)" "$log" >/dev/null 2>&1 && return 0
		sleep 0.05
	done
	fail "a line with $1: $(tail -3 "$log")"
}
count() { jq -s "map(select($1)) | length" "$log"; }
fresh() { rm -rf "$state" "$log"*; }

test_each_change_each_refusal_and_who_reads_is_told() {
	fresh
	start_daemon --tokens "$tokens" --listen "unix:$work/socket"
	[ "$(stat -c %a "$log")" = 600 ] || fail "for its owner alone"
	told '.what == "start" and .n == 1'
	a=(-H "Authorization: Bearer $acquire") v=(-H "Authorization: Bearer $view")
	req POST /v1/scans "${a[@]}" "${json[@]}" --data-binary "$document"
	scan=$(json .id)
	told ".what == \"POST /v1/scans\" and .status == 201 and .of == \"$scan\""
	told '.what == "POST /v1/scans" and .status == 201 and .who == "the-acquire" and .role == "acquire" and .proof == "token" and .from == "127.0.0.1" and (.request | length > 0) and (.time | endswith("Z"))'
	req DELETE "/v1/scans/$scan" "${v[@]}"
	told ".what == \"DELETE /v1/scans/{}\" and .of == \"$scan\" and .status == 403 and .who == \"the-view\""
	req GET /v1/scans --unix-socket "$work/socket"
	told ".what == \"GET /v1/scans\" and .status == 401 and .who == \"\" and .role == \"anyone\" and .from == \"unix:$(id -u)\""
	# one connection that looks at a scan again and again
	curl -s "${v[@]}" "$url/v1/scans/$scan?[1-20]" -o /dev/null # 400, told once as well
	curl -s "${v[@]}" $(for ((i = 0; i < 20; i++)); do echo "$url/v1/scans/$scan -o /dev/null"; done)
	told ".what == \"GET /v1/scans/{}\" and .of == \"$scan\" and .status == 200"
	[ "$(count ".of == \"$scan\" and (.what | startswith(\"GET\"))")" -le 2 ] || fail "reads on one connection are told once"
	# nothing that a client wrote, whatever the path says
	req GET '/v1/scans/DOE%5EJANE%22%7D%0A' "${a[@]}"
	req DELETE '/v1/scans/DOE%5EJANE%22%7D%0A' "${a[@]}"
	told '.what == "DELETE /v1/scans/{}" and .status == 404 and .of == ""'
	req DELETE "/v1/scans/$scan" "${a[@]}"
	told ".what == \"DELETE /v1/scans/{}\" and .of == \"$scan\" and .status == 204"
	# what nobody needs to know
	req GET /metrics "${a[@]}"
	req GET /livez
	stop_daemon
	! grep -qE 'JANE|DOE|livez|metrics' "$log" || fail "neither names nor what is for anyone: $(grep -E 'JANE|DOE|livez|metrics' "$log")"
	! grep -qE "$view|$acquire" "$log" || fail "no token"
	[ "$(jq -s '[.[].n] == [range(1; length + 1)]' "$log")" = true ] || fail "lines without a gap"
	told '.what == "stop"'
	cbct audit verify "$log" || fail "a whole chain"
}

test_what_was_changed_removed_or_cut_shows() {
	local lines mark i forged=$work/forged
	mark=$(sed -n 's/.*audit: line \([0-9]*\) has the chain \(.*\)/\1:\2/p' "$work/cbctd.err" | tail -1)
	cbct audit verify "$log" --mark "$mark" || fail "the mark of the daemon's log: $mark"
	lines=$(wc -l <"$log")
	broken() { ! cbct audit verify "$forged" "$@" 2>"$work/refused" || fail "$what shows"; }
	for ((i = 2; i < lines; i++)); do
		what="a removed line $i"
		sed "${i}d" "$log" >"$forged"
		broken
	done
	what="a changed name" && sed 's/the-view/the-vieW/' "$log" >"$forged" && broken
	what="a changed status" && sed '3s/"status":[0-9]*/"status":200/; 4s/"status":[0-9]*/"status":200/' "$log" >"$forged" && broken
	what="an added line" && { sed -n 1,3p "$log"; sed -n 3p "$log"; sed -n '4,$p' "$log"; } >"$forged" && broken
	what="lines in another order" && { sed -n 1,2p "$log"; sed -n 4p "$log"; sed -n 3p "$log"; sed -n '5,$p' "$log"; } >"$forged" && broken
	what="a changed chain" && sed '2s/"chain":"./"chain":"x/' "$log" >"$forged" && broken
	what="half a line" && head -c -20 "$log" >"$forged" && broken
	what="a line of something else" && { cat "$log"; echo '{}'; } >"$forged" && broken
	what="a file without a line" && : >"$forged" && broken
	tail -n +3 "$log" >"$forged" && cbct audit verify "$forged" >"$work/verified" && grep -q 'caution: lines 1 to 2 are not here' "$work/verified" || fail "a beginning that was cut is told"
	what="an end that was cut" && head -n -2 "$log" >"$forged" && cbct audit verify "$forged" && broken --mark "$mark"
}

test_a_restart_goes_on_and_a_cut_line_is_dropped() {
	local before
	before=$(wc -l <"$log")
	printf '{"n":%d,"time":"20' $((before + 1)) >>"$log"
	start_daemon --tokens "$tokens"
	told ".n == $((before + 1)) and .what == \"start\""
	grep -q 'audit: dropped 16 bytes\|audit: dropped 1[0-9] bytes' "$work/cbctd.err" || fail "told in the log: $(grep audit "$work/cbctd.err")"
	# a crash takes nothing that was synced
	req GET /v1/scans
	told '.status == 401 and .what == "GET /v1/scans"'
	sleep 1.2
	stop_daemon KILL
	cbct audit verify "$log" || fail "a whole chain"
	echo nonsense >>"$log"
	! timeout 10 cbctd --listen 127.0.0.1:0 --state-dir "$state" --tokens "$tokens" >"$work/refused" 2>&1 || fail "no start behind nonsense"
	grep -q 'move it away' "$work/refused" || fail "what to do: $(cat "$work/refused")"
	sed -i '$d' "$log"
}

test_files_are_renamed_and_the_oldest_removed() {
	local i
	fresh
	start_daemon --tokens "$tokens" --audit "$work/elsewhere.jsonl" --audit-bytes 4K --audit-files 3
	curl -s -o /dev/null "$url/v1/scans?[1-120]"
	for ((i = 0; i < 20; i++)); do curl -s -o /dev/null -X POST "$url/v1/session"; done
	stop_daemon
	[ ! -e "$log" ] || fail "none in the state directory"
	[ "$(ls "$work"/elsewhere.jsonl.* | wc -l)" = 3 ] || fail "three renamed files: $(ls "$work"/elsewhere*)"
	for i in "$work"/elsewhere.jsonl*; do [ "$(stat -c %s "$i")" -le 4096 ] || fail "$i of 4 KiB"; done
	cbct audit verify "$work/elsewhere.jsonl" >"$work/verified" || fail "a chain through all files"
	! grep -q '^lines 1 to' "$work/verified" || fail "the first lines are gone for their age: $(cat "$work/verified")"
	# it goes on where the newest renamed one ends
	rm "$work/elsewhere.jsonl"
	start_daemon --tokens "$tokens" --audit "$work/elsewhere.jsonl" --audit-bytes 4K --audit-files 3
	stop_daemon
	cbct audit verify "$work/elsewhere.jsonl" || fail "the chain goes on"
	rm "$(ls "$work"/elsewhere.jsonl.* | sed -n 2p)"
	! cbct audit verify "$work/elsewhere.jsonl" 2>/dev/null || fail "a removed file shows"
}

test_a_log_that_cannot_be_written_is_told() {
	fresh
	ln -sf /dev/full "$work/full.jsonl" # as a full disk is
	start_daemon --tokens "$tokens" --audit "$work/full.jsonl"
	a=(-H "Authorization: Bearer $acquire")
	req POST /v1/scans "${a[@]}" "${json[@]}" --data-binary "$document"
	expect_status 201
	req GET /metrics "${a[@]}"
	grep -qx 'cbctd_audit_fails 1' "$body" || fail "it in the metrics"
	req GET /readyz
	expect_status 200
	[[ $(sed -n 2p "$body") == "audit: it cannot be written"* ]] || fail "it in /readyz: $(cat "$body")"
	stop_daemon
	grep -q 'audit: .*full.jsonl: No space left on device; lines are lost' "$work/cbctd.err" || fail "the reason: $(grep audit "$work/cbctd.err" | tail -3)"
	rm "$work/full.jsonl"
	start_daemon --tokens "$tokens" --audit "$work/full.jsonl"
	req GET /metrics "${a[@]}"
	grep -qx 'cbctd_audit_fails 0' "$body" || fail "that it can be written again"
	req GET /readyz
	[ "$(cat "$body")" = ready ] || fail "nothing more: $(cat "$body")"
	stop_daemon
}

test_without_tokens_there_is_one_only_if_it_is_wanted() {
	fresh
	start_daemon
	stop_daemon
	[ ! -e "$log" ] || fail "none"
	start_daemon --audit "$log"
	req POST /v1/scans "${json[@]}" --data-binary "$document"
	told '.what == "POST /v1/scans" and .status == 201 and .proof == "not asked" and .who == ""'
	stop_daemon
	fresh
	start_daemon --tokens "$tokens" --audit off
	stop_daemon
	[ ! -e "$log" ] || fail "none where it is off"
}

stop_after_each=1 run_tests
