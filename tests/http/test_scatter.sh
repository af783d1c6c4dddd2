#!/usr/bin/env bash
# Images of scatter that somebody else has computed: PUT and GET of each, whether they come before projections, behind
# them, or never, a restart, damage, and the programs that send them.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

ball=(--phantom head --scale 60 --density 0.02 --views 45 --arc 360 --columns 80 --rows 64 --pixel 3
	--source-to-isocentre 620 --source-to-detector 1100 --raw air --sample float32)
cbct simulate "${ball[@]}" -o "$work/good" >/dev/null || exit 1
# Scatter that is broad and turns with the arm, half of the primary amid the head; images of 20 x 16 pixels of views 0, 10, ... 40 and 44.
/usr/bin/env python3 - "$work" <<'EOP' || exit 1
import array, json, math, os, sys
work = sys.argv[1]
columns, rows, views, wide, high = 80, 64, 45, 20, 16
def scatter(view, x, y): # in shares of the detector
    turn = math.cos(2 * math.pi * view / views)
    return 9000 * math.exp(-((x - 0.5 - 0.05 * turn) ** 2 + (y - 0.5) ** 2) / 0.3) * (1 + 0.2 * turn)
good = array.array('f', open(f'{work}/good/projections.raw', 'rb').read())
spoiled = array.array('f', (good[(v * rows + r) * columns + c] + scatter(v, (c + 0.5) / columns, (r + 0.5) / rows)
                            for v in range(views) for r in range(rows) for c in range(columns)))
document = json.load(open(f'{work}/good/scan.json'))
for name, more in (('left-in', {}), ('images', {'scatter': {'kind': 'images', 'columns': wide, 'rows': high, 'every': 10}})):
    os.makedirs(f'{work}/{name}')
    spoiled.tofile(open(f'{work}/{name}/projections.raw', 'wb'))
    json.dump({**document, 'projections': {**document['projections'], **more}}, open(f'{work}/{name}/scan.json', 'w'))
with open(f'{work}/images/scatter.raw', 'wb') as file:
    for v in (0, 10, 20, 30, 40, 44):
        array.array('f', (scatter(v, (c + 0.5) / wide, (r + 0.5) / high) for r in range(high) for c in range(wide))).tofile(file)
EOP
recipe='{"scan": "SCAN", "grid": {"size": [40, 40, 28], "spacing_mm": [2.6, 2.6, 2.6]}, "fdk": {}}'
state=$work/state

digest() {
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | select(.name == "final") | .digest'
}
distance() { # HU, root mean square, between the volume of $job and that without scatter
	get_volume final "$work/volume.nii"
	cbct compare --json "$work/volume.nii" "$work/good.nii" | jq '.rmse / 0.0192 * 1000'
}
image_of() { # K: that of projection K, as a file
	dd if="$work/images/scatter.raw" of="$work/image.raw" bs=1280 skip=$((($1 + 9) / 10)) count=1 status=none
}
# K: as every client does it, again where the daemon is busy with this image, for it may be looking at its damage just now.
put_image() {
	local end=$((SECONDS + 60))
	image_of "$1"
	until req PUT "/v1/scans/$scan/scatter/$1" --data-binary @"$work/image.raw" && [ "$status" != 503 ]; do
		[ $SECONDS -lt $end ] || return 0 # whoever asks for the status finds 503
		sleep 0.1
	done
}
put_one() { # K: a projection
	dd if="$work/images/projections.raw" of="$work/one.raw" bs=20480 skip="$1" count=1 status=none
	req PUT "/v1/scans/$scan/projections/$1" --data-binary @"$work/one.raw"
	expect_status 201
}
waits_for_scatter() {
	local end=$((SECONDS + 60))
	until req GET "/v1/jobs/$job" && member '.state == "waiting" and (.waiting_for | index("scatter") != null)' "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "a job that waits for scatter: $(json '{state, waiting_for}')"
		sleep 0.05
	done
}

