#!/usr/bin/env bash
# What `make install` puts where, and that it fits the prefix.
. "$(dirname "$0")/lib.sh"

install_to() { # PREFIX
	make -C "$top" --no-print-directory -o all install CUDA=0 BUILD="$BUILD" DESTDIR="$work/root" prefix="$1" >"$work/installed" 2>&1 ||
		fail "make install: $(tail -3 "$work/installed")"
}

test_the_unit_names_the_paths_of_the_prefix() {
	local root=$work/root/opt/ct/lib unit path
	install_to /opt/ct
	unit=$root/systemd/system/cbctd.service
	grep -q '^ExecStart=/opt/ct/bin/cbctd --config=/opt/ct/etc/cbctd/cbctd.conf$' "$unit" || fail "ExecStart of the unit: $(grep ExecStart "$unit")"
	! grep -E '@[a-z]+@|/usr/local' "$unit" "$root/tmpfiles.d/cbctd.conf" || fail "no other path in the unit"
	for path in $(grep -ohE '/opt/ct[^ ]*' "$unit" "$root/tmpfiles.d/cbctd.conf"); do
		[ -e "$work/root$path" ] || fail "$path of the unit is installed"
	done
	for path in systemd/system/cbctd.socket sysusers.d/cbctd.conf; do
		[ -s "$root/$path" ] || fail "$path"
	done
}

test_settings_of_the_operator_stay() {
	local settings=$work/root/opt/ct/etc/cbctd/cbctd.conf
	install_to /opt/ct
	echo 'log-level = debug' >"$settings"
	install_to /opt/ct
	[ "$(cat "$settings")" = 'log-level = debug' ] || fail "the settings that were there: $(head -3 "$settings")"
	rm "$settings"
}

# What systemd itself says of the units: that it understands them, and how much of the system they leave open.
test_the_units_are_sound_and_hardened() {
	local unit exposure
	command -v systemd-analyze >/dev/null || skip "systemd-analyze (Debian's systemd) is not here"
	make -C "$top" --no-print-directory -o all install CUDA=0 BUILD="$BUILD" prefix="$work/real" >"$work/installed" 2>&1 || fail "make install"
	unit=$work/real/lib/systemd/system
	# Which man pages and other units there are is this machine's affair.
	systemd-analyze verify --man=no "$unit/cbctd.service" "$unit/cbctd.socket" >"$work/verified" 2>&1 || fail "verify: $(cat "$work/verified")"
	! grep -F "$work/real" "$work/verified" || fail "verify has nothing to say of them"
	exposure=$(systemd-analyze security --offline=true --no-pager "$unit/cbctd.service" | sed -n 's/.*Overall exposure level for [^:]*: \([0-9.]*\).*/\1/p')
	expect_number "$exposure" '<=' 2.0 "exposure"
	systemd-sysusers --dry-run "$work/real/lib/sysusers.d/cbctd.conf" >"$work/sysusers" 2>&1 || fail "sysusers: $(cat "$work/sysusers")"
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
