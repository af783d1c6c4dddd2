#!/usr/bin/env bash
# The page: how it is served, and how it does its work in a real browser (Chromium by playwright-core). Screenshots stay in $BUILD/test/test_page.
. "$(dirname "$0")/../http/lib.sh"

here=$top/tests/web
tools=$BUILD/web-tests
name='knee <b>3</b> & "co"'

phantom='{"kind": "circles", "balls": 12, "diameter_mm": 110, "distance_mm": 90, "ball_mm": 6, "first_angle_deg": 10, "shift_deg": 15}'

# A daemon, a calibration and the scan of balls that it was made of, one picture of them empty; a scan of an arm that sags,
# which was not calibrated; a scan of the solid over 220 degrees that does not say how it lies, and a job of it that does and has ended.
prepare() {
	node "$here/solid.mjs" "$work/solid.f32"
	cbct simulate --volume "$work/solid.f32" --size 24,24,24 --spacing 4 --centre --name "$name" --views 56 --arc 220 --columns 64 --rows 64 \
		--pixel 3.2 --source-to-isocentre 620 --source-to-detector 1100 -o "$work/scan" >/dev/null
	printf '%s' "$phantom" >"$work/phantom.json"
	cbct simulate -o "$work/balls" --balls "$work/phantom.json" --density .6 --columns 240 --rows 192 --pixel 1.58 --sag daly --views 16 --photons 20000 >/dev/null
	dd if=/dev/zero of="$work/balls/projections.raw" bs=$((240 * 192 * 4)) seek=5 count=1 conv=notrunc status=none
	cbct simulate -o "$work/sagging" --phantom asymmetric --scale 70 --density 0.0192 --views 64 --arc 200 --columns 80 --rows 64 --pixel 4.8 --sag daly >/dev/null
	start_daemon --threads 1
	sagging=$(cbct upload "$work/sagging" | head -1)
	balls=$(cbct upload "$work/balls" | head -1)
	calibration=$(cbct calibrate-scan "$balls" "$work/phantom.json" --arm "arm in room 2")
	post_scan "$work/scan"
	post_projections "$work/scan"
	post_job '{"scan": "SCAN", "grid": {"size": [36, 32, 40], "spacing_mm": [3, 3.4, 2.8]}, "fdk": {}, "sart": {"iterations": 7}, "tv": {}, "emit": ["fdk", 1, 2, 4, 6], "patient": {"position": "HFS"}}'
	wait_job succeeded
}

need_page() {
	command -v node >/dev/null || skip "node is not here"
	[ -e "$BUILD/web/files/index.html" ] || skip "the daemon was built without the page"
}

test_files_are_compressed_and_kept() {
	local file etag
	need_page
	start_daemon
	req GET / -H 'Accept-Encoding: gzip'
	expect_status 200
	[ "$(header content-encoding)" = gzip ] || fail "gzip"
	[ "$(header cache-control)" = no-cache ] || fail "asked for each time"
	[[ $(header content-security-policy) == "default-src 'none'; script-src 'self';"* ]] || fail "a strict policy"
	[[ $(header content-security-policy) != *unsafe* ]] || fail "nothing unsafe in it"
	gzip -dc <"$body" >"$work/index.html"
	req GET / -H 'Accept-Encoding: identity;q=0, X-Gzip'
	[ "$(header content-encoding)" = gzip ] || fail "gzip by its old name"
	req GET /
	cmp "$body" "$work/index.html" || fail "the same page without gzip"
	etag=$(header etag)
	req GET / -H "If-None-Match: $etag"
	expect_status 304
	req GET / -H "If-None-Match: $etag" -H 'Accept-Encoding: gzip'
	expect_status 200
	for file in $(grep -oE '"/assets/[^"]+"' "$work/index.html" | tr -d '"'); do
		req GET "$file" -H 'Accept-Encoding: gzip'
		expect_status 200
		[[ $(header cache-control) == *immutable* ]] || fail "$file kept for ever"
		[ "$(header x-content-type-options)" = nosniff ] || fail "nosniff"
	done
	req GET /assets/nothing.js
	expect_problem 404
	req GET "/assets/%3Cscript%3E"
	expect_problem 404
	stop_daemon
}

test_every_bundled_package_is_named_with_its_licence() {
	local package
	need_page
	for package in @niivue/niivue fzstd gl-matrix; do
		grep -q "^$package [0-9.]*: " "$BUILD"/web/files/licences-*.txt || fail "the licence of $package"
	done
}

