#!/usr/bin/env python3
"""One call after the other of the daemon and its worker fails once, in a small scan from POST to download.

every.py BUILD WORK [--first F] [--stride K] [--seconds S] [--processes P] [PROGRAM:CALL:KIND ...]

A reference run counts the calls. Then each N-th of them (in steps of K; by default all) fails in a run of its own,
with build/every.so (tests/http/every.c). Several of these side by side, F from 1 to K, share the N among them. Where
a daemon ended before it listened, for want of memory, the next run begins with the directory that it left, and only
each 16th of these goes on to the end without a fault. What holds in each: no program ends by a signal that was not
sent, nothing hangs, whatever was acknowledged is there and has the right bytes, also after a restart (half of them
without the catalogue, which is made again from the directories), a volume has the bits of the reference, a job that
was acknowledged ends as succeeded, and no more is left than in the reference: blocks of memory and descriptors when
the program ends, files after the restart. Prints a row for each PROGRAM:CALL:KIND; exit status 1 when something did
not hold.
"""
import argparse
import concurrent.futures
import http.client
import itertools
import json
import os
import random
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from typing import Dict, List, Optional, Tuple, Union

EIO, EINTR, ENOSPC, EMFILE, ENOMEM = 5, 4, 28, 24, 12
KINDS: Dict[str, List[Union[int, str]]] = {
    "write": [EIO, EINTR, "short"], "pwrite": [EIO, EINTR, "short"], "read": [EIO, EINTR, "short"],
    "pread": [EIO, EINTR, "short"], "fsync": [EIO], "fdatasync": [EIO], "rename": [EIO], "link": [EIO],
    "mmap": [ENOMEM], "fallocate": [ENOSPC, EINTR], "open": [EMFILE, EINTR], "accept": [EMFILE, EINTR],
    "malloc": [ENOMEM], "send": [EINTR, "short"], "recv": [EINTR, "short"],
}
VIEWS, COLUMNS, ROWS = 8, 24, 16
SCAN = {
    "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [4, 4]},
    "projections": {"count": VIEWS, "sample": "float32", "quantity": "line_integral"},
    "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000,
                 "first_angle_deg": 0, "angle_step_deg": 360 / VIEWS},
}
JOB = {"grid": {"size": [16, 16, 8], "spacing_mm": [4, 4, 6]}, "fdk": {},
       "sart": {"iterations": 2, "subsets": 2}, "emit": ["fdk"]}
FILES = ["catalogue.sqlite", "catalogue.sqlite-synced", "deleted", "jobs/ID/fdk.nii", "jobs/ID/final.nii",
         "jobs/ID/record.json", "lock", "reserve", "reserve-start", "scans/ID/projections.raw", "scans/ID/projections.sums",
         "scans/ID/record.json", "scans/ID/scan.json"]  # of the reference; an empty catalogue is set aside with a note
SET_ASIDE = "quarantine/catalogue.sqlite."
SHAPES: Dict[str, object] = {}  # of the documents in the reference run
LOST = 2  # blocks; OpenSSL 3.0 loses as many of an entry of its table of names for which there is no memory
PATIENCE = 60.0  # s that no step of a run takes, on a machine however loaded
rng = random.Random(1)
VIEW = [struct.pack(f"<{COLUMNS * ROWS}f", *(rng.random() for _ in range(COLUMNS * ROWS))) for _ in range(VIEWS)]


class Gone(Exception):
    """The daemon has ended."""


class Daemon:
    def __init__(self, build: str, work: str, every: Optional[str], *options: str, backend: str = "cpu") -> None:
        environment = dict(os.environ, OMP_NUM_THREADS="1")
        if every is not None:
            environment.update(LD_PRELOAD=f"{build}/every.so", CBCT_EVERY=every)
        self.out = open(f"{work}/out", "w+b")
        self.err = open(f"{work}/err", "ab")
        self.process = subprocess.Popen(
            [f"{build}/cbctd", "--listen", "127.0.0.1:0", "--state-dir", f"{work}/state", "--backend", backend,
             "--threads", "1", *options], stdout=self.out, stderr=self.err, env=environment)
        self.port = 0
        end = time.monotonic() + PATIENCE
        while self.port == 0 and self.process.poll() is None:
            text = open(f"{work}/out", "rb").read().decode()
            if text.startswith("listening on ") and text.endswith("\n"):
                self.port = int(text.rsplit(":", 1)[1].strip().rstrip("/"))
            elif time.monotonic() > end:
                raise AssertionError("the daemon hangs at its start")
            else:
                time.sleep(0.005)

    def ask(self, method: str, path: str, body: Optional[bytes] = None, headers: Dict[str, str] = {}) -> Tuple[int, bytes]:
        """A reply, or 0 where the connection broke though the daemon lives."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE)
        try:
            connection.request(method, path, body, headers)
            reply = connection.getresponse()
            return reply.status, reply.read()
        except TimeoutError:
            raise AssertionError(f"{method} {path} hangs") from None
        except (http.client.HTTPException, OSError):
            if self.process.poll() is not None:
                raise Gone from None
            time.sleep(0.05)
            if self.process.poll() is not None:
                raise Gone from None
            return 0, b""
        finally:
            connection.close()

    def insist(self, method: str, path: str, body: Optional[bytes] = None, headers: Dict[str, str] = {}) -> bytes:
        """What a client does: it asks again where that helps. One call fails; the next try meets none."""
        for _ in range(40):
            status, reply = self.ask(method, path, body, headers)
            if 200 <= status < 300:
                return reply
            if 400 <= status < 500:
                raise AssertionError(f"{method} {path}: {status} {reply[:300]!r}")
            time.sleep(0.05)
        raise AssertionError(f"{method} {path} does not go on: {status} {reply[:300]!r}")

    def stop(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise AssertionError("the daemon hangs at its stop") from None
        finally:
            self.out.close()
            self.err.close()


def shape(value: object) -> object:
    """The names of a document's members, and of theirs."""
    if isinstance(value, dict):
        return {name: shape(member) for name, member in value.items()}
    return [shape(item) for item in value] if isinstance(value, list) else None