test_images_are_taken_off_whatever_the_order_of_arrival() {
	local first k
	reconstruct "$work/good" "$recipe"
	get_volume final "$work/good.nii"
	reconstruct "$work/left-in" "$recipe"
	expect_number "$(distance)" '>' 60 "RMSE in HU where scatter is left in"
	# by `cbct upload`, before the projections
	scan=$(cbct upload --quiet --url "$url" "$work/images") || fail "cbct upload"
	req GET "/v1/scans/$scan"
	expect_json '.scatter == {"kind": "images", "columns": 20, "rows": 16, "every": 10, "count": 6, "received_count": 6, "missing": []}'
	expect_json '.projections.scatter.kind == "images" and ([.warnings[] | select(.code == "no_scatter")] == [])'
	post_job "$recipe"
	wait_job succeeded
	expect_json '[.warnings[].code | select(startswith("scatter"))] == []'
	expect_number "$(distance)" '<' 2 "RMSE in HU with images"
	first=$(digest)
	req GET "/v1/jobs/$job/volumes/final/provenance"
	expect_json '.images.scatter | startswith("sha-256=:")'
	# in one process, without a daemon
	cbct recon "$work/images" -o "$work/alone" --backend "$BACKEND" --fdk hann --grid 40,40,28 --spacing 2.6 --quiet >"$work/said" 2>&1 || fail "cbct recon: $(cat "$work/said")"
	cbct compare --json "$work/alone/final.nii" "$work/volume.nii" | jq -e '.rmse == 0' >/dev/null || fail "the same volume by cbct recon"
	# The job first, projections from the last to the first, and scatter amid them and behind them.
	post_scan "$work/images"
	post_job "$recipe"
	for k in $(seq 44 -1 20) 0; do put_one "$k"; done
	for k in 20 44; do put_image $k && expect_status 201; done
	for k in $(seq 1 19); do put_one "$k"; done
	waits_for_scatter
	req GET "/v1/scans/$scan"
	expect_json '.state == "complete" and .scatter.missing == [0, 10, 30, 40]'
	expect_json '[.warnings[] | select(.code == "no_scatter")] | length == 1 and .[0].severity == "caution"'
	for k in 40 0 30 10; do put_image $k && expect_status 201; done
	wait_job succeeded
	[ "$(digest)" = "$first" ] || fail "the bits of the job that came before all else"
}

test_an_image_comes_back_and_is_checked() {
	post_scan "$work/images"
	put_image 10
	expect_status 201
	put_image 10
	expect_status 200
	req GET "/v1/scans/$scan/scatter/10"
	expect_status 200
	cmp "$body" "$work/image.raw" || fail "the same bytes"
	[ "$(header repr-digest)" = "sha-256=:$(openssl dgst -sha256 -binary "$work/image.raw" | base64):" ] || fail "its digest"
	req GET "/v1/scans/$scan/scatter/10" -H "If-None-Match: $(header etag)"
	expect_status 304
	image_of 20
	req PUT "/v1/scans/$scan/scatter/10" --data-binary @"$work/image.raw"
	expect_problem 409
	req GET "/v1/scans/$scan/scatter/20"
	expect_problem 404
	req PUT "/v1/scans/$scan/scatter/11" --data-binary @"$work/image.raw"
	expect_problem 404
	expect_json '.detail | contains("every 10-th")'
	req PUT "/v1/scans/$scan/scatter/45" --data-binary @"$work/image.raw"
	expect_problem 404
	req PUT "/v1/scans/$scan/scatter/20" --data-binary abc
	expect_problem 400
	expect_json '.detail | contains("1280 bytes: 20 x 16 float32")'
	req PUT "/v1/scans/$scan/scatter/20" -H 'Content-Digest: sha-256=:AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA=:' --data-binary @"$work/image.raw"
	expect_problem 400
	{ head -c 8 "$work/image.raw" && printf '\0\0\300\177' && tail -c +13 "$work/image.raw"; } >"$work/nan.raw"
	req PUT "/v1/scans/$scan/scatter/20" --data-binary @"$work/nan.raw"
	expect_problem 422
	expect_json '.detail | contains("column 2, row 0")'
	{ head -c 80 "$work/image.raw" && printf '\0\0\200\277' && tail -c +85 "$work/image.raw"; } >"$work/negative.raw"
	req PUT "/v1/scans/$scan/scatter/20" --data-binary @"$work/negative.raw"
	expect_problem 422
	expect_json '.detail | contains("column 0, row 1) is negative")'
	zstd -q -c "$work/image.raw" >"$work/image.zst"
	req PUT "/v1/scans/$scan/scatter/20" -H 'Content-Encoding: zstd' --data-binary @"$work/image.zst"
	expect_status 201
	post_scan "$work/good"
	req PUT "/v1/scans/$scan/scatter/0" --data-binary @"$work/image.raw"
	expect_problem 409
	expect_json '.detail | contains("announces no images")'
}

