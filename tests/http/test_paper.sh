#!/usr/bin/env bash
# The short form of `make paper`: the study's Fig 7 through HTTP, held to the errors that the project has set itself.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}

test_tv_halves_the_error_that_noise_drives_up() {
	"$python" -c 'import numpy, requests' 2>/dev/null || skip "python3-numpy and python3-requests are not here"
	PYTHONDONTWRITEBYTECODE=1 timeout 200 "$python" "$top/tests/paper/experiments.py" --build "$BUILD" --backend cpu --size small \
		--only '^fig7-(plain|tv)$' --results "$work/results" >"$work/log" || fail "the experiments to run: $(tail -3 "$work/log")"
	# As tests/unit/test_study.c has it; the climb is a property of the data.
	errors() { jq -c '[.rows[].relative] | [.[0], min, .[-1]]' "$work/results/$1".cpu-*.json; }
	jq -ne --argjson plain "$(errors fig7-plain)" --argjson tv "$(errors fig7-tv)" \
		'$plain[1] < 0.49 and $plain[2] > 0.62 and $tv[2] <= 0.35 and $tv[2] <= 0.52 * $plain[2]' >/dev/null ||
		fail "errors first, least, last below .49, above .62 without TV and at most .35 with it: $(errors fig7-plain), $(errors fig7-tv)"
	jq -e '.rows | length == 50 and all(.[]; .residual > 0 and .seconds > 0)' "$work"/results/fig7-tv.cpu-*.json >/dev/null ||
		fail "50 rows with residual and seconds"
}

test_one_report_of_the_results() {
	"$python" -c 'import matplotlib' 2>/dev/null || skip "python3-matplotlib is not here"
	"$python" -c 'import requests' 2>/dev/null || skip "python3-requests is not here"
	timeout 100 "$python" "$top/tests/paper/report.py" "$work/results" "$work/paper" >/dev/null || fail "a report of what the test before has left"
	[ "$(grep -c '<img alt=' "$work/paper.html")" -ge 2 ] || fail "pictures in the report"
	! grep -E 'src="[^d]|href=' "$work/paper.html" || fail "a report that needs no other file"
	[ "$(head -c 5 "$work/paper.pdf")" = %PDF- ] || fail "a PDF"
}

run_tests
