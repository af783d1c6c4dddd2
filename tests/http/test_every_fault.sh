#!/usr/bin/env bash
# A sample of what tests/soak/test_every_fault.sh does with every call: one fails, and nothing acknowledged is lost.
. "$(dirname "$0")/lib.sh"

test_a_call_that_fails_once_loses_nothing() {
	[ "${SANITIZED:-0}" = 0 ] || skip "the sanitizers' own allocator cannot be loaded beside build/every.so"
	/usr/bin/python3 "$here/every.py" "$BUILD" "$work/every" --processes 2 --stride 7 cbctd:rename:5 cbctd:write:5 cbctd:fsync:5 \
		cbct-worker:fdatasync:5 >"$work/every.log" || fail "all of it holds: $(cat "$work/every.log")"
	tail -1 "$work/every.log"
}

test_memory_that_is_not_to_be_had_once_loses_nothing() {
	[ "${SANITIZED:-0}" = 0 ] || skip "the sanitizers' own allocator cannot be loaded beside build/every.so"
	/usr/bin/python3 "$here/every.py" "$BUILD" "$work/memory" --processes 2 --stride 1499 cbctd:malloc:12 >"$work/memory.log" &&
		/usr/bin/python3 "$here/every.py" "$BUILD" "$work/memory" --processes 2 --stride 150 cbct-worker:malloc:12 >>"$work/memory.log" ||
		fail "all of it holds: $(cat "$work/memory.log")"
	tail -1 "$work/memory.log"
}

test_calls_that_are_interrupted_or_do_half_lose_nothing() {
	[ "${SANITIZED:-0}" = 0 ] || skip "the sanitizers' own allocator cannot be loaded beside build/every.so"
	/usr/bin/python3 "$here/every.py" "$BUILD" "$work/half" --processes 2 --stride 50 cbctd:pwrite:short cbctd:pread:4 cbctd:open:4 \
		cbctd:accept:24 cbctd:recv:4 cbctd:recv:short cbct-worker:pread:short cbct-worker:open:24 cbct-worker:send:4 cbct-worker:mmap:12 \
		>"$work/half.log" || fail "all of it holds: $(cat "$work/half.log")"
	tail -1 "$work/half.log"
}

run_tests
