#!/usr/bin/env bash
# Other tools' files: what cbct import makes of them is the scan that they were written from, and what
# cbct export-geometry writes brings the same views back. The files are written by images.py and DCMTK's
# programs, none of them by the project's own code.
. "$(dirname "$0")/lib.sh"

small=(--views 20 --arc 200 --first-angle 80 --columns 48 --rows 32 --pixel 4,3 --source-to-isocentre 600 --source-to-detector 1000)
ball=(--phantom ball --scale 30 --density 0.02 --shift 20,-9,4)
circle=(--first-angle 80 --angle-step 10.526315789473685 --source-to-isocentre 600 --source-to-detector 1000)
counts=$work/counts    # uint16, air 50000
floats=$work/floats    # line integrals
grid=(--grid 32,32,24 --spacing 3)

need_numpy() { /usr/bin/python3 -c 'import numpy' 2>/dev/null || skip "python3-numpy is not here"; }
need_dcmtk() {
	local program
	for program in dump2dcm dcm2xml dcmdump dcmdjpeg dcmdrle dcmcrle dcmcjpeg; do
		command -v $program >/dev/null || skip "$program of the package dcmtk is not here"
	done
}
images() { /usr/bin/python3 "$here/images.py" "$@"; }

# status_of COMMAND ...: its exit status; what it said is in $work/said
status_of() {
	local status=0
	"$@" >"$work/said" 2>&1 || status=$?
	echo "$status"
}
# refused STATUS TEXT COMMAND ...: fails so, and says the text
refused() {
	local expected=$1 text=$2 got
	shift 2
	got=$(status_of "$@")
	[ "$got" = "$expected" ] || fail "exit status $expected of $*, got $got: $(cat "$work/said")"
	grep -qF -- "$text" "$work/said" || fail "\"$text\" from $*, got: $(cat "$work/said")"
	[ ! -e "$work/never/scan.json" ] || fail "no scan of what was refused"
}
# imports SCAN ARGUMENT ...: the same samples come back
imports() {
	local scan=$1
	shift
	rm -rf "$work/back"
	cbct import "$@" -o "$work/back" 2>"$work/said" || fail "$* imported: $(cat "$work/said")"
	cmp "$scan/projections.raw" "$work/back/projections.raw" || fail "the same samples from $*"
	cmp <(jq -c .projections "$scan/scan.json" | jq -S .) <(jq -c .projections "$work/back/scan.json" | jq -S .) ||
		fail "the same quantity and sample from $*"
}
# same_views A B TOLERANCE NAME: source, centre, u and v of every view, mm
same_views() {
	local worst
	cbct export-geometry "$1" --format astra -o "$work/a.vectors"
	cbct export-geometry "$2" --format astra -o "$work/b.vectors"
	[ "$(wc -l <"$work/a.vectors")" = "$(wc -l <"$work/b.vectors")" ] || fail "as many views"
	worst=$(paste -d' ' "$work/a.vectors" "$work/b.vectors" |
		awk '{ for (i = 1; i <= 12; i++) { d = $i - $(i + 12); if (d < 0) d = -d; if (d > m) m = d } } END { print m + 0 }')
	expect_number "$worst" '<=' "$3" "views of $4, largest difference in mm"
}

make_scans() {
	[ -e "$counts/scan.json" ] || cbct simulate -o "$counts" "${ball[@]}" "${small[@]}" --raw air --air 50000
	[ -e "$floats/scan.json" ] || cbct simulate -o "$floats" "${ball[@]}" "${small[@]}"
}

# XML and stack from any kind of document, back by the parameters and by the matrices. 3x4 matrices in pixels tell
# their vectors to some 1e-11 mm in double precision; the rest is angles' rounding.
test_rtk_round_trips_are_exact() {
	local kind trust
	for kind in "--kind circular" "--kind angles --clockwise --detector-offset 3,-5" "--kind views --source-offset -2,1" \
		"--kind matrices" "--wobble 2" "--wobble 20 --kind views --clockwise"; do
		# shellcheck disable=SC2086
		cbct simulate -o "$work/ours" "${ball[@]}" "${small[@]}" $kind
		cbct export-geometry "$work/ours" -o "$work/geometry.xml" --stack "$work/stack.mhd"
		for trust in both parameters matrices; do
			imports "$work/ours" "$work/stack.mhd" --rtk "$work/geometry.xml" --trust $trust
			same_views "$work/ours" "$work/back" 1e-10 "$kind, trust $trust"
		done
	done
}

test_a_real_sweeps_matrices_come_through_rtk() {
	need_data carm_kct_248.npy
	head -c $((248 * 62 * 48 * 2)) /dev/zero >"$work/black.raw"
	# A tenth of the columns and rows: pixels ten times as large, their centres moved by 4.5 of the old ones.
	cbct import "$work/black.raw" --size 62,48 --type uint16 --air 1000 --matrices "$DATA/carm_kct_248.npy" --pixel 0.616 \
		-o "$work/kct" 2>/dev/null
	cbct export-geometry "$work/kct" -o "$work/kct.xml" --stack "$work/kct.mhd"
	grep -c '<Projection>' "$work/kct.xml" | grep -qx 248 || fail "248 projections"
	imports "$work/kct" "$work/kct.mhd" --rtk "$work/kct.xml" --air 1000
	same_views "$work/kct" "$work/back" 1e-10 "the real sweep"
	# The matrices that come out are those that went in, up to their scale.
	cbct export-geometry "$work/back" --format matrices -o "$work/kct.txt"
	imports "$work/kct" "$work/black.raw" --size 62,48 --type uint16 --air 1000 --matrices "$work/kct.txt" --pixel 0.616
	same_views "$work/kct" "$work/back" 1e-9 "the real sweep's matrices as text"
}

