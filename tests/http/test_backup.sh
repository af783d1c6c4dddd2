#!/usr/bin/env bash
# cbct backup while the daemon works, cbct restore, and a daemon that goes on from there.
. "$(dirname "$0")/lib.sh"
stop_after_each=1

simulate() { [ -e "$work/scan/scan.json" ] || cbct simulate -o "$work/scan" --phantom head --views 40 --columns 32 --rows 24 --pixel 5 >/dev/null; }
projection() { # K: its bytes in $work/one
	dd if="$work/scan/projections.raw" of="$work/one" bs=3072 skip="$1" count=1 status=none
}
fresh() {
	rm -rf "$state" "$work/copy" "$work/restored"
}

test_a_copy_of_a_daemon_at_work_goes_on_to_the_same_bits() {
	local whole half long digest slow
	fresh
	simulate
	start_daemon --checkpoint-seconds 0.1
	reconstruct "$work/scan" '{"scan": "SCAN", "fdk": {}, "sart": {"iterations": 2}, "emit": ["fdk", 2]}'
	whole=$job
	get_volume final "$work/whole.nii"
	digest=$(curl -s "$url/v1/jobs/$whole/volumes" | jq -r '.volumes[] | select(.name == "final").digest')
	# What the long job comes to when nobody disturbs it.
	post_job '{"scan": "SCAN", "fdk": {}, "grid": {"size": [48, 48, 48], "spacing_mm": [3, 3, 3]}, "sart": {"iterations": 60}}'
	wait_job succeeded
	get_volume final "$work/undisturbed.nii" format=raw
	post_scan "$work/scan" # of which a part is here, and the rest comes while the copy is made
	half=$scan
	projection 3
	req PUT "/v1/scans/$half/projections/3" --data-binary @"$work/one"
	expect_status 201
	scan=$(curl -s "$url/v1/jobs/$whole" | jq -r .scan)
	post_job '{"scan": "SCAN", "fdk": {}, "grid": {"size": [48, 48, 48], "spacing_mm": [3, 3, 3]}, "sart": {"iterations": 60}}'
	long=$job
	state_becomes running
	(
		for ((k = 10; k < 40; k++)); do
			dd if="$work/scan/projections.raw" of="$work/next" bs=3072 skip="$k" count=1 status=none
			curl -s -o /dev/null -X PUT "$url/v1/scans/$half/projections/$k" --data-binary @"$work/next"
		done
	) &
	slow=$!
	cbct backup "$state" "$work/copy" || fail "a backup"
	wait $slow
	stop_daemon KILL
	cbct restore "$work/copy" "$work/restored" || fail "what was backed up is restored"
	[ ! -e "$work/restored/catalogue.sqlite" ] || fail "the catalogue is made from the directories"

	state=$work/restored start_daemon
	job=$whole
	req GET "/v1/jobs/$whole"
	expect_json '.state == "succeeded"'
	get_volume final "$work/again.nii"
	cmp "$work/whole.nii" "$work/again.nii" || fail "the bits of a volume"
	[ "$(curl -s "$url/v1/jobs/$whole/volumes" | jq -r '.volumes[] | select(.name == "final").digest')" = "$digest" ] || fail "its digest"
	req GET "/v1/scans/$half"
	expect_json '(.received | length) >= 1 and .received[0][0] == 3'
	projection 3
	req GET "/v1/scans/$half/projections/3"
	expect_status 200
	cmp "$work/one" "$body" || fail "the bits of a projection"
	req PUT "/v1/scans/$half/projections" -T "$work/scan/projections.raw" # and the upload goes on
	[[ $status == 20[01] ]] || fail "the rest of the upload, got $status"
	req GET "/v1/scans/$half"
	expect_json '.missing == []'
	job=$long
	wait_job succeeded
	get_volume final "$work/resumed.nii" format=raw
	cmp "$work/undisturbed.nii" "$work/resumed.nii" || fail "the bits of the job that was running"
	req GET /v1/quarantine # also that the catalogue is a new one is no loss
	expect_json '.entries == []'
	[ ! -e "$work/restored/restored" ] || fail "the next loss of the catalogue is told"
}

# Jobs and scans come and go while it copies: whatever is in the copy is whole.
test_what_is_deleted_meanwhile_is_left_out() {
	local i busy
	fresh
	simulate
	start_daemon
	(
		for ((i = 0; i < 25; i++)); do
			scan=$(curl -s "$url/v1/scans" -H 'Content-Type: application/json' --data-binary @"$work/scan/scan.json" | jq -r .id)
			curl -s -o /dev/null -T "$work/scan/projections.raw" "$url/v1/scans/$scan/projections"
			job=$(curl -s "$url/v1/jobs" -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"fdk\": {}}" | jq -r .id)
			curl -s -o /dev/null "$url/v1/jobs/$job?wait=20"
			[ $((i % 3)) = 0 ] || curl -s -o /dev/null -X DELETE "$url/v1/jobs/$job"
			[ $((i % 3)) = 0 ] || curl -s -o /dev/null -X DELETE "$url/v1/scans/$scan"
		done
	) &
	busy=$!
	for ((i = 0; i < 3; i++)); do
		sleep 0.3
		cbct backup "$state" "$work/copy" >/dev/null || fail "backup $i"
		cbct restore "$work/copy" "$work/restored" >/dev/null || fail "restore $i"
		"$BUILD/cbctd" --state-dir "$work/restored" --rebuild-catalogue >"$work/rebuilt" 2>&1 || fail "a catalogue of it: $(cat "$work/rebuilt")"
		grep -q '; 0 directories were set aside' "$work/rebuilt" || fail "nothing in it that nobody knows: $(cat "$work/rebuilt")"
		rm -rf "$work/copy" "$work/restored"
	done
	wait $busy
}

