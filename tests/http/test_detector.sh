#!/usr/bin/env bash
# What tube and detector add to the counts: lag and scatter in a scan's document, whether projections come in order or
# not, refusals, and the programs that find their numbers.
. "$(dirname "$0")/lib.sh"

ball=(--phantom head --scale 60 --density 0.02 --views 60 --arc 360 --columns 80 --rows 64 --pixel 3
	--source-to-isocentre 620 --source-to-detector 1100 --raw air --sample float32)
cbct simulate "${ball[@]}" -o "$work/good" >/dev/null || exit 1
# 3 % of each frame come later, in two exponentials; and frames in which the beam goes off.
/usr/bin/env python3 - "$work" <<'EOF' || exit 1
import array, json, math, os, sys
work = sys.argv[1]
columns, rows, views = 80, 64, 60
pixels = columns * rows
good = array.array('f', open(f'{work}/good/projections.raw', 'rb').read())
lag = [(0.02, 1.5), (0.01, 20)]
document = json.load(open(f'{work}/good/scan.json'))

def write(name, data, more):
    os.makedirs(f'{work}/{name}')
    array.array('f', data).tofile(open(f'{work}/{name}/projections.raw', 'wb'))
    changed = json.loads(json.dumps(document))
    changed['projections'].update(more)
    json.dump(changed, open(f'{work}/{name}/scan.json', 'w'))

kept = [[0.0] * pixels for _ in lag]
late = []
for view in range(views):
    signal = good[view * pixels:(view + 1) * pixels]
    frame = [x * (1 - sum(share for share, _ in lag)) for x in signal]
    for traps, (share, frames) in zip(kept, lag):
        stays = math.exp(-1 / frames)
        for i in range(pixels):
            frame[i] += (1 - stays) * traps[i]
            traps[i] = stays * traps[i] + share * signal[i]
    late.extend(frame)
terms = [{'share': share, 'frames': frames} for share, frames in lag]
write('lag', late, {'lag': terms})
write('lag-left-in', late, {})
# the beam goes off behind frame 39: 100 frames of 16 x 16 pixels
traps = [0.0] * len(lag)
frames = []
for k in range(100):
    signal = 20000 if k < 40 else 0
    value = signal * (1 - sum(share for share, _ in lag)) + 50
    for n, (share, decay) in enumerate(lag):
        stays = math.exp(-1 / decay)
        value += (1 - stays) * traps[n]
        traps[n] = stays * traps[n] + share * signal
    frames.extend([value] * 256)
array.array('f', frames).tofile(open(f'{work}/frames.raw', 'wb'))
array.array('f', [50] * 256).tofile(open(f'{work}/dark.raw', 'wb'))
EOF
grid='"grid": {"size": [48, 48, 36], "spacing_mm": [2.2, 2.2, 2.2]}'
recipe="{\"scan\": \"SCAN\", $grid, \"fdk\": {}}"

digest() {
	req GET "/v1/jobs/$job/volumes"
	json '.volumes[] | select(.name == "final") | .digest'
}
# HU between the volume of $job and that without lag, root mean square
distance() {
	get_volume final "$work/volume.nii"
	cbct compare --json "$work/volume.nii" "$work/good.nii" | jq '.rmse / 0.0192 * 1000'
}
# Of the volume of $job, its mean amid
density() {
	get_volume final "$work/volume.nii"
	cbct compare --json --region 12-35,12-35,12-23 --value 0.02 "$work/volume.nii" | jq .mean
}
# Sends projection K of the scan with lag, of 80 x 64 floats.
put_one() {
	dd if="$work/lag/projections.raw" of="$work/one.raw" bs=20480 skip="$1" count=1 status=none
	req PUT "/v1/scans/$scan/projections/$1" --data-binary @"$work/one.raw"
	expect_status 201
}

