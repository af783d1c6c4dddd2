#!/usr/bin/env bash
# Builds the working tree twice, in folders of other names and depth, in another time zone, language, umask and order of
# work, and compares programs and packages byte by byte. Usage: packages/reproducible.sh [MAKE-ARGUMENT ...]
# nvcc writes the path of its sources into its code: with CUDA=1 both builds are in the same folder.
# No compiler cache: what it gives twice is the same anyway. PROGRAMS names what is built in place of all.
set -euo pipefail
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git log -1 --format=%ct)}
export CCACHE_DISABLE=1
one=$work/one two=$work/another/folder/two first=$one/build
targets=${PROGRAMS:-all deb}

build() { # FOLDER JOBS MAKE-ARGUMENT ...
	local folder=$1 jobs=$2
	shift 2
	make -C "$folder" --no-print-directory -j"$jobs" "$@" $targets >"$folder.log" 2>&1 || { tail -5 "$folder.log" >&2; exit 1; }
}

mkdir -p "$one" "$(dirname "$two")"
git ls-files -z --cached --others --exclude-standard | xargs -0 tar -c --ignore-failed-read 2>/dev/null | tar -x -C "$one"
cp -a "$one" "$two"
build "$one" "$(nproc)" "$@"
if [[ " $* " == *" CUDA=1 "* ]]; then
	first=$work/first
	mv "$one/build" "$first"
	rm -rf "$one"
	mv "$two" "$one"
	two=$one
fi
(umask 027 && TZ=Asia/Tokyo LC_ALL=C.UTF-8 HOME=$work build "$two" 1 "$@")

failed=0 count=0
for file in $(cd "$first" && ls -d cbctd cbct-worker cbct-dicom cbct cbct-cuda deb/*.deb 2>/dev/null); do
	count=$((count + 1))
	if cmp -s "$first/$file" "$two/build/$file"; then
		echo "same   $file  $(sha256sum <"$first/$file" | cut -c1-16)"
	else
		echo "DIFFER $file: $(cmp "$first/$file" "$two/build/$file" 2>&1 | sed 's/.*differ: //')"
		failed=1
	fi
done
[ $count -gt 0 ] || { echo "nothing was built" >&2; exit 1; }
exit $failed
