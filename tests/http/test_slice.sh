#!/usr/bin/env bash
# Slices of a kept volume as PNG: the right plane the right way up, window and level in HU, refusals that name the parameter.
. "$(dirname "$0")/lib.sh"
program=cbctd-held # asserts the order of locks

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --shift 12,-9,10 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1

# The job that all tests look at; the daemon and its state stay.
export CBCT_TEST_HOLD_DRAWING=$work/hold-drawing
start_daemon --listen "unix:$work/socket" --picture-patience 3600 || exit 1
post_scan "$scan_dir"
post_projections "$scan_dir"
post_job '{"scan": "SCAN", "grid": {"size": [31, 24, 15], "spacing_mm": [3, 4, 5]}, "fdk": {}}'
wait_job succeeded
volume=/v1/jobs/$job/volumes/final
get_volume final "$work/hu.raw" "format=raw&type=int16"

be32() { od -An -tu1 -j "$1" -N 4 "$body" | awk '{ print (($1 * 256 + $2) * 256 + $3) * 256 + $4 }'; }
# Width, height, bit depth and colour of the last body.
picture() { echo "$(be32 16) $(be32 20) $(od -An -tu1 -j 24 -N 2 "$body" | xargs)"; }

test_each_axis_gives_its_plane() {
	local axis size
	for axis in x:24:15 y:31:15 z:31:24; do
		IFS=: read -r axis w h <<<"$axis"
		req GET "$volume/slice?axis=$axis&index=7"
		expect_status 200
		[ "$(header content-type)" = image/png ] || fail "image/png"
		[ "$(picture)" = "$w $h 8 0" ] || fail "$w x $h, 8 bit gray, got $(picture)"
	done
	req GET "$volume/slice"
	expect_status 200
	[ "$(picture)" = "31 24 8 0" ] || fail "the middle across z without parameters"
	cp "$body" "$work/middle"
	req GET "$volume/slice?axis=z&index=7&window=2000&level=0"
	cmp "$body" "$work/middle" || fail "the same with the defaults written out"
}

test_a_contact_sheet_shows_all_planes() {
	req GET "$volume/slice?axis=z&sheet=1"
	expect_status 200
	# 15 planes, six across
	[ "$(picture)" = "186 72 8 0" ] || fail "6 x 3 tiles of 31 x 24, got $(picture)"
}

test_tags_save_the_drawing() {
	local etag
	req GET "$volume/slice?axis=y&index=3"
	etag=$(header etag)
	[[ $etag == '"'*'"' ]] || fail "a strong ETag"
	req GET "$volume/slice?axis=y&index=3" -H "If-None-Match: $etag"
	expect_status 304
	req GET "$volume/slice?axis=y&index=4" -H "If-None-Match: $etag"
	expect_status 200
	req GET "$volume/slice?axis=y&index=3&level=1" -H "If-None-Match: $etag"
	expect_status 200
	req GET "$volume/slice?axis=y&index=3" -H "If-Match: \"another\", $etag"
	expect_status 200
	req GET "$volume/slice?axis=y&index=3" -H 'If-Match: "another"'
	expect_problem 412
	req GET "$volume/slice?axis=y&index=3" -H "If-Match: W/$etag"
	expect_problem 412
}

