#!/usr/bin/env bash
# cbct doctor: what it finds on a machine that is fit, and on ones that are not.
. "$(dirname "$0")/lib.sh"

report=$work/report
# doctor [VARIABLE=VALUE ...] DIR: sets $code
doctor() {
	code=0
	env CBCT_URL=http://127.0.0.1:9 "$@" >"$report" 2>"$work/errors" || code=$?
	jq -e 'all(.[]; (.subject | length > 0) and (.finding | length > 0) and (.verdict | IN("ok", "note", "problem")))' "$report" >/dev/null ||
		fail "findings: $(head -c 600 "$report")$(cat "$work/errors")"
	jq -e 'all(.[] | select(.verdict == "problem"); .advice | length > 0)' "$report" >/dev/null || fail "what to do about each problem"
}
has() { # SUBJECT VERDICT PATTERN
	jq -e --arg s "$1" --arg v "$2" --arg p "$3" 'any(.[]; .subject == $s and .verdict == $v and (.finding | test($p)))' "$report" >/dev/null ||
		fail "$2 of $1: $3, got $(jq -c ".[] | select(.subject == \"$1\")" "$report")"
}
fit() { mkdir -p -m 750 "$work/fit"; }

test_a_fit_directory_has_no_problem_and_nothing_stays_in_it() {
	fit
	doctor cbct doctor --json "$work/fit"
	[ $code = 0 ] || fail "exit status 0: $(jq -c 'map(select(.verdict == "problem"))' "$report")"
	has sync ok '^a sync takes [0-9.]+ ms'
	has rights ok 'mode 750'
	has limits ok 'descriptors'
	has memory "$(jq -r '.[] | select(.subject == "memory" and (.finding | test("available"))) | .verdict' "$report")" 'GB are available'
	/sbin/ldconfig -p | grep -q libnvidia-ml || has card note 'libnvidia-ml.so.1'
	has daemon note 'Failed to connect'
	[ -z "$(ls -A "$work/fit")" ] || fail "nothing stays: $(ls -A "$work/fit")"
	cbct doctor "$work/fit" >"$work/text" || fail "the same as text"
	grep -q '^ok       rights: ' "$work/text" || fail "a line a finding: $(head -3 "$work/text")"
}

test_a_sync_that_does_nothing_is_found() {
	[ "$(stat -f -c %T /dev/shm)" = tmpfs ] || skip "/dev/shm is no tmpfs"
	local shared
	shared=$(mktemp -d /dev/shm/cbct-doctor-XXXXXX)
	chmod 750 "$shared"
	doctor cbct doctor --json "$shared"
	rmdir "$shared"
	[ $code = 1 ] || fail "exit status 1, got $code"
	has disk problem 'tmpfs: a power cut loses all'
	has sync problem 'which no disk can'
	grep -qE 'cbct doctor: [0-9]+ problems?$' "$work/errors" || fail "how many: $(cat "$work/errors")"
}

test_a_full_disk_is_called_so() {
	disk=$work/small # not local: the trap runs after the function
	mkdir -p "$disk"
	mount -t tmpfs -o size=1m none "$disk" 2>/dev/null || skip "no permission to mount a small tmpfs"
	trap 'umount "$disk"' EXIT
	doctor cbct doctor --json "$disk"
	has sync problem 'No space left on device'
	jq -e 'any(.[]; .subject == "sync" and (.advice | test("make room")))' "$report" >/dev/null || fail "what to do: $(jq -c . "$report")"
}

test_rights_and_directories_that_are_none() {
	mkdir -p "$work/open" && chmod 755 "$work/open"
	doctor cbct doctor --json "$work/open"
	[ $code = 1 ] || fail "exit status 1"
	has rights problem 'may be opened by others \(mode 755\)'
	doctor cbct doctor --json "$work/nowhere"
	has disk problem 'No such file'
	fit
	doctor prlimit --nofile=256:256 cbct doctor --json "$work/fit"
	has limits note 'at most 256 descriptors'
	touch -d '2 days' "$work/fit"
	doctor cbct doctor --json "$work/fit"
	touch "$work/fit"
	has clock problem 'changed later than that'
}

test_cards_and_their_troubles() {
	fit
	printf '61 1000000 3 2\n91 20000000000 -1 -1\n' >"$work/cards"
	doctor LD_LIBRARY_PATH="$BUILD/simulated-nvml" CBCT_TEST_NVML="$work/cards" cbct doctor --json "$work/fit"
	has card ok "NVIDIA's driver 570.86.15"
	has card ok 'card 0 is A "test" card with 24575 of 24576 MiB free, 61 degrees'
	has card problem 'card 0 had 2 errors that could not be corrected'
	has card problem 'card 1 has 91 degrees'
	has card note 'more than half of the memory of card 1'
	[ -e /dev/nvidiactl ] || has card problem '/dev/nvidiactl is not there'
	: >"$work/cards"
	doctor LD_LIBRARY_PATH="$BUILD/simulated-nvml" CBCT_TEST_NVML="$work/cards" cbct doctor --json "$work/fit"
	has card problem 'card 0 does not answer'
}

test_a_daemon_that_runs_is_asked() {
	start_daemon
	doctor CBCT_URL="$url" cbct doctor --json "$state"
	has daemon ok '^it answers: ready'
	stop_daemon
}

run_tests
