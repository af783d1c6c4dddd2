#!/usr/bin/env bash
# A catalogue that is lost, older or damaged takes nothing with it, and is told.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --views 12 --arc 360 --columns 32 --rows 24 --pixel 8 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1
small='{"scan": "SCAN", "grid": {"size": [16, 16, 8], "spacing_mm": [6, 6, 8]}, "fdk": {}, "sart": {"iterations": 2}, "emit": ["fdk"]}'

# A scan with a finished job; all that is known of both is in $work/$1.*
made() {
	rm -rf "$state"
	start_daemon
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes?wait=20"
	known before
	expect_ready ""
}
known() {
	req GET "/v1/scans/$scan"
	expect_status 200
	mv "$body" "$work/$1.scan"
	req GET "/v1/jobs/$job"
	expect_status 200
	mv "$body" "$work/$1.job"
	req GET "/v1/jobs/$job/volumes"
	expect_status 200
	mv "$body" "$work/$1.volumes"
	curl -sS -N --max-time 60 "$url/v1/jobs/$job/events" >"$work/$1.events"
	get_volume final "$work/$1.final"
}
known_as_before() {
	local what
	known after
	for what in scan job volumes events final; do
		cmp "$work/before.$what" "$work/after.$what" || fail "the same $what as before"
	done
}
expect_ready() { # WHAT the second line of /readyz begins with
	req GET /readyz
	expect_status 200
	[[ $(sed -n 2p "$body") == "$1"* ]] || fail "second line of /readyz \"$1\": $(cat "$body")"
	[ -n "$1" ] || [ "$(wc -l <"$body")" = 1 ] || fail "nothing more: $(cat "$body")"
}

