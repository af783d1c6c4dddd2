#!/usr/bin/env bash
# Whether a change leaves every volume as it was, to the last bit:
#
#     tests/same_bits.sh COMMIT [SUITE...]
#
# builds the unit tests of COMMIT, in a worktree under build/, and those of the present tree, both with tests/digests.c
# linked in, runs the suites in both and compares the digests of all volumes that the tests read. Volumes of a test
# that only one of the two has are counted apart. COMMIT's digests are kept in build/same_bits for the next time.
# Fails where a volume differs. Both trees run with the same number of threads, on the same machine: digests of
# different processors are not comparable. MAKE_FLAGS are further words for make.
set -euo pipefail
cd "$(dirname "$0")/.."

[ $# -ge 1 ] || { sed -n '2,/^set/{/^set/d;s/^# \{0,1\}//;p}' "$0"; exit 2; }
commit=$(git rev-parse --verify --short=12 "$1^{commit}")
shift
suites=("$@")
[ ${#suites[@]} -gt 0 ] || suites=(phantom study recon exterior metal outofcore algorithm)
at=$PWD/build/same_bits
mkdir -p "$at"

# Object files of the two trees stay apart, and those of the linked-in file from the build's own.
gcc -std=c11 -D_GNU_SOURCE -O2 -I. -c -o "$at/digests.o" tests/digests.c

# digests TREE BUILD FILE SUITE: runs a suite of TREE's unit tests.
digests() {
	local tree=$1 build=$2 file=$3 suite=$4
	rm -f "$file.part"
	touch "$file.part"
	# A test that fails leaves its volumes all the same, and is told.
	(cd "$tree" && DIGESTS=$file.part timeout "${SECONDS_MOST:-1500}" "$build/unit" "$suite" >"$file.log") ||
		{ echo "same_bits: $suite failed in $tree:"; tail -n 5 "$file.log"; }
	mv "$file.part" "$file"
}
unit() { # TREE BUILD
	# shellcheck disable=SC2086
	make -s -C "$1" CUDA=0 BUILD="$2" LDFLAGS="-Wl,--wrap=recon_read $at/digests.o" ${MAKE_FLAGS:-} "$2/unit"
}

old=$at/tree.$commit
missing=()
for suite in "${suites[@]}"; do [ -e "$at/$commit.$suite" ] || missing+=("$suite"); done
if [ ${#missing[@]} -gt 0 ]; then
	[ -e "$old/Makefile" ] || git worktree add -q --detach "$old" "$commit"
	unit "$old" "$at/old"
	# Test data beside the project are found from both trees.
	[ ! -e ../shared ] || ln -sfn "$(realpath ../shared)" "$at/shared"
	for suite in "${missing[@]}"; do digests "$old" "$at/old" "$at/$commit.$suite" "$suite"; done
	git worktree remove --force "$old"
fi
unit . "$at/new"
for suite in "${suites[@]}"; do digests . "$at/new" "$at/new.$suite" "$suite"; done

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
		}' "$at/$commit.$suite" "$at/new.$suite" || failed=1
done
exit $failed
