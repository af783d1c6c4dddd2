#!/usr/bin/env bash
# TLS: versions, ciphers, certificates of the daemon and of clients, and the same care for framing as without.
. "$(dirname "$0")/lib.sh"
python=${PYTHON:-/usr/bin/python3}
command -v "$python" >/dev/null || python=python3
keys=$work/keys
tokens=$work/tokens
export CURL_CA_BUNDLE=$keys/ca.pem

new_key() { openssl req -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout "$keys/$1.key" -out "$keys/$1.csr" -subj "$2" 2>/dev/null; }
# sign NAME AUTHORITY EXTENSIONS
sign() {
	openssl x509 -req -in "$keys/$1.csr" -CA "$keys/$2.pem" -CAkey "$keys/$2.key" -CAcreateserial -out "$keys/$1.pem" -days 2 \
		-extfile <(printf '%b' "$3") 2>/dev/null
}
authority() { openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout "$keys/$1.key" -out "$keys/$1.pem" -days 2 -subj "/CN=$1" 2>/dev/null; }
server() { # NAME: a certificate of the daemon
	new_key "$1" /CN=cbctd
	sign "$1" ca 'subjectAltName=IP:127.0.0.1,DNS:localhost\nextendedKeyUsage=serverAuth\n'
}
client() { # NAME SUBJECT [AUTHORITY [USAGE]]
	new_key "$1" "$2"
	sign "$1" "${3:-ca}" "extendedKeyUsage=${4:-clientAuth}\n"
}
mkdir -p "$keys"
authority ca
authority foreign
server first
server second
for role in view acquire admin; do declare "$role=$(cbct token new "the-$role" --role $role --file "$tokens" 2>/dev/null)"; done
old=cbct_once-it-was-good
printf 'the-old acquire 2020-01-01 sha256:%s\n' "$(printf %s "$old" | sha256sum | cut -d' ' -f1)" >>"$tokens"

