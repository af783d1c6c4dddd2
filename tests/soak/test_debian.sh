#!/usr/bin/env bash
# The package's life in a bare Debian 12 of its own: installed by apt with its libraries, started as its user, upgraded over
# the one before with its catalogue, removed and purged. Needs root, debootstrap and a Debian mirror.
. "$(dirname "$0")/../http/lib.sh"
DEBIAN_MIRROR=${DEBIAN_MIRROR:-http://deb.debian.org/debian}
chroot=
daemon_pid=

in_debian() { chroot "$chroot" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive "$@"; }
package() { # VERSION
	make -C "$top" --no-print-directory -o all deb CUDA=0 BUILD="$BUILD" VERSION="$1" >"$work/made" 2>&1 || fail "make deb: $(tail -5 "$work/made")"
	install -D -m 644 -t "$chroot/packages" "$BUILD/deb/cbctd_$1_amd64.deb"
}
install_package() { # VERSION
	in_debian apt-get install -y -qq --no-install-recommends "/packages/cbctd_$1_amd64.deb" >"$work/apt.log" 2>&1 || fail "apt-get install: $(tail -5 "$work/apt.log")"
}
# As the unit does, which nothing runs here.
start_in_debian() {
	local i
	in_debian setpriv --reuid cbctd --regid cbctd --init-groups env STATE_DIRECTORY=/var/lib/cbctd cbctd --config=/etc/cbctd/cbctd.conf \
		--listen 127.0.0.1:0 >"$work/cbctd.out" 2>"$work/cbctd.err" &
	daemon_pid=$!
	for ((i = 0; i < 400; i++)); do
		url=$(sed -n 's/^listening on \(http:\)/\1/p' "$work/cbctd.out")
		[ -n "$url" ] && [ "$(curl -s -o /dev/null -w '%{http_code}' "$url/readyz")" = 200 ] && return 0
		sleep 0.05
	done
	fail "a start: $(cat "$work/cbctd.err")"
}
stop_in_debian() {
	pkill -TERM -P "$daemon_pid" cbctd 2>/dev/null || kill "$daemon_pid" 2>/dev/null || true
	wait "$daemon_pid" || fail "exit status 0: $(tail -3 "$work/cbctd.err")"
}

# Beside the first one, where `make deb` has made it; without a card its worker is taken, finds none and is the processor's.
package_for_cards() {
	local file=$BUILD/deb/cbctd-cuda_1.0.0_amd64.deb pid
	[ -e "$file" ] || { echo "  the package for cards is not tried: CUDA is not built here"; return 0; }
	install -m 644 -t "$chroot/packages" "$file"
	in_debian apt-get install -y -qq --no-install-recommends "/packages/${file##*/}" >"$work/apt.log" 2>&1 || fail "the package for cards: $(tail -5 "$work/apt.log")"
	! in_debian ldd /usr/bin/cbct-worker-cuda | grep 'not found' || fail "all of its libraries"
	start_in_debian
	for pid in $(pgrep -x cbct-worker-cud) $(pgrep -x cbct-worker); do
		[ "$(readlink "/proc/$pid/root")" != "$chroot" ] || [[ $(readlink "/proc/$pid/exe") == */cbct-worker-cuda ]] || fail "the daemon takes it: $(readlink "/proc/$pid/exe")"
	done
	stop_in_debian
	in_debian apt-get purge -y -qq cbctd-cuda >"$work/apt.log" 2>&1 || fail "its removal: $(tail -5 "$work/apt.log")"
	[ ! -e "$chroot/usr/lib/cbctd" ] && [ ! -e "$chroot/usr/bin/cbct-worker-cuda" ] || fail "nothing of it is left"
}

leave_debian() {
	[ -z "$daemon_pid" ] || kill "$daemon_pid" 2>/dev/null || true
	! mountpoint -q "$chroot/proc" || umount -l "$chroot/proc"
	rm -rf --one-file-system "$chroot"
}

test_life_in_a_bare_debian() {
	local digest
	[ "$(id -u)" = 0 ] || skip "only root makes another Debian"
	command -v debootstrap >/dev/null || skip "debootstrap is not here"
	chroot=$(mktemp -d)
	chmod 755 "$chroot" # it is the root folder of the service's user, too
	trap leave_debian EXIT
	debootstrap --variant=minbase bookworm "$chroot" "$DEBIAN_MIRROR" >"$work/debootstrap.log" 2>&1 || skip "no Debian from $DEBIAN_MIRROR: $(tail -1 "$work/debootstrap.log")"
	mount --bind /proc "$chroot/proc"
	package 1.0.0
	install_package 1.0.0
	in_debian getent passwd cbctd >/dev/null || fail "the user"
	in_debian stat -c %U:%G:%a /var/lib/cbctd | grep -qx cbctd:cbctd:750 || fail "the state directory is the user's"
	[ "$(in_debian stat -c %U:%G:%a /etc/cbctd/cbctd.conf)" = root:cbctd:640 ] || fail "the settings are for the service to read"
	package_for_cards
	start_in_debian
	cbct simulate -o "$work/scan" --phantom head --views 24 --columns 24 --rows 20 --pixel 6 >/dev/null
	reconstruct "$work/scan" '{"scan": "SCAN", "sart": {"iterations": 3}}'
	get_volume final "$work/before.nii"
	stop_in_debian
	echo 'log-level = debug' >>"$chroot/etc/cbctd/cbctd.conf"
	package 1.0.1
	install_package 1.0.1
	in_debian dpkg-query -W -f '${Version}' cbctd | grep -qx 1.0.1 || fail "the new version"
	grep -qx 'log-level = debug' "$chroot/etc/cbctd/cbctd.conf" || fail "the operator's settings"
	start_in_debian
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded"'
	get_volume final "$work/after.nii"
	cmp "$work/before.nii" "$work/after.nii" || fail "the volume's bits"
	stop_in_debian
	in_debian apt-get remove -y -qq cbctd >"$work/apt.log" 2>&1 || fail "apt-get remove: $(tail -5 "$work/apt.log")"
	[ ! -e "$chroot/usr/bin/cbctd" ] || fail "the programs go"
	digest=$(find "$chroot/var/lib/cbctd/jobs" -name 'final.nii' -size +1k | wc -l)
	in_debian apt-get purge -y -qq cbctd >"$work/apt.log" 2>&1 || fail "apt-get purge: $(tail -5 "$work/apt.log")"
	[ ! -e "$chroot/etc/cbctd" ] || fail "the settings go when it is purged: $(ls "$chroot/etc/cbctd")"
	[ "$digest" = 1 ] && [ -n "$(find "$chroot/var/lib/cbctd/jobs" -name final.nii)" ] || fail "scans and volumes stay"
}

run_tests
