#!/usr/bin/env bash
# Bits that the disk has turned round, in every kind of file: found by whoever reads them, told by name, never used.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks
stop_after_each=1

scan_dir=$work/head
cbct simulate --phantom shepp-logan --scale 60 --views 24 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
one=$((64 * 48 * 4))
grid='"grid": {"size": [24, 24, 24], "spacing_mm": [4, 4, 4]}'
small="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 2, \"subsets\": 4}}"

# flip FILE BYTE [BIT]: its time of change tells that something wrote to it, but not what
flip() {
	python3 - "$@" <<'PY'
import sys
name, at, bit = sys.argv[1], int(sys.argv[2]), int((sys.argv + ["3"])[3])
with open(name, "r+b") as file:
    file.seek(at)
    byte = file.read(1)[0]
    file.seek(at)
    file.write(bytes([byte ^ 1 << bit]))
PY
}
spool() { echo "$state/scans/$scan"; }
view() { dd if="$scan_dir/projections.raw" bs=$one skip="$1" count=1 status=none; }
expect_damaged() {
	expect_problem 500
	expect_json '.type == "urn:cbctd:problem:damaged"'
}
put_view() { req PUT "/v1/scans/$scan/projections/$1" --data-binary @<(view "$1"); }
missing_is() { # JSON
	req GET "/v1/scans/$scan"
	expect_status 200
	expect_json ".missing == $1"
}
undisturbed() { # sets $right: what the job's final volume must be
	req GET "/v1/jobs/$job/volumes/final?format=raw"
	expect_status 200
	right=$(sha256sum <"$body")
	cp "$body" "$work/right"
}
# What came again came last: a job that takes projections as they arrive adds the same numbers up in another order.
is_right() {
	req GET "/v1/jobs/$job/volumes/final?format=raw"
	expect_status 200
	/usr/bin/python3 - "$body" "$work/right" <<'PY' || fail "the volume of an undisturbed job"
import sys
import numpy
a, b = (numpy.fromfile(name, "<f4").astype(float) for name in sys.argv[1:])
assert abs(a - b).max() <= 1e-5 * abs(b).max(), abs(a - b).max()
PY
}
is_undisturbed() {
	req GET "/v1/jobs/$job/volumes/final?format=raw"
	expect_status 200
	[ "$(sha256sum <"$body")" = "$right" ] || fail "the bits of an undisturbed job"
}

test_a_damaged_projection_is_missing_and_can_be_sent_again() {
	start_daemon
	reconstruct "$scan_dir" "$small"
	undisturbed
	for format in raw png; do
		req GET "/v1/scans/$scan/projections/7?format=$format"
		expect_status 200
		flip "$(spool)/projections.raw" $((7 * one + 4321))
		req GET "/v1/scans/$scan/projections/7?format=$format"
		expect_damaged
		expect_json '.detail | test("projection 7 ")'
		req GET "/v1/scans/$scan/projections/7?format=$format"
		expect_problem 404
		missing_is '[[7, 7]]'
		expect_json '.received == [[0, 6], [8, 23]] and .state == "receiving" and
			([.warnings[] | select(.code == "damaged_projections" and .severity == "serious")] | length == 1)'
		# its digest is known still, also behind a restart: other bytes are no repair
		req PUT "/v1/scans/$scan/projections/7" --data-binary @<(view 6)
		expect_problem 409
		json .detail | grep -q 'damaged by the disk' || fail "why not: $(json .detail)"
		if [ $format = png ]; then
			stop_daemon KILL
			start_daemon
			req PUT "/v1/scans/$scan/projections/7" --data-binary @<(view 6)
			expect_problem 409
		fi
		missing_is '[[7, 7]]'
		put_view 7
		expect_status 201
		missing_is '[]'
		expect_json '[.warnings[] | select(.code | startswith("damaged"))] == []'
	done
	req GET "/v1/scans/$scan/projections/7" -r 100-199
	expect_status 206
	cmp "$body" <(view 7 | tail -c +101 | head -c 100) || fail "the range of a projection"
	post_job "$small"
	wait_job succeeded
	is_undisturbed
	stop_daemon
}

