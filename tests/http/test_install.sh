#!/usr/bin/env bash
# What `make install` puts where, and that it fits the prefix.
. "$(dirname "$0")/lib.sh"

install_to() { # PREFIX
	make -C "$top" --no-print-directory -o all install CUDA=0 BUILD="$BUILD" DESTDIR="$work/root" prefix="$1" >"$work/installed" 2>&1 ||
		fail "make install: $(tail -3 "$work/installed")"
}

test_the_unit_names_the_paths_of_the_prefix() {
	local unit=$work/root/opt/ct/lib/systemd/system/cbctd.service path
	install_to /opt/ct
	grep -q '^ExecStart=/opt/ct/bin/cbctd$' "$unit" || fail "ExecStart of the unit: $(grep ExecStart "$unit")"
	! grep -E '@|/usr/local' "$unit" || fail "no other path in the unit"
	for path in $(grep -oE '/opt/ct[^ ]*' "$unit"); do
		[ -e "$work/root$path" ] || fail "$path of the unit is installed"
	done
}

test_programs_readme_and_example_are_installed() {
	local root=$work/root/opt/ct program
	install_to /opt/ct
	for program in cbctd cbct-worker cbct; do
		[ -x "$root/bin/$program" ] || fail "bin/$program"
	done
	cmp "$top/README.md" "$root/share/doc/cbctd/README.md" || fail "README.md"
	# The example says nothing that is not the default, and every line of it is a setting once it is said.
	grep -q '^[^#]' "$root/share/doc/cbctd/cbctd.conf" && fail "an example of comments alone"
	sed 's/^#\([a-z-]* = .*\)/\1/' "$root/share/doc/cbctd/cbctd.conf" >"$work/said.conf"
	grep -q '^listen' "$work/said.conf" || fail "the example has the setting listen"
	"$root/bin/cbctd" --config "$work/said.conf" --print-config >/dev/null || fail "the example is read"
}

run_tests
