#!/usr/bin/env bash
# The page as $1/assets.c, by npm's esbuild; without npm or its registry an empty table, aloud: the daemon then has its
# plain page only. $1/without then tells the Makefile to try again each time.
set -uo pipefail
mkdir -p "$1/npm"
to=$(realpath "$1")
cd "$(dirname "$0")" || exit 1

without() {
	echo "building without the web page: $*" >&2
	printf '#include "daemon/api/assets.h"\n\nconst struct asset assets[] = {{0}};\n' >"$to/without"
	cmp -s "$to/without" "$to/assets.c" || cp "$to/without" "$to/assets.c"
	rm -rf "$to/files"
	exit 0
}

command -v node >/dev/null && command -v npm >/dev/null || without "node or npm is not here"
[ "$(node -p 'parseInt(process.versions.node)')" -ge 18 ] 2>/dev/null || without "node $(node --version) is older than 18"
if ! cmp -s package-lock.json "$to/npm/installed"; then
	cp package.json package-lock.json "$to/npm/"
	(cd "$to/npm" && npm ci --ignore-scripts --no-audit --no-fund --fetch-retries=1 --fetch-timeout=30000) >"$to/npm.log" 2>&1 ||
		without "npm cannot install its packages: $(grep -m 1 -iE 'err' "$to/npm.log")"
	cp package-lock.json "$to/npm/installed"
fi
# What fails from here on is ours.
rm -f "$to/without"
cp -r build.mjs src licences "$to/npm/"
node "$to/npm/build.mjs" "$to"
