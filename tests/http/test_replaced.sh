#!/usr/bin/env bash
# Files of the state that somebody replaces or removes under the daemon: requests are answered, and nothing that is lost is acknowledged.
. "$(dirname "$0")/lib.sh"

scan_dir=$work/head
cbct simulate --phantom shepp-logan --scale 60 --views 24 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
one=$((64 * 48 * 4))
small='{"scan": "SCAN", "grid": {"size": [24, 24, 24], "spacing_mm": [4, 4, 4]}, "fdk": {}}'

spool() { echo "$state/scans/$scan"; }
view() { dd if="$scan_dir/projections.raw" bs=$one skip="$1" count=1 status=none; }

# Nobody waits for the other end of a pipe that stands where a file was: the answers are errors, and others have theirs.
test_a_pipe_in_the_place_of_a_file_keeps_nobody_waiting() {
	local file asks ask
	start_daemon
	reconstruct "$scan_dir" "$small"
	req GET "/v1/jobs/$job/volumes/final?format=raw"
	expect_status 200
	cp "$body" "$work/right"
	for file in "$state/jobs/$job"/*final* "$(spool)/projections.raw" "$(spool)/projections.sums"; do
		case $file in
		*.raw) asks=("/v1/scans/$scan/projections/3?format=raw") ;;
		*.sums) asks=("/v1/scans/$scan") ;;
		*) asks=("/v1/jobs/$job/volumes/final" "/v1/jobs/$job/volumes/final/slice?index=3" "/v1/jobs/$job/volumes/final?format=raw") ;;
		esac
		mv "$file" "$work/aside"
		mkfifo "$file"
		for ask in "${asks[@]}"; do
			for _ in $(seq 12); do # more than there are threads that wait
				req GET "$ask" --max-time 20
				[[ $status = [2-5][0-9][0-9] ]] || fail "an answer to $ask with ${file##*/} a pipe"
				[[ $file = *.sums || $status = [45][0-9][0-9] ]] || fail "$status to $ask with ${file##*/} a pipe"
			done
		done
		[[ $file = *.sums || $file = *.raw ]] && req PUT "/v1/scans/$scan/projections/3" --max-time 20 --data-binary @<(view 3)
		[[ $status = [2-5][0-9][0-9] ]] || fail "an answer to an upload with ${file##*/} a pipe"
		rm "$file"
		mv "$work/aside" "$file"
	done
	req GET /v1/health
	stop_daemon
	start_daemon
	req GET "/v1/jobs/$job/volumes/final?format=raw"
	cmp "$body" "$work/right" || fail "the volume as it was"
	stop_daemon
}

# What was written to a file that is under no name any more is not acknowledged. Half of a projection is sent, the file goes, and
# the other half follows.
test_an_upload_whose_file_is_removed_under_it_is_no_success() {
	local file end
	start_daemon
	for file in projections.raw projections.sums; do
		post_scan "$scan_dir"
		status=$({
			view 3 | head -c 6000
			end=$((SECONDS + patience))
			until ls -l "/proc/$(cat "$work/daemon.pid")/fd" | grep -q "$scan/projections.sums"; do
				[ $SECONDS -lt $end ] || exit 1
				sleep .05
			done
			rm "$(spool)/$file"
			view 3 | tail -c +6001
		} | curl -sS -o "$work/answer" -w '%{http_code}' --max-time "$patience" -X PUT -T - "$url/v1/scans/$scan/projections/3")
		[[ $status = 5[0-9][0-9] ]] || fail "$file removed: an error of the server, got $status: $(cat "$work/answer")"
		grep -q "removed while projections were written to it" "$work/answer" || fail "the reason: $(cat "$work/answer")"
		end=$((SECONDS + patience))
		until req PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw" && [[ $status = 20[01] ]]; do
			[ $SECONDS -lt $end ] || fail "sent again: $status $(cat "$body")"
			sleep .2
		done
		req GET "/v1/scans/$scan"
		expect_json '.missing == []'
		cmp "$(spool)/projections.raw" "$scan_dir/projections.raw" || fail "the samples"
	done
	stop_daemon
}

run_tests
