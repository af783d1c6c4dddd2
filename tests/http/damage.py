#!/usr/bin/env python3
"""Random damage to a state directory: found, repaired or harmless, never silent, and nothing deleted.

damage.py BUILD WORK ROUNDS [SEED]

A daemon's state is made once: scans of all kinds (complete, closed, with flat, dark and defects, incomplete), jobs that
ended, one that waits, and one that was stopped in the middle and left a checkpoint. All that a client can read of it is
recorded. Then each round damages one file of a copy: a bit flipped, the file cut off, or deleted; before the daemon
starts, where a killed daemon left its log, or under the running daemon. Whatever a client gets afterwards must be what
was recorded, or say what is wrong with it: a problem document, a projection that is missing again, an entry of
/v1/quarantine, a job that failed. A reply that is neither is a silent difference. And whatever was in the directory
must still be there, or in quarantine/.
"""
import collections
import http.client
import json
import os
import random
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

BUILD, WORK = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
ROUNDS = int(sys.argv[3])
SEED = int(sys.argv[4]) if len(sys.argv) > 4 else random.SystemRandom().randrange(1 << 31)
VIEWS, COLUMNS, ROWS, ITERATIONS = 8, 12, 8, 1500
GRID = {"size": [8, 8, 8], "spacing_mm": [4, 4, 4]}
# Times of this run, and what follows from a run that is repeated.
CHANGING = {"timings", "eta_s", "attempts", "progress", "started", "ended", "queued", "stage", "device", "plan"}


class Gone(Exception):
    """The daemon is not there any more."""


class Daemon:
    def __init__(self, state):
        self.state = state
        self.connection = None
        self.log = open(WORK / "cbctd.err", "a")
        self.start()

    def start(self):
        self.process = subprocess.Popen(
            [BUILD / "cbctd", "--listen", "127.0.0.1:0", "--state-dir", self.state, "--backend", "cpu", "--threads", "1",
             "--http-threads", "2"],
            stdout=subprocess.PIPE, stderr=self.log, text=True)
        line = self.process.stdout.readline()
        if not line.startswith("listening on "):
            self.process.wait()
            raise Gone(f"it did not start: exit status {self.process.returncode}")
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
        "projections": {"count": VIEWS, "sample": "float32", "quantity": kind},
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


def make_state(state):
    daemon = Daemon(state)
    scans = {"plain": make_scan(daemon, "plain", "line_integral", range(VIEWS)),
             "images": make_scan(daemon, "images", "intensity", range(VIEWS), images=True),
             "closed": make_scan(daemon, "closed", "line_integral", [7, 0, 2, 3, 5, 6], complete=True),
             "arriving": make_scan(daemon, "arriving", "line_integral", [4, 1])}
    jobs = {"ended": post_job(daemon, scans["plain"], 3, emit=["fdk", 1, 3]),
            "corrected": post_job(daemon, scans["images"], 2)}
    for job in jobs.values():
        status, body = wait_for(daemon, job)
        assert json.loads(body)["state"] == "succeeded", body
        daemon.get(f"/v1/jobs/{job}/volumes?wait=20")
    # Without FDK: an idle worker attends one that has it, and leaves it for another job after seconds only.
    jobs["waiting"] = post_job(daemon, scans["arriving"], 2, fdk=None)
    # Deleted: it must not come back.
    gone_scan = make_scan(daemon, "gone", "line_integral", [0])
    gone_job = post_job(daemon, scans["plain"], 1)
    wait_for(daemon, gone_job)
    daemon.get(f"/v1/jobs/{gone_job}/volumes?wait=20")
    for path in (f"/v1/scans/{gone_scan}", f"/v1/jobs/{gone_job}"):
        status, body = daemon.request("DELETE", path)
        assert status == 204, body
    daemon.stop()
    jobs["stopped"] = stop_in_the_middle(state, scans["plain"], ITERATIONS)
    return scans, jobs


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

unanswered = [] # for each job asked for in this round: whether the reply said that something went wrong


def settled(value):
    """A document without what changes by itself."""
    if isinstance(value, dict):
        return {name: settled(member) for name, member in value.items() if name not in CHANGING}
    return [settled(member) for member in value] if isinstance(value, list) else value


