#!/usr/bin/env bash
# Whether a change leaves every volume as it was, to the last bit:
#
#     tests/same_bits.sh COMMIT [SUITE...]
#
# builds COMMIT, in a worktree under build/, and the present tree, runs the suites in both and compares the digests of
# all volumes. A suite is one of the unit tests, with tests/digests.c linked in, which notes every volume that a test
# reads, or `http/test_phantom`: phantoms of all kinds through the daemon, whose volumes and true objects are files.
# Without SUITE: all unit tests that reconstruct, and the phantoms. Volumes of a test that only one of the two has are
# counted apart. COMMIT's digests are kept in build/same_bits for the next time. Fails where a volume differs. Both
# trees run with the same number of threads, on the same machine: digests of different processors are not comparable.
# MAKE_FLAGS are further words for make.
set -euo pipefail
cd "$(dirname "$0")/.."

[ $# -ge 1 ] || { sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "$0"; exit 2; }
commit=$(git rev-parse --verify --short=12 "$1^{commit}")
shift
suites=("$@")
if [ ${#suites[@]} = 0 ]; then
	mapfile -t suites < <(grep -lE 'recon_read|unit/(scene|anatomy)\.h' tests/unit/test_*.c | sed 's,.*/test_,,;s,\.c$,,')
	suites+=(http/test_phantom)
fi
file_of() { echo "$at/$1.${2//\//.}"; } # COMMIT-OR-new SUITE
at=$PWD/build/same_bits
mkdir -p "$at"

# Object files of the two trees stay apart, and those of the linked-in file from the build's own.
gcc -std=c11 -D_GNU_SOURCE -O2 -I. -c -o "$at/digests.o" tests/digests.c

# digests TREE BUILD FILE SUITE: runs a suite of TREE. A test that fails leaves its volumes all the same, and is told.
digests() {
	local tree=$1 build=$2 file=$3 suite=$4 status=0
	rm -f "$file.part"
	touch "$file.part"
	if [[ $suite == http/* ]]; then
		(cd "$tree" && BUILD=$build timeout "${SECONDS_MOST:-1500}" tests/run.sh "$suite" >"$file.log" 2>&1) || status=$?
		# TEST FIRST COUNT DIGEST; a file is one volume, whose header names its job.
		find "$build/test/${suite#http/}" -name state -prune -o -name '*.nii' -print | sort | while read -r volume; do
			voxels=$(od -An -j108 -N4 -tf4 "$volume" | tr -d ' ')
			echo "${volume#"$build/test/"} 0 0 $(tail -c "+$((${voxels%.*} + 1))" "$volume" | sha256sum | cut -d ' ' -f 1)"
		done >"$file.part"
	else
		(cd "$tree" && DIGESTS=$file.part timeout "${SECONDS_MOST:-1500}" "$build/unit" "$suite" >"$file.log") || status=$?
	fi
	[ $status = 0 ] || { echo "same_bits: $suite failed in $tree:"; tail -n 5 "$file.log"; }
	mv "$file.part" "$file"
}
build() { # TREE BUILD
	# shellcheck disable=SC2086
	make -s -C "$1" CUDA=0 BUILD="$2" LDFLAGS="-Wl,--wrap=recon_read $at/digests.o" ${MAKE_FLAGS:-} "$2/unit"
	# shellcheck disable=SC2086
	[[ " ${suites[*]} " != *" http/"* ]] || make -s -C "$1" CUDA=0 BUILD="$2" ${MAKE_FLAGS:-} "$2"/{cbctd,cbct,cbct-worker}
}

old=$at/tree.$commit
missing=()
for suite in "${suites[@]}"; do [ -e "$(file_of "$commit" "$suite")" ] || missing+=("$suite"); done
if [ ${#missing[@]} -gt 0 ]; then
	[ -e "$old/Makefile" ] || git worktree add -q --detach "$old" "$commit"
	build "$old" "$at/old"
	# Test data beside the project are found from both trees.
	[ ! -e ../shared ] || ln -sfn "$(realpath ../shared)" "$at/shared"
	for suite in "${missing[@]}"; do digests "$old" "$at/old" "$(file_of "$commit" "$suite")" "$suite"; done
	git worktree remove --force "$old"
fi
build . "$at/new"
for suite in "${suites[@]}"; do digests . "$at/new" "$(file_of new "$suite")" "$suite"; done

failed=0
for suite in "${suites[@]}"; do
	# A volume is known by its test and by which of that test's reads it is.
	awk -v suite="$suite" '
		{ name = $1 " " $2 " " $3; key = FILENAME == ARGV[1] ? name " " ++before[name] : name " " ++after[name] }
		FILENAME == ARGV[1] { old[key] = $4; next }
		key in old { if (old[key] == $4) same++; else { differ++; tests[$1] } delete old[key]; next }
		{ added++ }
		END {
			for (key in old) gone++
			printf "%s: %d volumes the same, %d differ", suite, same, differ
			if (added + gone) printf " (%d only now, %d only before)", added, gone
			print ""
			for (test in tests) print "    " test
			exit differ > 0
		}' "$(file_of "$commit" "$suite")" "$(file_of new "$suite")" || failed=1
done
exit $failed
