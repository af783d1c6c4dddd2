#!/usr/bin/env bash
# The house's rules that a machine can check: who includes whom, and what does not belong into the tree.
set -uo pipefail
cd "$(dirname "$0")/.."
failed=0

# found NAME LINES: a rule is broken where there are any
found() {
	[ -n "$2" ] || return 0
	echo "lint: $1"
	sed 's/^/    /' <<<"$2"
	failed=1
}
# rule NAME PATTERN FILE...: no line of the files may match
rule() {
	local name=$1 pattern=$2
	shift 2
	found "$name" "$(grep -nE "$pattern" "$@" /dev/null 2>/dev/null)"
}
files() { find "$@" -name node_modules -prune -o \( -name '*.[ch]' -o -name '*.cu' -o -name '*.cuh' \) -print 2>/dev/null; }

rule "core includes core only" '#include "(kernels|proto|daemon|clients|tests)/' $(files core)
rule "core is mathematics: no JSON, HTTP, SQL, compression, CUDA" '#include <(cjson|microhttpd|sqlite3|libpq|zstd|curl|png|openssl|cuda)' $(files core)
rule "core neither logs nor exits" '\b(printf|fprintf|perror|exit|abort|puts) *\(' $(files core)
rule "kernels include core only" '#include "(proto|daemon|clients|tests)/' $(files kernels)
found "kernels differ between cards below 8.0 and from 8.0 on only, as .ci/run takes for granted" \
	"$(grep -nE '^ *#.*__CUDA_ARCH__' $(files kernels tests) | grep -vE '__CUDA_ARCH__ (<|>=) 800\b')"
rule "proto includes core and proto only" '#include "(kernels|daemon|clients|tests)/' $(files proto)
rule "clients do not include daemon or kernels" '#include "(kernels|daemon|tests)/' $(files clients)
rule "nothing includes daemon but daemon and its tests" '#include "daemon/' $(files core kernels proto clients)
rule "the daemon never touches CUDA" '#include [<"](cuda|cufft|kernels/)' $(files daemon)
rule "libmicrohttpd stays in daemon/http" '#include <microhttpd' $(files daemon | grep -v '^daemon/http/')
rule "SQLite stays in daemon/store/sqlite.c and the files beneath it" '#include [<"](sqlite3|daemon/store/checksum_vfs)' \
	$(files daemon core proto clients | grep -vE '^daemon/store/(sqlite|checksum_vfs|log_index)\.[ch]$')
rule "PostgreSQL stays in daemon/store/postgresql*" '#include [<"](libpq|daemon/store/postgresql)' \
	$(files daemon core proto clients | grep -vE '^daemon/store/postgresql(_[a-z]+)?\.[ch]$')
rule "a database knows no table of the catalogue" '#include "daemon/store/(catalogue|tables|store|internal)' \
	daemon/store/sqlite.c daemon/store/checksum_vfs.[ch] daemon/store/postgresql*.[ch] daemon/store/backend.h
rule "the files beneath SQLite know no statement" '\b(SELECT|INSERT|UPDATE|DELETE|CREATE|PRAGMA [a-z_]+ =)|sqlite3_(prepare|exec|step)' \
	daemon/store/checksum_vfs.[ch]
rule "no struct is bytes in the catalogue" 'COLUMN_BYTES.*AT\(' <(grep COLUMN_BYTES daemon/store/tables.c | grep -vE '(sha256|digest)\)')
found "the README's glossary has at most 30 words" "$(
	sed -n '/^## Glossary/,/^## C/p' README.md | grep -c '^| ' | awk '{ $1 -= 1 } $1 > 30'
)"
found "daemon/THREADS.md does not name the file of a thread" "$(
	grep -l 'pthread_create(' $(files daemon) | sed 's,^daemon/,,' | while read -r file; do
		grep -q "^|.*\`$file\`" daemon/THREADS.md || echo "$file"
	done
)"
found "daemon/THREADS.md names a file that is not there" "$(
	grep -oE '`[a-z/_]+\.[ch]`' daemon/THREADS.md | tr -d '`' | sort -u | while read -r file; do
		[ -e "$file" ] || [ -e "daemon/$file" ] || echo "$file"
	done
)"
found "scripts that their own language cannot read" "$(
	git ls-files '*.sh' | while read -r script; do bash -n "$script" 2>/dev/null || echo "$script"; done
	git ls-files '*.py' | python3 -c '
