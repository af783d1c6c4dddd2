#!/usr/bin/env bash
# The house's rules that a machine can check: who includes whom, and what does not belong into the tree.
set -uo pipefail
cd "$(dirname "$0")/.."
failed=0

# rule NAME PATTERN FILE...: no line of the files may match
rule() {
	local name=$1 pattern=$2 found
	shift 2
	found=$(grep -nE "$pattern" "$@" /dev/null 2>/dev/null) || return 0
	echo "lint: $name"
	sed 's/^/    /' <<<"$found"
	failed=1
}
files() { find "$@" -name node_modules -prune -o \( -name '*.[ch]' -o -name '*.cu' -o -name '*.cuh' \) -print 2>/dev/null; }

rule "core includes core only" '#include "(kernels|proto|daemon|clients|tests)/' $(files core)
rule "core is mathematics: no JSON, HTTP, SQL, compression, CUDA" '#include <(cjson|microhttpd|sqlite3|zstd|curl|png|openssl|cuda)' $(files core)
rule "core neither logs nor exits" '\b(printf|fprintf|perror|exit|abort|puts) *\(' $(files core)
rule "kernels include core only" '#include "(proto|daemon|clients|tests)/' $(files kernels)
rule "proto includes core and proto only" '#include "(kernels|daemon|clients|tests)/' $(files proto)
rule "clients do not include daemon or kernels" '#include "(kernels|daemon|tests)/' $(files clients)
rule "nothing includes daemon but daemon and its tests" '#include "daemon/' $(files core kernels proto clients)
rule "the daemon never touches CUDA" '#include [<"](cuda|cufft|kernels/)' $(files daemon)
rule "libmicrohttpd stays in daemon/http" '#include <microhttpd' $(files daemon | grep -v '^daemon/http/')
rule "SQLite stays in daemon/store" '#include <sqlite3' $(files daemon core proto clients | grep -v '^daemon/store/')
rule "no process-wide string functions" '\b(strtok|sprintf|strcpy|strcat|gets|localtime|gmtime|strerror_l|rand|srand) *\(' $(files core proto daemon clients)
rule "no unfinished work by its own words" '\b(TODO|FIXME|XXX|HACK)\b' $(files core kernels proto daemon clients tests)

if command -v clang-format >/dev/null; then
	for file in $(git ls-files '*.c' '*.h' '*.cu' '*.cuh' 2>/dev/null); do
		[ -e "$file" ] || continue
		clang-format --dry-run --Werror "$file" >/dev/null 2>&1 || { echo "lint: clang-format would change $file"; failed=1; }
	done
else
	echo "lint: clang-format is not here, layout unchecked"
fi
[ $failed = 0 ] && echo "lint: clean"
exit $failed