class Client:
    """Knows what was acknowledged, and goes on from there with another daemon."""

    def __init__(self) -> None:
        self.scan = self.job = ""
        self.views: List[int] = []

    def run(self, daemon: Daemon) -> bytes:
        headers = {"Content-Type": "application/json", "Idempotency-Key": "scan"}
        if not self.scan:
            self.scan = json.loads(daemon.insist("POST", "/v1/scans", json.dumps(SCAN).encode(), headers))["id"]
        for view in self.views:
            self.check(daemon, view)
        for view in range(VIEWS):
            if view not in self.views:
                daemon.insist("PUT", f"/v1/scans/{self.scan}/projections/{view}", VIEW[view])
                self.views.append(view)
        if not self.job:
            body = json.dumps({**JOB, "scan": self.scan}).encode()
            self.job = json.loads(daemon.insist("POST", "/v1/jobs", body, {**headers, "Idempotency-Key": "job"}))["id"]
        end = time.monotonic() + PATIENCE
        while True:
            job = json.loads(daemon.insist("GET", f"/v1/jobs/{self.job}?wait=5"))
            if job["state"] in ("succeeded", "failed", "cancelled"):
                break
            assert time.monotonic() < end, f"the job goes on for ever: {job['state']} {job['waiting_for']}"
        assert job["state"] == "succeeded", f"the job {job['state']}: {job['error']}"
        self.check(daemon, VIEWS - 1)
        scan = json.loads(daemon.insist("GET", f"/v1/scans/{self.scan}"))
        for name, document in (("scan", scan), ("job", job)):
            usual = SHAPES.setdefault(name, shape(document))
            assert shape(document) == usual, f"the {name}'s document has other members: {json.dumps(document)}"
        return daemon.insist("GET", f"/v1/jobs/{self.job}/volumes/final?format=raw")

    def check(self, daemon: Daemon, view: int) -> None:
        got = daemon.insist("GET", f"/v1/scans/{self.scan}/projections/{view}")
        assert got == VIEW[view], f"projection {view} was acknowledged and has other bytes"


def ended(status: int, what: str) -> None:
    assert status >= 0, f"{what} ended by signal {-status}"
    assert status in (0, 1), f"{what} ended with {status}"


def files(state: str) -> List[str]:
    """What a directory of state holds, each scan and job named alike."""
    walk = os.walk(state)
    names = (os.path.relpath(os.path.join(folder, name), state) for folder, _, inside in walk for name in inside)
    return sorted({re.sub(r"/[0-9a-z]{16}/", "/ID/", name) for name in names})


def left(mark: str) -> List[int]:
    """The most blocks of memory and descriptors that a process left when it ended, as build/every.so says."""
    lines = open(f"{mark}.left").read().split("\n") if os.path.exists(f"{mark}.left") else []
    return [max(numbers) for numbers in zip(*([int(word) for word in line.split()] for line in lines if line))]


def failed_in(mark: str) -> str:
    """The file name of the program or library whose call failed."""
    return os.path.basename(open(f"{mark}.fired").readline().strip()) if os.path.exists(f"{mark}.fired") else ""


