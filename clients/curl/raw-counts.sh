#!/usr/bin/env bash
# Raw detector counts in place of line integrals: the flat (open beam) and dark
# images are sent once, and the daemon computes p = -ln((I - dark) / (flat - dark)).
# Dead pixels are replaced from their neighbours and reported as a warning.
#
# Usage: raw-counts.sh         (a running daemon: CBCT_URL, default http://127.0.0.1:2228)
set -euo pipefail
url=${CBCT_URL:-http://127.0.0.1:2228}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# uint16 counts of an uneven detector of which one pixel in a thousand is dead.
cbct simulate -o "$work" --phantom ball --scale 30 --density 0.02 --views 90 --columns 80 --rows 64 --pixel 2.5 \
	--raw flat --sample uint16 --photons 100000 --defects 0.001
jq -c .projections "$work/scan.json"

scan=$(curl -sS --fail-with-body "$url/v1/scans" -H 'Content-Type: application/json' --data-binary "@$work/scan.json" | jq -r .id)
for image in flat dark; do
	curl -sS --fail-with-body -o /dev/null -w "$image: status %{http_code}\n" -T "$work/$image.f32" "$url/v1/scans/$scan/$image"
done
curl -sS --fail-with-body -o /dev/null -w 'projections: status %{http_code}\n' -T "$work/projections.raw" "$url/v1/scans/$scan/projections"

job=$(curl -sS --fail-with-body "$url/v1/jobs" -H 'Content-Type: application/json' --data-binary @- <<JSON | jq -r .id
{ "scan": "$scan", "grid": { "size": [48, 48, 32], "spacing_mm": [1.5, 1.5, 1.5] }, "fdk": {} }
JSON
)
until [ "$(curl -sS --fail-with-body "$url/v1/jobs/$job?wait=20" | jq -r .state)" = succeeded ]; do
	curl -sS "$url/v1/jobs/$job" | jq -e '.state != "failed" and .state != "cancelled"' >/dev/null
done
curl -sS --fail-with-body "$url/v1/jobs/$job" | jq -c .warnings
curl -sS --fail-with-body -o "$work/volume.nii" "$url/v1/jobs/$job/volumes/final"
echo "in the middle of the ball of 0.02/mm:"
cbct compare "$work/volume.nii" --value 0.02 --region 18-29,18-29,12-19 | sed -n 2,3p