test_rtk_files_of_others_are_understood() {
	make_scans
	# One value for all, persisting ones, an offset that goes over to the next view, the old name of the angle.
	{
		echo '<?xml version="1.0"?><!DOCTYPE RTKGEOMETRY><RTKThreeDCircularGeometry version="2">'
		echo '<SourceToIsocenterDistance>600</SourceToIsocenterDistance><SourceToDetectorDistance>1000</SourceToDetectorDistance>'
		awk 'BEGIN { for (k = 0; k < 20; k++) {
			name = k % 2 ? "Angle" : "GantryAngle"
			printf "<Projection><%s>%.17g</%s>\n", name, 80 + k * 200 / 19, name
			if (k == 5) print "<ProjectionOffsetX>7.5</ProjectionOffsetX>"
			print "</Projection>" } }'
		echo '</RTKThreeDCircularGeometry>'
	} >"$work/other.xml"
	need_numpy
	images mha "$counts" "$work/other.mha"
	imports "$counts" "$work/other.mha" --rtk "$work/other.xml" --air 50000
	# Views 0 to 4 are the circle's, those behind have their detector 7.5 mm along u.
	cbct export-geometry "$counts" --format astra -o "$work/a.vectors"
	cbct export-geometry "$work/back" --format astra -o "$work/b.vectors"
	paste -d' ' "$work/a.vectors" "$work/b.vectors" |
		awk '{ d = sqrt(($4 - $16)^2 + ($5 - $17)^2 + ($6 - $18)^2); s = sqrt(($1 - $13)^2 + ($2 - $14)^2 + ($3 - $15)^2)
			if (s > 1e-10 || (d - (NR > 5 ? 7.5 : 0))^2 > 1e-18) bad = 1 } END { exit bad }' || fail "a circle whose detector moves at the sixth view"
}

test_contradicting_matrices_are_named() {
	cbct simulate -o "$work/ours" "${ball[@]}" "${small[@]}"
	cbct export-geometry "$work/ours" -o "$work/geometry.xml" --stack "$work/stack.mhd"
	# The eighth view's angle, changed by hand.
	awk '/<GantryAngle>/ && n++ == 7 { sub(/>[0-9.]+</, ">155<") } { print }' "$work/geometry.xml" >"$work/wrong.xml"
	refused 1 "view 7: the matrix contradicts the parameters by" cbct import "$work/stack.mhd" --rtk "$work/wrong.xml" -o "$work/never"
	grep -q -- '--trust parameters or --trust matrices' "$work/said" || fail "a way out in: $(cat "$work/said")"
	imports "$work/ours" "$work/stack.mhd" --rtk "$work/wrong.xml" --trust matrices
	same_views "$work/ours" "$work/back" 1e-10 "the matrices that count"
}

test_metaimages_of_every_kind() {
	local how
	need_numpy
	make_scans
	for how in "type=<u2" "type=>u2 packed=1" "type=<i2" "type=<f4 packed=1 data=pixels.zraw" "type=<f8 data=pixels.raw header=-1" \
		"type=<i4 data=pixels.raw header=77"; do
		# shellcheck disable=SC2086
		images mha "$counts" "$work/counts.mha" $how factor=$([[ $how == *i2* ]] && echo 0.5 || echo 1)
		if [[ $how == *i2* ]]; then
			# Half of the counts, so that they fit, and doubled again: the odd ones lose their last bit.
			cbct import "$work/counts.mha" "${circle[@]}" --scale 2 --air 50000 -o "$work/back" 2>/dev/null
			[ "$(jq -c .projections.sample "$work/back/scan.json")" = '"uint16"' ] || fail "counts of int16 as uint16"
			continue
		fi
		imports "$counts" "$work/counts.mha" "${circle[@]}" --air 50000
	done
	images mha "$floats" "$work/floats.mha" packed=1
	imports "$floats" "$work/floats.mha" "${circle[@]}"
	same_views "$floats" "$work/back" 1e-10 "angles"
}

