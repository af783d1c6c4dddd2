#!/usr/bin/env bash
# Who may: tokens, roles, sessions.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}
command -v "$python" >/dev/null || python=python3
tokens=$work/tokens
declare -A token
json=(-H 'Content-Type: application/json')
document='{"name": "DOE^JANE knee", "detector": {"columns": 16, "rows": 12, "pixel_mm": [4, 4]},
  "projections": {"count": 6, "sample": "float32", "quantity": "line_integral"},
  "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "first_angle_deg": 0, "angle_step_deg": 60}}'

as() { bearer=(-H "Authorization: Bearer ${token[$1]}"); }
expired() { printf '%s acquire 2020-01-01T00:00:00Z sha256:%s\n' "$1" "$(printf %s "$2" | sha256sum | cut -d' ' -f1)" >>"$tokens"; }
log_has() { # TEXT: soon, in what the daemon has logged
	local i
	for ((i = 0; i < 2400; i++)); do grep -q "$1" "$work/cbctd.err" && return 0; sleep 0.05; done
	fail "a line of the log with $1: $(tail -3 "$work/cbctd.err")"
}
reload() { # TEXT of the log
	: >"$work/cbctd.err"
	kill -HUP "$(cat "$work/daemon.pid")"
	log_has "$1"
}

rm -f "$tokens"
for role in view acquire admin; do token[$role]=$(cbct token new "the-$role" --role $role --file "$tokens" 2>/dev/null); done
token[expired]=cbct_once-it-was-good
expired the-old "${token[expired]}"

test_without_tokens_nobody_is_asked() {
	local state=$work/open
	start_daemon
	req POST /v1/scans "${json[@]}" --data-binary "$document"
	expect_status 201
	req GET /v1/session -H 'Authorization: Bearer whatever'
	expect_status 200
	expect_json '.name == null and .role == "admin" and .proof == "not asked"'
	req POST /v1/session
	expect_problem 409
	stop_daemon
}