test_an_image_is_removed_and_another_put() {
	local k right uploaded
	uploaded=$(cbct upload --quiet --url "$url" "$work/images")
	scan=$uploaded
	post_job "$recipe"
	wait_job succeeded
	right=$(digest)
	post_scan "$work/images"
	put_image 10
	req DELETE "/v1/scans/$scan/scatter/20"
	expect_problem 404
	req DELETE "/v1/scans/$scan/scatter/11"
	expect_problem 404
	req DELETE "/v1/scans/$scan/scatter/10"
	expect_status 204
	req GET "/v1/scans/$scan/scatter/10"
	expect_problem 404
	expect_json '.detail | contains("not been stored yet")'
	image_of 20
	req PUT "/v1/scans/$scan/scatter/10" --data-binary @"$work/image.raw"
	expect_status 201
	for k in 0 20 30 40 44; do put_image $k; done
	# A job that has begun with views as they came begins anew, and has the bits of the images that are there in the end.
	post_job "$recipe"
	for k in $(seq 0 43); do put_one "$k"; done
	req DELETE "/v1/scans/$scan/scatter/10"
	expect_status 204
	put_one 44
	waits_for_scatter
	put_image 10
	expect_status 201
	wait_job succeeded
	[ "$(digest)" = "$right" ] || fail "the bits of a scan whose images were right at once"
	req DELETE "/v1/scans/$scan/scatter"
	expect_status 204
	req GET "/v1/scans/$scan"
	expect_json '.scatter.received_count == 0 and ([.warnings[].code] | index("damaged_image") == null)'
	req DELETE "/v1/scans/$scan/scatter"
	expect_problem 404
	put_image 44
	expect_status 201
	# not while a job needs them
	scan=$uploaded
	post_job '{"scan": "SCAN", "grid": {"size": [40, 40, 28], "spacing_mm": [2.6, 2.6, 2.6]}, "sart": {"iterations": 100000}, "tv": null}'
	until req GET "/v1/jobs/$job" && member '.iteration >= 1' "$body" >/dev/null; do sleep 0.05; done
	for k in scatter/10 scatter; do
		req DELETE "/v1/scans/$scan/$k"
		expect_problem 409
		expect_json ".detail | contains(\"job $job has begun\")"
	done
	req DELETE "/v1/jobs/$job"
	wait_job cancelled
	req DELETE "/v1/scans/$scan/scatter/10"
	expect_status 204
	post_scan "$work/good"
	req DELETE "/v1/scans/$scan/scatter"
	expect_problem 409
}

# Views 35 to 44 never come: their images are waited for no more, and views behind 30 have that of 30.
test_a_scan_that_is_broken_off_wants_the_images_of_its_views() {
	local k
	post_scan "$work/images"
	for k in $(seq 0 34); do put_one "$k"; done
	for k in 0 10 20; do put_image $k && expect_status 201; done
	post_job "$recipe"
	req POST "/v1/scans/$scan/complete"
	expect_status 200
	waits_for_scatter
	put_image 40
	expect_problem 409
	expect_json '.detail | contains("completed without projection 40")'
	put_image 30
	expect_status 201
	wait_job succeeded
	put_image 44
	expect_problem 409
}

# $1: which images, FROM TO; $2: what happens to their pixel 10, 8, or with "block" to four, or with "all" to all of them
spoil() {
	rm -rf "$work/spoiled"
	cp -r "$work/images" "$work/spoiled"
	/usr/bin/env python3 - "$work/spoiled/scatter.raw" "$@" <<'EOP'
import array, sys
path, first, last, where, factor = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4], float(sys.argv[5])
samples = array.array('f', open(path, 'rb').read())
offsets = {'pixel': [8 * 20 + 10], 'block': [8 * 20 + 10, 8 * 20 + 11, 9 * 20 + 10, 9 * 20 + 11], 'all': range(320)}[where]
for image in range(first, last + 1):
    for at in offsets:
        samples[320 * image + at] = min(3.4e38, samples[320 * image + at] * factor)