# Every parameter of a job has a field in the form and is shown in the job's view.
test_the_page_knows_every_parameter() {
	command -v node >/dev/null || skip "node is not here"
	cbct parameters --json >"$work/parameters.json"
	node "$here/parameters.mjs" "$top/clients/web/src/parameters.js" "$work/parameters.json" ||
		fail "clients/web/src/parameters.js with the table that \`cbct parameters\` shows"
}

# lang/de.js has every text that the sources have, with the same values in it.
test_every_language_has_every_text() {
	command -v node >/dev/null || skip "node is not here"
	node "$here/strings.mjs" "$top/clients/web/src" || fail "each file of clients/web/src/lang with all texts"
}

# Planes, slabs and files from disk against volumes in closed form.
test_the_page_samples_volumes_as_they_are() {
	command -v node >/dev/null || skip "node is not here"
	node "$here/sampling.mjs" "$top/clients/web/src" || fail "samples where they lie"
}

test_the_page_has_a_sentence_for_every_problem() {
	command -v node >/dev/null || skip "node is not here"
	node "$here/problems.mjs" "$top/clients/web/src/problems.js" "$top/daemon/problem.c" || fail "the sentences of daemon/problem.c"
}

# What stands for the whole page where npm is not.
test_the_plain_page_shows_jobs_and_escapes_names() {
	start_daemon
	req POST /v1/scans -H 'Content-Type: application/json' --data-binary '{"name": "<script>\"&", "detector": {"columns": 4, "rows": 4, "pixel_mm": [1, 1]},
		"projections": {"count": 3, "sample": "float32", "quantity": "line_integral"},
		"geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "angle_step_deg": 120}}'
	expect_status 201
	scan=$(json .id)
	post_job '{"scan": "SCAN", "fdk": {}}'
	for path in /plain "/plain/$job"; do
		req GET "$path"
		expect_status 200
		[[ $(header content-type) == text/html* ]] || fail "HTML"
		grep -q '&lt;script&gt;&quot;&amp;' "$body" || fail "the name, escaped"
		! grep -q '<script' "$body" || fail "no markup out of a name"
	done
	req GET /plain/nothing
	expect_problem 404
	req GET "/plain/$job?volume=%3Cscript%3E"
	expect_problem 404
	req GET "/plain/$job?window=9"
	expect_problem 400
	stop_daemon
}