test_a_put_looks_at_the_disk_before_it_says_same() {
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	put_view 3
	expect_status 200
	flip "$(spool)/projections.raw" $((3 * one))
	put_view 3
	expect_status 201
	put_view 3
	expect_status 200
	cmp "$(spool)/projections.raw" "$scan_dir/projections.raw" || fail "the damage is repaired"
	flip "$(spool)/projections.raw" $((5 * one + 99))
	flip "$(spool)/projections.raw" $((20 * one + 99))
	req PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
	expect_status 201
	expect_json '.stored == 2 and .same == 22'
	cmp "$(spool)/projections.raw" "$scan_dir/projections.raw" || fail "the damage is repaired"
	req PUT "/v1/scans/$scan/projections/4" --data-binary @<(view 5)
	expect_problem 409
	stop_daemon
}

test_a_job_waits_for_what_was_damaged() {
	start_daemon
	reconstruct "$scan_dir" "$small"
	undisturbed
	flip "$(spool)/projections.raw" $((11 * one + 5))
	flip "$(spool)/projections.raw" $((19 * one + 5))
	post_job "$small"
	state_becomes waiting
	local end=$((SECONDS + 20))
	until req GET "/v1/jobs/$job" && [ "$(json '.waiting_for | join(" ")')" = projections ]; do
		[ $SECONDS -lt $end ] || fail "waiting for projections: $(json '{state, waiting_for, error}')"
		sleep 0.05
	done
	missing_is '[[11, 11], [19, 19]]' # both, though the worker had met the first only
	put_view 11
	expect_status 201
	put_view 19
	expect_status 201
	wait_job succeeded
	expect_json '.attempts == 1 and .error == null'
	is_right
	stop_daemon
}

test_files_that_are_gone_are_told_before_the_first_request() {
	local other job_dir
	counts
	start_daemon
	post_scan "$counts_dir"
	post_projections "$counts_dir"
	other=$scan
	reconstruct "$scan_dir" "$large"
	digested
	undisturbed
	# the file of the projections, then its second half
	for how in 'rm "$(spool)/projections.raw"' 'truncate -s $((12 * one + 5)) "$(spool)/projections.raw"'; do
		stop_daemon KILL
		eval "$how"
		start_daemon
		req GET "/v1/scans/$scan" # the very first
		case $how in
		rm*) expect_json '.missing == [[0, 23]] and .received == []' ;;
		*) expect_json '.missing == [[12, 23]] and .received == [[0, 11]]' ;;
		esac
		stop_daemon KILL # noted on the disk, too
		start_daemon
		req GET "/v1/scans/$scan"
		expect_json '.received_count < 13 and ([.warnings[] | select(.code == "damaged_projections")] | length == 1)'
		req PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
		expect_status 201
		missing_is '[]'
	done
	stop_daemon KILL
	truncate -s 100 "$state/scans/$other/flat.f32"
	start_daemon
	req GET "/v1/scans/$other"
	expect_json '(.flat | not) and ([.warnings[] | select(.code == "damaged_image")] | length == 1)'
	# all of a scan
	stop_daemon
	mv "$(spool)" "$work/away"
	start_daemon
	req GET "/v1/scans/$scan"
	expect_damaged
	req GET /v1/scans
	expect_json ".scans | map({(.id): [.state, .received_count]}) | add | .\"$scan\" == [\"receiving\", 0] and .\"$other\" == [\"complete\", 24]"
	is_undisturbed
	[ ! -e "$(spool)" ] || fail "nothing in the place of what may come back"
	stop_daemon
	mv "$work/away" "$(spool)"
	start_daemon
	missing_is '[]'
	stop_daemon
	rm -r "$(spool)"
	start_daemon
	req DELETE "/v1/scans/$scan"
	expect_status 204
	req PUT "/v1/scans/$other/flat" --data-binary @"$counts_dir/flat.f32"
	expect_status 201
	# all of a job
	stop_daemon
	job_dir=$state/jobs/$job
	rm -r "$job_dir"
	start_daemon
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded" and ([.warnings[] | select(.code == "damaged_volume" and .severity == "serious" and (.detail | test("volume final")))] | length == 1)'
	expect_damaged_volume "" "?format=raw" "/slice?axis=z"
	req GET "/v1/jobs/$job"
	expect_json '[.warnings[] | select(.code == "damaged_volume")] | length == 1'
	curl -sf --max-time 20 -o "$work/stream" "$url/v1/jobs/$job/stream" || fail "a stream that ends properly"
	! grep -q 'CBCT-Volume' "$work/stream" || fail "no part of what is gone"
	grep -q 'damaged_volume' "$work/stream" || fail "the job's document"
	tail -1 "$work/stream" | grep -q -- '^--.*--' || fail "the closing boundary"
	stop_daemon
}

