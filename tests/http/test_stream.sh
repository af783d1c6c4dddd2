#!/usr/bin/env bash
# The stream of a job: every kept volume as one part, at once and as it is made, then the job's document.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
grid='"grid": {"size": [31, 24, 15], "spacing_mm": [3, 4, 5]}'
whole="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 4}, \"emit\": [\"fdk\", 1, 3]}"
slow="{\"scan\": \"SCAN\", $grid, \"fdk\": {}, \"sart\": {\"iterations\": 100000, \"subsets\": \"views\"}, \"emit\": [\"fdk\"]}"
stop_after_each=1

uploaded_scan() {
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
}
stream() { # FILE QUERY [CURL OPTION ...]
	local file=$1 query=$2
	shift 2
	curl -sS -N --max-time 60 -D "$headers" -o "$file" "$@" "$url/v1/jobs/$job/stream${query:+?$query}"
}
# The same to be run with & and killed: the shell becomes curl.
reader() { # FILE QUERY [CURL OPTION ...]
	local file=$1 query=$2
	shift 2
	exec curl -sS -N --max-time 60 -o "$file" "$@" "$url/v1/jobs/$job/stream${query:+?$query}" 2>/dev/null
}
cut_out() { dd if="$1" iflag=skip_bytes,count_bytes skip="$2" count="$3" bs=1M status=none; } # FILE FIRST COUNT
# Parts of a file into DIR/0.head, DIR/0.body ...; each length and digest is checked on the way.
split_parts() { # FILE DIR
	local boundary at=0 n=0 length line head digest
	rm -rf "$2"
	mkdir -p "$2"
	boundary=$(header content-type | sed -n 's/.*boundary="\(.*\)".*/\1/p')
	[ -n "$boundary" ] || fail "multipart/mixed with a boundary, got $(header content-type)"
	while :; do
		head=$2/$n.head
		: >"$head"
		cut_out "$1" $at 1024 >"$2/chunk"
		IFS= read -r line <"$2/chunk"
		line=${line%$'\r'}
		[ "$line" = "--$boundary--" ] && break
		[ "$line" = "--$boundary" ] || fail "a boundary at byte $at of $1, got $line"
		LC_ALL=C awk '{ sub(/\r$/, "") } $0 == "" { exit } { print }' "$2/chunk" >"$head"
		at=$((at + $(LC_ALL=C awk '{ n += length($0) + 2 } END { print n + 2 }' "$head")))
		length=$(part_header "$head" content-length)
		cut_out "$1" $at "$length" >"$2/$n.body"
		digest=$(part_header "$head" content-digest)
		sed -i 1d "$head" # the boundary, which is another one each time
		[ -z "$digest" ] || [ "$digest" = "sha-256=:$(openssl dgst -sha256 -binary "$2/$n.body" | base64 -w 0):" ] ||
			fail "the digest of part $n"
		at=$((at + length + 2))
		n=$((n + 1))
	done
	rm "$2/chunk"
	parts=$n
}
part_header() { awk -v name="$2" 'BEGIN { FS = ": *" } tolower($1) == name { sub(/^[^:]*: */, ""); print }' "$1"; }
names() { for ((i = 0; i < parts - 1; i++)); do part_header "$1/$i.head" cbct-volume; done | paste -sd' '; }
own_memory() { awk '/RssAnon/ { print $2 }' "/proc/$(cat "$work/daemon.pid")/status"; } # KiB
open_files() { ls "/proc/$(cat "$work/daemon.pid")/fd" | wc -l; }
wait_for_bytes() { # FILE COUNT
	local i
	for ((i = 0; i < 2400; i++)); do
		[ "$(stat -c %s "$1" 2>/dev/null || echo 0)" -ge "$2" ] && return 0
		sleep 0.05
	done
	fail "$2 bytes of $1, got $(stat -c %s "$1")"
}

