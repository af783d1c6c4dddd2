#!/usr/bin/env bash
# An upload that was interrupted goes on where it stopped: `missing` in the
# scan's document says what has not arrived. Sending a projection twice does no
# harm (201 the first time, 200 for the same bytes, 409 for other bytes).
#
# Usage: resume-upload.sh      (a running daemon: CBCT_URL, default http://127.0.0.1:2228)
set -euo pipefail
url=${CBCT_URL:-http://127.0.0.1:2228}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# Something to send: 40 projections of 64 x 48 float32.
columns=64 rows=48 count=40
one=$((columns * rows * 4))
cbct simulate -o "$work" --phantom ball --scale 30 --views $count --columns $columns --rows $rows --pixel 4
scan=$(curl -sS --fail-with-body "$url/v1/scans" -H 'Content-Type: application/json' --data-binary "@$work/scan.json" | jq -r .id)
echo "scan $scan"

# All in one request, but the line breaks after 12 projections and a half: curl promises
# the whole length, and is stopped once it has sent less.
echo "the connection breaks ..."
{ head -c $((one * 25 / 2)) "$work/projections.raw"; sleep 2; } |
	curl -sS -m 1 -T - -H "Content-Length: $((one * count))" -H 'Transfer-Encoding:' \
		"$url/v1/scans/$scan/projections" 2>/dev/null || true

# What is whole stayed. The daemon notices the break a moment later.
for ((i = 0; i < 50; i++)); do
	missing=$(curl -sS --fail-with-body "$url/v1/scans/$scan" | jq -c .missing)
	[ "$missing" != "[[0,$((count - 1))]]" ] && break
	sleep 0.1
done
echo "missing: $missing"

# Each missing run is one request, with a digest of its bytes (RFC 9530) that the daemon checks.
jq -r '.[] | "\(.[0]) \(.[1])"' <<<"$missing" | while read -r first last; do
	head -c $(((last + 1) * one)) "$work/projections.raw" | tail -c $(((last - first + 1) * one)) >"$work/run"
	digest=$(openssl dgst -sha256 -binary "$work/run" | base64)
	curl -sS --fail-with-body -o /dev/null -w "projections $first-$last: status %{http_code}\n" \
		-H "Content-Digest: sha-256=:$digest:" -T "$work/run" "$url/v1/scans/$scan/projections/$first-$last"
done

curl -sS --fail-with-body "$url/v1/scans/$scan" | jq -e -c '{received, missing}, (.missing == [] or error("not complete"))' | head -1
curl -sS --fail-with-body -X DELETE "$url/v1/scans/$scan"