test_lag_is_taken_off_whatever_the_order_of_arrival() {
	local after left k
	reconstruct "$work/good" "$recipe"
	get_volume final "$work/good.nii"
	reconstruct "$work/lag-left-in" "$recipe"
	left=$(distance)
	reconstruct "$work/lag" "$recipe"
	after=$(digest)
	expect_number "$(distance)" '<' 0.5 "RMSE in HU"
	expect_number "$left" '>' 2 "RMSE in HU where it is left in"
	# The job comes first, and the projections from the last to the first: the same bits.
	post_scan "$work/lag"
	post_job "$recipe"
	for k in $(seq 59 -1 0); do put_one "$k"; done
	wait_job succeeded
	[ "$(digest)" = "$after" ] || fail "the bits of the job that came before its projections"
	# Views 7 to 9 never come: the job ends all the same (unit/detector has what bridging leaves).
	post_scan "$work/lag"
	for k in $(seq 0 6) $(seq 10 59); do put_one "$k"; done
	req POST "/v1/scans/$scan/complete"
	expect_status 200
	post_job "$recipe"
	wait_job succeeded
}

test_scatter_is_taken_off_and_told() {
	mkdir -p "$work/constant"
	cp "$work/good/projections.raw" "$work/constant/"
	jq '.projections.scatter = {"fraction": 0.3}' "$work/good/scan.json" >"$work/constant/scan.json"
	reconstruct "$work/constant" "$recipe"
	expect_json '[.warnings[] | select(.code == "scatter_constant")] | length == 1 and .[0].severity == "caution"'
	# 95 times what there is: held at a twentieth, and told
	jq '.projections.scatter = {"kernels": [{"amplitude": 95, "power": 1, "width_mm": 100}]}' "$work/good/scan.json" >"$work/constant/scan.json"
	reconstruct "$work/constant" "$recipe"
	expect_json '[.warnings[] | select(.code | startswith("scatter_")) | [.code, .severity]] == [["scatter_exceeds", "serious"]]'
}

refuse() { # STATUS POINTER WORDS MEMBERS: a scan with these members of projections
	jq ".projections += $4" "$work/good/scan.json" >"$work/bad.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/bad.json"
	expect_problem "$1" "$2"
	expect_json ".detail | contains(\"$3\")"
}
test_numbers_that_cannot_be_are_refused() {
	refuse 422 /projections/lag/0/share 0.9 '{"lag": [{"share": 0.95, "frames": 3}]}'
	refuse 422 /projections/lag 1.2 '{"lag": [{"share": 0.6, "frames": 3}, {"share": 0.6, "frames": 9}]}'
	refuse 422 /projections/lag/1/frames -3 '{"lag": [{"share": 0.1, "frames": 3}, {"share": 0.1, "frames": -3}]}'
	refuse 400 /projections/lag/0/frames '' '{"lag": [{"share": 0.1}]}'
	refuse 400 /projections/scatter "either" '{"scatter": {}}'
	refuse 400 /projections/scatter "either" '{"scatter": {"fraction": 0.2, "kernels": [{"amplitude": 1, "power": 1, "width_mm": 9}]}}'
	refuse 400 /projections/scatter/kernels/0/wide '' '{"scatter": {"kernels": [{"amplitude": 1, "power": 1, "width_mm": 9, "wide": 1}]}}'
	refuse 422 /projections/scatter/kernels/0/amplitude 101 '{"scatter": {"kernels": [{"amplitude": 101, "power": 1, "width_mm": 9}]}}'
	refuse 400 /projections/scatter/kind 'no kind beside' '{"scatter": {"kind": "bodies"}}'
	refuse 400 /projections/scatter/multiple '' '{"scatter": {"kind": "body", "amplitude": 1}}'
	refuse 422 /projections/scatter/amplitude 0 '{"scatter": {"kind": "body", "amplitude": 0, "multiple": 0}}'
	refuse 400 /projections/scatter/columns '' '{"scatter": {"kind": "body", "amplitude": 1, "multiple": 0.3, "columns": 8}}'
	refuse 400 /projections/scatter "either" '{"scatter": {"fraction": 0.2, "kind": "body", "amplitude": 1, "multiple": 0.3}}'
	refuse 422 /projections/scatter/fraction 11 '{"scatter": {"fraction": 11}}'
	refuse 400 /projections/lag "line integrals" '{"lag": [{"share": 0.1, "frames": 3}], "quantity": "line_integral", "air": null}'
	refuse 400 /projections/scatter "line integrals" '{"scatter": {"fraction": 0.3}, "quantity": "line_integral", "air": null}'
}