samples.tofile(open(path, 'wb'))
EOP
}
test_spikes_are_replaced_and_too_much_is_told() {
	reconstruct_spoiled() {
		scan=$(cbct upload --quiet --url "$url" "$work/spoiled") || fail "cbct upload"
		post_job "$recipe"
		wait_job succeeded
	}
	spikes_of() { # IMAGES PIXELS FROM TO WHERE FACTOR
		spoil "${@:3}"
		reconstruct_spoiled
		expect_json '[.warnings[] | select(.code | startswith("scatter")) | [.code, .severity]] == [["scatter_spikes", "caution"]]'
		expect_json "[.warnings[].detail | select(test(\" $2 pixels? in $1 images? of\"))] | length == 1"
		expect_number "$(distance)" '<' 3 "RMSE in HU with $* in place of an image"
	}
	spikes_of 6 6 0 5 pixel 2
	spikes_of 6 24 0 5 block 3
	spikes_of 1 1 2 2 pixel 1e38
	# five times the scatter is told, by one warning, as is far more than all there is
	for factor in 5 1000; do
		spoil 0 5 all $factor
		reconstruct_spoiled
		expect_json '[.warnings[] | select(.code | startswith("scatter")) | [.code, .severity]] == [["scatter_exceeds", "serious"]]'
	done
}

test_scans_that_cannot_be_are_refused() {
	refuse() { # STATUS POINTER WORDS SCATTER
		jq ".projections.scatter = $4" "$work/good/scan.json" >"$work/bad.json"
		req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/bad.json"
		expect_problem "$1" "$2"
		expect_json ".detail | contains(\"$3\")"
	}
	refuse 400 /projections/scatter/kind images '{"kind": "kernels", "columns": 4, "rows": 4}'
	refuse 400 /projections/scatter/rows '' '{"kind": "images", "columns": 4}'
	refuse 422 /projections/scatter/columns 4096 '{"kind": "images", "columns": 4097, "rows": 4}'
	refuse 422 /projections/scatter/every '' '{"kind": "images", "columns": 4, "rows": 4, "every": 0}'
	refuse 400 /projections/scatter either '{"kind": "images", "columns": 4, "rows": 4, "fraction": 0.2}'
}

# N images are damaged by the disk. The daemon looks at one after the other and tells each as soon as its damage is noted
# durably, so that a scan may be seen with fewer for a while.
expect_damage() {
	local end=$((SECONDS + 60)) told="[.warnings[] | select(.code == \"damaged_image\") | [.severity, (.detail | test(\"damaged $1 images? of scatter\"))]] == [[\"serious\", true]]"
	until req GET "/v1/scans/$scan" && member "$told" "$body" >/dev/null; do
		[ $SECONDS -lt $end ] || fail "$1 damaged images: $(json .warnings)"
		sleep 0.05
	done
}
# Damage to a file of the images: NAME HOW
damage() {
	local file="$state/scans/$scan/$1"
	case $2 in
	zero) head -c "$(stat -c %s "$file")" /dev/zero >"$work/zeros" && cat "$work/zeros" >"$file" ;;
	cut) truncate -s $(($(stat -c %s "$file") / 2)) "$file" ;;
	longer) echo more >>"$file" ;;
	gone) rm "$file" ;;
	flip) printf '\377\377' | dd of="$file" bs=1 seek=700 conv=notrunc status=none ;;
	esac
}
test_damage_under_the_running_daemon_is_told_and_healed() {
	local first k how
	scan=$(cbct upload --quiet --url "$url" "$work/images")
	post_job "$recipe"
	wait_job succeeded
	first=$(digest)
	# a job comes first: it waits, says for what, and has the same bits once the images were sent again
	for how in 'raw zero' 'raw gone' 'sums zero' 'raw flip'; do
		damage scatter.${how% *} "${how#* }"
		post_job "$recipe"
		waits_for_scatter
		case $how in
		'raw flip') expect_damage 1 ;;
		*) expect_damage 6 ;;
		esac
		req GET "/v1/scans/$scan/scatter/0"
		expect_problem 404
		expect_json '.detail | contains("damaged on the disk")'
		for k in 0 10 20 30 40 44; do put_image $k && expect_status "$(if [ "$how" = 'raw flip' ] && [ $k != 0 ]; then echo 200; else echo 201; fi)"; done
		req GET "/v1/scans/$scan"
		expect_json '[.warnings[].code] | index("damaged_image") == null'
		wait_job succeeded
		[ "$(digest)" = "$first" ] || fail "the same bits once what was damaged ($how) was sent again"
	done
	# and an image comes first, or who asks for one
	for how in 'raw cut' 'raw longer' 'sums cut' 'sums gone' 'sums flip'; do
		damage scatter.${how% *} "${how#* }"
		if [ "${how#* }" = cut ]; then
			req GET "/v1/scans/$scan/scatter/44"
			expect_problem 500
		fi
		for k in 44 0 10 20 30 40; do put_image $k && member '.stored + .same == 1' "$body" >/dev/null || fail "$how: an image that is sent again"; done
		post_job "$recipe"
		wait_job succeeded
		[ "$(digest)" = "$first" ] || fail "the same bits ($how)"
	done
	# images that never came are not told as damaged, also where the list of all of them is gone
	post_scan "$work/images"
	put_image 10
	damage scatter.sums gone
	put_image 20
	expect_status 201
	expect_damage 1
	req GET "/v1/scans/$scan/scatter/30"
	expect_problem 404
	expect_json '.detail | contains("not been stored yet")'
}

