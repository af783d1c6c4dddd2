#!/usr/bin/env bash
# The command-line client: what needs no daemon, then against the running one.
. "$(dirname "$0")/lib.sh"

small=(--views 40 --columns 48 --rows 32 --pixel 4 --source-to-isocentre 600 --source-to-detector 1000)
ball=(--phantom ball --scale 30 --density 0.02)
all_pixels=(--size 48,32,40)

# status_of COMMAND ...: its exit status; what it said is in $work/said
status_of() {
	local status=0
	"$@" >"$work/said" 2>&1 || status=$?
	echo "$status"
}
expect_exit() { # STATUS COMMAND ...
	local expected=$1 got
	shift
	got=$(status_of "$@")
	[ "$got" = "$expected" ] || fail "exit status $expected of $*, got $got: $(cat "$work/said")"
}
measure() { # NAME, compare's arguments
	cbct compare --json "${@:2}" | jq ".$1"
}

test_help_knows_every_command_and_option() {
	local command
	expect_exit 2 cbct
	expect_exit 2 cbct nonsense
	expect_exit 0 cbct help
	for command in $(awk '/^  [a-z-]+ / { print $1 }' "$work/said"); do
		expect_exit 0 cbct "$command" --help
		grep -q "usage: cbct $command" "$work/said" || fail "the usage of $command"
		expect_exit 2 cbct "$command" --no-such-option
		grep -q -- '--help' "$work/said" || fail "a hint at --help from $command"
	done
}

test_wrong_arguments_are_named() {
	expect_exit 2 cbct simulate -o "$work/x" "${ball[@]}" --views many
	grep -q -- "--views.*many" "$work/said" || fail "--views and its value in: $(cat "$work/said")"
	expect_exit 2 cbct simulate -o "$work/x" "${ball[@]}" --views 0
	expect_exit 2 cbct simulate -o "$work/x" "${ball[@]}" --shift 1,2
	expect_exit 2 cbct simulate -o "$work/x" "${ball[@]}" --pixel 1,
	expect_exit 2 cbct simulate -o "$work/x" "${ball[@]}" --views
	expect_exit 2 cbct simulate -o "$work/x" --phantom nobody
	expect_exit 2 cbct simulate -o "$work/x" "${ball[@]}" left over
	expect_exit 2 cbct simulate -o "$work/x"
	expect_exit 1 cbct slice "$work/not-here.nii"
}

test_a_seed_gives_the_same_bytes_for_any_number_of_threads() {
	OMP_NUM_THREADS=1 cbct simulate -o "$work/one" "${ball[@]}" "${small[@]}" --photons 5000 --multiplicative 0.1 --seed 3
	OMP_NUM_THREADS=3 cbct simulate -o "$work/three" "${ball[@]}" "${small[@]}" --photons 5000 --multiplicative 0.1 --seed 3
	cmp "$work/one/projections.raw" "$work/three/projections.raw" || fail "the same bytes"
	cbct simulate -o "$work/other" "${ball[@]}" "${small[@]}" --photons 5000 --multiplicative 0.1 --seed 4
	cmp -s "$work/one/projections.raw" "$work/other/projections.raw" && fail "other bytes for another seed"
	true
}

# Outside of the ball p = 0: the deviation of ln(n / N) is 1 / sqrt(N). The window has 4 x 32 x 40 pixels;
# its deviation is known to 1 / sqrt(2 * 5120) = 1 %, four times of which is allowed.
test_photons_give_poisson_noise() {
	local rmse
	cbct simulate -o "$work/photons" "${ball[@]}" "${small[@]}" --photons 10000
	rmse=$(measure rmse "$work/photons/projections.raw" "${all_pixels[@]}" --value 0 --region 0-3,0-31,0-39)
	expect_number "$rmse" '>' 0.0096 "deviation of 10000 photons"
	expect_number "$rmse" '<' 0.0104 "deviation of 10000 photons"
}

# The mean of 1 - A r is 1 - A / 2; over some 20000 pixels inside of the ball its own deviation is below 0.1 %.
test_multiplicative_noise_has_its_mean() {
	local before after
	cbct simulate -o "$work/before" "${ball[@]}" "${small[@]}"
	cbct simulate -o "$work/after" "${ball[@]}" "${small[@]}" --multiplicative 0.3
	before=$(measure mean "$work/before/projections.raw" "${all_pixels[@]}" --value 0)
	after=$(measure mean "$work/after/projections.raw" "${all_pixels[@]}" --value 0)
	expect_number "$(jq -n "$after / $before")" '>' 0.846 "mean with multiplicative noise over mean"
	expect_number "$(jq -n "$after / $before")" '<' 0.854 "mean with multiplicative noise over mean"
}

