#!/usr/bin/env bash
# A job is cancelled while it runs: the daemon answers 202 at once and the job
# ends between two steps. What it has kept so far stays until the job is deleted
# a second time.
#
# Usage: cancel-job.sh         (a running daemon: CBCT_URL, default http://127.0.0.1:2228)
set -euo pipefail
url=${CBCT_URL:-http://127.0.0.1:2228}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

cbct simulate -o "$work" --phantom ball --scale 30 --views 60 --columns 64 --rows 48 --pixel 4
scan=$(cbct upload "$work" --url "$url")

# Far more iterations than anybody waits for.
job=$(curl -sS --fail-with-body "$url/v1/jobs" -H 'Content-Type: application/json' --data-binary @- <<JSON | jq -r .id
{ "scan": "$scan", "grid": { "size": [64, 64, 48], "spacing_mm": [2, 2, 2] },
  "fdk": {}, "sart": { "iterations": 100000, "subsets": 10 }, "emit": ["fdk"] }
JSON
)
echo "job $job"

# Until the FDK volume is there.
for ((i = 0; i < 600; i++)); do
	names=$(curl -sS --fail-with-body "$url/v1/jobs/$job/volumes" | jq -r '.volumes[].name')
	[[ $names == *fdk* ]] && break
	sleep 0.1
done
curl -sS --fail-with-body "$url/v1/jobs/$job" | jq -c '{state, stage, iteration}'

echo "cancel:"
curl -sS --fail-with-body -o /dev/null -w 'status %{http_code}\n' -X DELETE "$url/v1/jobs/$job"
state=$(curl -sS --fail-with-body "$url/v1/jobs/$job?wait=30" | jq -r .state)
echo "state: $state"
[ "$state" = cancelled ]
curl -sS --fail-with-body "$url/v1/jobs/$job/volumes" | jq -c '{kept: [.volumes[].name]}'

echo "remove the job and its volumes, then the scan:"
curl -sS --fail-with-body -o /dev/null -w 'status %{http_code}\n' -X DELETE "$url/v1/jobs/$job"
curl -sS --fail-with-body -o /dev/null -w 'status %{http_code}\n' -X DELETE "$url/v1/scans/$scan"
