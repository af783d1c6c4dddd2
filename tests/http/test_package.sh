#!/usr/bin/env bash
# `make deb`: what is in the package, its life in an empty root (dpkg's own, without a chroot), man pages and completions.
# The same in a Debian of its own, with its users and its libraries: tests/soak/test_debian.sh.
. "$(dirname "$0")/lib.sh"
command -v dpkg-deb >/dev/null || { run_tests() { echo "skip test_package.sh: dpkg-deb is not here" >>"$RESULTS"; echo "SKIP test_package.sh: dpkg-deb is not here"; }; }

root=$work/root
package() { # VERSION: sets $deb, made once a run
	deb=$BUILD/deb/cbctd_$1_$(dpkg --print-architecture).deb
	[ ! -e "$work/made-$1" ] || return 0
	make -C "$top" --no-print-directory -o all deb CUDA=0 BUILD="$BUILD" VERSION="$1" >"$work/made" 2>&1 || fail "make deb: $(tail -5 "$work/made")"
	[ -e "$deb" ] || fail "$deb"
	touch "$work/made-$1"
}
into_root() { # DPKG-ARGUMENT ...: in a root with nothing in it but dpkg's own files
	mkdir -p "$root/var/lib/dpkg/info" "$root/var/lib/dpkg/updates"
	touch "$root/var/lib/dpkg/status" "$root/var/lib/dpkg/available"
	dpkg --root="$root" --force-not-root --force-depends --force-script-chrootless --force-confold --log=/dev/null "$@" >"$work/dpkg.log" 2>&1 ||
		fail "dpkg $*: $(tail -5 "$work/dpkg.log")"
}

test_the_package_names_what_its_programs_load_and_holds_no_more_than_it_should() {
	local library
	package 1.0.0
	dpkg-deb -x "$deb" "$work/files"
	dpkg-deb -f "$deb" Depends | tr ',' '\n' | sed 's/^ *//; s/ .*//' >"$work/depends"
	for library in libmicrohttpd12 libsqlite3-0 libcurl4 libc6; do
		grep -qx "$library" "$work/depends" || fail "Depends has $library: $(paste -sd' ' "$work/depends")"
	done
	for library in $(sed '/^libc6$/d' "$work/depends"); do
		dpkg-query -L "$library" 2>/dev/null | grep -q '\.so' || fail "$library has a library"
	done
	! readelf -d "$work/files"/usr/bin/* | grep -iE 'cuda|cufft|RPATH|RUNPATH' || fail "no library of CUDA, and no path of this machine"
	! grep -rlF "$top" "$work/files" || fail "no path of this machine in a file"
	! find "$work/files" -perm /022 -not -type l | grep . || fail "nothing that others may write"
	(cd "$work/files" && dpkg-deb -e "$deb" "$work/control" && md5sum --quiet -c "$work/control/md5sums") || fail "md5sums"
	[ "$(cat "$work/control/conffiles")" = /etc/cbctd/cbctd.conf ] || fail "the settings are a conffile"
}

test_it_is_installed_upgraded_with_its_settings_and_removed() {
	package 1.0.0
	into_root -i "$deb"
	[ -x "$root/usr/bin/cbctd" ] || fail "the daemon"
	"$root/usr/bin/cbct" --version >/dev/null || fail "the client runs"
	echo 'log-level = debug' >"$root/etc/cbctd/cbctd.conf"
	# The next version, as far as dpkg can tell: `make deb VERSION=` in full is tests/soak/test_debian.sh's.
	dpkg-deb -R "$deb" "$work/next"
	sed -i 's/^Version: .*/Version: 1.0.1/' "$work/next/DEBIAN/control"
	dpkg-deb --root-owner-group -Znone -b "$work/next" "$work/next.deb" >/dev/null
	into_root -i "$work/next.deb"
	dpkg-query --root="$root" -W -f '${Version} ${db:Status-Status}\n' cbctd 2>/dev/null | grep -qx '1.0.1 installed' ||
		grep -A9 '^Package: cbctd$' "$root/var/lib/dpkg/status" | grep -q '^Version: 1.0.1' || fail "the upgrade"
	[ "$(cat "$root/etc/cbctd/cbctd.conf")" = 'log-level = debug' ] || fail "the operator's settings stay"
	echo scan >"$root/var/lib/cbctd/scan"
	into_root -r cbctd
	[ ! -e "$root/usr/bin/cbctd" ] && [ ! -e "$root/usr/lib/systemd/system/cbctd.service" ] || fail "the programs go"
	[ -e "$root/etc/cbctd/cbctd.conf" ] || fail "the settings stay when it is removed"
	into_root -P cbctd
	[ ! -e "$root/etc/cbctd/cbctd.conf" ] || fail "the settings go when it is purged"
	[ "$(cat "$root/var/lib/cbctd/scan")" = scan ] || fail "scans stay whatever becomes of the package"
	[ "$(find "$root/usr" -type f | wc -l)" = 0 ] || fail "nothing is left: $(find "$root/usr" -type f)"
}

