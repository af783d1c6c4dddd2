#!/usr/bin/env bash
# A volume in Hounsfield units (int16), compressed on the way, and fetched again
# only when it has changed.
#
# Usage: download-hu.sh        (a running daemon: CBCT_URL, default http://127.0.0.1:2228)
set -euo pipefail
url=${CBCT_URL:-http://127.0.0.1:2228}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# A ball of water, reconstructed.
cbct simulate -o "$work" --phantom ball --scale 40 --density 0.0192 --views 120 --columns 96 --rows 96 --pixel 2
scan=$(cbct upload "$work" --url "$url")
job=$(curl -sS --fail-with-body "$url/v1/jobs" -H 'Content-Type: application/json' --data-binary @- <<JSON | jq -r .id
{ "scan": "$scan", "grid": { "size": [64, 64, 48], "spacing_mm": [1.5, 1.5, 1.5] }, "fdk": {} }
JSON
)
until [ "$(curl -sS --fail-with-body "$url/v1/jobs/$job?wait=20" | jq -r .state)" = succeeded ]; do
	curl -sS "$url/v1/jobs/$job" | jq -e '.state != "failed" and .state != "cancelled"' >/dev/null
done

# ?type=int16 is HU = 1000 (mu - mu_water) / mu_water; ?format= is nifti, mha or raw.
volume="$url/v1/jobs/$job/volumes/final?type=int16&format=nifti"
curl -sS --fail-with-body --compressed -o "$work/hu.nii" -w 'status %{http_code}, %{size_download} bytes\n' "$volume"

# The ETag belongs to this very volume, type, format and encoding.
etag=$(curl -sS --fail-with-body -I "$volume" | tr -d '\r' | sed -n 's/^[Ee][Tt]ag: //p')
curl -sS --fail-with-body -o /dev/null -H "If-None-Match: $etag" -w "asked again with $etag: status %{http_code}\n" "$volume"

# Part of a file: the first 352 bytes, NIfTI's own header.
curl -sS --fail-with-body -r 0-351 -o "$work/header" -w 'the header alone: status %{http_code}, %{size_download} bytes\n' "$volume"
cmp -n 352 "$work/header" "$work/hu.nii"

echo "in the middle of the ball, where water is 0 HU:"
cbct compare "$work/hu.nii" --hu --hu-volume --value 0 --region 24-39,24-39,20-27 | head -2