install_certificate() { # NAME
	cp "$keys/$1.pem" "$keys/now.pem"
	cp "$keys/$1.key" "$keys/now.key"
	chmod 600 "$keys/now.key"
}
start_tls() {
	install_certificate first
	start_daemon --tls-cert "$keys/now.pem" --tls-key "$keys/now.key" "$@"
	[[ $url == https://* ]] || fail "listening on https, got $url"
}
reload() { # TEXT of the log
	local i
	: >"$work/cbctd.err"
	kill -HUP "$(cat "$work/daemon.pid")"
	for ((i = 0; i < 2400; i++)); do grep -q "$1" "$work/cbctd.err" && return 0; sleep 0.05; done
	fail "a line of the log with $1: $(cat "$work/cbctd.err")"
}
serial() { openssl x509 -noout -serial -in "$keys/$1.pem"; }
serial_shown() { openssl s_client -connect "${url#https://}" </dev/null 2>/dev/null | openssl x509 -noout -serial; }

# negotiates OPTION ...: what openssl agreed on; false where the daemon refuses
negotiates() { openssl s_client -connect "${url#https://}" "$@" </dev/null 2>/dev/null | sed -nE 's/^ *(New, .*), Cipher is (.*)/\1 \2/p' | grep -v '(NONE)'; }

test_nothing_older_than_tls_1_2_and_no_weak_cipher() {
	local cipher version good='ECDHE-ECDSA-AES128-GCM-SHA256 ECDHE-ECDSA-AES256-GCM-SHA384 ECDHE-ECDSA-CHACHA20-POLY1305' others
	start_tls
	for version in -tls1 -tls1_1; do
		! negotiates $version -cipher 'ALL:@SECLEVEL=0' || fail "no $version"
	done
	negotiates -tls1_2 || fail "TLS 1.2"
	negotiates -tls1_3 || fail "TLS 1.3"
	# all others that this openssl can speak: without forward secrecy, with CBC, SHA-1, RC4, none at all ...
	for cipher in $good; do negotiates -tls1_2 -cipher "$cipher" || fail "$cipher"; done
	others=$(openssl ciphers -s -tls1_2 'ALL:COMPLEMENTOFALL:@SECLEVEL=0' | tr ':' '\n' | grep -vE "^TLS_|^(${good// /|})$" | paste -sd:)
	[ "$(tr ':' '\n' <<<"$others" | wc -l)" -gt 40 ] || fail "other ciphers to try: $others"
	! negotiates -tls1_2 -cipher "$others:@SECLEVEL=0" || fail "none of $others"
	for cipher in TLS_AES_128_GCM_SHA256 TLS_AES_256_GCM_SHA384 TLS_CHACHA20_POLY1305_SHA256; do
		negotiates -tls1_3 -ciphersuites $cipher || fail "$cipher"
	done
	! negotiates -tls1_3 -ciphersuites TLS_AES_128_CCM_8_SHA256 || fail "no short tags"
	! negotiates -tls1_2 -sigalgs ECDSA+SHA1 -cipher 'ALL:@SECLEVEL=0' || fail "no signature with SHA-1"
	# plain HTTP gets nothing but the end
	! curl -s --max-time 5 "http://${url#https://}/livez" || fail "no plain HTTP at the port of TLS"
	req GET /livez
	expect_status 200
	stop_daemon
}

# alert OPTION ...: the alert that openssl names as the reason why it was refused
alert() { openssl s_client -connect "${url#https://}" "$@" </dev/null 2>&1 | sed -n "s/.*alert \([^:]*\):.*SSL alert number.*/\1/p"; }

test_who_is_refused_in_a_handshake_is_told_why() {
	start_tls
	[ "$(alert -tls1_1 -cipher 'ALL:@SECLEVEL=0')" = "protocol version" ] || fail "an old version: $(alert -tls1_1 -cipher 'ALL:@SECLEVEL=0')"
	[ "$(alert -tls1_2 -cipher AES128-SHA:@SECLEVEL=0)" = "handshake failure" ] || fail "no cipher in common"
	req GET /livez
	expect_status 200
	stop_daemon
}

test_what_is_sent_through_tls_is_read_by_the_letter() {
	local raw
	start_tls
	raw() { RAW_TLS_CA=$keys/ca.pem "$python" "$here/raw_http.py" "${url##*:}" "$@"; }
	raw malformed
	raw fine
	raw smuggling
	raw pipelining
	stop_daemon
}

test_tokens_and_sessions_hold_over_tls_too() {
	start_tls --tokens "$tokens"
	req POST /v1/session -H "Authorization: Bearer $view"
	expect_status 201
	[[ $(header set-cookie) == *'; HttpOnly; SameSite=Strict; Secure' ]] || fail "a cookie for TLS alone: $(header set-cookie)"
	# what the network put into a page that came without TLS is not ours
	req DELETE /v1/session -H "Authorization: Bearer $view" -H "Origin: http://${url#https://}"
	expect_problem 403
	expect_json '.type == "urn:cbctd:problem:foreign-origin"'
	req POST /v1/session -H "Authorization: Bearer $view" -H "Origin: $url"
	expect_status 201
	"$python" "$top/proto/openapi.py" --json "$top/proto/openapi.yaml" >"$work/openapi.json" 2>/dev/null || req GET /v1/openapi.json -o "$work/openapi.json"
	jq -n --arg v "$view" --arg q "$acquire" --arg a "$admin" --arg o "$old" --arg c "$(header set-cookie | sed 's/^cbctd_session_[0-9]*=\([^;]*\);.*/\1/')" \
		'{view: $v, acquire: $q, admin: $a, expired: $o, "cookie view": $c}' >"$work/proofs.json"
	"$python" "$here/access.py" "$url" "$work/openapi.json" "$work/proofs.json" "$keys/ca.pem"
	stop_daemon
}

test_a_job_through_tls() {
	local bytes=$((40 * 64 * 48 * 4)) cookie
	start_tls --tokens "$tokens" --listen "unix:$work/socket"
	as=(-H "Authorization: Bearer $acquire")
	req POST /v1/scans "${as[@]}" -H 'Content-Type: application/json' --data-binary '{"detector": {"columns": 64, "rows": 48, "pixel_mm": [4, 4]},
	  "projections": {"count": 40, "sample": "float32", "quantity": "line_integral"},
	  "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "first_angle_deg": 0, "angle_step_deg": 9}}'
	expect_status 201
	scan=$(json .id)
	head -c $bytes /dev/zero | tr '\0' '\100' >"$work/all"
	req PUT "/v1/scans/$scan/projections" "${as[@]}" -T "$work/all" -H "Content-Digest: sha-256=:$(openssl dgst -sha256 -binary "$work/all" | base64):"
	expect_status 201
	# what came through TLS is what a Unix socket gives without it
	curl -s --unix-socket "$work/socket" "${as[@]}" "http://localhost/v1/scans/$scan/projections/7" | cmp - <(tail -c +$((7 * 64 * 48 * 4 + 1)) "$work/all" | head -c $((64 * 48 * 4))) ||
		fail "the bytes of projection 7"
	req POST /v1/jobs "${as[@]}" -H 'Content-Type: application/json' --data-binary "{\"scan\": \"$scan\", \"grid\": {\"size\": [96, 96, 48], \"spacing_mm\": [2, 2, 2]}, \"sart\": {\"iterations\": 1}}"
	expect_status 202
	job=$(json .id)
	# a browser's event stream has a cookie
	req POST /v1/session "${as[@]}"
	cookie=(-H "Cookie: $(header set-cookie | cut -d';' -f1)")
	req GET "/v1/jobs/$job/events" "${cookie[@]}" --max-time 60
	grep -q '^event: end' "$body" || fail "events to the end"
	req GET "/v1/jobs/$job/volumes/final?format=raw" "${cookie[@]}"
	expect_status 200
	[ "$(stat -c %s "$body")" = $((96 * 96 * 48 * 4)) ] || fail "a whole volume"
	cmp "$body" <(curl -s --unix-socket "$work/socket" "${as[@]}" "http://localhost/v1/jobs/$job/volumes/final?format=raw") || fail "the same volume without TLS"
	stop_daemon
}

test_a_client_that_goes_is_noticed() {
	local pid i
	start_tls
	curl -sN -o /dev/null "$url/v1/events" &
	pid=$!
	open() { curl -s "$url/metrics" | sed -n 's/^cbctd_connections //p'; }
	for ((i = 0; i < 2400; i++)); do [ "$(open)" -ge 2 ] && break; sleep 0.05; done
	kill $pid
	for ((i = 0; i < 2400; i++)); do [ "$(open)" = 1 ] && break; sleep 0.05; done
	[ "$(open)" = 1 ] || fail "its connection is closed"
	stop_daemon
}

test_a_new_certificate_is_shown_without_a_break() {
	local pid
	start_tls
	[ "$(serial_shown)" = "$(serial first)" ] || fail "the first certificate"
	# a connection from before goes on meanwhile
	mkfifo "$work/pipe"
	curl -s -o "$work/slow" "$url/v1/scans" -H 'Content-Type: application/json' -T - -X POST <"$work/pipe" &
	pid=$!
	exec 9>"$work/pipe"
	echo '{' >&9
	install_certificate second
	reload 'certificate read'
	[ "$(serial_shown)" = "$(serial second)" ] || fail "the second certificate"
	# neither a key that does not fit nor a broken file takes its place
	cp "$keys/first.key" "$keys/now.key"
	reload 'is not the key of the certificate'
	echo nonsense >"$keys/now.pem"
	reload 'now.pem: '
	[ "$(serial_shown)" = "$(serial second)" ] || fail "the second certificate still"
	echo '}' >&9
	exec 9>&-
	wait $pid
	jq -e '.type == "urn:cbctd:problem:invalid"' "$work/slow" >/dev/null || fail "an answer on the connection from before: $(cat "$work/slow")"
	stop_daemon
}

test_the_daemon_starts_with_a_good_certificate_only() {
	install_certificate first
	refused() { # WHAT THE ERROR SAYS, OPTION ...
		local text=$1
		shift
		! timeout 10 cbctd --listen 127.0.0.1:0 --state-dir "$work/none" "$@" >"$work/refused" 2>&1 || fail "no start"
		grep -q "$text" "$work/refused" || fail "$text in $(cat "$work/refused")"
	}
	refused 'both --tls-cert and --tls-key' --tls-cert "$keys/now.pem"
	refused 'both --tls-cert and --tls-key' --tls-key "$keys/now.key"
	refused 'both --tls-cert and --tls-key' --tls-client-ca "$keys/ca.pem"
	refused 'does not exist' --tls-cert "$keys/none.pem" --tls-key "$keys/now.key"
	refused 'is not the key' --tls-cert "$keys/now.pem" --tls-key "$keys/second.key"
	chmod 644 "$keys/now.key"
	refused 'mode 0644' --tls-cert "$keys/now.pem" --tls-key "$keys/now.key"
}

test_other_addresses_need_tokens_and_tls() {
	local port
	install_certificate first
	tls=(--tls-cert "$keys/now.pem" --tls-key "$keys/now.key")
	for options in "" "--tokens $tokens" "${tls[*]}"; do
		! timeout 10 cbctd --listen 0.0.0.0:0 --state-dir "$work/none" $options >"$work/refused" 2>&1 || fail "no start with '$options'"
		grep -q 'only loopback addresses' "$work/refused" || fail "the reason in $(cat "$work/refused")"
	done
	start_tls --tokens "$tokens" --listen 0.0.0.0:0
	port=$(sed -n 's,^listening on https://0\.0\.0\.0:,,p' "$work/cbctd.out")
	[ -n "$port" ] || fail "a port on all addresses: $(cat "$work/cbctd.out")"
	url=https://127.0.0.1:$port
	req GET /livez
	expect_status 200
	req GET /v1/scans
	expect_problem 401
	req GET /livez -H 'Host: 127.0.0.2'
	expect_problem 421
	stop_daemon
}

test_client_certificates_are_as_good_as_their_row() {
	local name certified=$work/certified
	# a row for certificates is none for tokens, and the other way round
	cp "$tokens" "$certified"
	cbct token new arm-3 --role acquire --certificate --file "$certified" 2>/dev/null
	cbct token new ward --role view --certificate --file "$certified" 2>/dev/null
	printf 'past admin 2020-01-01 certificate\n' >>"$certified"
	client arm /CN=arm-3/O=hospital
	client ward /CN=ward
	client past /CN=past
	client unknown /CN=nobody
	client token /CN=the-admin
	client alien /CN=arm-3 foreign
	client wrong-use /CN=arm-3 ca serverAuth
	client two-names /CN=ward/CN=arm-3
	start_tls --tokens "$certified" --tls-client-ca "$keys/ca.pem"
	with() { certificate=(--cert "$keys/$1.pem" --key "$keys/$1.key"); }
	with arm
	req GET /v1/session "${certificate[@]}"
	expect_status 200
	expect_json '.name == "arm-3" and .role == "acquire" and .proof == "certificate"'
	req DELETE /v1/scans/1m00000000000000 "${certificate[@]}"
	expect_status 404
	with ward
	req DELETE /v1/scans/1m00000000000000 "${certificate[@]}"
	expect_problem 403
	# a token that is shown goes first
	req DELETE /v1/scans/1m00000000000000 "${certificate[@]}" -H "Authorization: Bearer $acquire"
	expect_status 404
	for name in past unknown token alien wrong-use two-names; do
		with $name
		req GET /v1/session "${certificate[@]}"
		[ "$status" = 401 ] || fail "401 with the certificate $name, got $status: $(cat "$body")"
	done
	req GET /v1/session
	expect_problem 401
	stop_daemon
}

test_the_clients_show_tokens_and_certificates() {
	local dir=$work/ball scan job file=$work/acquire.token
	cbct simulate --phantom ball --views 12 --columns 24 --rows 16 --pixel 8 --source-to-isocentre 600 --source-to-detector 1000 -o "$dir" >/dev/null
	cp "$tokens" "$work/clients"
	cbct token new uploads --role acquire --file "$work/clients" --output "$file" 2>/dev/null
	cbct token new arm-3 --role acquire --certificate --file "$work/clients" 2>/dev/null
	[ "$(stat -c %a "$file")" = 600 ] || fail "a token that others cannot read"
	! cbct token new more --file "$work/clients" --output "$file" 2>/dev/null || fail "no file is overwritten"
	client arm /CN=arm-3
	start_tls --tokens "$work/clients" --tls-client-ca "$keys/ca.pem"
	export CBCT_URL=$url CBCT_CACERT=$keys/ca.pem
	! cbct scans 2>"$work/refused" || fail "nobody without a token"
	grep -q 'a token is wanted' "$work/refused" || fail "what is wanted: $(cat "$work/refused")"
	! (unset CBCT_CACERT; cbct scans --token-file "$file") 2>/dev/null || fail "an authority that nobody trusts"
	scan=$(cbct upload "$dir" --token-file "$file" | tail -1)
	CBCT_TOKEN_FILE=$file cbct scans | grep "${scan##* }" >/dev/null || fail "the scan in the list: $scan"
	! CBCT_TOKEN=$view cbct rm "${scan##* }" 2>"$work/refused" || fail "who may view removes nothing"
	grep -q 'acquire is wanted' "$work/refused" || fail "the role that is wanted: $(cat "$work/refused")"
	CBCT_TOKEN=$acquire cbct jobs
	cbct status --cert "$keys/arm.pem" --key "$keys/arm.key" | grep cpu >/dev/null || fail "a client certificate"
	chmod 644 "$file"
	! cbct scans --token-file "$file" 2>"$work/refused" || fail "a token that everybody can read is not sent"
	grep -q 'mode 0644' "$work/refused" || fail "why: $(cat "$work/refused")"
	if "$python" -c 'import numpy, requests' 2>/dev/null; then
		PYTHONPATH=$top/clients/python PYTHONDONTWRITEBYTECODE=1 "$python" - "$file" "$keys" <<-'END'
			import os, sys, cbctd
			file, keys = sys.argv[1:]
			assert len(list(cbctd.Client(token_file=file).scans())) >= 1
			with open(file) as text:
			    token = text.read().strip()
			assert len(list(cbctd.Client(token=token, cacert=keys + "/ca.pem").scans())) >= 1
			assert len(list(cbctd.Client(cert=(keys + "/arm.pem", keys + "/arm.key")).scans())) >= 1
			os.environ["CBCT_TOKEN"] = token
			assert len(list(cbctd.Client().scans())) >= 1
			os.environ["CBCT_TOKEN"] = token + "x"
			try:
			    list(cbctd.Client().scans())
			except cbctd.Problem as problem:
			    assert problem.status == 401, problem
			else:
			    raise AssertionError("a wrong token")
		END
	fi
	CBCT_TOKEN=$acquire cbct rm "${scan##* }"
	stop_daemon
}

stop_after_each=1 run_tests