import ast, sys
for name in sys.stdin.read().split():
    try:
        ast.parse(open(name).read())
    except SyntaxError:
        print(name)'
)"
# The rooms of core/ and daemon/, lowest first, each with those beneath it whose doors it may use; a room's own files
# may include each other. A room's doors are the headers that others may include: ROOM/ROOM.h, or those named in doors.
core_rooms=("scan:" "calibrate: scan" "cpu: scan" "outofcore: scan" "cards: scan" "refine: scan" "correct: scan refine" "fit: scan correct" "recon: scan outofcore refine correct")
daemon_rooms=("http:" "store:" "volumes: store" "jobs: store" "calibrations: store" "sendings: store jobs"
	"fleet: store jobs" "dicom:" "intake: http store"
	"api: http store volumes jobs calibrations sendings fleet intake")
declare -A doors=(
	[daemon/store]="store|ledger"
	[core/scan]="crop|geometry|grid|image|orbit|phantom"
	[core/cpu]="none"
	[core/correct]="averaging|correction|counts|images|input|lag|projection_noise|rings|scatter|scatter_images|shadow|stuck"
	[core/refine]="agreement|reduced|refine"
	[core/fit]="hardening|lag|scatter"
	[core/recon]="algorithm|parameters|quality|recipe|recon|self_test"
)
door() { echo "$1/(${doors[$1]:-$(basename "$1")})\.h"; }
for top in core daemon; do
	declare -n rooms=${top}_rooms
	beneath=" "
	for row in "${rooms[@]}"; do
		room=${row%%:*} others=${row#*:} known="$top/$room/"
		for other in $others; do
			[[ $beneath == *" $other "* ]] || found "$top/$room is above the rooms that it uses" "$other"
			known+="|$(door "$top/$other")"
		done
		beneath+="$room "
		found "$top/$room uses doors, of:${others:- no other room}" \
			"$(grep -nE "#include \"$top/[a-z]+/" "$top/$room"/*.[ch] | grep -vE "\"($known)")"
	done
	found "a folder of $top/ without a row in rooms" \
		"$(for room in "$top"/*/; do [[ $beneath == *" $(basename "$room") "* ]] || echo "$room"; done)"
	found "files of $top/ have at most 700 lines" "$(wc -l "$top"/*.[ch] "$top"/*/*.[ch] | awk '$1 > 700 && $2 != "total"')"
done
# What stands in daemon/ itself serves all rooms and knows none, but for main.c. What stands in core/ itself, the
# backends' contract and what is built on it, knows core/scan; that room knows core/error.h alone.
rule "daemon/*.[ch] serve the rooms and know none" '#include "daemon/[a-z]+/' $(ls daemon/*.[ch] | grep -v daemon/main.c)
rule "daemon/main.c uses doors" '#include "daemon/([a-z]+)/([a-z_]+)\.h"' \
	<(grep -vE '#include "daemon/([a-z]+)/\1\.h"' daemon/main.c)
rule "core/*.[ch] know core/scan and no other room" '#include "core/[a-z]+/' \
	<(cat core/*.[ch] | grep -vE "#include \"$(door core/scan)\"")
rule "core/scan knows core/error.h and nothing above" '#include "core/[a-z_]+\.h"' \
	<(cat core/scan/*.[ch] | grep -v '#include "core/error\.h"')
found "who is outside of core/ uses the doors of its rooms" "$(grep -nE '#include "core/[a-z]+/' $(files kernels proto daemon clients) |
	grep -vE "\"($(for row in "${core_rooms[@]}"; do door "core/${row%%:*}"; done | paste -sd '|'))\"")"

rule "mutexes are made by lock_init, with their rank" 'pthread_mutex_init' $(files daemon | grep -v '^daemon/lock\.c$')
found "daemon/THREADS.md (>) has the locks of daemon/lock.h (<) in their order" \
	"$(diff <(sed -nE 's/^\t(LOCK_[A-Z]+),.*/\1/p' daemon/lock.h) <(sed -nE 's/^\| (LOCK_[A-Z]+) .*/\1/p' daemon/THREADS.md))"
rule "what goes into a list or an object goes by json_append and json_add" 'cJSON_AddItem(To|Ref)' \
	$(files daemon proto | grep -v '^proto/json\.c$')
rule "no process-wide string functions" '\b(strtok|sprintf|strcpy|strcat|gets|localtime|gmtime|strerror_l|rand|srand) *\(' $(files core proto daemon clients)
rule "no unfinished work by its own words" '\b(TODO|FIXME|XXX|HACK)\b' $(files core kernels proto daemon clients tests)

python=${PYTHON:-/usr/bin/python3}
found "docs/rooms.svg is drawn from the includes" "$("$python" docs/rooms.py --check 2>&1)"
found "docs/third-party.md has every library and every package of the page" "$("$python" docs/third-party.py --check 2>&1)"

# http/NAME:TEST, unit/NAME:TEST; without :TEST the file. Commits in the first column of the track record.
found "tests and commits that docs/risks.md and docs/track-record.md name exist" "$(
	grep -ohE '`(http|unit|web)/[a-z_]+(:[a-z0-9_]+)?`' docs/risks.md docs/track-record.md | tr -d '`' | sort -u | while IFS=: read -r file name; do
		case $file in
		unit/*) path=tests/unit/test_${file#unit/}.c pattern="START_TEST($name)" ;;
		*) path=tests/${file%/*}/test_${file#*/}.sh pattern="$name()" ;;
		esac
		grep -qF -- "${name:+$pattern}" "$path" 2>/dev/null || echo "$file${name:+:$name}"
	done
	git rev-parse --is-shallow-repository 2>/dev/null | grep -q false && grep -oE '^\| `[0-9a-f]{7}`' docs/track-record.md | tr -d '|` ' | while read -r commit; do
		git cat-file -e "$commit^{commit}" 2>/dev/null || echo "commit $commit"
	done
)"