test_a_stream_leaves_a_damaged_volume_out_and_goes_on() {
	local file
	start_daemon
	reconstruct "$scan_dir" "${small%\}}, \"emit\": [\"fdk\", 1]}"
	file=$state/jobs/$job/fdk.nii
	flip "$file" $(($(stat -c %s "$file") / 2))
	for _ in 1 2; do # not known yet, then known
		curl -sf --max-time 20 -o "$work/stream" "$url/v1/jobs/$job/stream?format=raw" || fail "a stream that ends properly"
		[ "$(grep -ac '^CBCT-Volume: ' "$work/stream")" = 2 ] || fail "the two whole volumes: $(grep -a '^CBCT-Volume' "$work/stream")"
		! grep -aq '^CBCT-Volume: fdk' "$work/stream" || fail "no part of the damaged one"
		grep -aq 'damaged_volume' "$work/stream" || fail "the job's document tells"
	done
	stop_daemon
}

test_a_file_that_is_cut_off_under_the_daemon() {
	start_daemon
	reconstruct "$scan_dir" "$small"
	undisturbed
	for how in 'truncate -s $((20 * one + 7)) "$(spool)/projections.raw"' 'rm "$(spool)/projections.raw"'; do
		eval "$how"
		post_job "$small"
		local end=$((SECONDS + 20)) missing='[[20, 23]]'
		[[ $how != rm* ]] || missing='[[0, 23]]'
		until req GET "/v1/scans/$scan" && member ".missing == $missing" "$body" >/dev/null; do
			[ $SECONDS -lt $end ] || fail "what the file no longer holds is missing: $(json .missing)"
			sleep 0.05
		done
		state_becomes waiting
		req PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
		expect_status 201
		wait_job succeeded
		is_right
	done
	cmp "$(spool)/projections.raw" "$scan_dir/projections.raw" || fail "the damage is repaired"
	stop_daemon
}

test_checksums_that_go_under_the_daemon_are_made_again() {
	local size=$((512 + 64 * 24)) how
	start_daemon
	reconstruct "$scan_dir" "$small"
	undisturbed
	for how in 'rm "$(spool)/projections.sums"' 'truncate -s 1000 "$(spool)/projections.sums"' 'flip "$(spool)/projections.sums" 20'; do
		eval "$how"
		put_view 3
		expect_status 200
		missing_is '[]'
		eval "$how"
		post_job "$small"
		wait_job succeeded
		is_undisturbed
		# one that was lost is stored in the new file, with the others, also behind a restart
		flip "$(spool)/projections.raw" $((5 * one + 99))
		req GET "/v1/scans/$scan/projections/5?format=raw"
		expect_damaged
		eval "$how"
		put_view 6
		expect_status 200
		missing_is '[[5, 5]]'
		stop_daemon KILL
		start_daemon
		req PUT "/v1/scans/$scan/projections/5" --data-binary @<(view 6)
		expect_problem 409
		put_view 5
		expect_status 201
		missing_is '[]'
		[ "$(stat -c %s "$(spool)/projections.sums")" = $size ] || fail "the checksums are there again"
	done
	cmp "$(spool)/projections.raw" "$scan_dir/projections.raw" || fail "the samples"
	stop_daemon
}