test_tiff_numpy_and_raw_images() {
	local plain
	need_numpy
	make_scans
	images tiff "$counts" "$work/folder"
	echo "not an image" >"$work/folder/notes.txt"
	imports "$counts" "$work/folder" "${circle[@]}" --pixel 4,3 --air 50000
	# 9 before 10: else the images are in another order, which the comparison above would have told.
	images tiles "$counts" "$work/tiles" "type=>u2"
	imports "$counts" "$work/tiles" "${circle[@]}" --pixel 4,3 --air 50000
	images pages "$floats" "$work/pages.tif"
	imports "$floats" "$work/pages.tif" "${circle[@]}" --pixel 4,3
	images npy "$floats" "$work/floats.npy" "type=<f8"
	imports "$floats" "$work/floats.npy" "${circle[@]}" --pixel 4,3
	images npy "$counts" "$work/bytes.npy" type=\|u1 factor=0.005
	cbct import "$work/bytes.npy" "${circle[@]}" --pixel 4,3 --air 250 -o "$work/back"
	[ "$(jq -c .projections.sample "$work/back/scan.json")" = '"uint16"' ] || fail "bytes as uint16"
	# Raw: one file for all, then one for each with a header, named in a list.
	plain=(--size 48,32 --type uint16 --pixel 4,3 --air 50000)
	imports "$counts" "$counts/projections.raw" "${circle[@]}" "${plain[@]}"
	mkdir -p "$work/raws"
	(cd "$work/raws" && split -b $((48 * 32 * 2)) -a 2 -d "$counts/projections.raw" x && for f in x??; do { printf 'HEAD'; cat "$f"; } >"${f/x/image}.raw"; done && rm x??)
	ls "$work/raws" | sed 's,^,raws/,' >"$work/list.txt"
	imports "$counts" "$work/list.txt" "${circle[@]}" "${plain[@]}" --header 4
	imports "$counts" "$work/raws" "${circle[@]}" "${plain[@]}" --header 4
	# Mirrored on the way in and once more: as they were.
	cbct import "$counts/projections.raw" "${circle[@]}" "${plain[@]}" --flip-rows --flip-columns -o "$work/flipped"
	! cmp -s "$work/flipped/projections.raw" "$counts/projections.raw" || fail "mirrored images"
	imports "$counts" "$work/flipped/projections.raw" "${circle[@]}" "${plain[@]}" --flip-rows --flip-columns
}

test_lists_of_angles_and_matrices() {
	local plain=(--size 48,32 --type float32 --pixel 4,3)
	make_scans
	awk 'BEGIN { print "# gantry"; for (k = 0; k < 20; k++) printf "%.15g%s", 80 + k * 200 / 19, k % 3 ? "\n" : ", " }' >"$work/angles.csv"
	imports "$floats" "$floats/projections.raw" "${plain[@]}" --angles "$work/angles.csv" --source-to-isocentre 600 --source-to-detector 1000
	same_views "$floats" "$work/back" 1e-10 "angles in a file"
	awk 'BEGIN { for (k = 0; k < 20; k++) printf "%.17g\n", -(80 + k * 200 / 19) * atan2(0, -1) / 180 }' >"$work/angles.txt"
	imports "$floats" "$floats/projections.raw" "${plain[@]}" --angles "$work/angles.txt" --radians --clockwise --source-to-isocentre 600 --source-to-detector 1000
	same_views "$floats" "$work/back" 1e-10 "angles in radians the other way"
	cbct export-geometry "$floats" --format matrices -o "$work/matrices.txt"
	imports "$floats" "$floats/projections.raw" "${plain[@]}" --matrices "$work/matrices.txt"
	same_views "$floats" "$work/back" 1e-10 "matrices in lines of 12"
	cbct export-geometry "$floats" --format astra -o "$work/vectors.txt"
	imports "$floats" "$floats/projections.raw" --size 48,32 --type float32 --astra "$work/vectors.txt"
	same_views "$floats" "$work/back" 1e-10 "ASTRA's vectors"
	jq -e '.detector.pixel_mm | (.[0] - 4 | fabs) < 1e-12 and (.[1] - 3 | fabs) < 1e-12' "$work/back/scan.json" >/dev/null || fail "the vectors' pitch"
	# Three lines each, brackets, another scale and sign, pixels that begin at 1.
	awk '!/^#/ { print "% view " NR; for (r = 0; r < 3; r++) { printf "["; for (c = 1; c <= 4; c++)
		printf("%s%.17g", (c > 1 ? "; " : ""), -0.01 * ($(4 * r + c) + (r < 2 ? $(8 + c) : 0))); print "]" } }' "$work/matrices.txt" >"$work/three.txt"
	imports "$floats" "$floats/projections.raw" "${plain[@]}" --matrices "$work/three.txt" --first-pixel 1
	same_views "$floats" "$work/back" 1e-9 "matrices in three lines"
}

