#!/usr/bin/env bash
# A machine that loses its power a few times: tests/http/cuts.py, with fewer cuts than tests/soak/test_cuts.sh.
. "$(dirname "$0")/lib.sh"

test_a_machine_that_loses_its_power_loses_nothing_that_was_acknowledged() {
	need_mounts
	in_own_mounts /usr/bin/python3 "$here/cuts.py" "$BUILD" "$work/cuts" --uploads 6 --jobs 4 --iterations 40 ${SEED:+--seed "$SEED"} >"$work/cuts.log" ||
		fail "nothing is lost: $(cat "$work/cuts.log")"
	cat "$work/cuts.log"
}

run_tests