test_projections_whose_file_goes_under_the_daemon_can_be_sent_again() {
	local end
	start_daemon
	reconstruct "$scan_dir" "$small"
	undisturbed
	rm "$(spool)/projections.raw"
	req GET "/v1/scans/$scan/projections/7?format=raw"
	[ "$status" = 404 ] || expect_damaged # the check that this begins may be faster
	expect_json '.detail | test("projection 7 ")'
	end=$((SECONDS + patience))
	until req GET "/v1/scans/$scan" && member '.missing == [[0, 23]]' "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "all of it is missing: $(json .missing)"
		sleep 0.05
	done
	expect_json '.state == "receiving" and ([.warnings[] | select(.code == "damaged_projections")] | length == 1)'
	req PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
	expect_status 201
	missing_is '[]'
	# what is sent meets the loss itself
	rm "$(spool)/projections.raw"
	put_view 3
	expect_status 201
	req PUT "/v1/scans/$scan/projections" -T "$scan_dir/projections.raw"
	expect_status 201
	missing_is '[]'
	stop_daemon KILL
	start_daemon
	missing_is '[]'
	cmp "$(spool)/projections.raw" "$scan_dir/projections.raw" || fail "the samples"
	post_job "$small"
	wait_job succeeded
	is_right
	stop_daemon
}

test_damage_while_the_daemon_is_down() {
	local byte
	start_daemon
	reconstruct "$scan_dir" "$small"
	undisturbed
	for file in projections.raw projections.sums; do
		stop_daemon
		case $file in
		projections.raw) byte=$((2 * one + 1)) ;;
		projections.sums) byte=$((512 + 64 * 2 + 40)) ;; # the record of projection 2
		esac
		flip "$(spool)/$file" $byte
		start_daemon
		post_job "$small"
		if [ $file = projections.raw ]; then
			state_becomes waiting
			put_view 2
			expect_status 201
		fi
		wait_job succeeded
		is_right
	done
	# the line of the file, its first half, all of it
	for how in 'flip "$(spool)/projections.sums" 20' 'truncate -s 1000 "$(spool)/projections.sums"' 'rm "$(spool)/projections.sums"'; do
		stop_daemon
		eval "$how"
		start_daemon
		missing_is '[]'
		post_job "$small"
		wait_job succeeded
		is_undisturbed
		[ "$(stat -c %s "$(spool)/projections.sums")" = $((512 + 64 * 24)) ] || fail "the checksums are there again"
	done
	stop_daemon
	flip "$(spool)/scan.json" 20
	start_daemon
	req GET "/v1/scans/$scan"
	expect_damaged
	expect_json '.detail | test("scan.json")'
	req POST /v1/jobs -H 'Content-Type: application/json' --data-binary "${small/SCAN/$scan}"
	expect_damaged
	req GET /v1/scans
	expect_status 200
	req DELETE "/v1/scans/$scan"
	expect_status 204
	stop_daemon
}

test_a_document_that_is_damaged_while_it_is_used() {
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	flip "$(spool)/scan.json" 20
	post_job "$small"
	wait_job failed
	expect_json '.error.type == "urn:cbctd:problem:damaged" and (.error.detail | test("scan.json"))'
	stop_daemon
}