# Half a count of 60000 rounded away is 1e-5 of the open beam, some 1e-4 behind 60 mm of water.
test_raw_counts_hold_the_line_integrals() {
	cbct simulate -o "$work/exact" "${ball[@]}" "${small[@]}"
	cbct simulate -o "$work/counts" "${ball[@]}" "${small[@]}" --raw flat --sample float32
	[ "$(jq -c .projections.quantity "$work/counts/scan.json")" = '"intensity"' ] || fail "intensities"
	jq -e '.projections.air == null' "$work/counts/scan.json" >/dev/null || fail "no air beside a flat"
	cbct recon "$work/exact" --quiet --fdk hann --grid 24 --spacing 3 >/dev/null
	cbct recon "$work/counts" --quiet --fdk hann --grid 24 --spacing 3 >/dev/null
	expect_number "$(measure relative_error "$work/counts/final.nii" "$work/exact/final.nii")" '<' 1e-3 "float32 counts, relative error"
	cbct simulate -o "$work/counts" "${ball[@]}" "${small[@]}" --raw air --air 60000
	[ ! -e "$work/counts/flat.f32" ] || fail "the flat of an earlier simulation gone"
	cbct recon "$work/counts" --quiet --fdk hann --grid 24 --spacing 3 >/dev/null
	expect_number "$(measure relative_error "$work/counts/final.nii" "$work/exact/final.nii")" '<' 5e-3 "uint16 counts, relative error"
}

# The truth, 1 mm voxels, sent through the fine sampler: what differs from the exact ball is its edge, blurred over
# a voxel. A ball moved by a voxel instead (or mirrored: it is off-centre) would differ by 5 % and more.
test_a_volume_is_projected_like_the_phantom_it_shows() {
	cbct simulate -o "$work/ball" "${ball[@]}" "${small[@]}" --shift 5,-9,4 --truth "$work/truth.nii" --grid 80 --spacing 1
	cbct simulate -o "$work/voxels" --volume "$work/truth.nii" "${small[@]}"
	expect_number "$(measure relative_error "$work/voxels/projections.raw" "$work/ball/projections.raw" "${all_pixels[@]}")" '<' 0.02 "voxels against the exact ball"
}

test_every_kind_of_geometry_gives_the_same_projections() {
	local kind
	cbct simulate -o "$work/circular" "${ball[@]}" "${small[@]}" --shift 20,-9,4 --clockwise --detector-offset 3,-5
	for kind in angles matrices views; do
		cbct simulate -o "$work/kind" "${ball[@]}" "${small[@]}" --shift 20,-9,4 --clockwise --detector-offset 3,-5 --kind $kind
		expect_number "$(measure relative_error "$work/kind/projections.raw" "$work/circular/projections.raw" "${all_pixels[@]}")" '<' 1e-5 "$kind against circular"
		cbct simulate -o "$work/again" "${ball[@]}" --shift 20,-9,4 --scan "$work/kind/scan.json"
		cmp "$work/again/projections.raw" "$work/kind/projections.raw" || fail "the same projections from the document"
	done
}

