#!/usr/bin/env bash
# Debian packages of what `make install` installs: cbctd, and cbctd-cuda with the worker for NVIDIA cards where it was
# built. Usage: packages/deb.sh ROOT VERSION OUT [CUDA-WORKER]
#   ROOT         where `make install DESTDIR=ROOT prefix=/usr` has put everything
#   CUDA-WORKER  a cbct-worker with the CUDA backend
#   MAINTAINER   in the environment: who gives the package out, "NAME <ADDRESS>"
# The same input and SOURCE_DATE_EPOCH give the same bytes.
set -euo pipefail
root=$1 version=$2 out=$3 cuda=${4:-}
here=$(cd "$(dirname "$0")" && pwd)
architecture=$(dpkg --print-architecture)
export SOURCE_DATE_EPOCH=${SOURCE_DATE_EPOCH:-$(git -C "$here" log -1 --format=%ct 2>/dev/null || date +%s)}
maintainer=${MAINTAINER:-the maintainers of cbctd <cbctd@localhost>}
mkdir -p "$out"

# The Debian packages of the libraries that these programs name; those of the libraries' own are their packages' affair.
depends() { # FOLDER-OF-OWN-LIBRARIES PROGRAM...
	local own=$1 loaded library path paths=() names=() owners
	shift
	loaded=$(ldd "$@")
	for library in $(readelf -d "$@" | sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p' | sort -u); do
		[ ! -e "$own/$library" ] || continue
		path=$(awk -v name="$library" '$1 == name && $2 == "=>" { print $3; exit } $1 ~ "/" name "$" { print $1; exit }' <<<"$loaded")
		names+=("$library")
		# /lib and /usr/lib may be one folder, of which the package knows either name.
		paths+=("$path" "$(realpath "$path")" "/usr${path#/usr}" "${path#/usr}")
	done
	owners=$(dpkg-query -S "${paths[@]}" 2>/dev/null || true)
	for library in "${names[@]}"; do
		grep -qF "/${library%%.so*}" <<<"$owners" || { echo "packages/deb.sh: no Debian package has $library" >&2; return 1; }
	done
	# Symbols of the C library come with its version; the others' are in their names.
	sed 's/:.*//' <<<"$owners" | sort -u | sed "s/^libc6\$/libc6 (>= $(dpkg-query -W -f '${Version}' libc6 | sed 's/-.*//'))/" | paste -sd, | sed 's/,/, /g'
}

# build NAME FOLDER: with its control file in FOLDER/DEBIAN
build() {
	local file=$out/$1_${version}_$architecture.deb
	(cd "$2" && find . -path ./DEBIAN -prune -o -type f -printf '%P\n' | LC_ALL=C sort | xargs -d '\n' md5sum >DEBIAN/md5sums)
	chmod 644 "$2/DEBIAN/md5sums"
	find "$2" -newermt "@$SOURCE_DATE_EPOCH" -exec touch -h -d "@$SOURCE_DATE_EPOCH" {} +
	dpkg-deb --root-owner-group -Zxz -z3 --uniform-compression --build "$2" "$file" >/dev/null
	echo "$file"
}

# What Debian wants to be told with each package; the lines for lintian come from standard input.
documents() { # NAME FOLDER COPYRIGHT
	local to=$2/usr/share/doc/$1 line
	mkdir -p "$to" "$2/usr/share/lintian/overrides"
	printf '%s\n' "$3" >"$to/copyright"
	printf '%s (%s) unstable; urgency=medium\n\n  * The commits of the project say what has changed.\n\n -- %s  %s\n' \
		"$1" "$version" "$maintainer" "$(LC_ALL=C date -u -R -d "@$SOURCE_DATE_EPOCH")" | gzip -9n >"$to/changelog.gz"
	# Who builds a package for himself has no address to name.
	[ -n "${MAINTAINER:-}" ] || printf '%s\n' "$1: bogus-mail-host" "$1: bogus-mail-host-in-debian-changelog" \
		>"$2/usr/share/lintian/overrides/$1"
	while read -r line; do
		if [ "${line:0:1}" = '#' ]; then echo "$line"; else echo "$1: $line"; fi
	done >>"$2/usr/share/lintian/overrides/$1"
}

control() { # NAME FOLDER DEPENDS MORE: the description is standard input's
	mkdir -p "$2/DEBIAN"
	{
		printf 'Package: %s\nVersion: %s\nArchitecture: %s\nSection: science\nPriority: optional\n' "$1" "$version" "$architecture"
		printf 'Maintainer: %s\nDepends: %s\n' "$maintainer" "$3"
		[ -z "$4" ] || printf '%s\n' "$4"
		printf 'Installed-Size: %s\n' "$(du -sk --exclude=DEBIAN "$2" | cut -f1)"
		cat
	} >"$2/DEBIAN/control"
}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
umask 022

main=$work/cbctd
cp -a "$root" "$main"
rm -f "$main/usr/bin/cbct-cuda"
# Modes are those of a package, whatever the umask of the build was.
find "$main" -type d ! -path "$main/etc/cbctd" -exec chmod 755 {} +
find "$main/usr" -type f ! -perm /100 -exec chmod 644 {} +
for program in "$main"/usr/bin/*; do strip --strip-unneeded "$program"; done
find "$main/usr/share/man" -type f -name '*.[18]' -exec gzip -9n {} +
documents cbctd "$main" 'No licence is chosen: that is for the owner of cbctd to do. The web page has parts of others, whose licences it
shows; libraries are those of Debian, each under its own licence (/usr/share/doc/LIBRARY/copyright).' <<'TEXT'
# Tokens and keys lie beside the settings.
non-standard-dir-perm 0750 != 0755 [etc/cbctd/]
non-standard-file-perm 0640 != 0644 [etc/cbctd/cbctd.conf]
# No helper of debhelper is needed for it.
maintainer-script-calls-systemctl
# There is no licence to give notice of.
copyright-without-copyright-notice
TEXT
needs=$(depends /nowhere "$main"/usr/bin/*)
control cbctd "$main" "$needs" "Recommends: systemd
Suggests: dcmtk, cbctd-cuda" <<'TEXT'
Description: cone-beam CT reconstruction as a service
 Acquisition software of a C-arm posts projections over HTTP; the daemon keeps
 them on the disk and reconstructs them by FDK, SART and total variation.
 .
 This package has the daemon, its worker for the processor, the client cbct,
 units for systemd and settings in /etc/cbctd.
TEXT
for script in postinst prerm postrm; do install -m 755 "$here/debian/$script" "$main/DEBIAN/$script"; done
echo /etc/cbctd/cbctd.conf >"$main/DEBIAN/conffiles"
build cbctd "$main"

if [ -n "$cuda" ]; then
	card=$work/cbctd-cuda own=$work/cbctd-cuda/usr/lib/cbctd
	install -D -m 755 "$cuda" "$card/usr/bin/cbct-worker-cuda"
	strip --strip-unneeded "$card/usr/bin/cbct-worker-cuda"
	mkdir -p "$own"
	# CUDA's own libraries are in no package of Debian's main; the worker finds them by its RUNPATH.
	ldd "$cuda" | awk '/=> \// && /lib(cufft|cudart)/ { print $3 }' | xargs -r cp -L -t "$own"
	# CUDA 13 has left drivers behind that 12 still takes.
	driver=525
	[ ! -e "$own/libcudart.so.13" ] || driver=580
	documents cbctd-cuda "$card" "No licence is chosen: that is for the owner of cbctd to do. The libraries in /usr/lib/cbctd are NVIDIA's, of the CUDA
Toolkit, under its End User License Agreement, which lets them be given out with a program." <<'TEXT'
# CUDA's libraries are in no package of Debian's main.
embedded-library
shared-library-lacks-stack-section
hardening-no-fortify-functions
maintainer-script-calls-systemctl
custom-library-search-path
# There is no licence to give notice of.
copyright-without-copyright-notice
TEXT
	needs=$(depends "$own" "$card/usr/bin/cbct-worker-cuda")
	control cbctd-cuda "$card" "cbctd (= $version), $needs" "" <<TEXT
Description: cone-beam CT reconstruction on NVIDIA cards
 The worker of cbctd for NVIDIA cards, with the libraries of CUDA that it needs.
 The driver ($driver or later) is not part of it. cbctd takes this worker as soon as
 it is there.
TEXT
	install -m 755 "$here/debian/cuda.postinst" "$card/DEBIAN/postinst"
	install -m 755 "$here/debian/cuda.postinst" "$card/DEBIAN/postrm"
	build cbctd-cuda "$card"
fi