test_what_is_damaged_or_no_backup_is_refused() {
	local file
	fresh
	simulate
	start_daemon
	reconstruct "$work/scan" '{"scan": "SCAN", "fdk": {}, "sart": null}'
	stop_daemon
	cbct backup "$state" "$work/copy" >"$work/said"
	grep -qE '^[0-9]+ files, [0-9.]+ MB, [1-9][0-9]* of them shared$' "$work/said" || fail "volumes are shared on one disk: $(cat "$work/said")"
	cbct backup "$state" "$work/copy" 2>"$work/said" && fail "no second backup in the same place"
	cbct backup "$work/scan" "$work/other" 2>"$work/said" && fail "no backup of what is no state directory"
	grep -q 'no state directory' "$work/said" || fail "why: $(cat "$work/said")"
	cbct restore "$work/copy" "$state" 2>"$work/said" && fail "no restore over what is there"
	file=$(find "$work/copy/scans" -name projections.raw)
	printf 'x' | dd of="$file" bs=1 seek=1000 conv=notrunc status=none
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" && fail "a damaged file is found"
	grep -q "scans/.*/projections.raw is not what was backed up" "$work/said" || fail "which: $(cat "$work/said")"
	[ ! -e "$work/restored" ] && [ ! -e "$work/restored.restored" ] || fail "nothing is left of it"
	cbct backup "$state" "$state/copy" 2>"$work/said" && fail "no backup within itself"
	grep -q 'lies within' "$work/said" && [ ! -e "$state/copy" ] || fail "why: $(cat "$work/said")"
	(cd "$state" && cbct backup . copy 2>"$work/said") && fail "nor by a relative path"
	[ ! -e "$state/copy" ] || fail "nothing was made"
	cp -r "$work/copy" "$work/good"
	relist() { # FILTER: another list, with its digest
		rm -rf "$work/copy" "$work/restored"
		cp -r "$work/good" "$work/copy"
		jq "$1" "$work/good/backup.json" >"$work/copy/backup.json"
		(cd "$work/copy" && sha256sum backup.json >backup.json.sha256)
	}
	(cd "$work/copy" && sha256sum --quiet -c backup.json.sha256) || fail "a digest that sha256sum reads"
	jq '.files |= .[:-1]' "$work/good/backup.json" >"$work/copy/backup.json"
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" && fail "a list that was changed is found"
	grep -q 'backup.json is damaged' "$work/said" || fail "why: $(cat "$work/said")"
	rm "$work/copy/backup.json.sha256"
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" && fail "the digest is not optional"
	# A pipe keeps nobody waiting, and a link leads nowhere.
	file=$(jq -r '.files[0].path' "$work/good/backup.json")
	relist .
	rm "$work/copy/$file" && mkfifo "$work/copy/$file"
	timeout 10 "$BUILD/cbct" restore "$work/copy" "$work/restored" 2>"$work/said" && fail "a pipe is no file"
	grep -q 'is no regular file' "$work/said" || fail "why: $(cat "$work/said")"
	relist .
	mv "$work/copy/$file" "$work/elsewhere" && ln -s "$work/elsewhere" "$work/copy/$file"
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" && fail "a link is no file"
	relist .
	mv "$work/copy/scans" "$work/scans" && ln -s "$work/scans" "$work/copy/scans"
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" && fail "nor is one that is a link's"
	rm -r "$work/scans" "$work/copy/backup.json" && mkfifo "$work/copy/backup.json"
	timeout 10 "$BUILD/cbct" restore "$work/copy" "$work/restored" 2>"$work/said" && fail "a pipe is no list"
	grep -q 'is no regular file' "$work/said" || fail "why: $(cat "$work/said")"
	relist '.format = 1'
	file=$(cd "$work/copy" && find scans -name projections.raw)
	dd if="$state/$file" of="$work/copy/$file" status=none # the one that was damaged above
	rm "$work/copy/backup.json.sha256"
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" || fail "a backup of the first version: $(cat "$work/said")"
	grep -q 'before lists had digests' "$work/said" || fail "told: $(cat "$work/said")"
	[[ $(stat -c %a "$work/restored") == 7[05]0 ]] || fail "for nobody else to read"
	relist '.files[0].path = "../../escape"'
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" && fail "a path that leads out"
	grep -q 'no path within the backup' "$work/said" || fail "why: $(cat "$work/said")"
	rm "$work/copy/backup.json"
	cbct restore "$work/copy" "$work/restored" 2>"$work/said" && fail "a backup that was not finished"
	grep -q 'backup.json' "$work/said" || fail "why: $(cat "$work/said")"
}

run_tests
