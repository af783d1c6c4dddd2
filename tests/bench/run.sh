#!/bin/sh
# Benchmarks: the CPU's reconstruction, beside plastimatch where that is
# installed, and HTTP. Tables on standard output, results as JSON in $BUILD/bench/.
# Never part of the tests: times depend on the machine and on who else uses it.
set -eu
cd "$(dirname "$0")/../.."
BUILD=${BUILD:-build}
out=$BUILD/bench
mkdir -p "$out"

# A thread that waits must not keep the core from another that works.
OMP_WAIT_POLICY=${OMP_WAIT_POLICY:-passive}
export OMP_WAIT_POLICY

date=$(date -u +%Y-%m-%dT%H:%M:%SZ)
commit=$(git rev-parse --short HEAD 2>/dev/null || echo unknown)

"$BUILD/cpu-bench" "$out/measured.json" ${BENCH_REPEATS:-}

# The same case: exact forward projection of a ball, then FDK from the files it wrote.
seconds() {
	begin=$(date +%s.%N)
	"$@" >"$out/plastimatch.log" 2>&1
	end=$(date +%s.%N)
	awk -v a="$begin" -v b="$end" 'BEGIN { printf "%.2f", b - a }'
}

plastimatch=null
if command -v plastimatch >/dev/null 2>&1; then
	work=$(mktemp -d)
	trap 'rm -rf "$work"' EXIT
	plastimatch synth --pattern sphere --radius 40 --foreground 100 --background -1000 --dim "256 256 256" \
		--spacing ".3725 .3725 .3725" --origin "-47.49375 -47.49375 -47.49375" --output "$work/ball.mha" >/dev/null
	forward=$(seconds plastimatch drr --algorithm exact --num-angles 100 --gantry-angle-spacing 3.6 \
		--dim "559 559" --detector-size "295.711 295.711" --sad 620 --sid 1100 --output-format pfm \
		--output "$work/view" --input "$work/ball.mha")
	fdk=$(seconds plastimatch fdk --input "$work" --output "$work/fdk.mha" --dim "256 256 256" \
		--volume-size "95.36 95.36 95.36")
	plastimatch="{\"forward\": $forward, \"fdk\": $fdk}"
	jq -r --argjson p "$plastimatch" '"\nplastimatch here, with its files: forward \($p.forward) s, FDK \($p.fdk) s:" +
		" \($p.forward / .circular.forward * 10 | round / 10) and \($p.fdk / .circular.fdk * 10 | round / 10) times as long"' \
		"$out/measured.json"
else
	echo
	echo "plastimatch is not installed: no comparison on this machine"
fi

jq --arg date "$date" --arg commit "$commit" --argjson plastimatch "$plastimatch" \
	'{date: $date, commit: $commit} + . + {plastimatch: $plastimatch}' "$out/measured.json" >"$out/cpu.json"
rm -f "$out/measured.json"
echo "written: $out/cpu.json"

for more in http page arriving live; do
	echo
	BUILD=$BUILD tests/bench/$more.sh
done