test_compare_measures_and_masks() {
	cbct simulate -o "$work/c" "${ball[@]}" "${small[@]}" --truth "$work/c.nii" --grid 40,36,32 --spacing 2
	cbct compare --json "$work/c.nii" "$work/c.nii" >"$work/same.json"
	jq -e '.relative_error == 0 and .rmse == 0 and (.ssim - 1 | fabs) < 1e-6 and (.correlation - 1 | fabs) < 1e-9 and .voxels == 40 * 36 * 32' \
		"$work/same.json" >/dev/null || fail "no error against itself: $(cat "$work/same.json")"
	[ "$(measure voxels "$work/c.nii" "$work/c.nii" --slices 3-4)" = $((40 * 36 * 2)) ] || fail "two slices"
	[ "$(measure voxels "$work/c.nii" "$work/c.nii" --region 0-3,5-5,0-31)" = $((4 * 32)) ] || fail "a box"
	# Where the ball is: 4/3 pi 15^3 voxels of 8 mm^3, those at its edge more or less.
	expect_number "$(measure voxels "$work/c.nii" "$work/c.nii" --body 0.01)" '>' 13700 "voxels of the ball"
	expect_number "$(measure voxels "$work/c.nii" "$work/c.nii" --body 0.01)" '<' 14600 "voxels of the ball"
	[ "$(measure voxels "$work/c.nii" "$work/c.nii" --mask "$work/c.nii" --body 0.01)" = "$(measure voxels "$work/c.nii" "$work/c.nii" --body 0.01)" ] || fail "both masks"
	expect_number "$(measure mean "$work/c.nii" --value 0 --hu --fov 5 --slices 15-16)" '>' 41 "HU of 0.02/mm"
	expect_number "$(measure mean "$work/c.nii" --value 0 --hu --fov 5 --slices 15-16)" '<' 42 "HU of 0.02/mm"
	expect_exit 2 cbct compare "$work/c.nii"
	expect_exit 2 cbct compare "$work/c.nii" "$work/c.nii" --slices 3-99
	cbct simulate -o "$work/c" "${ball[@]}" "${small[@]}" --truth "$work/d.nii" --grid 40,36,32 --spacing 2.5
	expect_exit 1 cbct compare "$work/c.nii" "$work/d.nii"
}

# A volume of 2 x 2 x 2 and pictures of its slices against pictures of plain 2 x 2 arrays.
test_slices_are_not_mirrored() {
	local f=('\0\0\0\0' '\0\0\200\077' '\0\0\0\100' '\0\0\100\100' '\0\0\200\100' '\0\0\240\100' '\0\0\300\100' '\0\0\340\100') # 0 .. 7
	local axis name expected one='--size 2,2,1 --spacing 1' i
	for i in 0 1 2 3 4 5 6 7; do printf "${f[i]}"; done >"$work/cube.raw"
	# z: rows along y; y: the upper slice's row on top; x: y to the right, the upper slice on top.
	for name in z:4,5,6,7 y:6,7,2,3 x:5,7,1,3; do
		axis=${name%%:*}
		for i in $(tr , ' ' <<<"${name#*:}"); do printf "${f[i]}"; done >"$work/expected.raw"
		cbct slice "$work/cube.raw" --size 2 --axis "$axis" --index 1 --level 3.5 --window 7 -o "$work/got.png"
		cbct slice "$work/expected.raw" $one --level 3.5 --window 7 -o "$work/expected.png"
		cmp "$work/got.png" "$work/expected.png" || fail "the slice along $axis as documented"
	done
}

test_upload_submit_watch_get() {
	local id job_id
	cbct simulate -o "$work/scan" "${ball[@]}" "${small[@]}" --shift 4,-6,3
	id=$(cbct upload "$work/scan" --connections 3 --run 7 --zstd)
	url_get_missing "$id" '[]'
	cbct scans | grep "$id" >/dev/null || fail "the scan in the list"
	job_id=$(cbct submit "$id" --grid 32,28,24 --spacing 2.5 --sart 3 --subsets 8 --tv gradient --emit fdk,2 --wait)
	expect_exit 0 cbct watch "$job_id"
	grep -q 'succeeded' "$work/said" || fail "the last state in: $(cat "$work/said")"
	cbct jobs | grep "$job_id" >/dev/null || fail "the job in the list"
	cbct get "$job_id" final -o "$work/final.nii"
	cbct get "$job_id" final --format raw --zstd -o - | cmp - <(tail -c +4097 "$work/final.nii") || fail "the same voxels, raw and compressed"
	# With no daemon the same code gives the same bits.
	cbct recon "$work/scan" --grid 32,28,24 --spacing 2.5 --sart 3 --subsets 8 --tv gradient --emit fdk,2 --quiet -o "$work/recon" >/dev/null
	cmp <(tail -c +4097 "$work/recon/final.nii") <(tail -c +4097 "$work/final.nii") || fail "recon's voxels are the daemon's"
	cbct rm "$job_id"
	expect_exit 1 cbct watch "$job_id"
	cbct rm "$id"
	expect_exit 1 cbct rm "$id"
}
url_get_missing() { # SCAN MISSING
	req GET "/v1/scans/$1"
	expect_json ".missing == $2"
}

