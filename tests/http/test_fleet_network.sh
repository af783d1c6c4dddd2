#!/usr/bin/env bash
# A fleet of three hosts, each in a network namespace of its own, with TLS, tokens and a bridge between them: links that are
# cut lose packets, where a process that is killed closes its connections.
if [ -z "${CBCT_TEST_NETWORK:-}" ] && unshare --net true 2>/dev/null; then
	CBCT_TEST_NETWORK=1 exec unshare --net -- bash "$0" "$@"
fi
pg_address=10.77.0.1
if [ -n "${CBCT_TEST_NETWORK:-}" ]; then
	ip link set lo up && ip link add bridge0 type bridge && ip address add $pg_address/24 dev bridge0 && ip link set bridge0 up || unset CBCT_TEST_NETWORK
fi
[ -n "${CBCT_TEST_NETWORK:-}" ] || pg_address=
. "$(dirname "$0")/lib.sh"
. "$here/fleet.sh"
[ -n "${CBCT_TEST_NETWORK:-}" ] || why="network namespaces cannot be made here"
trap 'stop_hosts; stop_networks; stop_postgresql' EXIT
networks=()

# make_network NAME NUMBER: a network for host NAME, with the bridge behind link-NAME
make_network() {
	local holder
	unshare --net sleep 3600 &
	holder=$!
	networks+=("$holder")
	until [ "$(readlink "/proc/$holder/ns/net")" != "$(readlink /proc/self/ns/net)" ]; do sleep 0.02; done
	ip link add "link-$1" type veth peer name eth0 netns $holder
	ip link set "link-$1" master bridge0 up
	address_of[$1]=10.77.0.$2 within[$1]="nsenter -t $holder --net --"
	${within[$1]} ip link set lo up
	${within[$1]} ip address add "10.77.0.$2/24" dev eth0
	${within[$1]} ip link set eth0 up
}
stop_networks() {
	[ ${#networks[@]} = 0 ] || kill "${networks[@]}" 2>/dev/null
}
link() { ip link set "link-$1" "$2"; } # NAME up|down

if [ -z "${why:-}" ]; then
	database="postgresql://cbctd@$pg_address/postgres"
	for each in a:11 b:12 c:13; do make_network ${each%:*} ${each#*:}; done
	openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=fleet \
		-addext 'subjectAltName=IP:10.77.0.11,IP:10.77.0.12,IP:10.77.0.13' -keyout "$work/key.pem" -out "$work/cert.pem" 2>/dev/null
	chmod 600 "$work/key.pem"
	rm -f "$work/tokens" "$work/token"
	(umask 077; cbct token new all --role admin --file "$work/tokens" >"$work/token" 2>/dev/null)
	printf 'cacert = "%s"\nheader = "Authorization: Bearer %s"\n' "$work/cert.pem" "$(cat "$work/token")" >"$work/.curlrc"
	export CURL_HOME=$work
	doors=(--tokens "$work/tokens" --tls-cert "$work/cert.pem" --tls-key "$work/key.pem" --fleet-token "$work/token" --fleet-cacert "$work/cert.pem")
fi
host() { start_host "$1" --fleet-address "https://${address_of[$1]}:PORT" "${doors[@]}" "${@:2}"; }
begin_network() {
	begin
	for each in a b c; do link $each up; done
}
other_than() { [ "$1" = a ] && echo b || echo a; }

test_jobs_cross_networks_to_the_same_bits() {
	begin_network
	undisturbed "$scan_dir" "$small" small
	host a
	host c --worker "$work/no-device"
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$small"
	wait_job succeeded
	expect_json '.device | startswith("a: ")'
	same_bits small
	told_once
	nothing_left a
}

test_a_link_that_is_cut_for_less_than_a_lease_changes_nothing() {
	begin_network
	lease=12 host a
	undisturbed "$scan_dir" "$long" long
	lease=12 host c --worker "$work/no-device"
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	given_to a
	progresses
	link a down
	sleep 2
	link a up
	wait_job succeeded
	expect_json '.device | startswith("a: ")'
	same_bits long
	told_once
	grep -q 'goes to a, claim 1$' "$work/c.err" || fail "the first claim"
	! grep -q 'claim 2' "$work/c.err" || fail "no other claim"
}

test_a_link_that_is_cut_sends_the_job_elsewhere_and_what_comes_back_is_not_heard() {
	local first next i
	begin_network
	undisturbed "$scan_dir" "$long" long
	host a
	host b
	host c --worker "$work/no-device"
	at c
	post_scan "$scan_dir"
	post_projections "$scan_dir"
	post_job "$long"
	for ((i = 0; i < 1200; i++)); do
		req GET "/v1/jobs/$job"
		[ "$(json '.state == "running"')" = true ] && break
		sleep 0.05
	done
	progresses
	first=$(json '.device | split(":")[0]')
	link "$first" down
	next=$(other_than "$first")
	given_to "$next"
	link "$first" up
	wait_job succeeded
	expect_json ".device | startswith(\"$next: \")"
	same_bits long
	told_once
	empty_ledger
	nothing_left "$first"
	nothing_left "$next"
}

test_a_cart_that_is_cut_off_goes_on_alone_and_joins_again() {
	begin_network
	undisturbed "$scan_dir" "$small" small
	host a
	host c
	link c down
	# Whoever operates the cart stands beside it.
	url=$(sed 's/10.77.0.1:/10.77.0.13:/' "$work/c.url")
	beside=(${within[c]})
	post_beside() { "${beside[@]}" curl -sS --max-time 60 "$@"; }
	scan=$(post_beside -H 'Content-Type: application/json' --data-binary "@$scan_dir/scan.json" "$url/v1/scans" | jq -r .id)
	post_beside -X PUT --data-binary "@$scan_dir/projections.raw" "$url/v1/scans/$scan/projections" >/dev/null
	job=$(post_beside -H 'Content-Type: application/json' --data-binary "${small/SCAN/$scan}" "$url/v1/jobs" | jq -r .id)
	for ((i = 0; i < 1200; i++)); do
		state_there=$(post_beside "$url/v1/jobs/$job" | jq -r .state)
		[ "$state_there" = succeeded ] && break
		sleep 0.05
	done
	[ "$state_there" = succeeded ] || fail "a job without a network, got $state_there"
	link c up
	at c
	same_bits small
	# It is there for the others again.
	for ((i = 0; i < 1200; i++)); do
		[ "$(sql "SELECT count(*) FROM cbctd_fleet_test.hosts WHERE name = 'c' AND seen > now() - interval '2 seconds'" 2>/dev/null)" = 1 ] && break
		sleep 0.1
	done
	[ $i -lt 1200 ] || fail "host c in the ledger again: $(sql 'SELECT * FROM cbctd_fleet_test.hosts')"
}

run_tests