found "files that CONTRIBUTING.md and README.md name exist" "$(grep -ohE '`(clients|core|daemon|docs|kernels|proto|tests)/[A-Za-z0-9_./-]+`' \
	CONTRIBUTING.md README.md | tr -d '`' | grep -vE 'NAME|ROOM' | sort -u | while read -r path; do [ -e "$path" ] || echo "$path"; done)"

# A script without the right to run fails only where it is called by its name, which may be on a machine with a card.
found "a file that begins with #! can be run, another can not" "$(git ls-files 2>/dev/null | while read -r file; do
	[ -f "$file" ] || continue
	script=no run=no
	[ "$(head -c2 "$file" | tr -d '\0')" = '#!' ] && script=yes
	[ -x "$file" ] && run=yes
	[ $script = $run ] || echo "$file"
done)"

if command -v clang-format >/dev/null; then
	found "clang-format would change" "$(git ls-files '*.c' '*.h' '*.cu' '*.cuh' 2>/dev/null | while read -r file; do
		[ ! -e "$file" ] || echo "$file"
	done | xargs -r clang-format --dry-run --Werror 2>&1 | grep -E '(error|warning): |^[^ ]*clang-format' | cut -d: -f1 | sort -u)"
else
	echo "lint: clang-format is not here, layout unchecked"
fi
[ $failed = 0 ] && echo "lint: clean"
exit $failed
