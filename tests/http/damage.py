#!/usr/bin/env python3
"""Random damage to a state directory: found, repaired or harmless, never silent, and nothing deleted.

damage.py BUILD WORK ROUNDS [SEED]

A daemon's state is made once, with every kind of file that a daemon writes (KINDS, which is held against the sources):
scans of all kinds (complete, closed, with flat, dark, defects and scatter, incomplete), calibrations, jobs that ended,
one of them annotated, one sent, one refined, one that waits, and some that were stopped in the middle and left what they
had reached. All that a client can read of it is recorded. Then each round damages one file of a copy: a bit flipped, the
file cut off, or deleted; before the daemon starts, where a killed daemon left its log, or under the running daemon.
Whatever a client gets afterwards must be what was recorded, or say what is wrong with it: a problem document, a
projection that is missing again, an entry of /v1/quarantine, a job that failed. A reply that is neither is a silent
difference. And whatever was in the directory must still be there, or in quarantine/.
"""
import collections
import http.client
import json
import os
import random
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

BUILD, WORK = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
ROUNDS = int(sys.argv[3])
SEED = int(sys.argv[4]) if len(sys.argv) > 4 else random.SystemRandom().randrange(1 << 31)
VIEWS, COLUMNS, ROWS, ITERATIONS = 8, 12, 8, 500
SCATTER = {"kind": "images", "columns": 3, "rows": 2, "every": 5}
GRID = {"size": [8, 8, 8], "spacing_mm": [4, 4, 4]}
PHANTOM = {"kind": "circles", "balls": 12, "diameter_mm": 110, "distance_mm": 90, "ball_mm": 6, "first_angle_deg": 10,
           "shift_deg": 15}
MARK = {"kind": "ellipse", "points": [[0, 0, 0], [5, 0, 0], [0, 3, 0]]}
# Times of this run, and what follows from a run that is repeated.
CHANGING = {"timings", "eta_s", "attempts", "progress", "started", "ended", "queued", "stage", "device", "plan", "age_s"}

# ---- the kinds of files, by their names ----

ID = "[0-9a-z]{16}"
KINDS = {name: re.compile(pattern.replace("ID", ID)) for name, pattern in {
    "catalogue.sqlite": "catalogue.sqlite", "its log": "catalogue.sqlite-wal", "how far that is synced": "catalogue.sqlite-synced",
    "lock": "lock", "reserve": "reserve", "reserve-start": "reserve-start", "deleted": "deleted", "devices.json": "devices.json",
    "audit.jsonl": "audit.jsonl", "audit.jsonl.%s": "audit.jsonl.[0-9]{12}",
    "scan.json": "scans/ID/scan.json", "record.json": "scans/ID/record.json", "a job's record": "jobs/ID/record.json",
    "projections.raw": "scans/ID/projections.raw", "projections.sums": "scans/ID/projections.sums",
    "flat.f32": "scans/ID/flat.f32", "dark.f32": "scans/ID/dark.f32", "defects.u8": "scans/ID/defects.u8",
    "scatter.raw": "scans/ID/scatter.raw", "scatter.sums": "scans/ID/scatter.sums",
    "%s.nii": "jobs/ID/(fdk|final|iter-[0-9]+).nii", "annotations.json": "jobs/ID/annotations.json",
    "refinement.json": "jobs/ID/refinement.json", "refining": "jobs/ID/refining",
    "checkpoint.f32": "jobs/ID/checkpoint.f32", "checkpoint-before.f32": "jobs/ID/checkpoint-before.f32",
    "request.json": "calibrations/ID/request.json", "result.json": "calibrations/ID/result.json",
    "quarantine": "quarantine/.*Z", "a note with it": "quarantine/(jobs|scans)-.*Z.json",
    "a note alone": "quarantine/catalogue.sqlite.*Z.json", "a directory": "quarantine/scans-.*Z/.*"}.items()}
# Names in the sources of files that a state directory does not have, or only for a moment.
ELSEWHERE = {
    "%s.tmp", "unfinished.tmp", "checkpoint-given.tmp", # half-written: the next start removes them
    "stream-XXXXXX.tmp", # has no name any more when it is written
    "restored", # cbct's, gone behind the first start
    "received", "%08d-%s.dcm", # what came by DICOM, until cbct-dicom has made a scan of it; the daemon reads nothing there
    "catalogue.postgresql", # without SQLite
    "%.40s-%d.raw", "%.40s-scatter-%.10s.raw", "CT%05d.dcm", "openapi.json", # names of downloads, and a path
    "scans", "jobs", "cbctd", # of directories
}