test_the_file_has_no_token_and_is_for_its_owner_alone() {
	local role
	[ "$(stat -c %a "$tokens")" = 600 ] || fail "mode 600, got $(stat -c %a "$tokens")"
	for role in view acquire admin; do
		[ ${#token[$role]} -ge 48 ] || fail "256 bits of token: ${token[$role]}"
		! grep -qF "${token[$role]}" "$tokens" || fail "no token in the file"
		grep -q "^the-$role $role .* sha256:$(printf %s "${token[$role]}" | sha256sum | cut -d' ' -f1)$" "$tokens" || fail "its digest in the file"
	done
	[ "$(cbct token list --file "$tokens" | wc -l)" = 4 ] || fail "four tokens in the list"
	cbct token list --file "$tokens" | grep '^the-old .*expired$' >/dev/null || fail "the old one as expired"
	! cbct token new the-view --file "$tokens" 2>/dev/null || fail "a name is given once"
	! cbct token new 'a b' --file "$tokens" 2>/dev/null || fail "a name is one word"
	! cbct token new never-born --expires 2031-02-30 --file "$tokens" 2>/dev/null || fail "no February has 30 days"
	! cbct token new stillborn --expires 2020-01-01 --file "$tokens" 2>/dev/null || fail "a token that is over already"
	! cbct token revoke nobody --file "$tokens" 2>/dev/null || fail "who is not there cannot be revoked"
}

test_the_daemon_starts_with_a_good_file_only() {
	local bad=$work/bad line mode
	refused() { # WHAT THE ERROR SAYS
		! timeout 10 cbctd --listen 127.0.0.1:0 --state-dir "$work/none" --tokens "$bad" >"$work/refused" 2>&1 || fail "no start"
		grep -q "$1" "$work/refused" || fail "$1 in $(cat "$work/refused")"
	}
	rm -f "$bad"
	refused 'No such file'
	for mode in 604 620 602 666; do
		cp "$tokens" "$bad"
		chmod $mode "$bad"
		refused "mode 0$mode"
	done
	chmod 600 "$bad"
	for line in 'one' 'one view' 'one view never' 'one view never sha256:00' 'one boss never certificate' 'one view,boss never certificate' \
		'one view tomorrow certificate' 'one view never certificate more' 'a/b view never certificate' "$(sed -n 's/^the-view/another/p' "$tokens")" \
		"the-view view never certificate"; do
		{ cat "$tokens"; echo "$line"; } >"$bad"
		refused 'tokens, line 5'
	done
}

test_each_operation_is_for_the_roles_that_the_schema_says() {
	local role name=cbctd_session_[0-9]*
	start_daemon --tokens "$tokens" --listen "unix:$work/socket"
	"$python" "$top/proto/openapi.py" --json "$top/proto/openapi.yaml" >"$work/openapi.json" 2>/dev/null || req GET /v1/openapi.json -o "$work/openapi.json"
	for role in view acquire admin; do
		as $role
		req POST /v1/session "${bearer[@]}"
		expect_status 201
		token[cookie $role]=$(header set-cookie | sed "s/^$name=\([^;]*\);.*/\1/")
	done
	for role in "${!token[@]}"; do jq -n --arg k "$role" --arg v "${token[$role]}" '{($k): $v}'; done | jq -s add >"$work/proofs.json"
	"$python" "$here/access.py" "$url" "$work/openapi.json" "$work/proofs.json" || fail "each operation as its security says"
	"$python" "$here/access.py" "unix:$work/socket" "$work/openapi.json" "$work/proofs.json" || fail "the same on a Unix socket"
	stop_daemon
}

test_roles_work_from_scan_to_volume() {
	start_daemon --tokens "$tokens"
	req GET /v1/scans
	expect_problem 401
	[ "$(header www-authenticate)" = 'Bearer realm="cbctd"' ] || fail "a challenge, got $(header www-authenticate)"
	as view
	req POST /v1/scans "${bearer[@]}" "${json[@]}" --data-binary "$document"
	expect_problem 403
	as acquire
	req POST /v1/scans "${bearer[@]}" "${json[@]}" --data-binary "$document"
	expect_status 201
	scan=$(json .id)
	head -c $((6 * 16 * 12 * 4)) /dev/zero >"$work/zeros"
	req PUT "/v1/scans/$scan/projections" -T "$work/zeros"
	expect_problem 401
	as view
	req PUT "/v1/scans/$scan/projections" "${bearer[@]}" -T "$work/zeros"
	expect_problem 403
	req GET "/v1/scans/$scan" "${bearer[@]}"
	expect_json '.received == []'
	as acquire
	req PUT "/v1/scans/$scan/projections" "${bearer[@]}" -T "$work/zeros"
	expect_status 201
	as view
	req DELETE "/v1/scans/$scan" "${bearer[@]}"
	expect_problem 403
	as acquire
	req DELETE "/v1/scans/$scan" "${bearer[@]}"
	expect_status 204
	stop_daemon
}

# A browser sends cookies to all ports of a host.
test_two_daemons_of_one_host_keep_their_sessions() {
	local jar=$work/jar first second
	rm -f "$jar"
	start_daemon --tokens "$tokens"
	as view
	req POST /v1/session "${bearer[@]}" -c "$jar" -b "$jar"
	expect_status 201
	first=$url
	"$BUILD/cbctd" --listen 127.0.0.1:0 --state-dir "$work/second" --backend cpu --tokens "$tokens" >"$work/second.out" 2>/dev/null &
	second=$!
	for _ in $(seq 200); do
		url=$(sed -n 's/^listening on \(http:\)/\1/p' "$work/second.out")
		[ -z "$url" ] || break
		sleep 0.05
	done
	req POST /v1/session "${bearer[@]}" -c "$jar" -b "$jar"
	expect_status 201
	req GET /v1/session -b "$jar"
	expect_status 200
	kill "$second"
	wait "$second" || fail "the second daemon ends well"
	url=$first
	req GET /v1/session -b "$jar"
	expect_json '.proof == "session"'
	stop_daemon
}

test_a_session_lasts_until_it_is_closed_or_its_token_revoked() {
	local cookie own
	start_daemon --tokens "$tokens"
	own="Origin: $url"
	as acquire
	req POST /v1/session "${bearer[@]}" -H "$own"
	expect_status 201
	expect_json '.name == "the-acquire" and .role == "acquire" and .proof == "token"'
	[[ $(header set-cookie) == *'; Path=/; Max-Age='*'; HttpOnly; SameSite=Strict' ]] || fail "a cookie for this site alone: $(header set-cookie)"
	cookie=(-H "Cookie: a=b; $(header set-cookie | cut -d';' -f1); c=d")
	[[ ${cookie[1]} != *"${token[acquire]}"* ]] || fail "the cookie is not the token"
	req GET /v1/session "${cookie[@]}"
	expect_json '.name == "the-acquire" and .proof == "session"'
	req POST /v1/scans "${json[@]}" "${cookie[@]}" -H "$own" --data-binary "$document"
	expect_status 201
	scan=$(json .id)
	# a page of another site cannot use it
	req DELETE "/v1/scans/$scan" "${cookie[@]}" -H 'Origin: http://evil.example'
	expect_problem 403
	expect_json '.type == "urn:cbctd:problem:foreign-origin"'
	# a session opens no session
	req POST /v1/session "${cookie[@]}"
	expect_problem 409
	# what a token says goes before the cookie
	as view
	req DELETE "/v1/scans/$scan" "${cookie[@]}" "${bearer[@]}"
	expect_problem 403
	req DELETE /v1/session "${cookie[@]}" -H "$own"
	expect_status 204
	[[ $(header set-cookie) == "cbctd_session_${url##*:}=; "*'Max-Age=0'* ]] || fail "the browser forgets it: $(header set-cookie)"
	req GET /v1/session "${cookie[@]}"
	expect_problem 401
	stop_daemon
}

test_one_token_cannot_end_the_sessions_of_others() {
	local cookie i own
	start_daemon --tokens "$tokens"
	own="Origin: $url"
	as acquire
	req POST /v1/session "${bearer[@]}" -H "$own"
	cookie=(-H "Cookie: $(header set-cookie | cut -d';' -f1)")
	as view
	for ((i = 0; i < 40; i++)); do printf 'next\nurl = "%s/v1/session"\nrequest = POST\noutput = /dev/null\n%s\n' "$url" "header = \"${bearer[1]}\""; done | sed 1d >"$work/many"
	timeout 60 curl -s -K "$work/many"
	req GET /v1/session "${cookie[@]}"
	expect_json '.name == "the-acquire" and .proof == "session"'
	stop_daemon
}

test_sighup_reads_the_file_again_and_keeps_the_old_one_if_it_is_bad() {
	local fresh cookie
	start_daemon --tokens "$tokens"
	as view
	fresh=$(cbct token new late --role view --days 1 --file "$tokens" 2>/dev/null)
	req GET /v1/scans -H "Authorization: Bearer $fresh"
	expect_problem 401
	reload '5 tokens'
	req GET /v1/scans -H "Authorization: Bearer $fresh"
	expect_status 200
	req POST /v1/session -H "Authorization: Bearer $fresh"
	cookie=(-H "Cookie: $(header set-cookie | cut -d';' -f1)")
	echo nonsense >>"$tokens"
	reload 'line 6'
	req GET /v1/scans "${bearer[@]}"
	expect_status 200
	sed -i '/nonsense/d' "$tokens"
	cbct token revoke late --file "$tokens" 2>/dev/null
	reload '4 tokens'
	req GET /v1/scans -H "Authorization: Bearer $fresh"
	expect_problem 401
	req GET /v1/scans "${cookie[@]}"
	expect_problem 401
	req GET /v1/scans "${bearer[@]}"
	expect_status 200
	! grep -qF "$fresh" "$work/cbctd.err" || fail "no token in the log"
	stop_daemon
}

# Streams may go on for hours.
test_streams_end_with_the_token_they_were_asked_with() {
	local short late shortly=$work/shortly stays revoked expires i
	cp "$tokens" "$shortly"
	late=$(cbct token new late --role view --file "$shortly" 2>/dev/null)
	short=$(cbct token new short --role view --expires "$(date -u -d '+3 seconds' +%Y-%m-%dT%H:%M:%SZ)" --file "$shortly" 2>/dev/null)
	start_daemon --tokens "$shortly"
	curl -sN -o "$work/stays" "$url/v1/events" -H "Authorization: Bearer ${token[view]}" & stays=$!
	curl -sN -o "$work/revoked" "$url/v1/events" -H "Authorization: Bearer $late" & revoked=$!
	curl -sN -o "$work/expires" -w '%{http_code}' "$url/v1/events" -H "Authorization: Bearer $short" >"$work/expires.status" & expires=$!
	sleep 1
	cbct token revoke late --file "$shortly" 2>/dev/null
	reload '5 tokens'
	for ((i = 0; i < 1200; i++)); do kill -0 $revoked 2>/dev/null || kill -0 $expires 2>/dev/null || break; sleep 0.1; done
	! kill -0 $revoked 2>/dev/null || fail "the stream of a token that was revoked ends"
	! kill -0 $expires 2>/dev/null || fail "the stream of a token that expired ends"
	[ "$(cat "$work/expires.status")" = 200 ] || fail "it had begun, got $(cat "$work/expires.status")"
	kill $stays || fail "other streams go on"
	stop_daemon
}

# Bytes that come when the token is gone are nobody's: none is stored.
test_an_upload_ends_with_its_token() {
	local gone=$work/gone late upload large i
	cp "$tokens" "$gone"
	late=$(cbct token new late --role acquire --file "$gone" 2>/dev/null)
	start_daemon --tokens "$gone"
	as acquire
	large=${document/\"columns\": 16/\"columns\": 512}
	req POST /v1/scans "${bearer[@]}" "${json[@]}" --data-binary "${large/\"rows\": 12/\"rows\": 4096}"
	expect_status 201
	scan=$(json .id)
	i=$(json '.detector.columns * .detector.rows * 4')
	head -c "$i" /dev/zero >"$work/late.raw"
	curl -s -o "$work/late.body" -w '%{http_code}' --limit-rate $((i / 4)) -T "$work/late.raw" "$url/v1/scans/$scan/projections/0" \
		-H "Authorization: Bearer $late" >"$work/late.status" & upload=$!
	sleep 1
	cbct token revoke late --file "$gone" 2>/dev/null
	reload '4 tokens'
	wait $upload || true
	# The clock may cut it off before the next bytes are refused.
	[[ $(cat "$work/late.status") != 2* ]] || fail "401 or a connection that is closed, got $(cat "$work/late.status")"
	req GET "/v1/scans/$scan" "${bearer[@]}"
	expect_json '.received_count == 0'
	# Others' are taken.
	req PUT "/v1/scans/$scan/projections/0" "${bearer[@]}" -T "$work/late.raw"
	expect_status 201
	stop_daemon
}

# Who may not send a large body is told so, and the body is not read for that.
test_a_large_body_is_not_read_of_who_is_not_known() {
	start_daemon --tokens "$tokens"
	truncate -s 300M "$work/large.raw"
	curl -s -o "$work/large.body" -w '%{http_code} %{size_upload}' -H 'Expect:' -T "$work/large.raw" "$url/v1/scans/1m00000000000000/projections" >"$work/large.status" || true
	read -r status sent <"$work/large.status" || true
	[ "$status" = 401 ] || [ "$status" = 000 ] || fail "401 or a connection that is closed, got $status"
	[ "$sent" -lt 100000000 ] || fail "less than the body of 300 MB, got $sent"
	as view
	req PUT /v1/scans/1m00000000000000/projections "${bearer[@]}" -T "$work/late.raw"
	expect_problem 403
	stop_daemon
}

test_the_kernel_tells_who_is_at_a_unix_socket() {
	local socket=$work/peers
	with_rules() { # RULE ...: on a Unix socket
		local rule options=()
		for rule; do options+=(--unix-role "$rule"); done
		start_daemon --listen "unix:$socket" "${options[@]}"
	}
	with_rules "user:$(id -un)=view" "group:$(id -g)=acquire" "user:4000000=admin"
	req GET /v1/session --unix-socket "$socket"
	expect_status 200
	expect_json ".name == \"uid-$(id -u)\" and .role == \"acquire\" and .proof == \"peer\""
	req DELETE /v1/scans/1m00000000000000 --unix-socket "$socket"
	expect_problem 404
	# each is asked who it is, so the socket is no closer than that
	[ "$(stat -c %a "$socket")" = 666 ] || fail "mode 666, got $(stat -c %a "$socket")"
	# over TCP nobody is known
	req GET /v1/session
	expect_problem 401
	stop_daemon
	with_rules "user:$(id -u)=view" "group:4000000=acquire"
	req DELETE /v1/scans/1m00000000000000 --unix-socket "$socket"
	expect_problem 403
	stop_daemon
	with_rules "user:4000000=admin" "group:4000000=admin"
	req GET /v1/session --unix-socket "$socket"
	expect_problem 401
	stop_daemon
	local rule
	for rule in root user:root=boss user:root user:=view "user:no such=view" uid:0=view group:nosuchgroup=view; do
		! timeout 10 cbctd --listen "unix:$socket" --state-dir "$work/none" --unix-role "$rule" >"$work/refused" 2>&1 || fail "no start with $rule"
		grep -q 'unix-role' "$work/refused" || fail "the reason in $(cat "$work/refused")"
	done
}

stop_after_each=1 run_tests