test_planes_and_slabs_at_any_angle_are_the_volume_resampled() {
	local normal python=${PYTHON:-/usr/bin/python3}
	"$python" -c 'import numpy' 2>/dev/null || skip "numpy is not here"
	get_volume final "$work/v.raw" format=raw
	"$python" "$here/oblique.py" "$url" "$volume" "$work/v.raw" 31,24,15 3,4,5 -45,-46,-35 700 0 0.0192 || fail "the same pixels"
	# Without center, size and spacing: all of the volume, about its middle, a pixel as small as a voxel's smallest side.
	req GET "$volume/slice?normal=0,0,-1"
	expect_status 200
	[ "$(picture)" = "31 32 8 0" ] || fail "31 x 32 pixels of 3 mm for 93 x 96 mm, got $(picture)"
	req GET "$volume/slice?normal=1,1,0&size=64,48&spacing=2"
	expect_status 200
	[ "$(picture)" = "64 48 8 0" ] || fail "64 x 48, got $(picture)"
	# as programs print the cosine of a right angle
	req GET "$volume/slice?normal=0,1,0"
	cp "$work/body" "$work/straight"
	req GET "$volume/slice?normal=6.123233995736766e-17,1E0,0"
	cmp -s "$work/body" "$work/straight" || fail "the same plane by numbers with an exponent"
	# of whatever length, whose square may be nothing
	for normal in 0,1e-165,0 0,5e-324,0 0,1000000,0; do
		req GET "$volume/slice?normal=$normal"
		expect_status 200
		cmp -s "$work/body" "$work/straight" || fail "the same plane by the normal $normal"
	done
	req GET "$volume/slice?normal=0,0,3e-200"
	expect_status 200
	# Layers beyond the volume, along lines that would meet it billions of pixels away.
	req GET "$volume/slice?normal=0,0,1&up=0,-1,0&thickness=203&mode=max"
	cp "$work/body" "$work/straight"
	req GET "$volume/slice?normal=1e-11,0,1&up=0,-1,0&thickness=203&mode=max"
	expect_status 200
	cmp -s "$work/body" "$work/straight" || fail "the same slab where it is askew by less than can be seen"
}

