#!/usr/bin/env bash
# A mobile C-arm's scan goes in over HTTP and volumes come back, told step by
# step with plain curl. `make demo` builds the programs and runs this.
#
# What happens: a short scan (200 degrees) of a head phantom is simulated with a
# wobbling C-arm and quantum noise; the real daemon is started on a free port;
# the scan, its projections and a job are posted; the first volume (FDK) is
# fetched while the iterations still run; every volume is compared with the
# truth, which a simulation knows. Everything stays under $BUILD/demo.
#
# Lines that begin with $ are the commands themselves; try them on your own.
set -euo pipefail
cd "$(dirname "$0")/../.."
BUILD=${BUILD:-build}
PATH=$(cd "$BUILD" && pwd):$PATH
out=$BUILD/demo
unset CBCT_URL

step() { printf '\n== %s\n' "$*"; }

# Shows a command as one would type it, then runs it. The third descriptor is the
# terminal even where the command's own output goes into a pipe.
exec 3>&1
run() {
	local word line='$'
	for word; do
		[[ $word =~ ^[A-Za-z0-9_@%+=:,./-]+$ ]] || word="'$word'"
		line+=" $word"
	done
	printf '%s\n' "$line" >&3
	"$@"
}

daemon=
stop_daemon() {
	[ -n "$daemon" ] || return 0
	kill -TERM "$daemon" 2>/dev/null || true
	wait "$daemon" 2>/dev/null || true
	daemon=
}
trap stop_daemon EXIT

rm -rf "$out"
mkdir -p "$out"

step "1. A C-arm turns 200 degrees about a head: 124 projections of 256 x 256 pixels, 100 000 photons a pixel"
run cbct simulate -o "$out/scan" --name "demo head" --phantom head --scale 88 --density 0.1 \
	--views 124 --arc 200 --first-angle -100 --columns 256 --rows 256 --pixel 1.2 \
	--source-to-isocentre 750 --source-to-detector 1200 --wobble 4 --photons 100000 \
	--truth "$out/truth.nii" --grid 128 --spacing 1.45
echo "scan.json describes detector and geometry (a calibrated 3x4 matrix for each view, since the arm wobbles):"
jq -c '.geometry.matrices |= "[\(length) matrices of 12 numbers]"' "$out/scan/scan.json"

step "2. The daemon starts on a free port of this machine"
echo "\$ cbctd --listen 127.0.0.1:0 --state-dir $out/state &"
: >"$out/cbctd.out" # the shell below may look at it before the daemon's has made it
cbctd --listen 127.0.0.1:0 --state-dir "$out/state" >"$out/cbctd.out" 2>"$out/cbctd.log" &
daemon=$!
url=
for ((i = 0; i < 200; i++)); do
	url=$(sed -n 's/^listening on //p' "$out/cbctd.out")
	[ -n "$url" ] && break
	kill -0 "$daemon" 2>/dev/null || break
	sleep 0.05
done
if [ -z "$url" ]; then
	echo "cbctd did not start:" >&2
	cat "$out/cbctd.log" >&2
	exit 1
fi
# The daemon answers at once; a worker needs a moment until it can take a job.
for ((i = 0; i < 200; i++)); do
	curl -sf -o /dev/null "$url/readyz" && break
	sleep 0.05
done
cat "$out/cbctd.out"
run curl -sS "$url/v1/devices" | jq -c '.devices[] | {backend, device, state}'

step "3. The scan is announced; the daemon answers with what it understood of the geometry"
run curl -sS --fail-with-body "$url/v1/scans" -H 'Content-Type: application/json' --data-binary "@$out/scan/scan.json" \
	-o "$out/scan-reply.json"
jq -c '{id, missing}, {derived: (.derived | {arc_deg, direction, short_scan, weights, fan_angle_deg, field_of_view_mm})}, {warnings}' \
	"$out/scan-reply.json"
scan=$(jq -r .id "$out/scan-reply.json")

step "4. The first half of the projections, as the arm turns"
one=$((256 * 256 * 4)) # bytes of a projection
head -c $((62 * one)) "$out/scan/projections.raw" >"$out/first-half.raw"
tail -c $((62 * one)) "$out/scan/projections.raw" >"$out/second-half.raw"
run curl -sS --fail-with-body -T "$out/first-half.raw" "$url/v1/scans/$scan/projections/0-61" -o "$out/reply.json"
run curl -sS "$url/v1/scans/$scan" | jq -c '{received, missing}'
run curl -sS --fail-with-body "$url/v1/scans/$scan/projections/61?format=png" -o "$out/projection-61.png"