test_flat_and_dark_are_means() {
	cbct simulate -o "$work/uneven" "${ball[@]}" "${small[@]}" --raw flat
	{ cat "$work/uneven/flat.f32" "$work/uneven/flat.f32"; } >"$work/flats.raw"
	# The images are floats, so the projections are made so too.
	cbct import "$work/flats.raw" --size 48,32 --type float32 --pixel 4 --angle-step 1 --source-to-isocentre 600 --source-to-detector 1000 \
		--flat "$work/flats.raw" --dark "$work/uneven/dark.f32" -o "$work/back" 2>/dev/null
	cmp "$work/back/flat.f32" "$work/uneven/flat.f32" || fail "the mean of two that are the same"
	cmp "$work/back/dark.f32" "$work/uneven/dark.f32" || fail "the dark"
	[ ! -e "$work/back/defects.u8" ] || fail "no map of defects that nobody gave"
	[ "$(jq -c '[.projections.quantity, .projections.air]' "$work/back/scan.json")" = '["intensity",null]' ] || fail "intensities with a flat"
	# Fractions that fall towards the middle are no line integrals.
	cbct import "$work/uneven/projections.raw" --size 48,32 --type uint16 --scale 1e-4 --air 5 --pixel 4,3 "${circle[@]}" -o "$work/back" 2>"$work/said"
	[ "$(jq -c .projections.quantity "$work/back/scan.json")" = '"intensity"' ] || fail "intensities by --air"
	refused 2 "intensities need --air, --flat or --air-region; the brightest pixel is" \
		cbct import "$work/uneven/projections.raw" --size 48,32 --type uint16 --scale 1e-4 --pixel 4,3 "${circle[@]}" -o "$work/never"
}

test_images_of_linear_accelerators() {
	local kind
	need_numpy
	make_scans
	images his "$counts" "$work/all.his"
	imports "$counts" "$work/all.his" --inverted "${circle[@]}" --pixel 4,3 --air 50000
	for kind in hnd xim; do
		images $kind "$counts" "$work/$kind"
		imports "$counts" "$work/$kind" "${circle[@]}" --air 50000
	done
	truncate -s -9 "$work/hnd/Proj_00003.hnd"
	refused 1 "Proj_00003.hnd: its pixels break off at 15" cbct import "$work/hnd" "${circle[@]}" --air 50000 -o "$work/never"
}

# Scanners' own files tell pitch, distances and angles. Angles of a float32 have 7 digits: 600 mm times 2e-7 and a bit.
test_files_of_industrial_scanners() {
	local pixel=(--pixel 4,3) distances=(--source-to-isocentre 600 --source-to-detector 1000)
	need_numpy
	make_scans
	images xtekct "$counts" "$work/ball"
	imports "$counts" "$work/ball.xtekct"
	same_views "$work/back" "$counts" 1e-9 "Nikon"
	rm "$work/ball_0007.tif"
	refused 1 "its image 7: " cbct import "$work/ball.xtekct" -o "$work/never"
	sed -i '/^SrcToObject/d' "$work/ball.xtekct"
	refused 1 "it does not tell SrcToObject" cbct import "$work/ball.xtekct" -o "$work/never"
	images txrm "$counts" "$work/ball.txrm"
	imports "$counts" "$work/ball.txrm" --air 50000 "${pixel[@]}"
	same_views "$work/back" "$counts" 1e-3 "Zeiss"
	# A pixel of Zeiss's is square.
	cbct import "$work/ball.txrm" --air 50000 -o "$work/square" 2>/dev/null
	jq -e '.detector.pixel_mm | all(. - 4 | . * . < 1e-10)' "$work/square/scan.json" >/dev/null || fail "4 mm, got $(jq -c .detector.pixel_mm "$work/square/scan.json")"
	head -c 20000 "$work/ball.txrm" >"$work/short.txrm"
	refused 1 "the compound file is broken" cbct import "$work/short.txrm" --air 50000 -o "$work/never"
	/usr/bin/python3 -c 'import h5py' 2>/dev/null || skip "python3-h5py is not here: HDF5 was not read"
	images nexus "$counts" "$work/ball.nxs"
	imports "$counts" "$work/ball.nxs" --air 50000
	grep -q "2 images of the file are no projections" "$work/said" || fail "flat images are told, got $(cat "$work/said")"
	same_views "$work/back" "$counts" 1e-9 "NeXus"
	images exchange "$counts" "$work/ball.h5"
	imports "$counts" "$work/ball.h5" --air 50000 "${pixel[@]}" "${distances[@]}"
	same_views "$work/back" "$counts" 1e-9 "Data Exchange"
	cbct import "$work/ball.h5" --air 50000 "${pixel[@]}" "${distances[@]}" --clockwise -o "$work/other" 2>/dev/null
	cmp <(jq '.geometry.angles_deg | map(-.)' "$work/other/scan.json") <(jq '.geometry.angles_deg' "$work/back/scan.json") || fail "--clockwise"
	head -c 3000 "$work/ball.h5" >"$work/short.h5"
	refused 1 "libhdf5 cannot read it" cbct import "$work/short.h5" "${pixel[@]}" "${distances[@]}" -o "$work/never"
	/usr/bin/python3 -c 'import h5py, sys; h5py.File(sys.argv[1], "w")["a"] = 1' "$work/other.h5"
	refused 1 "it has neither NeXus's" cbct import "$work/other.h5" "${pixel[@]}" "${distances[@]}" -o "$work/never"
}