test_a_lost_catalogue_is_made_again_and_told() {
	need_sqlite
	made
	stop_daemon KILL
	rm "$state"/catalogue.sqlite*
	start_daemon
	known_as_before
	expect_ready "quarantine: 1 "
	req GET /v1/quarantine
	expect_json '.entries | length == 1 and .[0].from == "catalogue.sqlite" and (.[0].why | test("missing or empty: 1 scans and 1 jobs"))'
	req GET /metrics
	grep -qx 'cbctd_quarantine_entries 1' "$body" || fail "the entry in the metrics"
	grep -qx 'cbctd_catalogue_found{kind="job"} 1' "$body" || fail "the job that was found in the metrics"
	stop_daemon
	start_daemon
	known_as_before
	# a note whose bytes have changed says nothing; one of an earlier version has no checksum
	local note
	note=$(echo "$state"/quarantine/*.json)
	cp "$note" "$work/note"
	sed -i 's/missing or/nissing or/' "$note"
	req GET /v1/quarantine
	expect_json '.entries | length == 1 and .[0].from == null and .[0].why == null'
	jq -c 'del(.crc32)' "$work/note" >"$note"
	req GET /v1/quarantine
	expect_json '.entries | length == 1 and .[0].from == "catalogue.sqlite" and (.[0].why | test("missing or empty"))'
	rm "$state"/quarantine/*
	expect_ready ""
	stop_daemon
}

test_a_start_that_is_cut_off_while_it_writes_records_again_leaves_nothing_ahead() {
	need_sqlite
	made
	post_scan "$scan_dir"
	post_scan "$scan_dir"
	stop_daemon
	rm "$state"/scans/*/record.json "$state"/jobs/*/record.json
	mkdir -p "$work/copy"
	cp "$state"/catalogue.sqlite* "$work/copy"
	start_daemon
	stop_daemon
	[ "$(find "$state/scans" "$state/jobs" -name record.json | wc -l)" = 4 ] || fail "each record is there again"
	# As if the power had gone before the start's commit: the records of all, the catalogue of before.
	rm "$state"/catalogue.sqlite*
	cp "$work/copy"/* "$state"
	start_daemon
	expect_ready ""
	stop_daemon
}

test_an_older_catalogue_loses_nothing_and_brings_nothing_back() {
	need_sqlite
	local older scan_gone
	made
	scan_gone=$scan older=$job
	stop_daemon
	cp "$state/catalogue.sqlite" "$work/older"
	start_daemon
	req DELETE "/v1/jobs/$older"
	expect_status 204
	req DELETE "/v1/scans/$scan_gone"
	expect_status 204
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	wait_job succeeded
	req GET "/v1/jobs/$job/volumes?wait=20"
	known before
	stop_daemon KILL
	rm "$state"/catalogue.sqlite*
	cp "$work/older" "$state/catalogue.sqlite"
	start_daemon
	known_as_before
	req GET /v1/scans
	expect_json "[.scans[].id] == [\"$scan\"]"
	req GET /v1/jobs
	expect_json "[.jobs[].id] == [\"$job\"]"
	stop_daemon
}

# The disk is unmounted, or somebody moves the directory: nothing is acknowledged, and whoever watches the service knows.
test_a_state_directory_that_is_gone_is_told() {
	made
	mv "$state" "$work/moved"
	req GET /readyz
	expect_problem 503
	expect_json '.detail | test("state directory")'
	mkdir "$state"
	req GET /readyz
	expect_problem 503
	rmdir "$state"
	mv "$work/moved" "$state"
	expect_ready ""
	# Of the kept volumes: a page goes on behind one that is there.
	req GET "/v1/jobs/$job/volumes?limit=1"
	req GET "/v1/jobs/$job/volumes?after=$(json .next)"
	expect_json '[.volumes[].name] == ["fdk"]'
	req GET "/v1/jobs/$job/volumes?after=fdk"
	expect_json '.volumes == [] and .next == null'
	for name in nope iter-9; do
		req GET "/v1/jobs/$job/volumes?after=$name"
		expect_problem 400
		req GET "/plain/$job?volume=$name"
		expect_problem 404
	done
	for window in 3 -1 x; do
		req GET "/plain/$job?window=$window"
		expect_problem 400
	done
	req GET "/plain/$job?window=2&volume=fdk"
	expect_status 200
	stop_daemon
}

# Somebody deletes by mistake and puts the directories back from a backup: they are there again, also after a restart,
# and can be deleted like any others. What an earlier version has deleted is kept aside.
test_what_is_put_back_after_a_deletion_is_kept() {
	local round
	made
	known before
	for round in 1 2; do
		cp -r "$state/scans/$scan" "$work/scan.copy"
		cp -r "$state/jobs/$job" "$work/job.copy"
		req DELETE "/v1/jobs/$job"
		expect_status 204
		req DELETE "/v1/scans/$scan"
		expect_status 204
		stop_daemon KILL
		mv "$work/scan.copy" "$state/scans/$scan"
		mv "$work/job.copy" "$state/jobs/$job"
		start_daemon
		known_as_before
		stop_daemon
		start_daemon # the second time they are nothing new
		known_as_before
		[ "$(grep -c "put back after it was deleted" "$work/cbctd.err")" = $((2 * round)) ] || fail "two lines each time: $(grep "put back" "$work/cbctd.err")"
	done
	cp -r "$state/scans/$scan" "$work/scan.copy"
	req DELETE "/v1/jobs/$job"
	req DELETE "/v1/scans/$scan"
	expect_status 204
	stop_daemon
	mv "$work/scan.copy" "$state/scans/$scan"
	python3 - "$state/deleted" <<-'END' # as earlier versions wrote them
		import struct, sys, zlib
		data = bytearray(open(sys.argv[1], "rb").read())
		for at in range(0, len(data), 32):
		    if data[at]:
		        data[at + 17 : at + 28] = bytes(11)
		        data[at + 28 : at + 32] = struct.pack("<I", zlib.crc32(data[at : at + 28]))
		open(sys.argv[1], "wb").write(data)
	END
	start_daemon
	req GET "/v1/scans/$scan"
	expect_problem 404
	req GET /v1/quarantine
	expect_json ".entries | map(select(.from == \"scans/$scan\" and (.why | test(\"deleted\")))) | length == 1"
	[ -s "$state/quarantine/$(json ".entries[] | select(.from == \"scans/$scan\").name")/projections.raw" ] || fail "the projections, kept"
	stop_daemon
}

test_a_damaged_catalogue_is_set_aside_and_made_again() {
	need_sqlite
	made
	stop_daemon
	# one bit of each page but the first
	python3 - "$state/catalogue.sqlite" <<-'END'
		import sys
		data = bytearray(open(sys.argv[1], "rb").read())
		for at in range(4096 + 1000, len(data), 4096):
		    data[at] ^= 16
		open(sys.argv[1], "wb").write(data)
	END
	start_daemon
	known_as_before
	req GET /v1/quarantine
	expect_json '.entries | length == 1 and (.[0].why | test("damaged"))'
	[ -s "$state/quarantine/$(json '.entries[0].name')" ] || fail "the damaged catalogue, kept"
	stop_daemon
}

# Under a running daemon: what it answers names the damage, and it ends; the next one has everything again.
test_damage_of_the_log_is_named_in_the_reply() {
	need_sqlite
	local file
	made
	stop_daemon
	start_daemon # it has not read the rows of the job's volumes
	kill -STOP "$(cat "$work/daemon.pid")"
	for file in catalogue.sqlite catalogue.sqlite-wal; do
		head -c "$(stat -c %s "$state/$file")" /dev/urandom | dd of="$state/$file" conv=notrunc status=none
	done
	kill -CONT "$(cat "$work/daemon.pid")"
	req GET "/v1/jobs/$job"
	expect_problem 500
	expect_json '.detail | test("the catalogue is damaged")'
	stop_daemon || true
	start_daemon
	known_as_before
	stop_daemon
}

test_the_catalogue_is_made_again_when_asked() {
	made
	if "$BUILD/cbctd" --state-dir "$state" --rebuild-catalogue >"$work/rebuilt" 2>&1; then
		fail "a refusal while a daemon runs"
	fi
	grep -q "in use by another" "$work/rebuilt" || fail "why: $(cat "$work/rebuilt")"
	stop_daemon
	if "$BUILD/cbctd" --state-dir "$work/staet" --rebuild-catalogue >"$work/rebuilt" 2>&1; then
		fail "a refusal where there is nothing"
	fi
	grep -q "is no state directory" "$work/rebuilt" || fail "why: $(cat "$work/rebuilt")"
	[ ! -e "$work/staet" ] || fail "a directory that was not there, still not there"
	"$BUILD/cbctd" --state-dir "$state" --rebuild-catalogue >"$work/rebuilt"
	grep -q "has 1 scans and 1 jobs again; 0 " "$work/rebuilt" || fail "what was made: $(cat "$work/rebuilt")"
	start_daemon
	known_as_before
	stop_daemon
}

test_what_nobody_knows_is_kept_and_comes_back_once_it_is_whole() {
	need_sqlite
	made
	stop_daemon
	cp "$state/scans/$scan/record.json" "$work/record"
	echo >>"$state/scans/$scan/record.json"
	rm "$state/catalogue.sqlite"
	mkdir "$state/jobs/1m7yam2f9rgevqe7"
	echo something >"$state/jobs/1m7yam2f9rgevqe7/final.nii"
	start_daemon
	req GET "/v1/scans/$scan"
	expect_problem 404
	req GET /v1/quarantine
	expect_json "[.entries[].from] | sort == [\"catalogue.sqlite\", \"jobs/1m7yam2f9rgevqe7\", \"scans/$scan\"]"
	local name
	name=$(json ".entries[] | select(.from == \"scans/$scan\").name")
	[ -s "$state/quarantine/$name/projections.raw" ] || fail "the projections, kept"
	stop_daemon
	cp "$work/record" "$state/quarantine/$name/record.json"
	"$BUILD/cbctd" --state-dir "$state" --rebuild-catalogue >"$work/rebuilt"
	start_daemon
	known_as_before
	stop_daemon
}

stop_after_each=1 run_tests