# Counts with a flat image, a dark one and a map of defects.
counts() {
	local to=$work/counts
	[ -e "$to" ] || /usr/bin/python3 - "$scan_dir" "$to" <<'PY'
import json, os, sys
import numpy
source, to = sys.argv[1:]
os.makedirs(to)
document = json.load(open(source + "/scan.json"))
lines = numpy.fromfile(source + "/projections.raw", "<f4").reshape(24, 48, 64)
document["projections"].update(sample="uint16", quantity="intensity")
json.dump(document, open(to + "/scan.json", "w"))
numpy.rint(100 + 50000 * numpy.exp(-lines)).astype("<u2").tofile(to + "/projections.raw")
numpy.full((48, 64), 50100, "<f4").tofile(to + "/flat.f32")
numpy.full((48, 64), 100, "<f4").tofile(to + "/dark.f32")
defects = numpy.zeros((48, 64), "u1")
defects[5, 7] = 1
defects.tofile(to + "/defects.u8")
PY
	counts_dir=$to
}

test_a_damaged_image_is_told_and_can_be_sent_again() {
	local image file
	counts
	start_daemon
	reconstruct "$counts_dir" "$small"
	undisturbed
	for image in flat dark defects; do
		file=$image.f32
		[ $image != defects ] || file=defects.u8
		flip "$(spool)/$file" 1234
		post_job "$small"
		state_becomes waiting
		local end=$((SECONDS + 20))
		until req GET "/v1/jobs/$job" && [ "$(json '.waiting_for | join(" ")')" = $image ]; do
			[ $SECONDS -lt $end ] || fail "waiting for $image: $(json '{state, waiting_for, error}')"
			sleep 0.05
		done
		missing_is '[]'
		expect_json "[.warnings[] | select(.code == \"damaged_image\" and (.detail | test(\"$image\")))] | length == 1"
		if [ $image = dark ]; then # over a restart, too
			stop_daemon
			start_daemon
			req GET "/v1/jobs/$job"
			expect_json '.state == "waiting"'
		fi
		req PUT "/v1/scans/$scan/$image" --data-binary @"$counts_dir/$file"
		expect_status 201
		wait_job succeeded
		expect_json '.attempts == 1'
		is_undisturbed
		flip "$(spool)/$file" 77 # found by the PUT itself
		req PUT "/v1/scans/$scan/$image" --data-binary @"$counts_dir/$file"
		expect_status 201
		req PUT "/v1/scans/$scan/$image" --data-binary @"$counts_dir/$file"
		expect_status 200
		missing_is '[]'
		expect_json '[.warnings[] | select(.code | startswith("damaged"))] == []'
	done
	stop_daemon
}

test_what_the_catalogue_lost_is_found_beside_the_data() {
	need_sqlite
	counts
	start_daemon
	post_scan "$counts_dir"
	post_projections "$counts_dir"
	rm "$(spool)/projections.sums" # and made again, of the images, too, when they were checked
	post_job "$small"
	wait_job succeeded
	stop_daemon
	sqlite3 "$state/catalogue.sqlite" "DELETE FROM projections; UPDATE scans SET flat = NULL, dark = NULL, defects = NULL"
	start_daemon
	missing_is '[]'
	expect_json '.flat and .dark and .defects and .state == "complete"'
	post_job "$small"
	wait_job succeeded
	stop_daemon
}

large='{"scan": "SCAN", "grid": {"size": [96, 96, 96], "spacing_mm": [1, 1, 1]}, "fdk": {}}' # four blocks of checksums
made() { echo "$state/jobs/$job/final.nii"; }
digested() { # its digest is there, so that nothing reads it any more
	local end=$((SECONDS + 30))
	until req GET "/v1/jobs/$job/volumes" && member '.volumes | all(.digest != null)' "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "a digest"
	done
}
expect_damaged_volume() { # TARGET ...: under all of these
	for target; do
		req GET "/v1/jobs/$job/volumes/final$target"
		expect_damaged
		expect_json '.detail | test("volume final")'
	done
	req GET "/v1/jobs/$job"
	expect_json '[.warnings[] | select(.code == "damaged_volume" and .severity == "serious" and (.detail | test("final")))] | length == 1'
}
damage_told() { # [REGEX]: the one detail of the job's warnings of damaged volumes; none: there is no such warning
	req GET "/v1/jobs/$job"
	expect_json "[.warnings[] | select(.code == \"damaged_volume\") | .detail] | if \"${1:-}\" == \"\" then . == [] else length == 1 and (.[0] | test(\"${1:-}\")) end"
}

