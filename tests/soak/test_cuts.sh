#!/usr/bin/env bash
# Power cuts at random moments of uploads, reconstructions and starts, on a file system that keeps no more than POSIX promises
# and on ext4 on a block device that forgets what was not flushed: tests/http/cuts.py.
. "$(dirname "$0")/../http/lib.sh"

test_a_hundred_power_cuts_lose_nothing_on_a_disk_that_keeps_only_what_was_synced() {
	need_mounts
	in_own_mounts /usr/bin/python3 "$top/tests/http/cuts.py" "$BUILD" "$work/strict" --uploads 70 --jobs 30 ${SEED:+--seed "$SEED"} \
		>"$work/strict.log" || fail "nothing is lost: $(cat "$work/strict.log")"
	cat "$work/strict.log"
}

test_a_hundred_power_cuts_lose_nothing_on_ext4() {
	need_mounts
	[ "$(id -u)" = 0 ] && [ -e /dev/loop-control ] || skip "a loop device needs root"
	in_own_mounts /usr/bin/python3 "$top/tests/http/cuts.py" "$BUILD" "$work/ext4" --disk ext4 --uploads 70 --jobs 30 \
		${SEED:+--seed "$SEED"} >"$work/ext4.log" || fail "nothing is lost: $(cat "$work/ext4.log")"
	cat "$work/ext4.log"
}

run_tests