test_watch_saves_each_volume_as_it_is_kept() {
	local id job_id name
	cbct simulate -o "$work/scan" "${ball[@]}" "${small[@]}"
	id=$(cbct upload "$work/scan")
	job_id=$(cbct submit "$id" --grid 32,28,24 --spacing 2.5 --sart 4 --emit fdk,1,3)
	[ "$(cbct watch "$job_id" --save "$work/saved" 2>"$work/said")" = "$(printf "$work/saved/$job_id-%s.nii\n" fdk iter-1 iter-3 final)" ] ||
		fail "the names of the files in order"
	grep -q succeeded "$work/said" || fail "progress beside them"
	for name in fdk iter-1 iter-3 final; do
		get_volume_of "$job_id" $name ""
		cmp "$body" "$work/saved/$job_id-$name.nii" || fail "$name as it is downloaded"
	done
	cbct watch "$job_id" --save "$work/packed" --format mha --type int16 --zstd >/dev/null 2>&1
	get_volume_of "$job_id" iter-3 "?format=mha&type=int16"
	cmp "$body" "$work/packed/$job_id-iter-3.mha" || fail "another format, compressed on the way"
	[ "$(ls "$work/packed" | wc -l)" = 4 ] || fail "four files and nothing beside them: $(ls "$work/packed")"
	expect_exit 1 cbct watch "$job_id" --save "$work/scan/scan.json"
	expect_exit 1 cbct watch "$job_id" --save "$work/never" --format jpeg
}
get_volume_of() { # JOB NAME QUERY
	req GET "/v1/jobs/$1/volumes/$2$3"
	expect_status 200
}