test_a_damaged_volume_is_told_once_and_as_long_as_it_is_damaged() {
	local file
	start_daemon
	reconstruct "$scan_dir" "$large"
	digested
	undisturbed
	file=$(made)
	cp "$file" "$work/good.nii"
	# three kinds of damage, each told in place of the one before
	flip "$file" $((4096 + 2 * 1048576))
	expect_damaged_volume "" "?format=raw"
	damage_told 'block 2 of 4'
	cp "$work/good.nii" "$file"
	flip "$file" 300
	expect_damaged_volume ""
	damage_told 'block 0 of 4'
	cp "$work/good.nii" "$file"
	truncate -s $((4096 + 1048576)) "$file"
	expect_damaged_volume ""
	damage_told 'its (header|checksums)'
	# what is whole of it by itself takes nothing back; all of it does, for good
	cp "$work/good.nii" "$file"
	flip "$file" $((4096 + 2 * 1048576))
	expect_damaged_volume ""
	req GET "/v1/jobs/$job/volumes/final?format=raw" -r 0-999
	expect_status 206
	damage_told 'block 2 of 4'
	cp "$work/good.nii" "$file"
	is_undisturbed
	damage_told
	stop_daemon
	start_daemon
	damage_told
	# the check at the start
	stop_daemon KILL
	rm "$file"
	start_daemon
	damage_told 'its file is gone'
	stop_daemon
	cp "$work/good.nii" "$file"
	flip "$file" 300
	start_daemon
	damage_told 'block 0 of 4'
	stop_daemon
	cp "$work/good.nii" "$file"
	start_daemon
	damage_told
	is_undisturbed
	# a part of the stream is a read, too
	flip "$file" 300
	expect_damaged_volume ""
	cp "$work/good.nii" "$file"
	curl -sf --max-time 20 -o "$work/stream" "$url/v1/jobs/$job/stream?format=raw" || fail "a stream"
	damage_told
	stop_daemon
}

# The daemon holds what its worker has just made for whole without reading it: but not what has changed since then.
test_a_volume_that_is_damaged_before_the_daemon_hears_of_it_is_never_sent() {
	local daemon worker
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	daemon=$(cat "$work/daemon.pid")
	worker=$(worker_of)
	kill -STOP "$worker"
	post_job "$large"
	state_becomes running
	kill -STOP "$daemon"
	kill -CONT "$worker"
	until [ -e "$(made)" ]; do sleep 0.02; done
	flip "$(made)" $((4096 + 2 * 1048576))
	kill -CONT "$daemon"
	wait_job succeeded
	expect_damaged_volume ""
	stop_daemon
}

test_a_damaged_volume_is_told_and_never_sent() {
	local third=$((4096 + 2 * 1048576))
	start_daemon
	reconstruct "$scan_dir" "$large"
	digested
	undisturbed
	curl -sf -o "$work/stream" "$url/v1/jobs/$job/stream?format=raw" || fail "a stream"
	flip "$(made)" $third
	expect_damaged_volume "" "?format=raw" "?format=mha" "?type=int16" "?format=shuffled" "?scale=2" "/slice?axis=x" "/slice?sheet=1" "/slice?index=58"
	req GET "/v1/jobs/$job/volumes/final" -H 'Accept-Encoding: zstd'
	expect_damaged
	# what is whole of it, by itself
	req GET "/v1/jobs/$job/volumes/final?format=raw" -r 0-99999
	expect_status 206
	cmp "$body" <(head -c 100000 "$work/right") || fail "a part that is not damaged"
	req GET "/v1/jobs/$job/volumes/final/slice?index=3"
	expect_status 200
	req GET "/v1/jobs/$job/volumes/final?format=raw" -r 2100000-2100099
	expect_damaged
	for query in format=raw type=int16; do # streamed before, and not
		curl -sf --max-time 20 -o "$work/stream" "$url/v1/jobs/$job/stream?$query" || fail "a stream that ends properly"
		! grep -aq 'CBCT-Volume' "$work/stream" || fail "nothing of what is damaged"
		grep -aq 'damaged_volume' "$work/stream" || fail "the job's document tells"
	done
	flip "$(made)" $third # as it was
	is_undisturbed
	stop_daemon
	flip "$(made)" 300 # the header
	start_daemon
	expect_damaged_volume "" "?format=raw" "/slice?axis=z"
	flip "$(made)" 300
	is_undisturbed
	truncate -s $((third + 77)) "$(made)"
	expect_damaged_volume "" "?format=raw" "/slice?axis=z" "/slice?axis=x"
	stop_daemon
}