# In one view of a body's scan the detector stands before the isocentre: told with the scan, and where.
test_a_body_that_is_not_before_the_detector_is_refused() {
	jq '.projections.scatter = {"kind": "body", "amplitude": 1.4, "multiple": 0.3} | .projections.count = 8 | .geometry = {"kind": "views",
		"views": [range(8) as $k | ($k * 0.7853981634 | cos) as $c | ($k * 0.7853981634 | sin) as $s | (if $k == 3 then 300 else -480 end) as $d
		| {"source_mm": [620 * $c, 620 * $s, 0], "pixel0_mm": [$d * $c + 118.5 * $s, $d * $s - 118.5 * $c, -94.5],
		"column_step_mm": [-3 * $s, 3 * $c, 0], "row_step_mm": [0, 0, 3]}]}' "$work/good/scan.json" >"$work/bad.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/bad.json"
	expect_problem 422 /projections/scatter
	expect_json '.detail | contains("in view 3 it is")'
	jq 'del(.projections.scatter)' "$work/bad.json" >"$work/worse.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/worse.json"
	expect_status 201
}

test_projections_out_of_the_order_of_time_are_told() {
	jq '.projections.lag = [{"share": 0.02, "frames": 3}] | .geometry.angles_deg = [range(60) | . * 210 % 360]
		| del(.geometry.first_angle_deg, .geometry.angle_step_deg)' "$work/good/scan.json" >"$work/bad.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/bad.json"
	expect_status 201
	expect_json '[.warnings[] | select(.code == "lag_order")] | length == 0'
	jq '.geometry.angles_deg = [range(60) | . * . * 7 % 360]' "$work/bad.json" >"$work/worse.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/worse.json"
	expect_status 201
	expect_json '[.warnings[] | select(.code == "lag_order")] | length == 1'
}

imported() { # CBCT-OPTIONS ...
	cbct import "$work/good/projections.raw" --size 80,64 --type float32 --quantity intensity --air 60000 \
		--source-to-isocentre 620 --source-to-detector 1100 --pixel 3 --angle-step 6 "$@" 2>"$work/said"
}
test_numbers_are_found_from_exposures() {
	local mm
	cbct fit-lag "$work/frames.raw" --on 40 --size 16,16 --type float32 --dark "$work/dark.raw" -o "$work/found.json" 2>"$work/said" ||
		fail "cbct fit-lag: $(cat "$work/said")"
	jq -e '(.lag | map(.share) | add) as $sum | $sum > 0.028 and $sum < 0.032' "$work/found.json" >/dev/null || fail "the lag: $(cat "$work/found.json")"
	cbct fit-lag "$work/frames.raw" --on 50 --size 16,16 --type float32 --dark "$work/dark.raw" 2>"$work/said" && fail "a beam that was off is accepted"
	grep -q 'the beam was not on' "$work/said" || fail "what is said of it: $(cat "$work/said")"
	# steps of 20 mm behind which the beam hardens
	for mm in 20 40 60 80 100 120; do
		jq -nr "\"$mm \\(-((0.6 * (-0.025 * $mm | exp) + 0.4 * (-0.018 * $mm | exp)) | log))\""
	done >"$work/steps.txt"
	cbct fit-hardening "$work/steps.txt" --degree 2 --attenuation 0.0192 >>"$work/found.json" 2>"$work/said" ||
		fail "cbct fit-hardening: $(cat "$work/said")"
	imported --correct "$work/found.json" -o "$work/imported" || fail "cbct import --correct: $(cat "$work/said")"
	jq -e '.projections | (.lag | length) >= 1 and (.beam_hardening | length) == 3' "$work/imported/scan.json" >/dev/null || fail "members of the scan"
	echo '{"air": 3}' >"$work/found.json"
	imported --correct "$work/found.json" -o "$work/never" && fail "other members are accepted"
	grep -q 'are expected' "$work/said" || fail "what is said of it: $(cat "$work/said")"
}

