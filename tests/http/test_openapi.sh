#!/usr/bin/env bash
# proto/openapi.yaml is the schema of record: it names exactly the endpoints that the daemon's table of routes has.
. "$(dirname "$0")/lib.sh"

# METHOD /path/{} of each operation; those marked x-planned when $1 is "planned", else the others.
operations() {
	awk -v planned="$1" '
		/^components:/ { exit }
		/^  \/.*:$/ { path = $1; sub(/:$/, "", path); gsub(/\{[a-z]+\}/, "{}", path); later = 0 }
		/^    x-planned: true$/ { later = 1 }
		/^    (get|put|post|delete):$/ { method = toupper($1); sub(/:/, "", method); if (later == (planned == "planned")) print method, path }
	' "$top/proto/openapi.yaml" | sort
}
# The images of core/scan/image.h have a route each.
routes() {
	{
		sed -nE 's/^[[:space:]]*\{"([A-Z]+)", "([^" ]+)",.*/\1 \2/p' "$top/daemon/api/api.c"
		sed -nE 's/^[[:space:]]*row\([A-Z]+, "([a-z]+)", .*/PUT \/v1\/scans\/{}\/\1\nDELETE \/v1\/scans\/{}\/\1/p' "$top/core/scan/image.h"
	} | sort
}

test_schema_and_routes_name_the_same_operations() {
	[ "$(routes | wc -l)" -gt 10 ] || fail "the table of routes in daemon/api/api.c"
	diff <(operations served) <(routes) || fail "proto/openapi.yaml (<) and daemon/api/api.c (>) with the same operations"
}

test_what_is_planned_is_not_there_yet() {
	local both
	both=$(comm -12 <(operations planned) <(routes))
	[ -z "$both" ] || fail "no x-planned mark at what is served: $both"
}

test_every_reference_of_the_schema_has_its_target() {
	local target name kind
	while read -r target; do
		kind=${target%/*} name=${target##*/}
		awk -v kind="  $kind:" -v name="    $name:" '
			/^components:/ { inside = 1 }
			inside && /^  [a-zA-Z]+:$/ { here = ($0 == kind) }
			inside && here && index($0, name) == 1 { found = 1 }
			END { exit !found }
		' "$top/proto/openapi.yaml" || fail "components/$target"
	done < <(grep -oE '#/components/[A-Za-z]+/[A-Za-z]+' "$top/proto/openapi.yaml" | sed 's,#/components/,,' | sort -u)
}

test_what_is_served_is_the_schema() {
	local python=${PYTHON:-/usr/bin/python3}
	"$python" -c 'import yaml' 2>/dev/null || skip "python3-yaml is not here"
	start_daemon
	req GET /v1/openapi.json
	expect_status 200
	diff <("$python" "$top/proto/openapi.py" --json "$top/proto/openapi.yaml" | jq -S .) <(jq -S . "$body") ||
		fail "proto/openapi.yaml (<) as JSON (>)"
	req GET /v1/openapi.json -H "If-None-Match: $(header etag)"
	expect_status 304
	req GET /readyz
	expect_status 200
	# the plain page's style, which browsers fetch and no other test
	req GET /plain.css
	expect_status 200
	[[ $(header content-type) == text/css* ]] || fail "text/css, got $(header content-type)"
	grep -q '{' "$body" || fail "rules of a style: $(head -c 100 "$body")"
	stop_daemon
}

# Ranges, choices and defaults of the documents' parameters have one source, the programs' own tables.
test_parameters_of_the_schema_are_those_of_the_tables() {
	local python=${PYTHON:-/usr/bin/python3}
	"$python" -c 'import yaml' 2>/dev/null || skip "python3-yaml is not here"
	cbct parameters --json >"$work/parameters.json"
	"$python" "$top/proto/openapi.py" --json "$top/proto/openapi.yaml" >"$work/openapi.json"
	"$python" "$top/tests/openapi/parameters.py" "$work/parameters.json" "$work/openapi.json" ||
		fail "proto/openapi.yaml with the tables that \`cbct parameters\` shows"
	"$python" "$top/clients/python/parameters.py" --check <"$work/parameters.json" || fail "the Python client's table"
}

# Members that no table has: presets, the patient and the study, lists, phantoms of calibrations.
test_bounds_of_the_schema_are_those_of_the_daemon() {
	local python=${PYTHON:-/usr/bin/python3}
	"$python" -c 'import yaml' 2>/dev/null || skip "python3-yaml is not here"
	start_daemon
	"$python" "$top/proto/openapi.py" --json "$top/proto/openapi.yaml" >"$work/openapi.json"
	"$python" "$top/tests/openapi/bounds.py" "$url" "$work/openapi.json" || fail "the daemon with the bounds of proto/openapi.yaml"
	stop_daemon
}

# A parameter that nobody knows is refused, and the refusal names those of the schema.
test_query_parameters_are_those_of_the_schema() {
	local method path names count=0
	start_daemon
	req GET /v1/openapi.json
	jq -r '. as $all | .paths | to_entries[] | .key as $path | (.value.parameters // []) as $shared | .value | to_entries[] |
		select(.key | IN("get", "put", "post", "delete")) | [(.key | ascii_upcase), ($path | gsub("\\{[a-z]+\\}"; "x")),
		([$shared[], (.value.parameters // [])[]] | map(if .["$ref"] then $all.components.parameters[.["$ref"] | split("/")[-1]] else . end |
		select(.in == "query") | .name) | sort | join(" "))] | @tsv' "$body" >"$work/operations"
	while IFS=$'\t' read -r method path names; do
		case $method in
		PUT | POST) req "$method" "$path?nobody_knows=1" -H 'Content-Type: application/json' -d '{}' ;;
		*) req "$method" "$path?nobody_knows=1" ;;
		esac
		expect_problem 400
		json .detail | grep -q '"nobody_knows"' || fail "the name of the parameter: $(json .detail)"
		[ "$(json .detail | sed 's/.*known: //; s/^none$//' | tr ' ' '\n' | sort | paste -sd' ')" = "$names" ] ||
			fail "$method $path with the parameters $names: $(json .detail)"
		count=$((count + 1))
	done <"$work/operations"
	[ "$count" -gt 25 ] || fail "the operations of the schema, found $count"
	req GET "/v1/scans?limit=1&limit=2"
	expect_problem 400
	stop_daemon
}

# Spectral, as tests/openapi/package-lock.json names it, installed under build/ once for each lockfile.
test_the_schema_has_no_flaws_that_a_linter_sees() {
	local from=$top/tests/openapi to=$BUILD/openapi-lint
	command -v npm >/dev/null || skip "npm is not here"
	if ! cmp -s "$from/package-lock.json" "$to/installed"; then
		rm -rf "$to"
		mkdir -p "$to"
		cp "$from"/package*.json "$to/"
		(cd "$to" && npm ci --ignore-scripts --omit=optional --no-audit --no-fund) >"$work/npm.log" 2>&1 ||
			skip "npm cannot install the linter: $(grep -m 1 -i error "$work/npm.log")"
		cp "$from/package-lock.json" "$to/installed"
	fi
	"$to/node_modules/.bin/spectral" lint --fail-severity warn --ruleset "$from/ruleset.yaml" "$top/proto/openapi.yaml"
}

stop_after_each=1 run_tests
