# For tests/bench/*.sh, sourced with the project's root as the working directory.

# start_daemon WORK [OPTION ...]: a daemon of its own with WORK for its state, emptied before and removed at the end. Sets
# $daemon, its process, and $url, once a worker is ready.
start_daemon() {
	local work=$1
	shift
	rm -rf "$work"
	mkdir -p "$work"
	: >"$work/out"
	"$BUILD/cbctd" --listen 127.0.0.1:0 --state-dir "$work/state" "$@" >"$work/out" 2>"$work/err" &
	daemon=$!
	# shellcheck disable=SC2064
	trap "kill $daemon 2>/dev/null; wait $daemon 2>/dev/null; rm -rf '$work'" EXIT
	until url=$(sed -n 's/^listening on //p' "$work/out") && [ -n "$url" ]; do
		kill -0 $daemon || { cat "$work/err" >&2; exit 1; }
		sleep 0.05
	done
	until curl -sf -o /dev/null "$url/readyz"; do sleep 0.05; done
}
