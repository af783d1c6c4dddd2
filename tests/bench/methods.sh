#!/usr/bin/env bash
# The table of all methods: methods.sh PROGRAM leaves it in $OUT/methods.txt, a process for each processor and row, those of
# many views first. Rows that are done stay where an earlier call left them; $SECONDS_MOST ends it in time, and what is
# missing then is said in the table and on standard error.
set -euo pipefail
program=$1 out=${OUT:?} most=${SECONDS_MOST:-0}
read -r scans methods < <("$program" --list)
mkdir -p "$out/rows"

row() {
	[[ -s $out/rows/$1.$2 ]] || { OMP_NUM_THREADS=1 "$program" "$1/$2" >"$out/rows/$1.$2.part" && mv "$out/rows/$1.$2.part" "$out/rows/$1.$2"; }
}
export -f row
export out program
# Of nine scans of an anatomy the last three have 200 views, those before 60, the first 26.
for ((scan = 0; scan < scans; scan++)); do
	for ((method = 0; method < methods; method++)); do
		echo "$((scan % 9 / 3)) $scan $method"
	done
done | sort -k1,1nr -s | cut -d' ' -f2- |
	timeout "$most" xargs -P "$(nproc)" -n 2 bash -c 'row "$1" "$2"' row || true

left=0
for ((scan = 0; scan < scans; scan++)); do
	"$program" "$scan/"
	for ((method = 0; method < methods; method++)); do
		if [[ -s $out/rows/$scan.$method ]]; then
			cat "$out/rows/$scan.$method"
		else
			echo "  method $method: not run"
			left=$((left + 1))
		fi
	done
	echo
done >"$out/methods.txt"
echo "$left of $((scans * methods)) rows are missing in $out/methods.txt" >&2