# The last two: the daemons that they start have other ports.
test_what_was_stored_outlives_a_kill_and_damage_is_found() {
	local first k
	scan=$(cbct upload --quiet --url "$url" "$work/images")
	post_job "$recipe"
	wait_job succeeded
	first=$(digest)
	stop_daemon KILL
	# Two bits of the image of projection 20 (the third), and the record of that of 40 (the fifth).
	printf '\377\377' | dd of="$state/scans/$scan/scatter.raw" bs=1 seek=$((2 * 1280 + 100)) conv=notrunc status=none
	printf '\377' | dd of="$state/scans/$scan/scatter.sums" bs=1 seek=$((512 + 4 * 64 + 9)) conv=notrunc status=none
	start_daemon
	req GET "/v1/scans/$scan"
	expect_json '.scatter.missing == [40] and ([.warnings[] | select(.code == "damaged_image")] | length == 1)'
	put_image 40
	expect_status 201
	post_job "$recipe"
	waits_for_scatter
	req GET "/v1/scans/$scan"
	expect_json '.scatter.missing == [20]'
	req GET "/v1/scans/$scan/scatter/20"
	expect_problem 404
	put_image 20
	expect_status 201
	wait_job succeeded
	[ "$(digest)" = "$first" ] || fail "the same bits once the image was sent again"
	# the lists are gone altogether: all are sent again
	stop_daemon
	rm "$state/scans/$scan/scatter.sums"
	start_daemon
	expect_damage 6
	expect_json '.scatter.missing == [0, 10, 20, 30, 40, 44]'
	# that stays so, and so it is where they are zeros, all of them or one
	stop_daemon
	start_daemon
	expect_damage 6
	for k in 0 10 20 30 40 44; do put_image $k && expect_status 201; done
	stop_daemon
	head -c 64 /dev/zero | dd of="$state/scans/$scan/scatter.sums" bs=64 seek=9 conv=notrunc status=none
	start_daemon
	expect_damage 1
	expect_json '.scatter.missing == [10]'
	stop_daemon
	damage scatter.sums zero
	start_daemon
	expect_damage 6
	for k in 0 10 20 30 40 44; do put_image $k && expect_status 201; done
	post_job "$recipe"
	wait_job succeeded
	[ "$(digest)" = "$first" ] || fail "the same bits with new lists"
	# and the catalogue is made again
	stop_daemon
	if [ -z "${CBCT_TEST_CATALOGUE:-}" ]; then
		rm "$state"/catalogue.*
		start_daemon
		req GET "/v1/scans/$scan"
		expect_json '.scatter.received_count == 6'
		return
	fi
	start_daemon
}