def names_in_sources():
    """Of files, as they stand in strings of the daemon and of what it shares with its worker."""
    top = Path(__file__).resolve().parents[2]
    names = set()
    for path in [*top.glob("daemon/**/*.[ch]*"), *top.glob("proto/**/*.[ch]*"), top / "core/scan/image.h"]:
        text = re.sub(r"/\*.*?\*/|#include[^\n]*", "", path.read_text(), flags=re.S)
        for string in re.findall(r'"((?:[^"\\]|\\.)*)"', text):
            names.update(re.findall(r"(?:^|/)([%\w.-]+\.(?:raw|f32|u8|json|jsonl|sums|nii|tmp|sqlite|dcm|postgresql))$", string))
            names.update(re.findall(r"^%s/([a-z][a-z-]*)$", string))
        names.update(re.findall(r'#define \w+_FILE\w* "([^"]+)"', text))
        names.update(re.findall(r'\{"(reserve[a-z-]*)"', text))
    return names


def check_kinds(directories):
    unknown = names_in_sources() - ELSEWHERE - KINDS.keys()
    assert not unknown, f"kinds of files that this test does not know: {sorted(unknown)}"
    assert not ELSEWHERE - names_in_sources(), f"no name in the sources any more: {ELSEWHERE - names_in_sources()}"
    there = {str(path.relative_to(directory)) for directory in directories for path in Path(directory).rglob("*") if path.is_file()}
    absent = [kind for kind, pattern in KINDS.items() if not any(pattern.fullmatch(name) for name in there)]
    assert not absent, f"the state has no {absent}: {sorted(there)}"
    strange = [name for name in there if ".tmp" not in name and not any(pattern.fullmatch(name) for pattern in KINDS.values())]
    assert not strange, f"files of no known kind: {strange}"


World = collections.namedtuple("World", "directory scans jobs calibrations") # a state, and what is in it by name


class Gone(Exception):
    """The daemon is not there any more."""


class Refused(Gone):
    """The daemon does not start."""

    def __init__(self, status, said):
        super().__init__(f"it did not start: exit status {status}: {said[-300:]}")
        # Whoever keeps the audit log decides what becomes of one whose last line is none.
        self.file = re.search(r"(audit\.jsonl\S*) does not end with a line of the audit log: move it away", said)


class Daemon:
    def __init__(self, state, *more):
        self.state = state
        self.more = more
        self.connection = None
        self.log = open(WORK / "cbctd.err", "a+")
        self.start()

    def start(self):
        began = self.log.tell()
        self.process = subprocess.Popen(
            [BUILD / "cbctd", "--listen", "127.0.0.1:0", "--state-dir", self.state, "--backend", "cpu", "--threads", "1",
             "--http-threads", "2", "--audit", Path(self.state) / "audit.jsonl", "--audit-bytes", "4096", *self.more],
            stdout=subprocess.PIPE, stderr=self.log, text=True)
        line = self.process.stdout.readline()
        if not line.startswith("listening on "):
            self.process.wait()
            self.log.seek(began)
            raise Refused(self.process.returncode, self.log.read())
        self.port = int(line.rsplit(":", 1)[1])
        end = time.monotonic() + 20
        while self.get("/readyz")[0] != 200:
            if time.monotonic() > end:
                raise Gone("not ready after 20 s")
            time.sleep(0.005)

    def stop(self, number=signal.SIGTERM):
        self.disconnect()
        self.process.send_signal(number)
        self.process.wait()
        self.process.stdout.close()
        self.log.close()

    def disconnect(self):
        if self.connection is not None:
            self.connection.close()
        self.connection = None

    def request(self, method, path, body=None, headers=None):
        for attempt in range(2):
            try:
                if self.connection is None:
                    self.connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
                    self.connection.connect()
                    self.connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.connection.request(method, path, body, headers or {})
                reply = self.connection.getresponse()
                return reply.status, reply.read()
            except (OSError, http.client.HTTPException):
                self.disconnect()
                if attempt == 1 or self.process.poll() is not None:
                    raise Gone(f"{method} {path}: no reply") from None
        raise AssertionError

    def get(self, path):
        return self.request("GET", path)

    def post(self, path, document):
        return self.request("POST", path, json.dumps(document), {"Content-Type": "application/json"})

    def document(self, path):
        status, body = self.get(path)
        return json.loads(body) if status == 200 else None


# ---- the state ----

def samples(count, kind, seed):
    noise = random.Random(seed)
    values = [noise.uniform(0.1, 2) if kind == "line_integral" else noise.uniform(9000, 30000)
              for _ in range(count * ROWS * COLUMNS)]
    return struct.pack(f"<{len(values)}f", *values)