def look(daemon, scans, jobs):
    """All replies by their paths: (status, bytes or document). Also makes a job of each scan that can have one."""
    seen, stays = {}, set()
    wait_for(daemon, jobs["stopped"])
    for scan in ("images", "closed"):
        status, body = daemon.post("/v1/jobs", {"scan": scans[scan], "grid": GRID, "fdk": {}, "sart": None, "tv": None})
        key = f"a new job of {scan}"
        seen[key] = (status, None)
        unanswered.append(status >= 500) # such a job may be there or not
        if status == 202:
            job = json.loads(body)["id"]
            document = json.loads(wait_for(daemon, job)[1])
            seen[key] = (200 if document["state"] == "succeeded" else 500, None)
            if document["state"] == "succeeded":
                status, body = daemon.get(f"/v1/jobs/{job}/volumes/final?format=raw")
                seen[key + ": final"] = (status, body)
            daemon.get(f"/v1/jobs/{job}/volumes?wait=20")
            for _ in range(200): # one that waits with a worker is cancelled soon, then removed
                if daemon.request("DELETE", f"/v1/jobs/{job}?wait=5")[0] in (204, 404):
                    break
                time.sleep(0.02)
            else:
                stays.add(job) # each refusal was told
    for scan in scans.values():
        path = f"/v1/scans/{scan}"
        seen[path] = document_of(daemon.get(path))
        for view in range(VIEWS):
            seen[f"{path}/projections/{view}"] = daemon.get(f"{path}/projections/{view}")
    for name, job in jobs.items():
        path = f"/v1/jobs/{job}"
        seen[path] = document_of(daemon.get(path))
        ended = seen[path][0] == 200 and seen[path][1]["state"] in ("succeeded", "failed", "cancelled")
        status, volumes = document_of(daemon.get(f"{path}/volumes?wait={20 if ended else 0}"))
        seen[path + "/volumes"] = (status, volumes)
        for volume in volumes["volumes"] if status == 200 else []:
            seen[f"{path}/volumes/{volume['name']}"] = daemon.get(f"{path}/volumes/{volume['name']}")
        if name in ("ended", "corrected"):
            seen[path + "/events"] = daemon.get(path + "/events")
    for kind in ("scans", "jobs"):
        status, body = daemon.get(f"/v1/{kind}")
        listed = [entry["id"] for entry in json.loads(body)[kind]] if status == 200 else None
        seen[f"/v1/{kind}"] = (status, listed and [entry for entry in listed if entry not in stays])
    seen = {key: reply if reply[0] < 400 else (reply[0], None) for key, reply in seen.items()} # request ids
    # A catalogue that is damaged under the daemon may refuse this list, too, which is told.
    aside = daemon.document("/v1/quarantine")
    seen["quarantine"] = aside["entries"] if aside else []
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
    aside = [entry["from"] or "" for entry in seen["quarantine"]]
    parts = key.split("/")
    if key.startswith("a new job"):
        return "told" if status != 200 else f"{key} differs"
    if status == 404 and len(parts) == 6 and parts[4] == "projections":
        scan = seen[f"/v1/scans/{parts[3]}"]
        if scan[0] != 200 or int(parts[5]) in views_in(scan[1]["missing"]):
            return "told"
        return "404, but not missing"
    if status == 404:
        return "told" if f"{parts[2]}/{parts[3]}" in aside else "404 without a note"
    if status >= 400:
        return "told" if status in (409, 410, 422, 500, 503, 507) else f"status {status}"
    if len(parts) == 3: # the lists
        absent = [entry for entry in expected[1] if entry not in body]
        more = [entry for entry in body if entry not in expected[1]]
        return "told" if len(more) <= sum(unanswered) and all(f"{parts[2]}/{entry}" in aside for entry in absent) else f"{more}, not {absent}"
    if len(parts) == 4 and parts[2] == "scans":
        names = ("received", "received_count", "missing", "warnings", "state", "flat", "dark", "defects", "derived", "digests")
        # The digest of the projections is that of all of them, or null where some are missing.
        digests = body["digests"] == dict(expected[1]["digests"], projections=body["digests"]["projections"]) and \
            body["digests"]["projections"] in (None, expected[1]["digests"]["projections"])
        if not digests or without(body, *names) != without(expected[1], *names):
            return f"another document: {members_that_differ(body, expected[1])[:600]}"
        more = views_in(body["missing"]) - views_in(expected[1]["missing"])
        return "told" if more or body["warnings"] != expected[1]["warnings"] else "another document"
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
            bare = [[without(volume, "created") for volume in some["volumes"]] for some in (body, expected[1])]
            return None if bare[0] == bare[1] else "another volume"
        told = [volume["name"] for volume in body["volumes"] if volume.get("damaged")]
        return "told" if told else f"another list: {json.dumps(body)[:600]}"
    if key.endswith("/events"):
        extra = [event for event in body.split(b"\n\n") if event not in expected[1].split(b"\n\n")]
        rest = b"\n\n".join(event for event in body.split(b"\n\n") if event not in extra)
        return "told" if rest == expected[1] and all(b"damaged" in event for event in extra) else "other events"
    return "other bytes"