# Each view's air is the mean of the first columns, which the ball does not reach: whatever the tube gave.
test_regions_of_air_and_maps_of_defects() {
	local here=(--size 48,32 --type uint16 --pixel 4,3 "${circle[@]}")
	make_scans
	cbct import "$counts/projections.raw" "${here[@]}" --air-region 0,0,3,31 --beam-hardening 0,1,0.01 -o "$work/region" 2>"$work/said"
	jq -e '.projections | .air_region == [0, 0, 3, 31] and .beam_hardening == [0, 1, 0.01] and .air == 50000 and .sample == "uint16"' \
		"$work/region/scan.json" >/dev/null || fail "region and polynomial in $(cat "$work/region/scan.json")"
	# A map of defects is mirrored with the images.
	{ printf '\0\7'; head -c $((48 * 32 - 2)) /dev/zero; } >"$work/map.raw"
	cbct import "$counts/projections.raw" "${here[@]}" --air 50000 --defects "$work/map.raw" --flip-columns -o "$work/region" 2>"$work/said"
	{ head -c 46 /dev/zero; printf '\1\0'; head -c $((48 * 31)) /dev/zero; } | cmp - "$work/region/defects.u8" || fail "the mirrored map"
	refused 1 "no whole images" cbct import "$counts/projections.raw" "${here[@]}" --air 5 --defects "$counts/scan.json" -o "$work/never"
	refused 1 "air_region" cbct import "$counts/projections.raw" "${here[@]}" --air-region 0,0,3,32 -o "$work/never"
	refused 2 "--beam-hardening: '1,,2'" cbct import "$counts/projections.raw" "${here[@]}" --air 5 --beam-hardening 1,,2 -o "$work/never"
}

# DICOM's angles are about the patient: an object with a mark on each of the patient's sides has them there, however the
# patient lies on the table; in the world, which is the table's, they lie elsewhere each time.
test_dicom_tells_how_the_patient_lies() {
	local position python=${PYTHON:-/usr/bin/python3} how=(--air 50000 --source-to-isocentre 600 --name 'sides é')
	need_dcmtk
	need_numpy
	"$python" -c 'import nibabel' 2>/dev/null || skip "python3-nibabel is not here"
	mkdir -p "$work/sides"
	"$python" "$here/sides.py" make "$work/sides" counts
	xa() { # NAME [OPTION ...]: imported as a scan directory
		local name=$1
		shift
		images dicom "$work/sides" "$work/$name.dump" "$@"
		(cd "$work" && dump2dcm --quiet "$name.dump" "$name.dcm")
		cbct import "$work/$name.dcm" "${how[@]}" -o "$work/$name" 2>"$work/said"
	}
	for position in HFS HFP FFS FFP HFDL HFDR FFDL FFDR; do
		xa "lies$position" patient=$position
		jq -e ".patient == {position: \"$position\", name: \"Müller^Test\"}" "$work/lies$position/scan.json" >/dev/null || fail "$position in $(head -c 200 "$work/lies$position/scan.json")"
		cbct recon "$work/lies$position" --fdk hann --grid 42,42,42 --spacing 2 --quiet -o "$work/lies$position" >/dev/null
		"$python" "$here/sides.py" check "$position@" "" "" "nifti,1/mm,$work/lies$position/final.nii"
	done
	# Nobody says: not known, and told. A patient in a chair has none of the positions.
	for position in "" patient=SITTING; do
		xa silent $position
		jq -e '.patient == {name: "Müller^Test"}' "$work/silent/scan.json" >/dev/null || fail "no patient of $position"
		grep -q "left and right are not known" "$work/said" || fail "said of $position, got $(cat "$work/said")"
	done
	how+=(--patient FFS)
	xa told
	cmp "$work/told/scan.json" "$work/liesFFS/scan.json" || fail "--patient as the attribute"
	how=("${how[@]:0:6}" --patient unknown)
	xa told patient=FFS
	jq -e '.patient == {name: "Müller^Test"}' "$work/told/scan.json" >/dev/null || fail "--patient unknown"
	how=("${how[@]:0:6}")
	# At -90 degrees, the first frame, columns run to the front and rows to the feet: an image that says otherwise was mirrored.
	xa right patient=HFS orientation=A-F
	jq -e '.patient.position == "HFS"' "$work/right/scan.json" >/dev/null || fail "as the angles say"
	xa wrong patient=HFS orientation=P-F
	jq -e '.patient == {name: "Müller^Test"}' "$work/wrong/scan.json" >/dev/null || fail "sides of a mirrored image"
	grep -q 'Patient Orientation P\\F contradicts' "$work/said" || fail "the contradiction, got $(cat "$work/said")"
	how+=(--flip-columns)
	xa wrong patient=HFS orientation=P-F
	jq -e '.patient.position == "HFS"' "$work/wrong/scan.json" >/dev/null || fail "mirrored back"
	refused 2 "none of HFS" cbct import "$work/wrong.dcm" --air 5 --patient supine -o "$work/never"
}

