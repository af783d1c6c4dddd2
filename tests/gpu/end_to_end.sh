#!/usr/bin/env bash
# The CUDA backend through the real daemon: volumes beside the CPU's, memory that
# comes back after 200 jobs, a worker that dies of an illegal access while the
# daemon goes on. Needs a device, and for its last part curl and jq; skipped aloud without them.
set -uo pipefail
cd "$(dirname "$0")/../.."
BUILD=$(realpath "${BUILD:-build}")
PATH=$BUILD:$PATH
work=$BUILD/test/gpu
JOBS=${JOBS:-200}
rm -rf "$work" && mkdir -p "$work"
failures=0

if ! nvidia-smi -L >/dev/null 2>&1; then
	echo "SKIPPED: no CUDA device answers"
	exit 0
fi

start() { # [OPTION ...]: a daemon on a free port
	cbctd --listen 127.0.0.1:0 --state-dir "$work/state" --backend cuda --log-level info "$@" >"$work/out" 2>>"$work/err" &
	daemon=$!
	for ((i = 0; i < 600; i++)); do
		CBCT_URL=$(sed -n 's/^listening on //p' "$work/out")
		[ -n "$CBCT_URL" ] && grep -q "cuda, " "$work/err" && break
		kill -0 $daemon 2>/dev/null || { tail -5 "$work/err"; exit 1; }
		sleep 0.05
	done
	export CBCT_URL
}
stop() { kill $daemon && wait $daemon; }
trap 'kill $daemon 2>/dev/null' EXIT
memory() { nvidia-smi --query-gpu=memory.used --format=csv,noheader,nounits | head -1; }
check() { # WHAT CONDITION ...
	local what=$1
	shift
	if "$@"; then echo "pass $what"; else echo "FAIL $what" && failures=$((failures + 1)); fi
}
below() { awk -v a="$1" -v b="$2" 'BEGIN { exit !(a + 0 < b + 0) }'; }

# Counts with noise from a C-arm that wanders; FDK, SART and TV on both backends.
cbct simulate -o "$work/scan" --phantom head --scale 45 --density 0.0192 --views 120 --arc 200 --columns 260 --rows 220 \
	--pixel 1.2 --wobble 3 --kind matrices --photons 100000 >"$work/simulate.log" 2>&1 || cat "$work/simulate.log"
recipe=(--grid 128 --spacing 0.75 --sart 10 --subsets 10 --emit fdk)
start
scan=$(cbct upload "$work/scan" --quiet | tail -1)
job=$(cbct submit "$scan" "${recipe[@]}" --wait 2>>"$work/watch" | tail -1)
cbct recon "$work/scan" "${recipe[@]}" --backend cpu -o "$work/cpu" --quiet >/dev/null
for name in fdk final; do
	cbct get "$job" $name -o "$work/$name.nii" >/dev/null
	rms=$(cbct compare "$work/$name.nii" "$work/cpu/$name.nii" --hu --json | tr ',{' '\n\n' | sed -n 's/.*"rmse": *//p' | head -1)
	check "$name is the CPU's within 0.5 HU RMS ($rms)" below "${rms:-nan}" 0.5
done
# The matched pair: the volume beside the CPU's, and the plan that the job's document names.
matched=(--grid 128 --spacing 0.75 --sart 10 --subsets 10 --projector matched)
job=$(cbct submit "$scan" "${matched[@]}" --wait 2>>"$work/watch" | tail -1)
cbct recon "$work/scan" "${matched[@]}" --backend cpu -o "$work/cpu-matched" --quiet >/dev/null
cbct get "$job" final -o "$work/matched.nii" >/dev/null
rms=$(cbct compare "$work/matched.nii" "$work/cpu-matched/final.nii" --hu --json | tr ',{' '\n\n' | sed -n 's/.*"rmse": *//p' | head -1)
check "the matched pair's volume is the CPU's within 0.5 HU RMS ($rms)" below "${rms:-nan}" 0.5
check "the job was done by the matched pair" grep -q "back matched" <(cbct jobs --limit 1 --json)
# A grid inside of the body: FDK of what lies around it goes by a plan of its own.
inside=(--grid 48,48,40 --spacing 0.75 --sart 5 --subsets 10)
job=$(cbct submit "$scan" "${inside[@]}" --wait 2>>"$work/watch" | tail -1)
cbct recon "$work/scan" "${inside[@]}" --backend cpu -o "$work/cpu-inside" >/dev/null 2>"$work/inside.log"
cbct get "$job" final -o "$work/inside.nii" >/dev/null
rms=$(cbct compare "$work/inside.nii" "$work/cpu-inside/final.nii" --hu --json | tr ',{' '\n\n' | sed -n 's/.*"rmse": *//p' | head -1)
check "a volume inside of the body is the CPU's within 0.5 HU RMS ($rms)" below "${rms:-nan}" 0.5
check "what lies around it was taken out" grep -q outside_grid "$work/inside.log"
# Pixels whose gain has drifted, mended from all views, and views that are held out of a check.
if command -v python3 >/dev/null; then
	cp -r "$work/scan" "$work/drifted"
	rm -f "$work/drifted/projections.sums"
	python3 - "$work/drifted/projections.raw" <<'EOF'
