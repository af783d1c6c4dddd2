#!/usr/bin/env bash
# Bits flipped, files cut off and deleted at random in a state directory, by the thousand: tests/http/damage.py.
. "$(dirname "$0")/../http/lib.sh"

test_ten_thousand_damages_are_found_repaired_or_harmless() {
	/usr/bin/python3 "$top/tests/http/damage.py" "$BUILD" "$work/damage" "${ROUNDS:-10000}" ${SEED:-} >"$work/damage.log" || fail "no silent difference: $(cat "$work/damage.log")"
	head -1 "$work/damage.log"
	tail -1 "$work/damage.log"
}

run_tests