def make_scan(daemon, name, kind, views, images=False, complete=False):
    status, body = daemon.post("/v1/scans", {
        "name": name, "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [8, 8]},
        "projections": {"count": VIEWS, "sample": "float32", "quantity": kind, **({"scatter": SCATTER} if images else {})},
        "patient": {"name": "Doe^Jane", "id": "4711", "birth_date": "1970-02-28", "sex": "F", "position": "HFS"},
        "study": {"uid": "1.2.3.4", "accession_number": "A17", "referring_physician": "House^G"},
        "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000,
                     "first_angle_deg": 0, "angle_step_deg": 360 / VIEWS}})
    assert status == 201, body
    scan = json.loads(body)["id"]
    data = samples(VIEWS, kind, name)
    one = len(data) // VIEWS
    for view in views:
        status, body = daemon.request("PUT", f"/v1/scans/{scan}/projections/{view}", data[view * one:(view + 1) * one])
        assert status == 201, body
    if images:
        pixels = ROWS * COLUMNS
        for image, body in (("flat", struct.pack(f"<{pixels}f", *[60000.0 + i for i in range(pixels)])),
                            ("dark", struct.pack(f"<{pixels}f", *[100.0] * pixels)),
                            ("defects", bytes(1 if i == 40 else 0 for i in range(pixels)))):
            status, reply = daemon.request("PUT", f"/v1/scans/{scan}/{image}", body)
            assert status in (200, 201, 204), reply
        for view in (0, 5, 7):
            status, reply = daemon.request("PUT", f"/v1/scans/{scan}/scatter/{view}", struct.pack("<6f", *[50.0 + view] * 6))
            assert status in (200, 201, 204), reply
    if complete:
        status, body = daemon.request("POST", f"/v1/scans/{scan}/complete")
        assert status == 200, body
    return scan


def post_job(daemon, scan, iterations, **more):
    status, body = daemon.post("/v1/jobs", {"scan": scan, "grid": GRID, "fdk": {}, "tv": None,
                                            "sart": {"iterations": iterations, "subsets": 2}, **more})
    assert status == 202, body
    return json.loads(body)["id"]


def wait_for(daemon, job, seconds=120):
    """Its end, or that it waits for something that is missing again."""
    end = time.monotonic() + seconds
    while True:
        status, body = daemon.get(f"/v1/jobs/{job}?wait=0.1")
        document = json.loads(body)
        if (status != 200 or document["state"] in ("succeeded", "failed", "cancelled")
                or (waits(document) and document["waiting_for"] not in (["check"], ["worker"]))): # which end by themselves
            return status, body
        if time.monotonic() > end:
            raise Gone(f"job {job} does not end")


def make_calibrations(daemon, scans):
    """One that succeeded, whose pictures are gone, as they are after months; and one that failed."""
    phantom, balls = WORK / "phantom.json", WORK / "balls"
    phantom.write_text(json.dumps(PHANTOM))
    subprocess.run([BUILD / "cbct", "simulate", "-o", balls, "--balls", phantom, "--density", ".6", "--columns", "150", "--rows", "120",
                    "--pixel", "2.54", "--sag", "daly", "--views", "12", "--photons", "20000", "--raw", "flat"],
                   check=True, stdout=subprocess.DEVNULL)
    scan = subprocess.run([BUILD / "cbct", "upload", "--url", f"http://127.0.0.1:{daemon.port}", "--quiet", balls],
                          check=True, stdout=subprocess.PIPE, text=True).stdout.split()[0]
    made = {}
    for name, of in (("succeeded", scan), ("failed", scans["plain"])):
        status, body = daemon.post("/v1/calibrations", {"scan": of, "phantom": PHANTOM, "arm": "room 2"})
        assert status == 202, body
        made[name] = json.loads(body)["id"]
        document = daemon.document(f"/v1/calibrations/{made[name]}?wait=60")
        assert document["state"] == name, document
    assert daemon.request("DELETE", f"/v1/scans/{scan}")[0] == 204
    return made


def make_jobs(daemon, scans):
    jobs = {"ended": post_job(daemon, scans["plain"], 3, emit=["fdk", 1, 3]),
            "corrected": post_job(daemon, scans["images"], 2, send=[{"to": "away", "volumes": "last"}]),
            "refined": post_job(daemon, scans["plain"], 1, refine={"geometry": True})}
    for job in jobs.values():
        status, body = wait_for(daemon, job)
        assert json.loads(body)["state"] == "succeeded", body
        daemon.get(f"/v1/jobs/{job}/volumes?wait=20")
    status, body = daemon.request("PUT", f"/v1/jobs/{jobs['ended']}/annotations",
                                  json.dumps({"measurements": [{"id": "1", **MARK}]}),
                                  {"Content-Type": "application/json", "If-Match": "*"})
    assert status == 200, body
    status, body = daemon.request("DELETE", f"/v1/jobs/{jobs['corrected']}/send/away")
    assert status in (200, 202, 204), body
    # Without FDK: an idle worker attends one that has it, and leaves it for another job after seconds only.
    jobs["waiting"] = post_job(daemon, scans["arriving"], 2, fdk=None)
    return jobs


