#!/usr/bin/env bash
# The units under a real systemd: a bare Debian 12 that is booted (boot.sh), with the package installed, used, upgraded and
# purged by its own dpkg. Needs root, debootstrap, nsenter and a Debian mirror; DEBIAN_BASE, a folder that debootstrap has
# made with these packages, takes the place of the mirror.
. "$(dirname "$0")/../http/lib.sh"
DEBIAN_MIRROR=${DEBIAN_MIRROR:-http://deb.debian.org/debian}
debian= init=
group=cbctd-boot-$$

inside() { nsenter --target "$init" --all --wd=/ env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive "$@"; }
# The tests' own curl and cbct, in the network of that Debian.
curl() { nsenter --target "$init" --net curl "$@"; }

package() { # VERSION
	make -C "$top" --no-print-directory -o all deb CUDA=0 BUILD="$BUILD" VERSION="$1" >"$work/made" 2>&1 || fail "make deb: $(tail -5 "$work/made")"
	install -D -m 644 -t "$debian/packages" "$BUILD/deb/cbctd_$1_amd64.deb"
}
leave_debian() {
	[ -z "$boot" ] || kill -KILL "$boot" 2>/dev/null || true # unshare heeds no other signal
	wait 2>/dev/null || true
	rmdir /sys/fs/cgroup/{,unified/,systemd/}"$group" 2>/dev/null || true
	rm -rf --one-file-system "$debian"
}
boot_debian() {
	local needs
	[ "$(id -u)" = 0 ] || skip "only root boots another Debian"
	command -v debootstrap >/dev/null && command -v nsenter >/dev/null || skip "debootstrap or nsenter is not here"
	unshare --pid --mount --uts --ipc --net --cgroup --fork true 2>/dev/null || skip "no namespaces of our own here"
	debian=$(mktemp -d) boot=
	chmod 755 "$debian"
	trap leave_debian EXIT
	if [ -n "${DEBIAN_BASE:-}" ]; then
		cp -a "$DEBIAN_BASE/." "$debian"
	else
		debootstrap --variant=minbase --include=systemd,systemd-sysv,curl bookworm "$debian" "$DEBIAN_MIRROR" >"$work/debootstrap.log" 2>&1 ||
			skip "no Debian from $DEBIAN_MIRROR: $(tail -1 "$work/debootstrap.log")"
	fi
	package 1.0.0
	# Its libraries while there is a network.
	needs=$(dpkg-deb -f "$BUILD/deb/cbctd_1.0.0_amd64.deb" Depends | sed 's/([^)]*)//g; s/,/ /g')
	cp /etc/resolv.conf "$debian/etc/resolv.conf"
	chroot "$debian" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $needs >"$work/apt.log" 2>&1 ||
		fail "the libraries: $(tail -3 "$work/apt.log")"
	bash "$top/tests/soak/boot.sh" "$debian" "$group" >"$work/boot.log" 2>&1 &
	boot=$!
	for _ in $(seq 300); do
		init=$(pgrep -P "$boot" -x systemd | head -1) || true
		[ -z "$init" ] || [[ $(inside systemctl is-system-running 2>/dev/null) != running ]] || return 0
		sleep 0.1
	done
	skip "systemd does not come up in namespaces here: $(tail -3 "$work/boot.log")"
}
main_pid() { inside systemctl show -P MainPID cbctd; }
journal_has() { # TEXT
	local end=$((SECONDS + ${2:-5}))
	until grep -qF -- "$1" <(inside journalctl -u cbctd --no-pager -o cat); do
		[ $SECONDS -lt $end ] || fail "the journal has \"$1\": $(inside journalctl -u cbctd --no-pager -n 20)"
		sleep 0.2
	done
}
ready() {
	local end=$((SECONDS + 30))
	until [ "$(curl -s -o /dev/null -w '%{http_code}' "$url/readyz")" = 200 ]; do
		[ $SECONDS -lt $end ] || fail "ready: $(inside systemctl status cbctd --no-pager)"
		sleep 0.1
	done
}

test_the_life_of_the_service() {
	local pid before end ended
	boot_debian
	url=http://127.0.0.1:2228
	cbct simulate -o "$work/scan" --phantom head --views 24 --columns 24 --rows 20 --pixel 6 >/dev/null
	inside dpkg -i /packages/cbctd_1.0.0_amd64.deb >"$work/dpkg.log" 2>&1 || fail "dpkg -i: $(tail -5 "$work/dpkg.log")"
	inside systemctl is-active cbctd.service cbctd.socket || fail "service and sockets are started by the package"
	ready
	[ "$(inside stat -c %U:%a /var/lib/cbctd)" = cbctd:750 ] || fail "the state directory"
	[ "$(inside systemctl show -P User cbctd)" = cbctd ] || fail "its user"
	[ "$(inside systemctl show -P WatchdogUSec cbctd)" = 30s ] || fail "the watchdog"
	[[ $(inside systemctl show -P StatusText cbctd) == ready,* ]] || fail "its own words"
	inside curl -sf --unix-socket /run/cbctd/cbctd.sock http://localhost/readyz >/dev/null || fail "the Unix socket"

	# A job within the sandbox: its system calls, its memory, its files.
	reconstruct "$work/scan" '{"scan": "SCAN", "sart": {"iterations": 3}}'
	get_volume final "$work/before.nii"
	"$BUILD/cbct" recon "$work/scan" --sart 3 -o "$work/own" >/dev/null 2>&1 || true
	! inside journalctl -u cbctd -k --no-pager -o cat | grep -i 'audit.*SECCOMP' || fail "no call that the sandbox refuses"

	# The socket starts a daemon that was stopped; a client only waits.
	inside systemctl stop cbctd.service
	[ "$(inside systemctl is-active cbctd.service)" = inactive ] || fail "stopped"
	inside systemctl is-active cbctd.socket || fail "its sockets go on listening"
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded"'
	[ "$(inside systemctl is-active cbctd.service)" = active ] || fail "started by a request"

	# SIGHUP.
	pid=$(main_pid)
	inside sh -c 'echo "log-level = debug" >>/etc/cbctd/cbctd.conf'
	inside systemctl reload cbctd
	journal_has "SIGHUP: reading settings"
	req GET /v1/jobs
	journal_has "target=/v1/jobs "
	[ "$(main_pid)" = "$pid" ] || fail "the same process"
	grep -q . <(inside journalctl -u cbctd --no-pager "CBCT_JOB=$job") || fail "the journal has the job's fields"

	# A daemon that is stopped by a signal feeds no watchdog: systemd ends it, and another one goes on.
	ended=$SECONDS
	inside kill -STOP "$pid"
	end=$((SECONDS + 120))
	until [ "$(main_pid)" != "$pid" ] && [ "$(main_pid)" != 0 ]; do
		[ $SECONDS -lt $end ] || fail "another daemon: $(inside systemctl status cbctd --no-pager)"
		sleep 1
	done
	ready
	expect_number $((SECONDS - ended)) '<=' 60 "seconds without a daemon, from SIGSTOP on"
	journal_has "Watchdog timeout"
	req GET "/v1/jobs/$job"
	expect_json '.state == "succeeded"'
	# A crash, too.
	inside systemctl kill -s SEGV --kill-whom=main cbctd
	sleep 0.5
	req GET "/v1/jobs/$job" # waits at the socket
	expect_json '.state == "succeeded"'

	# An upgrade while a scan is open: what was acknowledged is there, the rest goes on.
	post_scan "$work/scan"
	head -c $((24 * 20 * 4 * 10)) "$work/scan/projections.raw" >"$work/part"
	req PUT "/v1/scans/$scan/projections/0-9" -T "$work/part"
	expect_status 201
	before=$scan
	package 1.0.1
	inside dpkg -i /packages/cbctd_1.0.1_amd64.deb >"$work/dpkg.log" 2>&1 || fail "the upgrade: $(tail -5 "$work/dpkg.log")"
	grep -q 'log-level = debug' "$debian/etc/cbctd/cbctd.conf" || fail "the operator's settings"
	[ "$(inside dpkg-query -W -f '${Version}' cbctd)" = 1.0.1 ] || fail "the version"
	req GET "/v1/scans/$before"
	expect_json '.received == [[0, 9]]'
	scan=$before
	req PUT "/v1/scans/$scan/projections" -T "$work/scan/projections.raw"
	expect_status 201
	post_job '{"scan": "SCAN", "sart": {"iterations": 3}}'
	wait_job succeeded
	get_volume final "$work/after.nii" format=raw
	job=$(curl -s "$url/v1/jobs" | jq -r '.jobs[-1].id')
	get_volume final "$work/first.nii" format=raw
	cmp "$work/first.nii" "$work/after.nii" || fail "the same bits after the upgrade"
	[ -z "$(inside systemctl --failed --no-legend --plain)" ] || fail "nothing has failed: $(inside systemctl --failed)"

	# The end.
	pid=$(main_pid)
	inside systemctl stop cbctd.socket cbctd.service
	[ "$(inside systemctl show -P Result cbctd)" = success ] || fail "it stops by itself: $(inside systemctl status cbctd --no-pager)"
	inside systemctl start cbctd.service
	ready
	inside dpkg --remove cbctd >"$work/dpkg.log" 2>&1 || fail "the removal: $(tail -5 "$work/dpkg.log")"
	[ ! -e "$debian/usr/bin/cbctd" ] || fail "the programs go"
	[ "$(inside systemctl is-active cbctd.service)" != active ] || fail "the service goes"
	inside dpkg --purge cbctd >"$work/dpkg.log" 2>&1 || fail "the purge: $(tail -5 "$work/dpkg.log")"
	[ ! -e "$debian/etc/cbctd" ] || fail "the settings go"
	[ -n "$(find "$debian/var/lib/cbctd/jobs" -name final.nii)" ] || fail "scans and volumes stay"
	[ -z "$(inside systemctl --failed --no-legend --plain)" ] || fail "nothing has failed: $(inside systemctl --failed)"
}

run_tests