def inventory(state):
    """Files that must not vanish, without those that come and go by themselves."""
    names = set()
    for path in Path(state).rglob("*"):
        name = path.name
        if path.is_file() and ".tmp" not in name and not name.startswith(("catalogue.sqlite", "checkpoint", "lock", "reserve")):
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

def damage(choose, state):
    files = sorted(path for path in Path(state).rglob("*") if path.is_file() and path.name not in ("lock", "reserve", "reserve-start"))
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


def one_round(number, choose, states, expected, scans, jobs):
    mode = choose.choice(["down", "down", "killed", "up"])
    state = WORK / "state"
    copy(states["killed" if mode == "killed" else "stopped"], state)
    starts = 2 if mode == "up" else 1
    seen_all = []
    what = None
    unanswered.clear()
    before = inventory(state)
    try:
        if mode != "up":
            what = damage(choose, state)
        for start in range(starts):
            daemon = Daemon(state)
            try:
                if mode == "up" and start == 0:
                    if choose.random() < 0.5: # some of it is in memory then
                        look(daemon, scans, jobs)
                    what = damage(choose, state)
                seen_all.append(look(daemon, scans, jobs))
            except Gone as gone:
                # It ended because its disk cannot be trusted; the next start says what it found.
                daemon.process.wait(timeout=60)
                if daemon.process.returncode != 1:
                    return what, mode, [f"the daemon ended with {daemon.process.returncode}: {gone}"], True
                if start + 1 == starts:
                    seen_all.append(look_again(state, scans, jobs))
            finally:
                if daemon.process.poll() is None:
                    daemon.stop()
    except Gone as gone:
        return what, mode, [str(gone)], True
    silent, told = [], False
    for seen in seen_all:
        told |= bool(seen["quarantine"])
        for key in expected:
            if key == "quarantine":
                continue
            verdict = differs(key, expected[key], seen.get(key), seen, jobs, scans)
            told |= verdict == "told"
            if verdict not in (None, "told"):
                silent.append(f"{key}: {verdict}")
    gone = vanished(before, state, what[0], what[1], jobs["stopped"])
    return what, mode, silent + [f"vanished: {name}" for name in sorted(gone)], told


def look_again(state, scans, jobs):
    daemon = Daemon(state)
    try:
        return look(daemon, scans, jobs)
    finally:
        daemon.stop()


def killed_state(source, to):
    """As a daemon leaves it that is killed: the log of the catalogue is there."""
    copy(source, to)
    daemon = Daemon(to)
    scan = make_scan(daemon, "late", "line_integral", [0, 1])
    daemon.request("DELETE", f"/v1/scans/{scan}")
    daemon.stop(signal.SIGKILL)
    assert (to / "catalogue.sqlite-wal").stat().st_size > 0


def main():
    print(f"seed {SEED}", flush=True)
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    states = {"stopped": WORK / "stopped", "killed": WORK / "killed"}
    scans, jobs = make_state(states["stopped"])
    copy(states["stopped"], WORK / "state")
    expected = look_again(WORK / "state", scans, jobs)
    again = look_again(WORK / "state", scans, jobs)
    for key in expected:
        assert again[key] == expected[key], f"{key} is not the same twice: {again[key]} {expected[key]}"
    killed_state(states["stopped"], states["killed"])
    choose = random.Random(SEED)
    counts = collections.Counter()
    failures = 0
    began = time.monotonic()
    for number in range(ROUNDS):
        what, mode, wrong, told = one_round(number, choose, states, expected, scans, jobs)
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