# One result for each test that the browser reports.
browser_tests() {
	local line status
	CHROMIUM=$(command -v chromium || command -v chromium-browser || true)
	if [ -z "$CHROMIUM" ]; then why="chromium is not here"
	elif ! command -v node >/dev/null || ! command -v npm >/dev/null; then why="node or npm is not here"
	elif [ ! -e "$BUILD/web/files/index.html" ]; then why="the daemon was built without the page"
	elif ! install_tools; then why="npm cannot install playwright-core: $(grep -m 1 -i err "$work/npm.log")"
	else why=; fi
	if [ -n "$why" ]; then
		echo "SKIP the page in a browser: $why"
		echo "skip $(basename "$0") the page in a browser: $why" >>"$RESULTS"
		return
	fi
	if ! (set -eEuo pipefail; trap - EXIT; prepare; echo "$url $scan $job $balls $calibration $sagging" >"$work/prepared") >"$work/prepare.log" 2>&1; then
		echo "FAIL the page in a browser: no job to look at"
		tail -5 "$work/prepare.log"
		echo "fail $(basename "$0") the page in a browser" >>"$RESULTS"
		return
	fi
	read -r url scan job balls calibration sagging <"$work/prepared"
	cp "$here"/*.mjs "$tools/"
	BALLS=$balls CALIBRATION=$calibration SAGGING=$sagging PHANTOM=$phantom \
		URL=$url OUT=$work SCAN=$scan FINISHED=$job NAME=$name SOURCES=$top/clients/web/src CHROMIUM=$CHROMIUM HOME=$work timeout -k 20 600 node "$tools/page.mjs" 2>&1 | tee "$work/browser.log"
	status=${PIPESTATUS[0]}
	# the same job where the daemon asks who it is
	stop_daemon
	rm -f "$work/tokens"
	VIEW=$(cbct token new ward --role view --file "$work/tokens" 2>/dev/null)
	ACQUIRE=$(cbct token new arm-3 --role acquire --file "$work/tokens" 2>/dev/null)
	ADMIN=$(cbct token new office --role admin --file "$work/tokens" 2>/dev/null)
	# what no record tells of is set aside, and the page says so
	mkdir "$state/jobs/1m7yam2f9rgevqe7"
	echo something >"$state/jobs/1m7yam2f9rgevqe7/final.nii"
	start_daemon --threads 1 --tokens "$work/tokens" --keep 86400 --max-jobs 5 --client-bytes 1G --max-bytes 2G
	VIEW=$VIEW ACQUIRE=$ACQUIRE ADMIN=$ADMIN CALIBRATION=$calibration URL=$url OUT=$work SCAN=$scan FINISHED=$job CHROMIUM=$CHROMIUM HOME=$work timeout -k 20 300 node "$tools/access.mjs" 2>&1 | tee -a "$work/browser.log"
	status=$((status + PIPESTATUS[0]))
	archive_test
	while read -r line; do
		case $line in
		pass\ * | FAIL\ *) echo "$(tr 'A-Z' 'a-z' <<<"${line%% *}") $(basename "$0") ${line#* }" | sed 's/ ([0-9.]* s)$//' >>"$RESULTS" ;;
		esac
	done <"$work/browser.log"
	if [ "$status" != 0 ] && ! grep -q '^FAIL' "$work/browser.log"; then
		echo "FAIL the page in a browser: ended with status $status"
		echo "fail $(basename "$0") the page in a browser: status $status" >>"$RESULTS"
	fi
}

# The same job in the viewer of an archive that it is sent to.
archive_test() {
	local plugins=/usr/share/orthanc/plugins why= rest series pid
	stop_daemon
	if [ ! -e "$plugins/libOrthancWebViewer.so" ] || ! command -v Orthanc >/dev/null; then why="orthanc-webviewer is not here"
	elif ! ldd "$BUILD/cbct-dicom" | grep libdcmnet >/dev/null; then why="cbct-dicom was built without libdcmtk-dev"; fi
	if [ -n "$why" ]; then
		echo "SKIP the archive's own viewer: $why"
		echo "skip $(basename "$0") the archive's own viewer: $why" >>"$RESULTS"
		return
	fi
	(
		set -eEuo pipefail
		trap - EXIT
		. "$top/tests/http/archive.sh"
		plugin=$plugins/libOrthancDicomWeb.so
		more=$(jq -n --arg viewer "$plugins/libOrthancWebViewer.so" --arg cache "$work/viewer" '{Plugins: [$viewer], WebViewer: {CachePath: $cache}}')
		start_archive
		jq -n '{destinations: [{name: "pacs", kind: "dimse", host: "127.0.0.1", port: '$dimse', title: "ARCHIVE", commitment_s: 0}]}' >"$work/destinations.json"
		start_daemon --threads 1 --destinations "$work/destinations.json"
		cbct send "$job" --to pacs --wait
		echo "$url $rest $(curl -sSf "$rest/series" | jq -r '.[0]')" >"$work/sent"
	) >"$work/archive-prepare.log" 2>&1
	if ! read -r url rest series <"$work/sent"; then
		echo "FAIL the archive's own viewer: nothing was sent: $(tail -3 "$work/archive-prepare.log")" | tee -a "$work/browser.log"
		status=$((status + 1))
	else
		URL=$url OUT=$work ARCHIVE=$rest SERIES=$series FINISHED=$job CHROMIUM=$CHROMIUM HOME=$work timeout -k 20 200 node "$tools/archive.mjs" 2>&1 | tee -a "$work/browser.log"
		status=$((status + PIPESTATUS[0]))
	fi
	while read -r pid; do kill -9 "$pid" 2>/dev/null; done <"$work/peers"
	rm -f "$work/peers"
}

install_tools() {
	cmp -s "$here/package-lock.json" "$tools/installed" && return 0
	mkdir -p "$tools"
	cp "$here"/package*.json "$tools/"
	(cd "$tools" && npm ci --ignore-scripts --no-audit --no-fund --fetch-retries=1 --fetch-timeout=30000) >"$work/npm.log" 2>&1 || return 1
	cp "$here/package-lock.json" "$tools/installed"
}

run_tests
browser_tests
stop_daemon