# Debian's own eye on packages; what is overridden has its reason beside it (packages/deb.sh).
test_lintian_finds_nothing() {
	command -v lintian >/dev/null || skip "lintian is not here: apt-get install lintian"
	package 1.0.0
	lintian --allow-root --fail-on error,warning "$deb" >"$work/lintian" 2>&1 || fail "$(grep -E '^[EW]:' "$work/lintian")"
}

test_the_same_sources_give_the_same_package() {
	local first
	package 1.0.0
	first=$(sha256sum <"$deb")
	rm "$deb" "$work/made-1.0.0"
	package 1.0.0
	[ "$(sha256sum <"$deb")" = "$first" ] || fail "the same bytes"
}

test_man_pages_and_completions_have_every_command_and_setting() {
	local name command shown completed
	package 1.0.0
	for name in $("$BUILD/cbctd" --help | sed -n 's/^  --\([a-z-]*\).*/\1/p'); do
		grep -qF -- "\\-\\-${name//-/\\-}" "$BUILD/manual/man/cbctd.8" || fail "cbctd.8 has --$name"
	done
	for command in $("$BUILD/cbct" help | sed -n 's/^  \([a-z-]*\) .*/\1/p'); do
		shown=$(sed -n "/^.SH ${command^^}$/,/^.SH /p" "$BUILD/manual/man/cbct.1")
		completed=$(bash -c ". '$BUILD/manual/completions/bash/cbct'; COMP_WORDS=(cbct '$command' --) COMP_CWORD=2; _cbct; printf '%s\n' \"\${COMPREPLY[@]}\"")
		for name in $("$BUILD/cbct" "$command" --help | grep -oE '^  (-., )?--[a-z-]+' | grep -oE -- '--[a-z-]+'); do
			[[ $shown == *"${name//-/\\-}"* ]] || fail "cbct.1 has $name of $command"
			[[ $'\n'$completed$'\n' == *$'\n'$name$'\n'* ]] || fail "bash completes $name of $command"
		done
	done
	if command -v man >/dev/null; then
		for name in cbctd.8 cbct.1 cbct-worker.8 cbct-dicom.8; do
			[ -z "$(man -l --warnings=w -Tutf8 "$BUILD/manual/man/$name" 2>&1 >/dev/null)" ] || fail "$name has no mistake"
		done
	fi
}

# Held against what readelf, ldd and the page's own list say, each by itself.
test_the_bill_of_materials_is_what_the_programs_need() {
	local program library file bom=$work/sbom.json
	[ -e /var/lib/dpkg/status ] || skip "no Debian, whose packages are told"
	"$top/packages/sbom.py" "$BUILD" >"$bom" || fail "a bill"
	jq -e '.bomFormat == "CycloneDX" and .specVersion == "1.5" and (.serialNumber | startswith("urn:uuid:"))' "$bom" >/dev/null || fail "its kind"
	jq -e '([.components[]."bom-ref"] | length == (unique | length)) and ([.components[]."bom-ref"] + ["product:cbctd"]) as $all |
		([.dependencies[] | .ref, .dependsOn[]] - $all) == []' "$bom" >/dev/null || fail "every reference has one component"
	jq -e 'all(.components[]; (.version | length > 0) and (.type == "application" or .licenses != null or .supplier != null))' "$bom" >/dev/null || fail "versions and licences"
	for program in cbctd cbct-worker cbct-dicom cbct; do
		diff <(readelf -d "$BUILD/$program" | sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p' | sort) \
			<(jq -r --arg p "program:$program" '.dependencies[] | select(.ref == $p).dependsOn[] | select(startswith("library:")) | ltrimstr("library:")' "$bom" | sort) ||
			fail "what $program needs"
		ldd "$BUILD/$program" | awk '/=> \// { print $1, $3 }' | while read -r library file; do
			[ "$(jq -r --arg l "$library" '.components[] | select(.name == $l).hashes[0].content' "$bom")" = "$(sha256sum <"$file" | cut -d' ' -f1)" ] ||
				fail "$library of $program with its digest"
		done
	done
	if ls "$BUILD"/web/files/licences-*.txt >/dev/null 2>&1; then
		for library in $(jq -r '.dependencies | to_entries[] | "\(.key)@\(.value)"' "$top/clients/web/package.json"); do
			jq -e --arg p "pkg:npm/${library/#@/%40}" 'any(.components[]; .purl == $p)' "$bom" >/dev/null || fail "$library of the page"
		done
	fi
	"$top/packages/sbom.py" "$BUILD" | cmp - "$bom" || fail "the same bill again"
}

run_tests