test_each_volume_comes_once_and_the_document_last() {
	local i name
	uploaded_scan
	post_job "$whole"
	stream "$work/live" ""
	[[ $(header content-type) == multipart/mixed* ]] || fail "multipart/mixed"
	split_parts "$work/live" "$work/parts"
	[ "$(names "$work/parts")" = "fdk iter-1 iter-3 final" ] || fail "every volume once, in order, got $(names "$work/parts")"
	for ((i = 0; i < parts - 1; i++)); do
		name=$(part_header "$work/parts/$i.head" cbct-volume)
		get_volume "$name" "$work/volume"
		cmp "$work/volume" "$work/parts/$i.body" || fail "$name as it is downloaded"
		[ "$(part_header "$work/parts/$i.head" content-disposition)" = "$(header content-disposition)" ] || fail "its name"
		[ "$(part_header "$work/parts/$i.head" content-type)" = "$(header content-type)" ] || fail "its type"
		[ -n "$(part_header "$work/parts/$i.head" content-digest)" ] || fail "a digest"
	done
	[ "$(part_header "$work/parts/2.head" cbct-iteration)" = 3 ] || fail "CBCT-Iteration"
	[ "$(part_header "$work/parts/0.head" cbct-stage)" = fdk ] || fail "CBCT-Stage"
	[ "$(part_header "$work/parts/$((parts - 1)).head" content-type)" = application/json ] || fail "the document as JSON"
	req GET "/v1/jobs/$job"
	diff <(jq -S . "$body") <(jq -S . "$work/parts/$((parts - 1)).body") || fail "the job's document"
	# who comes late gets the same
	stream "$work/late" ""
	split_parts "$work/late" "$work/late.parts"
	diff -r "$work/parts" "$work/late.parts" || fail "the same parts"
}

test_after_goes_on_behind_a_volume() {
	uploaded_scan
	post_job "$whole"
	wait_job succeeded
	stream "$work/rest" after=iter-1
	split_parts "$work/rest" "$work/parts"
	[ "$(names "$work/parts")" = "iter-3 final" ] || fail "the volumes behind iter-1"
	stream "$work/rest" after=final
	split_parts "$work/rest" "$work/parts"
	[ "$parts" = 1 ] || fail "the document alone"
	req GET "/v1/jobs/$job/stream?after=final"
	expect_status 200
	req GET "/v1/jobs/$job/stream?after=iter-2"
	expect_problem 400
	expect_json '.detail | contains("after")'
	req GET "/v1/jobs/$job/stream?format=jpeg"
	expect_problem 400
	expect_json '.detail | contains("format")'
	req GET "/v1/jobs/$job/stream?type=float16"
	expect_problem 400
	req GET "/v1/jobs/0000000000000000/stream"
	expect_problem 404
}

test_parameters_and_encodings_are_those_of_the_download() {
	local query i memory
	uploaded_scan
	post_job "$whole"
	wait_job succeeded
	for query in "format=mha&type=int16" "format=nrrd&scale=2" format=raw format=shuffled; do
		stream "$work/all" "$query"
		split_parts "$work/all" "$work/parts"
		get_volume iter-3 "$work/volume" "$query"
		cmp "$work/volume" "$work/parts/2.body" || fail "iter-3 with $query"
		stream "$work/all" "$query" -H 'Accept-Encoding: zstd'
		split_parts "$work/all" "$work/parts"
		if [ $query = format=shuffled ]; then
			cmp "$work/volume" "$work/parts/2.body" || fail "compressed once"
			continue
		fi
		[ "$(part_header "$work/parts/2.head" content-encoding)" = zstd ] || fail "Content-Encoding: zstd"
		# units of noise are searched for repetitions only near by
		memory=$([[ $query == *int16* ]] && echo 128KB || echo 8MB)
		zstd -q -d -c --memory="$memory" "$work/parts/2.body" | cmp - "$work/volume" || fail "the same through zstd with $query"
	done
}

