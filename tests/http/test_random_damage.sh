#!/usr/bin/env bash
# Bits flipped, files cut off and deleted at random in a state directory: tests/http/damage.py. The long form is
# tests/soak/test_random_damage.sh; a round that failed is found again with its seed.
. "$(dirname "$0")/lib.sh"

test_damage_is_found_repaired_or_harmless() {
	local rounds=40
	[ "${SANITIZED:-0}" = 0 ] || rounds=10
	/usr/bin/python3 "$here/damage.py" "$BUILD" "$work/damage" $rounds "${SEED:-7}" >"$work/damage.log" || fail "no silent difference: $(cat "$work/damage.log")"
	tail -1 "$work/damage.log"
}

run_tests