def delete_some(daemon, scans):
    """They must not come back."""
    scan = make_scan(daemon, "gone", "line_integral", [0])
    job = post_job(daemon, scans["plain"], 1)
    wait_for(daemon, job)
    daemon.get(f"/v1/jobs/{job}/volumes?wait=20")
    for path in (f"/v1/scans/{scan}", f"/v1/jobs/{job}"):
        status, body = daemon.request("DELETE", path)
        assert status == 204, body


def put_what_nobody_knows(state, scans, jobs):
    """For quarantine/: a scan without a record, a volume without a row."""
    one = scans["arriving"]
    shutil.copytree(state / "scans" / one, state / "scans" / (one[:-1] + ("0" if one[-1] != "0" else "1")))
    shutil.copy2(state / "jobs" / jobs["ended"] / "final.nii", state / "jobs" / jobs["ended"] / "iter-2.nii")


def sealed(document):
    """As proto/seal.h has it."""
    content = json.dumps(document).encode()
    table = struct.pack("<I", zlib.crc32(content))
    line = f"cbctd seal 1: {len(content)} in {1 << 20}, {zlib.crc32(table):08x}".ljust(55)
    return content + table + line.encode() + f"{zlib.crc32(line.encode()):08x}\n".encode()


def make_state(state):
    destinations = WORK / "destinations.json"
    destinations.write_text(json.dumps({"destinations": [{"name": "away", "kind": "dicomweb", "url": "http://127.0.0.1:1/"}]}))
    daemon = Daemon(state, "--destinations", destinations)
    scans = {"plain": make_scan(daemon, "plain", "line_integral", range(VIEWS)),
             "images": make_scan(daemon, "images", "intensity", range(VIEWS), images=True),
             "closed": make_scan(daemon, "closed", "line_integral", [7, 0, 2, 3, 5, 6], complete=True),
             "arriving": make_scan(daemon, "arriving", "line_integral", [4, 1])}
    calibrations = make_calibrations(daemon, scans)
    daemon.stop()
    for path in state.glob("catalogue.sqlite*"): # a loss that quarantine/ has a note of
        path.unlink()
    daemon = Daemon(state, "--destinations", destinations)
    jobs = make_jobs(daemon, scans)
    delete_some(daemon, scans)
    daemon.stop()
    put_what_nobody_knows(state, scans, jobs)
    # A machine that had cards once.
    (state / "devices.json").write_bytes(sealed({"set_aside": [{"device": 0, "since": 1.5e9, "error": "it hung"}], "backend": "cuda"}))
    jobs["stopped"] = stop_in_the_middle(state, scans["plain"], ITERATIONS)
    return World(state, scans, jobs, calibrations)