# Who it is and for which study; files of two patients are no scan, and a value that is none is not taken for one.
test_dicom_tells_who_the_patient_is() {
	local how=(--air 50000 --source-to-isocentre 600 --name 'who') one=(who:0010,0020,LO=4711 who:0010,0030,DA=19700228
		who:0010,0040,CS=F who:0020,000d,UI=1.2.3 who:0008,0050,SH=A17 who:0008,0090,PN=House^G who:0008,0020,DA=20261123 who:0008,0030,TM=043059.25)
	need_dcmtk
	need_numpy
	make_scans
	xa() { # NAME [OPTION ...]
		images dicom "$counts" "$work/$1.dump" "${@:2}"
		mkdir -p "$work/$1"
		(cd "$work" && dump2dcm --quiet "$1.dump" "$1/one.dcm")
	}
	xa who "${one[@]}"
	cbct import "$work/who" "${how[@]}" -o "$work/scan-of-who" 2>/dev/null
	jq -e '.patient == {name: "Müller^Test", id: "4711", birth_date: "1970-02-28", sex: "F"} and .study == {uid: "1.2.3",
		accession_number: "A17", referring_physician: "House^G", date: "2026-11-23", time: "04:30:59"}' "$work/scan-of-who/scan.json" >/dev/null ||
		fail "patient and study, got $(head -c 400 "$work/scan-of-who/scan.json")"
	xa other "${one[@]}" who:0010,0020,LO=4712
	cp "$work/other/one.dcm" "$work/who/two.dcm"
	refused 1 "two.dcm: its patient's id is another than the first's" cbct import "$work/who" "${how[@]}" -o "$work/never"
	xa odd "${one[@]}" who:0010,0030,DA=19700231 who:0010,0040,CS=X
	cbct import "$work/odd" "${how[@]}" -o "$work/scan-of-odd" 2>"$work/said"
	jq -e '.patient == {name: "Müller^Test", id: "4711"}' "$work/scan-of-odd/scan.json" >/dev/null || fail "values that are none are left out"
	grep -q "(0010,0030) is no value of the patient's birth_date" "$work/said" || fail "told, got $(cat "$work/said")"
	! grep -q 19700231 "$work/said" || fail "a value was shown"
}

# Read as DICOM shows them, the frames are the scan's turned by half a turn, and so is their detector.
test_dicom_angiography() {
	local name how=(--air 50000)
	need_dcmtk
	need_numpy
	make_scans
	images dicom "$counts" "$work/xa.dump"
	images dicom "$counts" "$work/each.dump" increments=each
	images enhanced "$counts" "$work/enhanced.dump"
	for name in xa each enhanced; do (cd "$work" && dump2dcm --quiet "$name.dump" "$name.dcm"); done
	dcmcrle "$work/xa.dcm" "$work/rle.dcm"
	dcmcjpeg "$work/enhanced.dcm" "$work/jpeg.dcm"
	for name in xa each enhanced rle jpeg; do
		imports "$counts" "$work/$name.dcm" "${how[@]}" --flip-rows --flip-columns
		cbct import "$work/$name.dcm" "${how[@]}" -o "$work/$name" 2>/dev/null
		# Texts of numbers have at most 16 characters in DICOM.
		same_views "$work/xa" "$work/$name" 1e-6 "$name"
	done
	cbct recon "$work/xa" --fdk hann "${grid[@]}" --quiet -o "$work/xa" >/dev/null
	cbct recon "$counts" --fdk hann "${grid[@]}" --quiet -o "$work/direct" >/dev/null
	# The same rays in other pixels: float32's rounding, and filters that begin at the other end of the rows.
	expect_number "$(cbct compare --json "$work/xa/final.nii" "$work/direct/final.nii" | jq .relative_error)" '<' 1e-4 "DICOM against the scan itself"
	# In front of and behind the patient: primary angle 0 has the detector in front, at -y, CRA lifts it.
	images enhanced "$counts" "$work/cra.dump" secondary=30
	(cd "$work" && dump2dcm --quiet cra.dump cra.dcm)
	cbct import "$work/cra.dcm" "${how[@]}" -o "$work/cra" 2>/dev/null
	cbct export-geometry "$work/cra" --format astra -o "$work/cra.vectors"
	head -1 "$work/cra.vectors" | awk '{ exit !($2 > 0 && $3 < -299.9 && $3 > -300.1 && $5 < 0 && $6 > 199.9 && $6 < 200.1) }' ||
		fail "source behind and below, detector in front and above"
	refused 1 "dcm2xml is not here: it comes with the package dcmtk" env PATH=/nonexistent "$BUILD/cbct" import "$work/xa.dcm" --air 1 -o "$work/never"
}

test_an_imported_scan_reconstructs_like_the_posted_one() {
	local id job_id
	cbct simulate -o "$work/ours" "${ball[@]}" "${small[@]}" --wobble 3 --raw flat
	cbct export-geometry "$work/ours" -o "$work/geometry.xml" --stack "$work/stack.mhd"
	id=$(cbct import "$work/stack.mhd" --rtk "$work/geometry.xml" --flat "$work/ours/flat.f32" --dark "$work/ours/dark.f32" \
		--size 48,32 --type float32 --quiet 2>/dev/null)
	req GET "/v1/scans/$id"
	expect_json '.missing == [] and .name == "stack.mhd"'
	cbct export-geometry "$id" | cmp - <(cbct export-geometry "$work/ours") || { same_views "$id" "$work/ours" 1e-10 "the daemon's"; }
	job_id=$(cbct submit "$id" "${grid[@]}" --sart 2 --emit fdk --wait)
	cbct get "$job_id" final -o "$work/imported.nii"
	id=$(cbct upload "$work/ours" --quiet 2>/dev/null)
	job_id=$(cbct submit "$id" "${grid[@]}" --sart 2 --emit fdk --wait)
	cbct get "$job_id" final -o "$work/posted.nii"
	# Views that differ by 1e-11 mm.
	expect_number "$(cbct compare --json "$work/imported.nii" "$work/posted.nii" | jq .relative_error)" '<' 1e-5 "imported against posted"
}