test_damaged_checksums_of_a_volume_that_is_whole_do_no_harm() {
	local size
	start_daemon
	reconstruct "$scan_dir" "$large"
	digested
	undisturbed
	size=$(stat -c %s "$(made)")
	[ "$size" = $((4096 + 96 * 96 * 96 * 4 + 4 * 4 + 64)) ] || fail "checksums at the end, got $size bytes"
	for byte in $((size - 70)) $((size - 64)) $((size - 40)) $((size - 5)); do
		flip "$(made)" "$byte"
		is_undisturbed
		flip "$(made)" "$byte"
	done
	flip "$(made)" $((size - 40))
	flip "$(made)" 9999
	expect_damaged_volume "" # now nothing fits
	stop_daemon
}

test_a_damaged_checkpoint_begins_the_job_again() {
	local yielded again worker
	start_daemon
	worker=$(worker_of)
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 300, \"subsets\": \"views\"}}"
	wait_job succeeded
	undisturbed
	for again in flip truncate; do
		post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 300, \"subsets\": \"views\"}}"
		yielded=$job
		until req GET "/v1/jobs/$job" && member '.iteration >= 2' "$body" >/dev/null; do sleep 0.02; done
		kill -STOP "$worker" # the job is short
		post_job "{\"scan\": \"SCAN\", $grid, \"sart\": {\"iterations\": 100000, \"subsets\": \"views\"}, \"priority\": \"stat\"}"
		kill -CONT "$worker"
		until req GET "/v1/jobs/$job" && member '.iteration >= 1' "$body" >/dev/null; do sleep 0.02; done
		case $again in
		flip) flip "$state/jobs/$yielded/checkpoint.f32" 3333 ;;
		truncate) truncate -s -8 "$state/jobs/$yielded/checkpoint.f32" ;;
		esac
		req DELETE "/v1/jobs/$job?wait=30"
		expect_json '.state == "cancelled"'
		job=$yielded
		wait_job succeeded
		expect_json '.attempts == 2 and ([.history[].iteration] == [range(1; 301)]) and ([.warnings[] | select(.code == "damaged_checkpoint")] | length == 1)'
		is_undisturbed
	done
	stop_daemon
}

test_cbct_recon_uses_no_damaged_file() {
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	stop_daemon
	cp -r "$(spool)" "$work/copy"
	echo "{$grid, \"fdk\": {}}" >"$work/recipe.json"
	cbct recon "$work/copy" "$work/recipe.json" -o "$work/out" >/dev/null 2>"$work/err" || fail "a whole directory: $(cat "$work/err")"
	flip "$work/copy/projections.raw" $((9 * one + 3))
	! cbct recon "$work/copy" "$work/recipe.json" -o "$work/out" >/dev/null 2>"$work/err" || fail "a word of the damage"
	grep -q 'projection 9 is damaged' "$work/err" || fail "the projection's number: $(cat "$work/err")"
	rm "$work/copy/projections.sums"
	cbct recon "$work/copy" "$work/recipe.json" -o "$work/out" >/dev/null 2>"$work/err" || fail "a directory without checksums"
}

run_tests
