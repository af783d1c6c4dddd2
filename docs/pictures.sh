#!/usr/bin/env bash
# docs/page.png and docs/before-after.png, from a real run: a daemon of its own, a simulated scan of the head of Kak and
# Slaney (exact line integrals, Poisson noise), a job with FDK, SART and TV, the page in Chromium. `make pictures`.
set -euo pipefail
top=$(cd "$(dirname "$0")/.." && pwd)
BUILD=$(cd "$top" && realpath "${BUILD:-build}")
PATH=$BUILD:$PATH
work=$BUILD/pictures
rm -rf "$work"
mkdir -p "$work/tools"

views=90 photons=6000 size=144,176,176 spacing=1
cbct simulate --phantom head --scale 84 --density 0.06 --views $views --photons $photons --columns 220 --rows 220 --pixel 1.6 --patient HFS --name 'Head 7' \
	-o "$work/scan" --truth "$work/truth.nii" --grid $size --spacing $spacing >/dev/null
cbctd --listen 127.0.0.1:0 --state-dir "$work/state" --backend cpu >"$work/out" 2>"$work/err" &
daemon=$!
trap 'kill $daemon' EXIT
for ((i = 0; i < 200; i++)); do
	CBCT_URL=$(sed -n 's/^listening on //p' "$work/out")
	[ -n "$CBCT_URL" ] && [ "$(curl -s -o /dev/null -w '%{http_code}' "$CBCT_URL/readyz")" = 200 ] && break
	sleep 0.05
done
export CBCT_URL
scan=$(cbct upload "$work/scan" | tail -1)
job=$(curl -sf "$CBCT_URL/v1/jobs" -H 'Content-Type: application/json' -d "{\"scan\": \"$scan\", \"grid\": {\"size\": [$size], \"spacing_mm\": [$spacing, $spacing, $spacing]},
	\"fdk\": {}, \"sart\": {}, \"tv\": {}, \"emit\": [\"fdk\", 1, 2, 5]}" | jq -r .id)
until [ "$(curl -sf "$CBCT_URL/v1/jobs/$job?wait=60" | jq -r .state)" = succeeded ]; do :; done

# The same plane three times, in the same window.
index=67 window=900 level=-450
for volume in fdk final; do
	curl -sf -o "$work/$volume.png" "$CBCT_URL/v1/jobs/$job/volumes/$volume/slice?axis=z&index=$index&window=$window&level=$level"
done
cbct slice "$work/truth.nii" --axis z --index $index --hu --window $window --level="$level" -o "$work/truth.png"

cp "$top"/tests/web/package*.json "$work/tools/"
(cd "$work/tools" && npm ci --ignore-scripts --no-audit --no-fund) >"$work/npm.log" 2>&1
cp "$top/docs/pictures.mjs" "$work/tools/"
WORK=$work TO=$top/docs JOB=$job VIEWS=$views CHROMIUM=$(command -v chromium || command -v chromium-browser) node "$work/tools/pictures.mjs"