test_saving_goes_on_after_a_restart_of_the_daemon() {
	local id job_id watcher
	cbct simulate -o "$work/scan" "${ball[@]}" "${small[@]}"
	id=$(cbct upload "$work/scan")
	local port=${url##*:} # the address stays
	job_id=$(cbct submit "$id" --grid 32,28,24 --spacing 2.5 --sart 100000 --subsets views --emit fdk,5,200)
	: >"$work/names"
	cbct watch "$job_id" --save "$work/resumed" >"$work/names" 2>"$work/said" &
	watcher=$!
	until grep -q iter-5 "$work/names"; do sleep 0.05; done
	stop_daemon KILL
	start_daemon
	until grep -q iter-200 "$work/names"; do sleep 0.05; done
	cbct rm "$job_id"
	! wait $watcher || fail "a status that tells of the cancelled job"
	[ "$(sed 's/.*-\(fdk\|iter-[0-9]*\|final\).nii/\1/' "$work/names" | head -3 | xargs)" = "fdk iter-5 iter-200" ] ||
		fail "each volume once, got $(cat "$work/names")"
	get_volume_of "$job_id" iter-200 ""
	cmp "$body" "$work/resumed/$job_id-iter-200.nii" || fail "iter-200 as it is downloaded"
}

test_an_interrupted_upload_goes_on() {
	local one=$((48 * 32 * 4)) k
	cbct simulate -o "$work/broken" "${ball[@]}" "${small[@]}" --photons 1000
	post_scan "$work/broken"
	head -c $((one * 9)) "$work/broken/projections.raw" >"$work/part"
	req PUT "/v1/scans/$scan/projections/0-8" -T "$work/part"
	expect_status 201
	[ "$(cbct upload "$work/broken" --scan "$scan" --run 4)" = "$scan" ] || fail "the same scan"
	url_get_missing "$scan" '[]'
	for k in 0 8 9 39; do
		req GET "/v1/scans/$scan/projections/$k"
		head -c $(((k + 1) * one)) "$work/broken/projections.raw" | tail -c $one >"$work/expected"
		cmp "$body" "$work/expected" || fail "projection $k"
	done
	# Nothing is missing: nothing is sent.
	[ "$(cbct upload "$work/broken" --scan "$scan")" = "$scan" ] || fail "the same scan"
}

# A scan of another patient, of the same detector or not, half received or whole, never takes a projection of this one.
test_an_upload_goes_on_with_its_own_scan_alone() {
	local tiny=(--views 8 --columns 16 --rows 16 --pixel 16) one=$((16 * 16 * 4)) whole id digest
	cbct simulate -o "$work/theirs" "${ball[@]}" "${tiny[@]}" --name first --patient HFS
	cbct simulate -o "$work/ours" --phantom shepp-logan "${tiny[@]}" --name second --patient HFS
	cbct simulate -o "$work/turned" "${ball[@]}" "${tiny[@]}" --name first --patient FFP
	cbct simulate -o "$work/finer" "${ball[@]}" "${tiny[@]}" --rows 20 --name first --patient HFS
	whole=$(cbct upload "$work/theirs")
	post_scan "$work/theirs"
	expect_exit 1 cbct upload "$work/ours" --scan "$scan" # that nothing is stored yet makes it no other
	jq 'del(.patient)' "$work/theirs/scan.json" >"$work/ours/scan.json"
	expect_exit 1 cbct upload "$work/ours" --scan "$scan"
	grep -q "/patient" "$work/said" || fail "the patient in: $(cat "$work/said")"
	cbct simulate -o "$work/ours" --phantom shepp-logan "${tiny[@]}" --name second --patient HFS
	head -c $((one * 4)) "$work/theirs/projections.raw" >"$work/part"
	req PUT "/v1/scans/$scan/projections/0-3" -T "$work/part"
	expect_status 201
	for id in "$scan" "$whole"; do
		expect_exit 1 cbct upload "$work/ours" --scan "$id"
		grep -q "/name" "$work/said" || fail "the name in: $(cat "$work/said")"
		expect_exit 1 cbct upload "$work/turned" --scan "$id"
		grep -q "/patient/position" "$work/said" || fail "the position in: $(cat "$work/said")"
		expect_exit 1 cbct upload "$work/finer" --scan "$id"
		grep -q "/detector/rows" "$work/said" || fail "the rows in: $(cat "$work/said")"
		# The document is the same, the samples of one projection are not.
		jq '.labels.room = "2"' "$work/theirs/scan.json" >"$work/ours/scan.json"
		cp "$work/theirs/projections.raw" "$work/ours/projections.raw"
		expect_exit 0 cbct upload "$work/ours" --scan "$whole"
		printf 'x' | dd of="$work/ours/projections.raw" bs=1 seek=$((one * 3 + 17)) conv=notrunc status=none
		expect_exit 1 cbct upload "$work/ours" --scan "$id"
		grep -q "projection 3 " "$work/said" || fail "projection 3 in: $(cat "$work/said")"
		cbct simulate -o "$work/ours" --phantom shepp-logan "${tiny[@]}" --name second --patient HFS
	done
	url_get_missing "$scan" '[[4,7]]'
	req GET "/v1/scans/$scan/projections/3"
	digest=$(openssl dgst -sha256 -binary "$body" | base64)
	[ "$(header Repr-Digest)" = "sha-256=:$digest:" ] || fail "the projection's digest, got $(header Repr-Digest)"
	[ "$(cbct upload "$work/theirs" --scan "$scan")" = "$scan" ] || fail "the same scan"
	url_get_missing "$scan" '[]'
}

test_failures_are_told() {
	cbct simulate -o "$work/scan" "${ball[@]}" "${small[@]}"
	scan=$(cbct upload "$work/scan")
	expect_exit 1 cbct submit "$scan" --sart 3 --relaxation 9
	grep -q '/sart/relaxation' "$work/said" || fail "the pointer in: $(cat "$work/said")"
	expect_exit 1 cbct submit unknown
	expect_exit 1 cbct watch unknown
	expect_exit 1 cbct get unknown final -o "$work/never.nii"
	expect_exit 1 cbct get "$(printf 'x%.0s' {1..700})" final --format raw --scale 2 -o "$work/never.nii"
	[ ! -e "$work/never.nii" ] || fail "no file of a volume that is not there"
	job=$(cbct submit "$scan" --grid 32 --spacing 2 --sart 100000 --subsets views)
	(sleep 1; cbct rm "$job") &
	expect_exit 1 cbct watch "$job"
	grep -q cancelled "$work/said" || fail "that the job was cancelled"
	expect_exit 1 env CBCT_URL=http://127.0.0.1:1 cbct scans
	expect_exit 1 env CBCT_URL=unix:/nonexistent cbct scans
	grep -q 'unix:/nonexistent: No such file' "$work/said" || fail "the socket and the reason in: $(cat "$work/said")"
	truncate -s -1 "$work/scan/projections.raw"
	expect_exit 1 cbct upload "$work/scan"
}

test_a_recipe_file_with_options_over_it() {
	echo '{"fdk": {"window": "cosine"}, "sart": {"iterations": 7}, "emit": [1]}' >"$work/recipe.json"
	cbct submit X "$work/recipe.json" --print --sart 9 --grid 8 --spacing 1 --emit fdk,3 --stop-residual 0.1 >"$work/printed.json"
	jq -e '. == {fdk: {window: "cosine"}, sart: {iterations: 9, stop: {residual: 0.1}}, emit: ["fdk", 3], scan: "X",
	    grid: {size: [8, 8, 8], spacing_mm: [1, 1, 1]}}' "$work/printed.json" >/dev/null || fail "the file with the options: $(cat "$work/printed.json")"
	[ "$(cbct submit X --print | jq -c .)" = '{"scan":"X"}' ] || fail "the whole job without any options"
	[ "$(cbct submit X --print --sart 2 | jq -c .)" = '{"scan":"X","sart":{"iterations":2},"fdk":{}}' ] || fail "FDK and SART"
	[ "$(cbct submit X --print --no-fdk --sart 2 | jq -c .fdk)" = null ] || fail "no FDK"
}