# Plates whose scatter goes as a kernel says, with and without stops of 7 x 7 pixels that let 2 % through: that kernel.
test_scatter_is_found_behind_beam_stops() {
	/usr/bin/env python3 - "$work" <<'EOF' || fail "images"
import array, math, sys
work, columns, rows = sys.argv[1], 64, 48
air, dark = 40000.0, 200.0
def stop(c, r):
    return c % 12 in range(3, 10) and r % 12 in range(3, 10)
def write(name, images):
    array.array('f', [value for image in images for value in image]).tofile(open(f'{work}/{name}', 'wb'))
def image(value):
    return [value(c, r) for r in range(rows) for c in range(columns)]
opened, stopped = [], []
for p in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0):
    # over all of a beam, and a Gaussian that is far wider than the detector of 256 mm: one number all over
    share = sum(math.exp(-(4 * (c - 31.5)) ** 2 / 2e6) for c in range(64)) * sum(math.exp(-(4 * (r - 23.5)) ** 2 / 2e6) for r in range(48))
    scatter = 6 * math.exp(-1.3 * p) * p * share * 16 / (2 * math.pi * 1e6)
    opened.append(image(lambda c, r: dark + air * (math.exp(-p) + scatter)))
    stopped.append(image(lambda c, r: dark + air * (math.exp(-p) * (0.02 if stop(c, r) else 1) + scatter)))
write('open.raw', opened)
write('stopped.raw', stopped)
write('stops.raw', [image(lambda c, r: dark + air * (0.02 if stop(c, r) else 1))])
write('flat.raw', [image(lambda c, r: dark + air)])
write('dark.raw', [image(lambda c, r: dark)])
EOF
	local how=(--size 64,48 --type float32 --pixel-mm 4 --flat "$work/flat.raw" --dark "$work/dark.raw")
	cbct fit-scatter "$work/open.raw" "$work/stopped.raw" --stops "$work/stops.raw" "${how[@]}" -o "$work/found.json" 2>"$work/said" ||
		fail "cbct fit-scatter: $(cat "$work/said")"
	cat "$work/said"
	expect_number "$(sed -nE 's/.*off by ([0-9.e-]+).*/\1/p' "$work/said")" '<' 0.01 "what is left of line integrals"
	jq '.projections.scatter = input.scatter' "$work/good/scan.json" "$work/found.json" >"$work/bad.json"
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary @"$work/bad.json"
	expect_status 201
	# The same exposures for a body: a scan's job takes its scatter off, so that all is denser than it was.
	cbct fit-scatter "$work/open.raw" "$work/stopped.raw" --stops "$work/stops.raw" "${how[@]}" --distances-mm 620,1100 -o "$work/found.json" \
		2>"$work/said" || fail "cbct fit-scatter: $(cat "$work/said")"
	jq -e '.scatter | .kind == "body" and .amplitude > 0 and .multiple >= 0 and length == 3' "$work/found.json" >/dev/null ||
		fail "a body: $(cat "$work/found.json")"
	mkdir -p "$work/bodily"
	cp "$work/good/projections.raw" "$work/bodily/"
	jq '.projections.scatter = {"kind": "body", "amplitude": 4, "multiple": 0.3}' "$work/good/scan.json" >"$work/bodily/scan.json"
	reconstruct "$work/good" "$recipe"
	local before
	before=$(density)
	reconstruct "$work/bodily" "$recipe"
	expect_json '[.warnings[].code | select(startswith("scatter"))] == []'
	expect_number "$(jq -n "$(density) / $before")" '>' 1.02 "density over that with scatter"
	cbct fit-scatter "$work/open.raw" "$work/stopped.raw" --stops "$work/stops.raw" "${how[@]}" --distances-mm 1100,620 2>"$work/said" && fail "objects behind the detector"
	grep -q 'before the detector' "$work/said" || fail "what is said of it: $(cat "$work/said")"
	cbct fit-scatter "$work/open.raw" "$work/stopped.raw" --stops "$work/stops.raw" "${how[@]}" --distances-mm 620,1100 --kernels 1 2>"$work/said" &&
		fail "kernels beside a body"
	grep -q -e '--kernels 1 beside --distances-mm' "$work/said" || fail "what is said of it: $(cat "$work/said")"
	cbct fit-scatter "$work/open.raw" "$work/stopped.raw" --stops "$work/flat.raw" "${how[@]}" 2>"$work/said" && fail "no stops are accepted"
	grep -q 'known at 0 places, 30 are needed: a place is one of 3072 cells' "$work/said" || fail "what is said of it: $(cat "$work/said")"
	cbct fit-scatter "$work/open.raw" "$work/flat.raw" --stops "$work/stops.raw" "${how[@]}" 2>"$work/said" && fail "other images are accepted"
	grep -q '6 images of 64 x 48 pixels without beam stops, 1 of' "$work/said" || fail "what is said of it: $(cat "$work/said")"
}

start_daemon
run_tests