step "5. A job may be posted before the scan is complete: FDK, then 5 iterations of SART, each followed by TV"
cat >"$out/job.json" <<JSON
{ "scan": "$scan",
  "grid": { "size": [128, 128, 128], "spacing_mm": [1.45, 1.45, 1.45] },
  "fdk":  { "window": "hann" },
  "sart": { "iterations": 5, "subsets": 10 },
  "tv":   { "method": "gradient", "alpha": 0.02, "step": 1, "iterations": 20 },
  "emit": ["fdk", 1, 2, 3, 4] }
JSON
cat "$out/job.json"
run curl -sS --fail-with-body "$url/v1/jobs" -H 'Content-Type: application/json' --data-binary "@$out/job.json" -o "$out/job-reply.json"
jq -c '{id, state}' "$out/job-reply.json"
job=$(jq -r .id "$out/job-reply.json")

step "6. The second half arrives, and the job starts"
run curl -sS --fail-with-body -T "$out/second-half.raw" "$url/v1/scans/$scan/projections/62-123" -o "$out/reply.json"
rm -f "$out/first-half.raw" "$out/second-half.raw"

step "7. Its progress, with ?wait=; each volume is fetched as soon as it is there"
echo "\$ curl -sS '$url/v1/jobs/$job?wait=1'    again and again"
shown= fetched=" "
while :; do
	curl -sS --fail-with-body "$url/v1/jobs/$job?wait=1" -o "$out/job-now.json"
	line=$(jq -r '"   \(.state), \(.stage // "-"), iteration \(.iteration) of \(.iterations)" +
		(if (.history | length) > 0 then ", residual \(.history[-1].residual * 10000 | round / 10000)" else "" end)' "$out/job-now.json")
	[ "$line" = "$shown" ] || echo "$line"
	shown=$line
	state=$(jq -r .state "$out/job-now.json")
	for name in $(curl -sS "$url/v1/jobs/$job/volumes" | jq -r '.volumes | reverse | .[].name'); do
		[[ $fetched == *" $name "* ]] && continue
		run curl -sS --fail-with-body "$url/v1/jobs/$job/volumes/$name" -o "$out/$name.nii"
		fetched+="$name "
	done
	case $state in succeeded | failed | cancelled) break ;; esac
done
if [ "$state" != succeeded ]; then
	jq . "$out/job-now.json"
	exit 1
fi
jq -c '{state, backend, device, timings}' "$out/job-now.json"

step "8. How far each volume is from the truth"
printf '%-8s %22s %12s %8s\n' volume "relative L2 error" "RMSE, HU" SSIM
previous=
for name in $fetched; do
	cbct compare --json --hu "$out/$name.nii" "$out/truth.nii" >"$out/hu.json"
	error=$(cbct compare --json "$out/$name.nii" "$out/truth.nii" | jq '.relative_error * 10000 | round / 10000')
	printf '%-8s %22s %12s %8s\n' "$name" "$error" "$(jq '.rmse * 10 | round / 10' "$out/hu.json")" \
		"$(jq '.ssim * 10000 | round / 10000' "$out/hu.json")"
	if [ -n "$previous" ] && ! jq -en "$error < $previous" >/dev/null; then
		echo "the error did not fall from the volume before" >&2
		exit 1
	fi
	previous=$error
done
rm -f "$out/hu.json"

step "9. Pictures: x to the right, y down, as seen from the feet; black -500, white 500 HU"
for name in truth fdk iter-1 final; do
	run cbct slice "$out/$name.nii" --axis z --index 52 --hu --level 0 --window 1000 --scale 3 -o "$out/$name.png"
done

step "10. Hounsfield units for a viewer, compressed on the way"
run curl -sS --fail-with-body --compressed "$url/v1/jobs/$job/volumes/final?format=mha&type=int16" -o "$out/final-hu.mha"

step "11. The daemon ends; everything it acknowledged is on the disk under $out/state"
stop_daemon
echo
echo "volumes:  $out/{$(echo $fetched | tr ' ' ,)}.nii and final-hu.mha"
echo "pictures: $out/{projection-61,truth,fdk,iter-1,final}.png"
echo "the log:  $out/cbctd.log"
