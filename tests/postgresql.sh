#!/usr/bin/env bash
# Parts of `make check` with the catalogue of every daemon and every unit test in a PostgreSQL server of their own.
# Usage: tests/postgresql.sh WORD ...   as for tests/run.sh; without words, those that have to do with the catalogue
set -uo pipefail
cd "$(dirname "$0")/.."
. tests/http/postgresql.sh
start_postgresql || { echo "tests/postgresql.sh: ${why:-the server does not start}" >&2; exit 1; }
trap stop_postgresql EXIT
[ $# -gt 0 ] || set -- unit/sums unit/queue unit/job unit/store unit/catalogue http/test_arriving http/test_calibrations \
	http/test_events http/test_job http/test_limits http/test_metrics http/test_quota http/test_restart http/test_scan \
	http/test_send http/test_stream http/test_supervise http/test_annotations
CBCT_TEST_CATALOGUE=$database tests/run.sh "$@"
