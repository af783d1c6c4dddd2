#!/usr/bin/env bash
# What many clients at once cost on loopback: slices of a 512^3 volume for 50 browsers (goal: 100 oblique ones a second on
# two cores), streamed volumes, 1,000 watchers of one job. Rates and, beside them, the daemon's own processor time, which says the same on a machine with others on it.
# A table, and $BUILD/bench/live.txt. Arguments: only these parts (slices, stream, watchers).
set -euo pipefail
cd "$(dirname "$0")/../.."
BUILD=$(realpath "${BUILD:-build}")
. tests/bench/lib.sh
work=$BUILD/bench/live
wanted=${*:-slices stream watchers}
ulimit -n "$(ulimit -Hn)"
export PATH=$BUILD:$PATH

start_daemon "$work" --backend cpu
export CBCT_URL=$url
port=${url##*:}

say() { tee -a "$BUILD/bench/live.txt"; }
cpu() { awk -v hz="$(getconf CLK_TCK)" '{ print ($14 + $15) / hz }' /proc/$daemon/stat; } # s, of the daemon alone
per() { awk "BEGIN { printf \"%.2f\", $1 }"; }
echo "$(date -u +%Y-%m-%dT%H:%M:%SZ) $(git rev-parse --short HEAD 2>/dev/null), $(nproc) processors, load $(cut -d' ' -f1 /proc/loadavg)" >"$BUILD/bench/live.txt"
cat "$BUILD/bench/live.txt"

# noise like that of a real scan: what is smooth compresses too well
scan_of() { # COLUMNS VIEWS
	cbct simulate --phantom shepp-logan --columns "$1" --rows "$1" --pixel $((384 / $1)) --views "$2" --arc 360 --photons 2000 \
		--source-to-isocentre 600 --source-to-detector 1000 -o "$work/scan$1" >/dev/null
	cbct upload "$work/scan$1"
}

if [[ $wanted == *s[lt]* ]]; then
	job=$(cbct submit "$(scan_of 128 40)" --fdk hann --grid 512 --spacing 0.4 --wait 2>/dev/null)
fi

if [[ $wanted == *slices* ]]; then
	for axis in z y x random oblique; do
		before=$(cpu)
		line=$("$BUILD/slices" "$port" "$job" 512 50 8 $([ $axis = random ] || echo $axis))
		count=$(sed 's/.*: \([0-9]*\) slices.*/\1/' <<<"$line")
		echo "$line; daemon $(per "1e3 * ($(cpu) - $before) / ($count * 8)") ms of a processor each" | say
	done
fi

if [[ $wanted == *stream* ]]; then
	for query in 'format=raw&type=int16' format=shuffled; do
		for reader in first second; do
			before=$(cpu)
			seconds=$(curl -sN -H 'Accept-Encoding: zstd' -o /dev/null -w '%{time_total}' "$url/v1/jobs/$job/stream?$query")
			echo "stream 512^3, $query, zstd, $reader reader: $seconds s, $(per "268.4e-3 / $seconds") GB/s of int16 voxels" \
				"($(per "536.9e-3 / $seconds") of float32); daemon $(per "$(cpu) - $before") s of processors" | say
		done
	done
	# a stream that waits, against the time at which the volume was recorded
	live=$(cbct submit "$(scan_of 64 60)" --grid 64 --spacing 3 --sart 60 --subsets 4 --emit "$(seq -s, 5 5 60)")
	curl -sN "$url/v1/jobs/$live/stream" | LC_ALL=C grep -a --line-buffered '^CBCT-Volume' |
		while read -r _ name; do echo "${name%$'\r'} $EPOCHREALTIME"; done >"$work/arrived"
	curl -s "$url/v1/jobs/$live/volumes" | jq -r '.volumes[] | "\(.name) \(.created)"' | while read -r name created; do
		awk -v name="$name" -v made="$(date -d "$created" +%s.%N)" '$1 == name { print 1000 * ($2 - made) }' "$work/arrived"
	done | sort -g >"$work/delays"
	echo "kept to first byte in a waiting stream, ms: median $(sed -n "$(($(wc -l <"$work/delays") / 2 + 1))p" "$work/delays")," \
		"most $(tail -1 "$work/delays")" | say
fi

if [[ $wanted == *watchers* ]]; then
	scan=$(scan_of 64 60)
	job_seconds() { # WATCHERS GRID ITERATIONS
		local id pid=
		id=$(cbct submit "$scan" --grid "$2" --spacing "$(per "192 / $2")" --sart "$3" --subsets 2)
		if [ "$1" != 0 ]; then
			rm -f "$work/created"
			mkfifo "$work/created"
			# niced: what the clients take is not the daemon's
			nice -n 19 "$BUILD/watchers" "$port" "$id" "$1" "$work/created" >"$work/watched" &
			pid=$!
			sleep 3
			awk '/RssAnon/ { print $2 / 1000 }' /proc/$daemon/status >"$work/memory"
		fi
		until curl -s "$url/v1/jobs/$id?wait=60" | jq -e '.state == "succeeded"' >/dev/null; do :; done
		curl -s "$url/v1/jobs/$id" | jq .timings.sart
		[ -n "$pid" ] || return 0
		kill -0 $pid # it reads what comes now
		# a copy: the catalogue of a running daemon is its own
		cp "$work/state/catalogue.sqlite" "$work/copy.sqlite"
		cp "$work/state/catalogue.sqlite-wal" "$work/copy.sqlite-wal"
		sqlite3 -separator ' ' "$work/copy.sqlite" "SELECT e.number, printf('%.6f', e.created)
			FROM events e JOIN jobs j ON j.number = e.job WHERE j.id = '$id'" >"$work/created"
		wait $pid
	}
	# 30 iterations a second, then as many as a small scan has
	for job in "96 200" "96 200" "96 200" "192 50" "192 50" "192 50"; do
		# shellcheck disable=SC2086
		alone=$(job_seconds 0 $job)
		before=$(cpu)
		# shellcheck disable=SC2086
		watched=$(job_seconds 1000 $job)
		used=$(per "$(cpu) - $before")
		{
			echo "1,000 watchers: job of ${job#* } iterations of ${job% *}^3 $alone s alone, $watched s watched ($(per "100 * ($watched / $alone - 1)") % slower);" \
				"daemon $used s of a processor, $(cat "$work/memory") MB of memory of its own"
			cat "$work/watched"
		} | say
	done
fi
