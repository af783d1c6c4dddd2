#!/usr/bin/env bash
# `make container` with buildah, on a base that debootstrap makes (DEBIAN_BASE, a folder that it has made, takes the place of
# the mirror), and the image run as its user, who has no rights. Needs root and buildah.
. "$(dirname "$0")/../http/lib.sh"
DEBIAN_MIRROR=${DEBIAN_MIRROR:-http://deb.debian.org/debian}
export STORAGE_DRIVER=vfs BUILDAH_ISOLATION=chroot
storage=(--root "$work/storage" --runroot "$work/run")
running=

descendants() { # PID: innermost first
	local child
	for child in $(pgrep -P "$1"); do
		descendants "$child"
		echo "$child"
	done
}
leave() {
	# buildah passes no signal on.
	[ -z "$running" ] || kill $(descendants "$running") "$running" 2>/dev/null || true
	wait 2>/dev/null || true
	"$real" "${storage[@]}" rm -a >/dev/null 2>&1 || true
	"$real" "${storage[@]}" rmi -a -f >/dev/null 2>&1 || true
	rm -rf "$work/storage" "$work/run" "$work/base" "$work/bin"
}

test_the_image_is_made_and_runs_without_rights() {
	local base=${DEBIAN_BASE:-$work/base} container i
	real=$(command -v buildah) || skip "buildah is not here"
	[ "$(id -u)" = 0 ] || skip "only root makes a base image here"
	trap leave EXIT
	if [ -z "${DEBIAN_BASE:-}" ]; then
		command -v debootstrap >/dev/null || skip "debootstrap is not here"
		debootstrap --variant=minbase bookworm "$base" "$DEBIAN_MIRROR" >"$work/debootstrap.log" 2>&1 || skip "no Debian from $DEBIAN_MIRROR: $(tail -1 "$work/debootstrap.log")"
	fi
	buildah() { "$real" "${storage[@]}" "$@"; }
	container=$(buildah from scratch)
	buildah add -q "$container" "$base/" / >/dev/null && buildah commit -q "$container" localhost/bookworm >/dev/null || fail "a base"
	# The Makefile calls buildah by its name.
	mkdir -p "$work/bin"
	printf '#!/bin/sh\nexec "%s" --root "%s" --runroot "%s" "$@"\n' "$real" "$work/storage" "$work/run" >"$work/bin/buildah"
	chmod 755 "$work/bin/buildah"
	PATH=$work/bin:$PATH make -C "$top" --no-print-directory -o all container CUDA=0 BUILD="$BUILD" CONTAINER_BASE=localhost/bookworm >"$work/made" 2>&1 || fail "make container: $(tail -5 "$work/made")"
	buildah images --format '{{.Name}}:{{.Tag}}' | grep -q '^localhost/cbctd:' || fail "an image"
	buildah inspect --type image localhost/cbctd:$(sed -n 's/^.define CBCT_VERSION "\(.*\)"/\1/p' "$top/proto/version.h") >"$work/image.json"
	jq -e '.OCIv1.config | .User == "cbctd:cbctd" and .Entrypoint[0] == "/usr/bin/cbctd" and (.Volumes | has("/var/lib/cbctd"))' "$work/image.json" >/dev/null || fail "its settings: $(jq .OCIv1.config "$work/image.json")"
	container=$(buildah from "localhost/cbctd:$(sed -n 's/^.define CBCT_VERSION "\(.*\)"/\1/p' "$top/proto/version.h")")
	buildah run "$container" -- sh -c 'id -un; grep CapEff /proc/self/status; touch /etc/x 2>&1' >"$work/who" 2>&1 || true
	grep -qx cbctd "$work/who" || fail "the user: $(cat "$work/who")"
	grep -q 'CapEff:.0000000000000000' "$work/who" || fail "no rights: $(cat "$work/who")"
	grep -qi 'denied' "$work/who" || fail "it cannot write its own programs' folders: $(cat "$work/who")"
	# As its entry point has it, on a free port.
	buildah run "$container" -- /usr/bin/cbctd --config=/etc/cbctd/cbctd.conf --listen 127.0.0.1:0 --listen unix:/run/cbctd/cbctd.sock >"$work/cbctd.out" 2>"$work/cbctd.err" &
	running=$!
	for ((i = 0; i < 200; i++)); do
		url=$(sed -n 's/^listening on \(http:\)/\1/p' "$work/cbctd.out" | head -1)
		[ -n "$url" ] && [ "$(curl -s -o /dev/null -w '%{http_code}' "$url/readyz")" = 200 ] && break
		sleep 0.1
	done
	[ -n "$url" ] || fail "a start: $(cat "$work/cbctd.err")"
	req GET /livez
	expect_status 200
	cbct simulate -o "$work/scan" --phantom head --views 24 --columns 24 --rows 20 --pixel 6 >/dev/null
	reconstruct "$work/scan" '{"scan": "SCAN", "sart": {"iterations": 2}}'
	get_volume final "$work/final.nii"
	buildah run "$container" -- cbct status --url unix:/run/cbctd/cbctd.sock >"$work/healthy" || fail "what HEALTHCHECK asks: $(cat "$work/healthy")"
}

run_tests