test_nothing_temporary_is_left() {
	local here=$work/temporary i pid server
	make_scans
	rm -rf "$here"
	mkdir -p "$here"
	TMPDIR=$here cbct import "$counts/projections.raw" --size 48,32 --type uint16 --pixel 4,3 "${circle[@]}" --air 50000 >/dev/null 2>&1
	[ -z "$(ls "$here")" ] || fail "nothing after an upload"
	# One that is broken off while it waits for somebody who listens and never answers.
	/usr/bin/python3 -c 'import socket, time
server = socket.create_server(("127.0.0.1", 0))
print(server.getsockname()[1], flush=True)
time.sleep(60)' >"$work/port" &
	server=$!
	for ((i = 0; i < 1000; i++)); do
		[ -s "$work/port" ] && break
		sleep 0.02
	done
	TMPDIR=$here CBCT_URL=http://127.0.0.1:$(cat "$work/port") cbct import "$counts/projections.raw" --size 48,32 --type uint16 \
		--pixel 4,3 "${circle[@]}" --air 50000 >/dev/null 2>&1 &
	pid=$!
	for ((i = 0; i < 1000; i++)); do
		[ -e "$(echo "$here"/*/scan.json)" ] && break
		sleep 0.02
	done
	[ -e "$(echo "$here"/*/scan.json)" ] || fail "a temporary directory while it waits"
	kill -TERM $pid
	wait $pid || true
	kill $server
	[ -z "$(ls "$here")" ] || fail "nothing after an end by a signal, found $(ls "$here")"
}

test_what_cannot_be_exported_is_said() {
	cbct simulate -o "$work/ours" "${ball[@]}" "${small[@]}" --kind views
	jq '.geometry.views[3].row_step_mm[0] += 0.01' "$work/ours/scan.json" >"$work/skewed.json"
	mkdir -p "$work/skewed"
	cp "$work/skewed.json" "$work/skewed/scan.json"
	refused 1 "view 3: its pixels are skewed by" cbct export-geometry "$work/skewed"
	cbct export-geometry "$work/skewed" --tolerance 1 >/dev/null
	cbct export-geometry "$work/skewed" --format astra >/dev/null
	jq '.geometry.views[4].column_step_mm |= map(. * 1.01)' "$work/ours/scan.json" >"$work/skewed/scan.json"
	refused 1 "view 4: a pixel pitch of 4.04 mm along the columns" cbct export-geometry "$work/skewed"
	refused 1 "" cbct export-geometry "$work/not-there"
	refused 2 "--stack needs a scan directory" cbct export-geometry some-id --stack "$work/x.mhd"
}