test_the_sides_of_the_picture_are_told() {
	local position expected
	sides() { header cbct-sides; }
	req GET "$volume/slice?axis=x"
	[ "$(sides)" = 'left="-y", right="+y", top="+z", bottom="-z"' ] || fail "the world's axes where no position is known, got $(sides)"
	req GET "$volume/slice?normal=1,1,0"
	[ "$(sides)" = 'left="+x-y", right="-x+y", top="+z", bottom="-z"' ] || fail "two axes each, got $(sides)"
	while read -r position expected; do
		post_job '{"scan": "SCAN", "grid": {"size": [8, 8, 8], "spacing_mm": [9, 9, 9]}, "fdk": {}, "patient": {"position": "'"$position"'"}}'
		wait_job succeeded
		req GET "/v1/jobs/$job/volumes/final/slice?normal=1,-0.5,0&thickness=10"
		expect_status 200
		[ "$(sides | tr -d '"')" = "$expected" ] || fail "$position: $expected, got $(sides)"
	done <<-EOF
		HFS left=AR, right=PL, top=S, bottom=I
		FFS left=AL, right=PR, top=I, bottom=S
		HFP left=PL, right=AR, top=S, bottom=I
	EOF
}

test_what_cannot_be_is_refused_by_its_name() {
	local query
	for query in axis=w index=15 index=-1 index=1.5 index=x "axis=x&index=31" window=0 window=-5 window=nan level=high sheet=2 \
		normal=0,0,0 normal=1,0 normal=1,0,0,0 normal=1,x,0 normal=1,0, normal=0x10,0,0 normal= "normal=1,0,0&up=2,0,0" "normal=1,0,0&up=0,0,0" \
		"normal=1,0,0&center=500,0,0" "normal=1,0,0&center=1,2" "normal=1,0,0&size=0,5" "normal=1,0,0&size=5" "normal=1,0,0&size=2049,5" \
		"normal=1,0,0&size=5.5,5" "normal=1,0,0&size=1e2,2" "normal=1,0,0&size=2,,2" "normal=1,0,0&size=2,2," "normal=1,0,0&spacing=0" "normal=1,0,0&spacing=-1" "normal=1,0,0&axis=x" "normal=1,0,0&index=3" \
		"normal=1,0,0&sheet=1" up=0,0,1 center=0,0,0 size=5,5 spacing=1 thickness=0 thickness=-3 thickness=thick thickness=1001 \
		"thickness=5&mode=median" mode=max "sheet=1&thickness=4" "sheet=1&index=3" "normal=1,0,0&size=2048,2048&thickness=200" "normal=1,0.3,0.3&size=2048,2048&spacing=0.02&thickness=20"; do
		req GET "$volume/slice?$query"
		expect_problem 400
		expect_json ".detail | contains(\"$(sed 's/.*&//; s/=.*//' <<<"$query")\")" # the last one is at fault
	done
	req GET "/v1/jobs/$job/volumes/iter-7/slice"
	expect_problem 404
	req GET /v1/jobs/0000000000000000/volumes/final/slice
	expect_problem 404
	req PUT "$volume/slice"
	expect_problem 405
}

test_other_formats_and_scales() {
	local n=$((31 * 24))
	# shuffled: of each plane the low bytes, then the high ones
	req GET "$volume?format=shuffled"
	expect_status 200
	[ "$(header content-type)" = application/vnd.cbct.shuffled+zstd ] || fail "the media type"
	[ -z "$(header content-encoding)" ] || fail "no Content-Encoding: the type says it"
	zstd -q -d -c <"$body" | od -An -v -tu1 -w1 | awk -v n=$n '
		{ b[NR - 1] = $1 }
		END { for (z = 0; z < 15; z++) for (i = 0; i < n; i++) { v = b[2 * z * n + i] + 256 * b[2 * z * n + n + i]; print (v > 32767 ? v - 65536 : v) } }' >"$work/unshuffled"
	od -An -v -td2 -w2 "$work/hu.raw" | awk '{ print $1 }' | cmp - "$work/unshuffled" || fail "the int16 voxels"
	req GET "$volume?format=shuffled&type=float32"
	expect_problem 400
	req GET "$volume?type=float64"
	expect_problem 400
	req GET "$volume?scale=0"
	expect_problem 400
	req GET "$volume?scale=17"
	expect_problem 400
	# scale=2 of odd sizes: the last ones are means of what is there
	get_volume final "$work/v.raw" format=raw
	get_volume final "$work/half.nrrd" "format=nrrd&scale=2"
	grep -a -q '^sizes: 16 12 8' "$work/half.nrrd" || fail "16 x 12 x 8: $(grep -a '^sizes' "$work/half.nrrd")"
	grep -a -q '^space directions: (6,0,0) (0,8,0) (0,0,10)' "$work/half.nrrd" || fail "twice the spacing"
	# voxel 0 was at -45, -46, -35
	grep -a -q '^space origin: (-43.5,-44,-32.5)' "$work/half.nrrd" || fail "the origin in the middle of the first eight"
	get_volume final "$work/half.raw" "format=raw&scale=2"
	paste <(od -An -v -tf4 -w4 "$work/v.raw" | awk '
		{ v[NR - 1] = $1 }
		END {
			for (z = 0; z < 8; z++) for (y = 0; y < 12; y++) for (x = 0; x < 16; x++) {
				s = n = 0
				for (k = 2 * z; k < 2 * z + 2 && k < 15; k++) for (j = 2 * y; j < 2 * y + 2; j++) for (i = 2 * x; i < 2 * x + 2 && i < 31; i++) { s += v[(k * 24 + j) * 31 + i]; n++ }
				print s / n
			}
		}') <(od -An -v -tf4 -w4 "$work/half.raw") |
		# awk prints six digits of numbers of at most 0.03
		awk '{ d = $1 - $2; n++; if (d > 1e-6 || d < -1e-6) bad++ } END { exit bad > 0 || n != 16 * 12 * 8 }' || fail "the means"
	get_volume final "$work/half.again" "format=raw&scale=2"
	cmp "$work/half.raw" "$work/half.again" || fail "the same bytes twice"
}

# A scan of small projections that lacks them all.
post_incomplete() {
	cbct simulate -o "$work/small" --phantom ball --views 4 --columns 8 --rows 8 --pixel 20 >/dev/null
	post_scan "$work/small"
}

test_nobody_waits_for_the_pictures_of_others_and_none_is_drawn_for_who_has_gone() {
	post_incomplete
	"${PYTHON:-/usr/bin/python3}" "$here/pictures.py" "$url" "$work/socket" "$volume" "$scan" "$CBCT_TEST_HOLD_DRAWING" || fail "what it says"
}

test_a_turn_that_does_not_come_is_refused() {
	post_incomplete
	stop_daemon
	start_daemon --picture-patience 0.1
	"${PYTHON:-/usr/bin/python3}" "$here/pictures.py" "$url" "$work/socket" "$volume" "$scan" "$CBCT_TEST_HOLD_DRAWING" late || fail "what it says"
}

run_tests
stop_daemon