def one_run(build: str, work: str, every: Optional[str], rebuilt: bool = False, brief: bool = False) -> Optional[bytes]:
    """The volume, of a run in which calls fail, and of what is there after it. rebuilt: by a catalogue that is made again
    from the directories. brief: None where the daemon ended before it listened, and what it left stays for the next run."""
    open(f"{work}/err", "w").close()
    client, volume = Client(), None
    daemon = Daemon(build, work, every)
    started = daemon.port != 0
    try:
        if started:
            volume = client.run(daemon)
    except Gone:
        pass
    except BaseException:
        daemon.process.kill()
        daemon.stop()
        raise
    ended(daemon.stop(), "the daemon")
    if brief and not started:
        return None
    for name in os.listdir(f"{work}/state") if rebuilt and os.path.exists(f"{work}/state") else []:
        if name.startswith("catalogue.sqlite"):
            os.unlink(f"{work}/state/{name}")
    daemon = Daemon(build, work, None)
    try:
        assert daemon.port != 0, "the daemon does not start again"
        again = client.run(daemon)
    except Gone:
        raise AssertionError("the daemon ended without a fault") from None
    finally:
        status = daemon.stop()
    ended(status, "the daemon")
    assert volume is None or volume == again, "the volume has other bytes after a restart"
    there = files(f"{work}/state")
    extra = [name for name in there if name not in FILES and not (rebuilt and name.startswith(SET_ASIDE))]
    assert not extra, f"files are left: {' '.join(extra)}"
    shutil.rmtree(f"{work}/state")
    return again


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("build")
    parser.add_argument("work")
    parser.add_argument("--first", type=int, help="the first N; by default the middle of the first step")
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1e9, help="ends after that, wherever it is")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("what", nargs="*")
    options = parser.parse_intermixed_args()
    shutil.rmtree(options.work, ignore_errors=True)
    os.makedirs(options.work)
    place = threading.local()
    places = itertools.count()

    def folder() -> str:
        """Of this thread."""
        if not hasattr(place, "path"):
            place.path = f"{options.work}/{next(places)}"
            os.makedirs(place.path)
        return str(place.path)

    def count(pair: str) -> Tuple[int, List[int]]:
        """The calls of a run without a fault, and what it leaves."""
        program, call = pair.split(":")
        mark = f"{folder()}/{pair}"
        one_run(options.build, folder(), f"{program} {call} 0 0 {mark}")
        return os.path.getsize(f"{mark}.count") if os.path.exists(f"{mark}.count") else 0, left(mark)

    def fail(row: str, number: int) -> Optional[Tuple[bool, str]]:
        """Whether the call failed, and what did not hold then. None: there was no time left."""
        program, call, kind = row.split(":")
        mark = f"{folder()}/{row}:{number}"
        if time.monotonic() > end:
            return None
        try:
            volume = one_run(options.build, folder(), f"{program} {call} {number} {kind} {mark}", number % 2 == 1,
                             call == "malloc" and number % 16 != 0)
            assert volume in (None, reference), "the volume has other bits"
            usually = counts[f"{program}:{call}"][1]
            for what, here, usual in zip(("blocks of memory", "descriptors"), left(mark), usually):
                lost = LOST if failed_in(mark).startswith("libcrypto.") else 0
                assert here <= usual + lost, f"{here} {what} are left when it ends, {usual} otherwise"
            wrong = ""
        except AssertionError as error:
            wrong = str(error)
            shutil.rmtree(f"{folder()}/state", ignore_errors=True)
            shutil.copy(f"{folder()}/err", f"{options.work}/{row}:{number}.log")
            if os.path.exists(f"{mark}.fired"):
                shutil.copy(f"{mark}.fired", f"{options.work}/{row}:{number}.fired")
        except Exception as error:
            wrong = f"the test itself: {error!r}"
        if wrong:
            print(f"  {row}:{number}: {wrong}", flush=True)
        return os.path.exists(f"{mark}.fired"), wrong

    reference = one_run(options.build, folder(), None)
    end = time.monotonic() + options.seconds
    what = options.what or [f"{p}:{c}:{k}" for p in ("cbctd", "cbct-worker") for c in KINDS for k in KINDS[c]]
    wrong = total = 0
    with concurrent.futures.ThreadPoolExecutor(options.processes) as pool:
        pairs = sorted({row.rsplit(":", 1)[0] for row in what})
        counts = dict(zip(pairs, pool.map(count, pairs)))
        runs = {}
        for row in what:
            calls = counts[row.rsplit(":", 1)[0]][0]
            first = options.first or (1 + options.stride // 2 if calls > options.stride else 1)
            numbers = range(first, calls + 1, options.stride)
            runs[row] = [pool.submit(fail, row, number) for number in numbers]
        for row, futures in runs.items():
            done = [future.result() for future in futures]
            made = [result for result in done if result is not None]
            hit, bad = sum(fired for fired, _ in made), sum(text != "" for _, text in made)
            wrong += bad
            total += hit
            print(f"{row:28} {counts[row.rsplit(':', 1)[0]][0]:6} calls, {len(made):5} runs, {hit:5} failed calls, {bad:3} did not hold",
                  flush=True)
    print(f"{total} calls failed, {wrong} runs did not hold")
    return wrong > 0


if __name__ == "__main__":
    sys.exit(main())