# A job of many iterations yields to another, and what its images of scatter were is found damaged meanwhile.
test_a_job_that_goes_on_later_never_mixes_two_sets_of_images() {
	[ "$BACKEND" = cpu ] || skip "a card is done before another job can come in between"
	local good iterate='"grid": {"size": [20, 20, 14], "spacing_mm": [5.2, 5.2, 5.2]}, "tv": null' first other_bits other_images going stat k
	going="{\"scan\": \"SCAN\", $iterate, \"sart\": {\"iterations\": 200, \"subsets\": 5}}"
	put_other() { # of projection 0: that of projection 20
		image_of 20
		req PUT "/v1/scans/$scan/scatter/0" --data-binary @"$work/image.raw"
	}
	lose_with_its_record() {
		damage scatter.raw flip
		printf '\377' | dd of="$state/scans/$scan/scatter.sums" bs=1 seek=$((512 + 9)) conv=notrunc status=none
		req GET "/v1/scans/$scan/scatter/0"
		expect_problem 500
	}
	has_yielded() {
		req GET "/v1/jobs/$job" && member '.state == "queued" and .iteration >= 1' "$body" >/dev/null
	}
	begin_and_yield() { # a job of new images, which had begun when $stat came; that one runs until it is cancelled
		local mine images
		for _ in $(seq 20); do # it may be faster than this
			scan=$(cbct upload --quiet --url "$url" "$work/images") || fail "cbct upload"
			post_job "$going"
			until req GET "/v1/jobs/$job" && member '.iteration >= 2' "$body" >/dev/null; do sleep 0.02; done
			mine=$job images=$scan scan=$good
			post_job "{\"scan\": \"SCAN\", $iterate, \"sart\": {\"iterations\": 100000}, \"priority\": \"stat\"}"
			stat=$job job=$mine scan=$images
			until req GET "/v1/jobs/$stat" && member '.state == "running"' "$body" >/dev/null; do sleep 0.02; done
			has_yielded && return
			req DELETE "/v1/jobs/$stat"
		done
		fail "a job that yields"
	}
	ends_with() { # DIGEST
		req DELETE "/v1/jobs/$stat"
		wait_job succeeded
		[ "$(digest)" = "$1" ] || fail "the bits of one set of images"
	}
	stop_daemon
	start_daemon --workers 1
	good=$(cbct upload --quiet --url "$url" "$work/good")
	scan=$(cbct upload --quiet --url "$url" "$work/images")
	post_job "$going"
	wait_job succeeded
	first=$(digest)
	# what was damaged may be removed while no job has begun with it, and another be put then
	damage scatter.raw flip
	req GET "/v1/scans/$scan/scatter/0"
	expect_problem 500
	put_other
	expect_problem 409
	req DELETE "/v1/scans/$scan/scatter/0"
	expect_status 204
	put_other
	expect_status 201
	post_job "$going"
	wait_job succeeded
	other_bits=$(digest)
	[ "$other_bits" != "$first" ] || fail "another image makes another volume"
	req GET "/v1/jobs/$job/volumes/final/provenance"
	other_images=$(json .images.scatter)
	# the digest of what is damaged is known: nothing but that comes in its place, behind a kill too, and the job goes on
	begin_and_yield
	damage scatter.raw flip
	req GET "/v1/scans/$scan/scatter/0"
	expect_problem 500
	req DELETE "/v1/scans/$scan/scatter/0"
	expect_problem 409
	put_other
	expect_problem 409
	expect_json '.detail | contains("with other bytes, and damaged")'
	stop_daemon KILL
	start_daemon --workers 1
	put_other
	expect_problem 409
	put_image 0
	expect_status 201
	has_yielded || fail "a job that goes on from where it was"
	ends_with "$first"
	# it is not known any more: another may come, behind which a job begins anew
	for k in yielded killed; do
		begin_and_yield
		lose_with_its_record
		put_other
		expect_status 201
		if [ $k = killed ]; then
			stop_daemon KILL
			start_daemon --workers 1
		fi
		ends_with "$other_bits"
		req GET "/v1/jobs/$job/volumes/final/provenance"
		[ "$(json .images.scatter)" = "$other_images" ] || fail "the images that it was made with ($k)"
	done
	# so does one that runs
	scan=$(cbct upload --quiet --url "$url" "$work/images") || fail "cbct upload"
	post_job "{\"scan\": \"SCAN\", $iterate, \"sart\": {\"iterations\": 100000}}"
	until req GET "/v1/jobs/$job" && member '.iteration >= 2' "$body" >/dev/null; do sleep 0.02; done
	lose_with_its_record
	put_other
	expect_status 201
	until req GET "/v1/jobs/$job" && member '.attempts >= 2' "$body" >/dev/null; do
		expect_json '.state == "running" or .state == "queued"'
		sleep 0.05
	done
	req DELETE "/v1/jobs/$job"
	wait_job cancelled
}

start_daemon
run_tests