import array, math, random, sys
random.seed(3)
pixels, views = 260 * 220, 120
data = array.array('f', open(sys.argv[1], 'rb').read())
for pixel in random.sample(range(pixels), pixels // 200):
    shift = random.choice((-0.01, 0.01))
    for view in range(views):
        data[view * pixels + pixel] += shift
open(sys.argv[1], 'wb').write(data.tobytes())
EOF
	rings=("${recipe[@]}" --rings --hold-out)
	drifted=$(cbct upload "$work/drifted" --quiet | tail -1)
	job=$(cbct submit "$drifted" "${rings[@]}" --wait 2>>"$work/watch" | tail -1)
	cbct recon "$work/drifted" "${rings[@]}" --backend cpu -o "$work/cpu-rings" >/dev/null 2>"$work/rings.log"
	cbct get "$job" final -o "$work/rings.nii" >/dev/null
	rms=$(cbct compare "$work/rings.nii" "$work/cpu-rings/final.nii" --hu --json | tr ',{' '\n\n' | sed -n 's/.*"rmse": *//p' | head -1)
	check "a volume without its rings is the CPU's within 0.5 HU RMS ($rms)" below "${rms:-nan}" 0.5
	check "rings were found" grep -q rings "$work/rings.log"
else
	echo "SKIPPED: pixels that drift need python3"
fi
# The circle's geometry told of the same projections: where each view stood, found on both.
if command -v python3 >/dev/null; then
	cp -r "$work/scan" "$work/wanders"
	cbct simulate -o "$work/circle" --phantom head --scale 45 --density 0.0192 --views 120 --arc 200 --columns 260 --rows 220 \
		--pixel 1.2 >>"$work/simulate.log" 2>&1
	cp "$work/circle/scan.json" "$work/wanders/"
	for backend in cuda cpu; do
		cbct recon "$work/wanders" --grid 64 --spacing 1.5 --refine-geometry --backend $backend -o "$work/refined-$backend" \
			>/dev/null 2>"$work/refined-$backend.log"
	done
	apart=$(python3 - "$work/refined-cuda" "$work/refined-cpu" <<'EOF'
import json, math, sys
found = [json.load(open(path + "/refinement.json")) for path in sys.argv[1:]]
assert all(one["accepted"] and len(one["views"]) == 120 for one in found)
print(max(math.dist(a["shift_mm"], b["shift_mm"]) for a, b in zip(*(one["views"] for one in found))))
EOF
	)
	check "each view stands where the CPU's refinement has it, within 0.001 mm ($apart)" below "${apart:-nan}" 0.001
else
	echo "SKIPPED: comparing refinements needs python3"
fi
again=$(cbct submit "$scan" "${recipe[@]}" --tv gradient --wait 2>>"$work/watch" | tail -1)
third=$(cbct submit "$scan" "${recipe[@]}" --tv gradient --wait 2>>"$work/watch" | tail -1)
# The voxels alone: a file says which job it is of.
cbct get "$again" final --format raw -o "$work/a.raw" >/dev/null && cbct get "$third" final --format raw -o "$work/b.raw" >/dev/null
check "the same bits again" cmp -s "$work/a.raw" "$work/b.raw"

# Memory: all kinds of small jobs, one after the other.
before=$(memory)
for ((i = 0; i < JOBS; i++)); do
	case $((i % 4)) in
	0) last=$(cbct submit "$scan" --fdk hann --grid 64 --spacing 1.5) ;;
	1) last=$(cbct submit "$scan" --grid 48,50,33 --spacing 1.5 --sart 2 --subsets views) ;;
	2) last=$(cbct submit "$scan" --grid 64 --spacing 1.5 --sart 2 --tv proximal) ;;
	3) last=$(cbct submit "$scan" --grid 33 --spacing 2 --sart 3 --subsets 1 --tv gradient --no-fdk) ;;
	esac
done
cbct watch "$last" >/dev/null 2>&1
after=$(memory)
check "memory after $JOBS jobs: $before MiB, $after MiB" below "$after" "$((before + 16))"
stop

# An illegal access: the worker ends, the daemon starts another, the job is done there.
if [ -x "$BUILD/cbct-worker-faulty" ]; then
	touch "$work/fault"
	export CBCT_FAULT=$work/fault
	: >"$work/err"
	start --worker "$BUILD/cbct-worker-faulty"
	job=$(cbct submit "$scan" --grid 64 --spacing 1.5 --tv gradient --wait 2>>"$work/watch" | tail -1)
	check "the job is done after the fault" cbct watch "$job"
	check "the fault was met" [ ! -e "$work/fault" ]
	check "its worker ended and another came" grep -q "ended with exit status 3, the next one starts" "$work/err"
	check "the daemon goes on" kill -0 $daemon
	stop
fi

# What arrives while the arm turns, in any order, what phantoms become and their end slices, what is beside metal, stuck
# pixels, rings, lag and scatter (fitted and by images), and what a job says of its quality: the daemon's own tests.
parts=(arriving phantom test_metal stuck_pixels rings detector test_scatter quality)
if command -v curl >/dev/null && command -v jq >/dev/null; then
	check "the daemon's tests: ${parts[*]}" env BACKEND=cuda BUILD="$BUILD" tests/run.sh "${parts[@]}"
else
	echo "SKIPPED: the daemon's tests (${parts[*]}) need curl and jq"
fi
# The daemon's own tests of jobs on several devices pretend that there are cards; these are real ones.
if [ "$(nvidia-smi -L | wc -l)" -gt 1 ] && command -v python3 >/dev/null; then
	check "jobs on several cards" python3 tests/gpu/several_cards.py "$BUILD" "$work/several"
else
	echo "SKIPPED: jobs on several cards need two of them, and python3"
fi

echo "$failures failures"
[ $failures = 0 ]