test_hostile_files_are_refused_with_a_reason() {
	local to=(-o "$work/never") raw
	make_scans
	raw=("$counts/projections.raw" --size 48,32 --type uint16 --pixel 4 --air 5)
	cbct export-geometry "$floats" -o "$work/geometry.xml" --stack "$work/stack.mhd"
	# MetaImages
	{ sed 's/ElementDataFile.*/ElementDataFile = LOCAL/' "$work/stack.mhd"; head -c 1000 "$floats/projections.raw"; } >"$work/short.mha"
	refused 1 "1000 bytes of pixels, the header tells of" cbct import "$work/short.mha" --rtk "$work/geometry.xml" "${to[@]}"
	sed 's/CompressedData.*/CompressedData = True/' "$work/short.mha" >"$work/packed.mha"
	refused 1 "the compressed pixels are damaged" cbct import "$work/packed.mha" --rtk "$work/geometry.xml" "${to[@]}"
	if /usr/bin/python3 -c 'import numpy' 2>/dev/null; then
		images mha "$floats" "$work/whole.mha" packed=1
		head -c 15000 "$work/whole.mha" >"$work/packed.mha"
		refused 1 "the compressed pixels end within image" cbct import "$work/packed.mha" --rtk "$work/geometry.xml" "${to[@]}"
	fi
	sed 's/DimSize.*/DimSize = 1000000 1000000 1000000/' "$work/stack.mhd" >"$work/huge.mhd"
	refused 1 "huge.mhd" cbct import "$work/huge.mhd" --rtk "$work/geometry.xml" "${to[@]}"
	head -c 100 "$work/stack.mhd" >"$work/cut.mhd"
	refused 1 "no ElementDataFile" cbct import "$work/cut.mhd" --rtk "$work/geometry.xml" "${to[@]}"
	sed 's/ElementDataFile.*/ElementDataFile = image%03d.raw 0 19 1/' "$work/stack.mhd" >"$work/pattern.mhd"
	refused 1 "give the folder" cbct import "$work/pattern.mhd" --rtk "$work/geometry.xml" "${to[@]}"
	# TIFF: what is left of a page that cannot be read was taken for the first one.
	refused 1 "page 1: it cannot be read" cbct import "$top/tests/fuzz/seeds/images/broken_page.tif" "${circle[@]}" --pixel 4 --air 5 "${to[@]}"
	# XML
	{
		echo '<?xml version="1.0"?><!DOCTYPE RTKGEOMETRY ['
		echo '<!ENTITY a0 "ha">'
		for i in 1 2 3 4 5 6 7 8 9; do
			printf '<!ENTITY a%d "' "$i"
			for j in 0 1 2 3 4 5 6 7 8 9; do printf '&a%d;' $((i - 1)); done
			echo '">'
		done
		echo ']><RTKThreeDCircularGeometry version="3"><SourceOffsetX>&a9;</SourceOffsetX></RTKThreeDCircularGeometry>'
	} >"$work/laughs.xml"
	refused 1 "the entity a0" cbct import "$work/stack.mhd" --rtk "$work/laughs.xml" "${to[@]}"
	sed '/<Projection>/,$ d' "$work/geometry.xml" >"$work/open.xml"
	refused 1 "no XML" cbct import "$work/stack.mhd" --rtk "$work/open.xml" "${to[@]}"
	sed 's/<GantryAngle>[^<]*/<GantryAngle>nan/' "$work/geometry.xml" >"$work/nan.xml"
	refused 1 '"nan" is no number' cbct import "$work/stack.mhd" --rtk "$work/nan.xml" "${to[@]}"
	awk '/<Projection>/ && ++n == 20 { exit } { print } END { print "</RTKThreeDCircularGeometry>" }' "$work/geometry.xml" >"$work/fewer.xml"
	refused 1 "19 projections in the geometry for 20 images" cbct import "$work/stack.mhd" --rtk "$work/fewer.xml" "${to[@]}"
	sed 's/<Projection>/<RadiusCylindricalDetector>900<\/RadiusCylindricalDetector><Projection>/; ' "$work/geometry.xml" >"$work/curved.xml"
	refused 1 "RadiusCylindricalDetector is 900" cbct import "$work/stack.mhd" --rtk "$work/curved.xml" "${to[@]}"
	# Lists
	printf '1\n2\nnan\n' >"$work/bad.txt"
	refused 1 'line 3: "nan" is no finite number' cbct import "${raw[@]}" --angles "$work/bad.txt" --source-to-isocentre 6 --source-to-detector 10 "${to[@]}"
	printf '1 2 3\n' >"$work/bad.txt"
	refused 1 "3 angles for 20 images" cbct import "${raw[@]}" --angles "$work/bad.txt" --source-to-isocentre 6 --source-to-detector 10 "${to[@]}"
	refused 1 "line 1: 3 numbers, 12 or 4" cbct import "${raw[@]}" --matrices "$work/bad.txt" "${to[@]}"
	printf '1 2 3 4 5 6 7 8 9 10 11 12\n1 2 3 4\n' >"$work/bad.txt"
	refused 1 "the last matrix is not whole" cbct import "${raw[@]}" --matrices "$work/bad.txt" "${to[@]}"
	for i in $(seq 20); do echo 1 0 0 0 0 1 0 0 0 0 0 0; done >"$work/bad.txt"
	refused 1 "singular" cbct import "${raw[@]}" --matrices "$work/bad.txt" "${to[@]}"
	printf '\x93NUMPY\x01\x00\xff\xff' >"$work/bad.npy"
	refused 1 "bad.npy" cbct import "$work/bad.npy" "${circle[@]}" --pixel 1 "${to[@]}"
	# Images
	refused 1 "no whole images" cbct import "$counts/projections.raw" --size 47,31 --type uint16 "${circle[@]}" --pixel 4 --air 5 "${to[@]}"
	refused 2 "raw images need --size and --type" cbct import "$counts/projections.raw" "${circle[@]}" "${to[@]}"
	refused 2 "--pixel is needed" cbct import "$counts/projections.raw" --size 48,32 --type uint16 "${circle[@]}" "${to[@]}"
	refused 2 "nothing tells the geometry" cbct import "${raw[@]}" --source-to-isocentre 6 --source-to-detector 10 "${to[@]}"
	refused 2 "one of --rtk" cbct import "${raw[@]}" --rtk "$work/geometry.xml" --angle-step 3 "${to[@]}"
	refused 1 "uint16" cbct import "${raw[@]}" "${circle[@]}" --sample uint16 --scale -1 "${to[@]}"
	printf 'II*\0\010\0\0\0' >"$work/empty.tif"
	refused 1 "empty.tif" cbct import "$work/empty.tif" "${circle[@]}" --pixel 1 "${to[@]}"
	{ head -c 128 /dev/zero; printf 'DICM'; head -c 200 /dev/urandom; } >"$work/noise.dcm"
	if command -v dcm2xml >/dev/null; then
		refused 1 "noise.dcm" cbct import "$work/noise.dcm" --air 5 "${to[@]}"
	fi
	mkdir -p "$work/none"
	refused 1 "has no images" cbct import "$work/none" "${circle[@]}" "${to[@]}"
	refused 1 "" cbct import "$work/not-there.mha" "${to[@]}"
}

start_daemon || exit 1
run_tests
