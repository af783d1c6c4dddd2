# A PostgreSQL server of Debian's for one test, sourced by test_postgresql.sh and tests/postgresql.sh: in a folder of its
# own, as a user that is not root, on a Unix socket in that folder, and on $pg_address where that is set. The database is thrown away, so
# nothing is synced: what a `kill -9` of the server leaves is in the kernel's memory.

# s for one unit test, in place of check's 4: a store that is opened asks the server hundreds of times, and a test opens up
# to seven of them, which takes a second alone and many on a machine with much else to do.
export CK_DEFAULT_TIMEOUT=120

# Sets $database, the address for --catalogue. Returns 1 where there is no server to start, with $why.
start_postgresql() {
	local programs
	programs=$(ls -d /usr/lib/postgresql/*/bin 2>/dev/null | sort -V | tail -1)
	if [ ! -x "${programs:-none}/initdb" ]; then
		why="PostgreSQL is not installed"
		return 1
	fi
	pg_programs=$programs
	pg_folder=$(mktemp -d "${TMPDIR:-/tmp}/cbct-postgresql-XXXXXX")
	as_server=()
	if [ "$(id -u)" = 0 ]; then
		chmod 755 "$pg_folder"
		mkdir "$pg_folder/server"
		chown 65534:65534 "$pg_folder/server"
		as_server=(setpriv --reuid 65534 --regid 65534 --clear-groups)
	else
		mkdir "$pg_folder/server"
	fi
	"${as_server[@]}" "$programs/initdb" -D "$pg_folder/server/data" -U cbctd -A trust -E UTF8 --locale C.UTF-8 --no-sync >"$pg_folder/log" 2>&1 ||
		{ cat "$pg_folder/log" >&2; return 1; }
	cat >>"$pg_folder/server/data/postgresql.conf" <<-END
		listen_addresses = '${pg_address:-}'
		unix_socket_directories = '$pg_folder/server'
		fsync = off
		max_connections = 60
		shared_buffers = 16MB
	END
	[ -z "${pg_address:-}" ] || echo "host all all samenet trust" >>"$pg_folder/server/data/pg_hba.conf"
	database="postgresql://cbctd@/postgres?host=$pg_folder/server"
	start_server
}
start_server() {
	"${as_server[@]}" "$pg_programs/pg_ctl" -D "$pg_folder/server/data" -l "$pg_folder/server/log" -w -t 30 start >/dev/null ||
		{ tail -20 "$pg_folder/server/log" >&2; return 1; }
	pg_pid=$(head -1 "$pg_folder/server/data/postmaster.pid")
}
# All of its processes, the server's first.
server_processes() {
	echo "$pg_pid"
	pgrep -P "$pg_pid" || true
}
kill_server() { # at once, all of it
	local all
	all=$(server_processes)
	kill -9 $all 2>/dev/null
	while kill -0 "$pg_pid" 2>/dev/null; do sleep 0.02; done
}
stop_postgresql() {
	[ -n "${pg_folder:-}" ] || return 0
	kill -CONT $(server_processes) 2>/dev/null || true
	"${as_server[@]}" "$pg_programs/pg_ctl" -D "$pg_folder/server/data" -m immediate stop >/dev/null 2>&1 || true
	rm -rf "$pg_folder"
	pg_folder=
}
sql() { # STATEMENT: its rows
	"$pg_programs/psql" -XAtq -h "$pg_folder/server" -U cbctd -d postgres -c "$1"
}