# The options are made from the table of parameters: each parameter of the job and of SART has one, under these names.
test_every_parameter_has_an_option() {
	cbct submit X --print --grid 8,9,10 --spacing 0.5 --origin 1,2,3 --fdk cosine --cutoff 0.5 --truncation off --sart 9 --max-iterations 12 --relaxation 0.5 \
		--subsets views --momentum --negative --stop-residual 0.1 --stop-change 0.2 --tv gradient --tv-alpha 0.3 --tv-strength light --tv-step 0.4 \
		--tv-iterations 7 --tv-unit 1e-5 --tv-after-sart --projector matched --binning 2 --rings --refine-geometry --refine-motion --refine-reference 1m7yam2f9rgevqe7 --hold-out --metal 3000 --emit fdk,3 --priority urgent --devices 2 --mu-water 0.02 \
		--reference-precision >"$work/printed.json"
	jq -e '. == {scan: "X", grid: {size: [8, 9, 10], spacing_mm: [0.5, 0.5, 0.5], origin_mm: [1, 2, 3]},
	    fdk: {window: "cosine", cutoff: 0.5, truncation: "off"},
	    sart: {iterations: 9, max_iterations: 12, relaxation: 0.5, subsets: "views", momentum: true, nonnegative: false, stop: {residual: 0.1, change: 0.2}},
	    tv: {method: "gradient", alpha: 0.3, strength: "light", step: 0.4, iterations: 7, unit: 1e-5, after: "sart"},
	    projector: "matched", binning: 2, rings: true, refine: {geometry: true, motion: true, reference: {job: "1m7yam2f9rgevqe7"}}, hold_out: true, metal: {threshold_hu: 3000}, emit: ["fdk", 3], priority: "urgent", devices: 2, mu_water: 0.02, precision: "reference"}' \
		"$work/printed.json" >/dev/null || fail "each option in its place: $(cat "$work/printed.json")"
	[ -z "$(jq -r --slurpfile document "$work/printed.json" '.job[].pointer | select(test("^/(cgls|fista)/") | not) |
	    select([.[1:] / "/"] as [$path] | $document[0] | getpath($path) == null)' <(cbct parameters --json))" ] || fail "an option for every parameter"
	[ "$(cbct submit X --print --cgls 3 --stop-change 0.2 | jq -c .cgls)" = '{"iterations":3,"stop":{"change":0.2}}' ] || fail "options of CGLS"
	echo '{"cgls": {"iterations": 7}}' >"$work/recipe.json"
	[ "$(cbct submit X "$work/recipe.json" --print --stop-change 0.2 | jq -c .)" = '{"cgls":{"iterations":7,"stop":{"change":0.2}},"scan":"X"}' ] ||
		fail "the algorithm of the file"
	[ "$(cbct submit X "$work/recipe.json" --print --sart 2 | jq -c .)" = '{"scan":"X","sart":{"iterations":2}}' ] || fail "another algorithm"
	expect_exit 2 cbct submit X --print --cgls 3 --subsets 2
	expect_exit 2 cbct submit X --print --cgls 3 --sart 2
	expect_exit 2 cbct submit X --print --no-fdk --truncation off
	expect_exit 2 cbct submit X --print --sart 2 --subsets all
	expect_exit 2 cbct submit X --print --tv-alpha much
	expect_exit 2 cbct submit X --print --projector none
	cbct parameters >"$work/parameters.txt"
	grep -q '^/sart/relaxation: ' "$work/parameters.txt" || fail "the table for people"
}

start_daemon || exit 1
run_tests
