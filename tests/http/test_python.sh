#!/usr/bin/env bash
# The Python client: every public function against a running daemon, over connections that break; its types.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}

scan_dir=$work/ball
cbct simulate --phantom ball --scale 30 --density 0.02 --shift 12,-9,10 --views 60 --arc 360 --columns 64 --rows 48 --pixel 4 \
	--source-to-isocentre 600 --source-to-detector 1000 -o "$scan_dir" >/dev/null || exit 1

client() { # CLASS: its tests in python_client.py
	"$python" -c 'import numpy, requests' 2>/dev/null || skip "python3-numpy and python3-requests are not here"
	PARAMETERS=$work/parameters.json SCAN_DIR=$scan_dir PYTHONPATH=$top/clients/python PYTHONDONTWRITEBYTECODE=1 timeout 300 "$python" "$here/python_client.py" "$1"
}

test_scans_and_uploads() { client Scans; }
test_jobs_and_refusals() { client Jobs; }
test_wrong_values_are_refused_before_they_are_sent() {
	cbct parameters --json >"$work/parameters.json"
	client Checks
}
test_volumes_as_arrays() { client Volumes; }
test_events() { client Events; }
test_reconstruction_in_one_call() { client Recon; }

test_a_busy_daemon_is_asked_again() {
	stop_daemon
	start_daemon --max-connections-per-address 8
	client Busy
}

test_types() {
	command -v mypy >/dev/null || skip "mypy is not here"
	mypy --config-file "$top/clients/python/pyproject.toml" --cache-dir "$work/mypy" "$top/clients/python/cbctd.py"
}

start_daemon || exit 1
run_tests