# A part's digest says which bytes a download has: also where they are compressed by several threads.
test_compressed_parts_are_the_bytes_of_the_download() {
	local query
	uploaded_scan
	# 8 MiB: some pieces of what a thread compresses at a time
	post_job '{"scan": "SCAN", "grid": {"size": [128, 128, 128], "spacing_mm": [1, 1, 1]}, "fdk": {}}'
	wait_job succeeded
	for query in format=shuffled format=nifti.gz "format=nifti.gz&type=int16" format=raw "type=int16" "scale=3"; do
		stream "$work/all" "$query" -H 'Accept-Encoding: zstd'
		split_parts "$work/all" "$work/parts"
		req GET "/v1/jobs/$job/volumes/final?$query" -H 'Accept-Encoding: zstd'
		expect_status 200
		cmp "$work/parts/0.body" "$body" || fail "the part's bytes with $query"
	done
}

test_a_volume_comes_while_the_job_runs_and_a_lost_reader_leaves_nothing_open() {
	local before i pids=()
	uploaded_scan
	post_job "$slow"
	req GET "/v1/jobs/$job/volumes"
	while [ "$(json '.volumes | length')" = 0 ]; do
		sleep 0.1
		req GET "/v1/jobs/$job/volumes"
	done
	before=$(open_files)
	for ((i = 0; i < 6; i++)); do
		: >"$work/reader.$i"
		reader "$work/reader.$i" "type=int16" -H 'Accept-Encoding: zstd' &
		pids+=($!)
	done
	# the part is whole while the job goes on
	for ((i = 0; i < 6; i++)); do wait_for_bytes "$work/reader.$i" 1500; done
	req GET "/v1/jobs/$job"
	expect_json '.state == "running"'
	kill -9 "${pids[@]}"
	wait "${pids[@]}" 2>/dev/null || true
	for ((i = 0; i < 70; i++)); do
		[ "$(open_files)" -le $((before + 2)) ] && break
		sleep 0.5
	done
	# an encoded copy or two may stay for readers that are behind
	[ "$(open_files)" -le $((before + 2)) ] || fail "descriptors as before ($before), got $(open_files)"
	req DELETE "/v1/jobs/$job?wait=20"
	expect_json '.state == "cancelled"'
	req DELETE "/v1/jobs/$job"
	expect_status 204
	[ "$(open_files)" -le "$before" ] || fail "nothing of a job that is removed"
}

test_one_that_leaves_in_the_middle_leaves_nothing_open() {
	local before memory i query encoding
	uploaded_scan
	# 16 MiB: more than sockets hold
	post_job '{"scan": "SCAN", "grid": {"size": [160, 160, 164], "spacing_mm": [1, 1, 1]}, "fdk": {}}'
	wait_job succeeded
	stream "$work/whole" "" -H 'Accept-Encoding: zstd'
	before=$(open_files) memory=$(own_memory)
	for i in 1 2 3; do
		for query in stream volumes/final "volumes/final?scale=1&format=raw"; do
			for encoding in identity zstd; do
				curl -sS -N -H "Accept-Encoding: $encoding" "$url/v1/jobs/$job/$query" 2>/dev/null | head -c 50000 >"$work/left" || true
				[ "$(stat -c %s "$work/left")" = 50000 ] || fail "50000 bytes of $query, got $(stat -c %s "$work/left")"
			done
		done
	done
	for ((i = 0; i < 60; i++)); do
		[ "$(open_files)" -le $((before + 1)) ] && break
		sleep 0.5
	done
	[ "$(open_files)" -le $((before + 1)) ] || fail "descriptors as before ($before), got $(open_files)"
	# a volume is 16 MiB, and eighteen readers have left
	expect_number $(($(own_memory) - memory)) '<' 16384 "growth of the daemon in KiB"
	stream "$work/again" ""
	split_parts "$work/again" "$work/parts"
	get_volume final "$work/volume"
	cmp "$work/volume" "$work/parts/0.body" || fail "the volume for the next one"
}

test_a_slow_reader_holds_up_nobody() {
	uploaded_scan
	post_job "$whole"
	reader "$work/slow" "" --limit-rate 40K &
	wait_job succeeded
	stream "$work/fast" ""
	wait $! || fail "the slow one's end"
	split_parts "$work/fast" "$work/parts"
	[ "$(stat -c %s "$work/slow")" = "$(stat -c %s "$work/fast")" ] || fail "all of it for the slow one, too"
}

run_tests