def make_refining(state):
    """A job that was stopped amid its refinement. Rounds of this state alone wait for it."""
    source = WORK / "sweep"
    subprocess.run([BUILD / "cbct", "simulate", "--phantom", "asymmetric", "--scale", "90", "--density", "0.02", "--views", "48",
                    "--arc", "210", "--columns", "24", "--rows", "24", "--pixel", "14", "-o", source],
                   check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    daemon = Daemon(state, "--checkpoint-seconds", "0.01")
    scan = subprocess.run([BUILD / "cbct", "upload", "--url", f"http://127.0.0.1:{daemon.port}", "--quiet", source],
                          check=True, stdout=subprocess.PIPE, text=True).stdout.split()[0]
    while True:
        job = post_job(daemon, scan, 1, refine={"geometry": True})
        while not (file := state / "jobs" / job / "refining").exists() and not daemon.document(f"/v1/jobs/{job}")["ended"]:
            pass
        daemon.stop()
        if file.exists():
            return World(state, {"sweep": scan}, {"stopped": job}, {})
        daemon = Daemon(state, "--checkpoint-seconds", "0.01")
        wait_for(daemon, job)
        daemon.get(f"/v1/jobs/{job}/volumes?wait=20")
        assert daemon.request("DELETE", f"/v1/jobs/{job}")[0] == 204


def stop_in_the_middle(state, scan, iterations):
    """A job that has left a checkpoint; on a machine that is too fast, a longer one."""
    daemon = Daemon(state)
    job = post_job(daemon, scan, iterations, priority="urgent")
    while True:
        document = daemon.document(f"/v1/jobs/{job}")
        if document["iteration"] >= iterations // 2 or document["state"] == "succeeded":
            break
        time.sleep(0.002)
    daemon.stop()
    if (Path(state) / "jobs" / job / "checkpoint.f32").exists():
        return job
    daemon = Daemon(state)
    daemon.get(f"/v1/jobs/{job}/volumes?wait=20")
    status, body = daemon.request("DELETE", f"/v1/jobs/{job}")
    assert status == 204, body
    daemon.stop()
    return stop_in_the_middle(state, scan, 2 * iterations)


# ---- what a client can read ----

MORE_OF = {"ended": ("events", "annotations"), "corrected": ("events", "send"), "refined": ("refinement",)}
unanswered = [] # for each job asked for in this round: whether the reply said that something went wrong
posted = set() # jobs of this round that were not removed: a daemon that ended, or that refused it, has them still


def settled(value):
    """A document without what changes by itself."""
    if isinstance(value, dict):
        return {name: settled(member) for name, member in value.items() if name not in CHANGING}
    return [settled(member) for member in value] if isinstance(value, list) else value


def look(daemon, world):
    """All replies by their paths: (status, bytes or document). Also makes a job of each scan that can have one."""
    _, scans, jobs, calibrations = world
    seen, stays = {}, set()
    wait_for(daemon, jobs["stopped"])
    for scan in [name for name in ("images", "closed") if name in scans]:
        status, body = daemon.post("/v1/jobs", {"scan": scans[scan], "grid": GRID, "fdk": {}, "sart": None, "tv": None})
        key = f"a new job of {scan}"
        seen[key] = (status, None)
        unanswered.append(status >= 500) # such a job may be there or not
        if status == 202:
            job = json.loads(body)["id"]
            posted.add(job)
            document = json.loads(wait_for(daemon, job)[1])
            seen[key] = (200 if document["state"] == "succeeded" else 500, None)
            if document["state"] == "succeeded":
                status, body = daemon.get(f"/v1/jobs/{job}/volumes/final?format=raw")
                seen[key + ": final"] = (status, body)
            daemon.get(f"/v1/jobs/{job}/volumes?wait=20")
            for _ in range(200): # one that waits with a worker is cancelled soon, then removed
                if daemon.request("DELETE", f"/v1/jobs/{job}?wait=5")[0] in (204, 404):
                    posted.discard(job)
                    break
                time.sleep(0.02)
            else:
                stays.add(job) # each refusal was told
    for scan in scans.values():
        path = f"/v1/scans/{scan}"
        seen[path] = document_of(daemon.get(path))
        for view in range(VIEWS):
            seen[f"{path}/projections/{view}"] = daemon.get(f"{path}/projections/{view}")
        if any(seen[f"{path}/projections/{view}"][0] == 404 for view in range(VIEWS)):
            seen[path] = document_of(daemon.get(path)) # a file that went under the daemon is met by the first who reads it
        for view in (0, 5, 7) if scan == scans.get("images") else ():
            seen[f"{path}/scatter/{view}"] = daemon.get(f"{path}/scatter/{view}")
    for name, job in jobs.items():
        path = f"/v1/jobs/{job}"
        seen[path] = document_of(daemon.get(path))
        ended = seen[path][0] == 200 and seen[path][1]["state"] in ("succeeded", "failed", "cancelled")
        status, volumes = document_of(daemon.get(f"{path}/volumes?wait={20 if ended else 0}"))
        seen[path + "/volumes"] = (status, volumes)
        for volume in volumes["volumes"] if status == 200 else []:
            seen[f"{path}/volumes/{volume['name']}"] = daemon.get(f"{path}/volumes/{volume['name']}")
        for more in MORE_OF.get(name, ()):
            seen[f"{path}/{more}"] = daemon.get(f"{path}/{more}")
    for calibration in calibrations.values():
        path = f"/v1/calibrations/{calibration}"
        seen[path] = document_of(daemon.get(path + "?wait=20"))
    for kind in ("scans", "jobs", "calibrations"):
        status, body = daemon.get(f"/v1/{kind}")
        listed = [entry["id"] for entry in json.loads(body)[kind]] if status == 200 else None
        seen[f"/v1/{kind}"] = (status, listed and [entry for entry in listed if entry not in stays])
    seen = {key: reply if reply[0] < 400 else (reply[0], None) for key, reply in seen.items()} # request ids
    # A catalogue that is damaged under the daemon may refuse this list, too, which is told.
    aside = daemon.document("/v1/quarantine")
    seen["quarantine"] = aside["entries"] if aside else None
    return seen


def document_of(reply):
    status, body = reply
    return status, settled(json.loads(body))


# ---- differences ----

def without(document, *names):
    return {name: value for name, value in document.items() if name not in names}


def members_that_differ(got, expected):
    return json.dumps({name: [got.get(name), expected.get(name)] for name in got.keys() | expected.keys()
                       if got.get(name) != expected.get(name)})


def views_in(runs):
    return {view for first, last in runs for view in range(first, last + 1)}


def waits(document):
    return document["state"] == "waiting" and bool(document["waiting_for"])


def rows_of(document):
    return [without(row, "seconds") for row in document.get("history", [])]


def differs(key, expected, got, seen, jobs, scans):
    """None, "told", or what is silently different."""
    if got == expected:
        return None
    parent = seen.get("/".join(key.split("/")[:4]), (404, None))
    if "/volumes" in key and (parent[0] != 200 or waits(parent[1]) or parent[1]["state"] == "failed"):
        return "told" # with its job
    if got is None:
        return "told" if seen.get(key.split(":")[0], (200,))[0] != 200 else "not listed"
    status, body = got
    aside = [entry["from"] or "" for entry in seen["quarantine"] or []]
    parts = key.split("/")
    if key.startswith("a new job"):
        return "told" if status != 200 else f"{key} differs"
    if status == 404 and len(parts) == 6 and parts[4] in ("projections", "scatter"):
        scan = seen[f"/v1/scans/{parts[3]}"]
        if scan[0] != 200 or int(parts[5]) in (views_in(scan[1]["missing"]) if parts[4] == "projections" else scan[1]["scatter"]["missing"]):
            return "told"
        return "404, but not missing"
    if status == 404:
        return "told" if f"{parts[2]}/{parts[3]}" in aside else "404 without a note"
    if status >= 400:
        return "told" if status in (409, 410, 422, 500, 503, 507) else f"status {status}"
    if len(parts) == 3: # the lists
        absent = [entry for entry in expected[1] if entry not in body]
        more = [entry for entry in body if entry not in expected[1] and entry not in posted]
        return "told" if len(more) <= sum(unanswered) and all(f"{parts[2]}/{entry}" in aside for entry in absent) else f"{more}, not {absent}"
    if len(parts) == 4 and parts[2] == "scans":
        names = ("received", "received_count", "missing", "warnings", "state", "flat", "dark", "defects", "derived", "digests", "scatter")
        # The digest of the projections is that of all of them, or null where some are missing.
        digests = body["digests"] == dict(expected[1]["digests"], projections=body["digests"]["projections"]) and \
            body["digests"]["projections"] in (None, expected[1]["digests"]["projections"])
        if not digests or without(body, *names) != without(expected[1], *names):
            return f"another document: {members_that_differ(body, expected[1])[:600]}"
        more = views_in(body["missing"]) - views_in(expected[1]["missing"]) or \
            (body["scatter"] and set(body["scatter"]["missing"]) - set(expected[1]["scatter"]["missing"]))
        return "told" if more or body["warnings"] != expected[1]["warnings"] else "another document"
    if len(parts) == 4 and parts[2] == "calibrations":
        return "told" if body["state"] == "failed" and body["error"] != expected[1].get("error") else \
            f"another calibration: {members_that_differ(body, expected[1])[:600]}"
    job = next((name for name, id in jobs.items() if len(parts) > 3 and parts[3] == id), None)
    if len(parts) == 4 and parts[2] == "jobs":
        if body["state"] == "failed" or (waits(body) and job != "waiting"):
            return "told"
        if body["state"] != expected[1]["state"] and job != "waiting":
            return f"state {body['state']}"
        if job in ("stopped", "waiting") and rows_of(body) == rows_of(expected[1]):
            return None # the run was repeated; a checkpoint that is of no use is told
        names = ("warnings", "views", "waiting_for", "damaged")
        return "told" if without(body, *names) == without(expected[1], *names) else f"another document: {members_that_differ(body, expected[1])}"
    if len(parts) == 5 and parts[4] == "volumes":
        if job == "stopped":
            # One that was damaged as it was made has no digest, and is never sent.
            refused = [volume["name"] for volume in body["volumes"] if seen[f"{key}/{volume['name']}"][0] >= 400]
            bare = [[without(volume, "created") for volume in some["volumes"] if volume["name"] not in refused]
                    for some in (body, expected[1])]
            return "another volume" if bare[0] != bare[1] else "told" if refused else None
        told = [volume["name"] for volume in body["volumes"] if volume.get("damaged")]
        return "told" if told else f"another list: {json.dumps(body)[:600]}"
    if key.endswith("/events"):
        extra = [event for event in body.split(b"\n\n") if event not in expected[1].split(b"\n\n")]
        rest = b"\n\n".join(event for event in body.split(b"\n\n") if event not in extra)
        return "told" if rest == expected[1] and all(b"damaged" in event for event in extra) else \
            f"other events: {extra[:3]}, without {[event for event in expected[1].split(chr(10).encode() * 2) if event not in body][:3]}"
    return "other bytes"


def notes_that_differ(seen, expected, damaged, kind):
    """Entries of quarantine/: whoever runs the machine removes them, and what is not removed says what it did."""
    wrong = []
    there = {entry["name"]: entry for entry in seen or []}
    for entry in expected if seen is not None else []:
        got = there.get(entry["name"])
        if got is None and not (kind == "delete" and damaged.startswith("quarantine/")):
            wrong.append(f"quarantine: {entry['name']} is not listed")
        elif got is not None and got != entry and got["from"] is not None:
            wrong.append(f"quarantine: {members_that_differ(got, entry)}")
    return wrong


def inventory(state):
    """Files that must not vanish, without those that come and go by themselves."""
    names = set()
    for path in Path(state).rglob("*"):
        name = path.name
        if path.is_file() and ".tmp" not in name and not name.startswith(("checkpoint", "lock", "reserve")) and \
                str(path.relative_to(state)) not in ("catalogue.sqlite", "catalogue.sqlite-wal", "catalogue.sqlite-shm", "catalogue.sqlite-synced"):
            names.add(str(path.relative_to(state)))
    return names


def vanished(before, state, damaged, kind, stopped):
    after = inventory(state)
    moved = {name for name in after if name.startswith("quarantine/")}
    gone = set()
    for name in before - after:
        if name == damaged and kind == "delete":
            continue
        base = name.split("/")
        # What an attempt left that did not end: the repeated run makes it again, and its content is compared.
        if base[:2] == ["jobs", stopped] and base[2:] != ["checkpoint.f32"]:
            continue
        if not any(base[-1] in entry.split("/")[-1] and (len(base) < 3 or base[1] in entry) for entry in moved):
            gone.add(name)
    return gone


# ---- damage ----

def damage(choose, state, under):
    """One file of those that are there; a running daemon renames its temporary ones meanwhile."""
    while True:
        try:
            return damage_one(choose, state, under)
        except FileNotFoundError:
            pass


def damage_one(choose, state, under):
    files = sorted(path for path in (Path(state) / under).rglob("*") if path.is_file() and path.name not in ("lock", "reserve", "reserve-start"))
    path = choose.choice(files)
    size = path.stat().st_size
    kind = choose.choice(["flip", "flip", "truncate", "delete"]) if size > 0 else "delete"
    if kind == "flip":
        at, bit = choose.randrange(size), choose.randrange(8)
        with open(path, "r+b") as file:
            file.seek(at)
            byte = file.read(1)[0]
            file.seek(at)
            file.write(bytes([byte ^ 1 << bit]))
        what = f"bit {bit} of byte {at} of {size}"
    elif kind == "truncate":
        at = choose.randrange(size)
        os.truncate(path, at)
        what = f"{at} of {size} bytes"
    else:
        path.unlink()
        what = f"{size} bytes"
    return str(path.relative_to(state)), kind, what


def copy(source, to):
    shutil.rmtree(to, ignore_errors=True)
    subprocess.run(["cp", "-a", source, to], check=True)


def audit_lines(state):
    return b"".join(path.read_bytes() for path in [*sorted(Path(state).glob("audit.jsonl.*")), Path(state) / "audit.jsonl"])


def audit_differs(state, expected):
    """None, "told" by the command that is there for it, with the line that the daemon's log has had last, or not."""
    if audit_lines(state).startswith(expected):
        return None
    last = json.loads(expected.splitlines()[-1])
    mark = f"{last['n']}:{last['chain']}"
    verify = subprocess.run([BUILD / "cbct", "audit", "verify", "--mark", mark, Path(state) / "audit.jsonl"], capture_output=True, text=True)
    return "told" if verify.returncode != 0 or verify.stdout.startswith("caution: lines 1 to") else f"audit log: {verify.stdout}"


def start(state):
    """A daemon, behind what somebody must do who was told to. Returns it, and whether there was something."""
    try:
        return Daemon(state), False
    except Refused as refused:
        if refused.file is None:
            raise
        aside = Path(state) / "quarantine"
        aside.mkdir(exist_ok=True)
        (Path(state) / refused.file[1]).rename(aside / f"{refused.file[1]}.moved-away")
        return Daemon(state), True


def one_round(choose, mode, world, expected, audit):
    state = WORK / "state"
    copy(world.directory, state)
    starts = 2 if mode == "up" else 1
    seen_all = []
    what = ("", "nothing", "")
    told = False
    unanswered.clear()
    posted.clear()
    before = inventory(state)
    # Rounds of a refinement are longer, and the rest of that state is that of others, too.
    under = f"jobs/{world.jobs['stopped']}" if mode == "refining" else ""
    try:
        if mode != "up":
            what = damage(choose, state, under)
        for number in range(starts):
            daemon, mended = start(state)
            told |= mended
            try:
                if mode == "up" and number == 0:
                    if choose.random() < 0.5: # some of it is in memory then
                        look(daemon, world)
                    what = damage(choose, state, under)
                seen_all.append(look(daemon, world))
            except Gone as gone:
                # It ended because its disk cannot be trusted; the next start says what it found.
                daemon.process.wait(timeout=60)
                if daemon.process.returncode != 1:
                    return what, [f"the daemon ended with {daemon.process.returncode}: {gone}"], True
                if number + 1 == starts:
                    seen_all.append(look_again(state, world))
            finally:
                if daemon.process.poll() is None:
                    daemon.stop()
    except Gone as gone:
        return what, [str(gone)], True
    silent = []
    for seen in seen_all:
        told |= (seen["quarantine"] or []) != expected["quarantine"]
        silent += notes_that_differ(seen["quarantine"], expected["quarantine"], what[0], what[1])
        for key in expected:
            if key == "quarantine":
                continue
            verdict = differs(key, expected[key], seen.get(key), seen, world.jobs, world.scans)
            told |= verdict == "told"
            if verdict not in (None, "told"):
                silent.append(f"{key}: {verdict}")
    verdict = audit_differs(state, audit)
    told |= verdict == "told"
    if verdict not in (None, "told"):
        silent.append(verdict)
    gone = vanished(before, state, what[0], what[1], world.jobs["stopped"])
    return what, silent + [f"vanished: {name}" for name in sorted(gone)], told


def look_again(state, world):
    daemon = Daemon(state)
    try:
        return look(daemon, world)
    finally:
        daemon.stop()


def killed_state(source, to):
    """As a daemon leaves it that is killed: the log of the catalogue is there, and both checkpoints amid their exchange."""
    job = to / "jobs" / source.jobs["stopped"]
    while True:
        copy(source.directory, to)
        daemon = Daemon(to)
        scan = make_scan(daemon, "late", "line_integral", [0, 1])
        daemon.request("DELETE", f"/v1/scans/{scan}")
        daemon.stop(signal.SIGKILL)
        assert (to / "catalogue.sqlite-wal").stat().st_size > 0
        if (job / "checkpoint.f32").exists(): # else the job had ended
            break
    shutil.copy2(job / "checkpoint.f32", job / "checkpoint-before.f32")
    return source._replace(directory=to)


def what_is_expected(world):
    """Also that it is the same twice."""
    copy(world.directory, WORK / "state")
    expected = look_again(WORK / "state", world)
    again = look_again(WORK / "state", world)
    for key in expected:
        assert again[key] == expected[key], f"{key} is not the same twice: {again[key]} {expected[key]}"
    return expected


def main():
    print(f"seed {SEED}", flush=True)
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    stopped, refining = make_state(WORK / "stopped"), make_refining(WORK / "refining")
    killed = killed_state(stopped, WORK / "killed")
    check_kinds([stopped.directory, killed.directory, refining.directory])
    worlds = {"down": stopped, "killed": killed, "up": stopped, "refining": refining}
    expected = {"refining": what_is_expected(refining), "down": what_is_expected(stopped)}
    audits = {mode: audit_lines(worlds[mode].directory) for mode in worlds}
    audits["killed"] = audits["down"] # lines of a daemon that was killed may be cut short
    choose = random.Random(SEED)
    counts = collections.Counter()
    failures = 0
    began = time.monotonic()
    for number in range(ROUNDS):
        mode = "refining" if number % 40 == 39 else choose.choice(["down", "down", "killed", "up"])
        what, wrong, told = one_round(choose, mode, worlds[mode], expected.get(mode, expected["down"]), audits[mode])
        counts[what[1]] += 1
        counts["told" if told else "harmless"] += 1
        if wrong:
            failures += 1
            vanishing = sum(line.startswith("vanished") for line in wrong)
            counts["vanished"] += vanishing
            counts["silent"] += len(wrong) - vanishing
            print(f"round {number}, {mode}: {what[1]} {what[0]}, {what[2]}")
            for line in wrong[:6]:
                print(f"    {line}"[:700])
            sys.stdout.flush()
    seconds = time.monotonic() - began
    print(f"{ROUNDS} rounds in {seconds:.0f} s: {counts['flip']} flips, {counts['truncate']} truncations, "
          f"{counts['delete']} deletions; {counts['told']} told, {counts['harmless']} harmless or mended, "
          f"{counts['silent']} silent differences, {counts['vanished']} files vanished")
    sys.exit(1 if failures else 0)


main()
