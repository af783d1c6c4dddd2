#!/usr/bin/env python3
"""The daemon and its worker are killed (-9) at random moments of uploads and of reconstructions, and nothing is lost.

kills.py BUILD WORK [--uploads N] [--jobs N] [--processes P] [--seed S]

N kills while four connections upload projections of a scan, make scans and jobs and delete old ones, and N while a job iterates;
shared among P processes with a state directory each. After each kill: what was acknowledged is there (scans,
projections with their bytes, jobs), what was deleted is gone, jobs that had ended have their volumes with the
bits they had, nothing is damaged or set aside; at the end every other job has succeeded with the bits of a run
that nobody disturbed. Prints the seed; exit status 1 when something did not hold, with the moment and the directory.
"""
import argparse
import collections
import hashlib
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
from typing import Counter, Dict, List, Optional, Set

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from every import COLUMNS, PATIENCE, ROWS, Daemon, Gone  # noqa: E402

VIEWS, CONNECTIONS, SCANS_MOST = 64, 4, 5
SCAN = {
    "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [4, 4]},
    "projections": {"count": VIEWS, "sample": "float32", "quantity": "line_integral"},
    "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000,
                 "first_angle_deg": 0, "angle_step_deg": 360 / VIEWS},
}
GRID = {"size": [24, 24, 12], "spacing_mm": [3, 3, 4]}
SMALL = {"grid": GRID, "fdk": {}, "sart": {"iterations": 2, "subsets": 4}, "emit": ["fdk"]}


def long_jobs(iterations: int) -> List[Dict[str, object]]:
    return [{"grid": GRID, "fdk": {}, "sart": {"iterations": iterations, "subsets": 8}, "tv": {"method": "gradient", "iterations": 1},
             "emit": [20]}, {"grid": GRID, "cgls": {"iterations": 2 * iterations}}]


KIND = {"Content-Type": "application/json"}
CHECKPOINT = ("--checkpoint-seconds", "0.05")


def projections() -> List[bytes]:
    rng = random.Random(7)
    return [struct.pack(f"<{COLUMNS * ROWS}f", *(rng.random() * 0.2 for _ in range(COLUMNS * ROWS))) for _ in range(VIEWS)]


VIEW = projections()


class Broken(Exception):
    """The connection broke: it is not known whether the request took effect."""


class Scan:
    def __init__(self, key: str) -> None:
        self.key, self.id = key, ""
        self.acknowledged: Set[int] = set()
        self.deleting = self.deleted = False


class Job:
    def __init__(self, scan: Scan, recipe: Dict[str, object], key: str) -> None:
        self.scan, self.recipe, self.key, self.id = scan, recipe, key, ""
        self.volumes: Dict[str, str] = {}  # digests, of a job that was seen to have succeeded
        self.killed_at = -1                # the checkpoint that was there when its worker was killed last
        self.deleting = self.deleted = False


class Cell:
    """One state directory, its daemon and all that was promised about it."""
    may_be_torn = False  # what was written and not acknowledged when it ended
    long = long_jobs(300)  # long enough for several kills

    def __init__(self, build: str, work: str, rng: random.Random) -> None:
        self.build, self.work, self.rng = build, work, rng
        self.lock = threading.Lock()
        self.scans: List[Scan] = []
        self.jobs: List[Job] = []
        self.reference: Dict[str, Dict[str, str]] = {}
        self.keys, self.counts = 0, collections.Counter()  # type: int, Counter[str]
        os.makedirs(work)
        self.prepare()
        self.daemon = Daemon(build, work, None, *CHECKPOINT)
        for recipe in [SMALL, *self.long]:
            scan = self.make_scan()
            self.upload(scan, list(range(VIEWS)))
            job = self.make_job(scan, recipe)
            self.finish(job)
            self.reference[json.dumps(recipe)] = job.volumes
        self.jobs, self.scans = [], []

    def prepare(self) -> None:
        """Before the first daemon."""

    # ---- requests; whoever calls knows what Broken and Gone mean ----

    def ask(self, method: str, path: str, body: Optional[bytes] = None, headers: Dict[str, str] = {}) -> "tuple[int, bytes]":
        status, reply = self.daemon.ask(method, path, body, headers)
        if status == 0:
            raise Broken
        self.counts["requests"] += 1
        return status, reply

    def good(self, method: str, path: str, body: Optional[bytes] = None, headers: Dict[str, str] = {}) -> bytes:
        status, reply = self.ask(method, path, body, headers)
        assert 200 <= status < 300, f"{method} {path}: {status} {reply[:300]!r}"
        return reply

    def key(self) -> Dict[str, str]:
        self.keys += 1
        return {**KIND, "Idempotency-Key": f"key-{self.keys}"}

    def post_scan(self, scan: Scan) -> None:
        made = json.loads(self.good("POST", "/v1/scans", json.dumps(SCAN).encode(), {**KIND, "Idempotency-Key": scan.key}))["id"]
        assert scan.id in ("", made), f"another scan {made} for the key of {scan.id}"
        scan.id = made

    def make_scan(self) -> Scan:
        scan = Scan(self.key()["Idempotency-Key"])
        with self.lock:
            self.scans.append(scan)
        self.post_scan(scan)
        return scan

    def post_job(self, job: Job) -> None:
        body = json.dumps({**job.recipe, "scan": job.scan.id}).encode()
        made = json.loads(self.good("POST", "/v1/jobs", body, {**KIND, "Idempotency-Key": job.key}))["id"]
        assert job.id in ("", made), f"another job {made} for the key of {job.id}"
        job.id = made

    def make_job(self, scan: Scan, recipe: Dict[str, object]) -> Job:
        job = Job(scan, recipe, self.key()["Idempotency-Key"])
        with self.lock:
            self.jobs.append(job)
        self.post_job(job)
        return job

    def upload(self, scan: Scan, views: List[int]) -> None:
        """One view, or a run of views."""
        name = f"{views[0]}" if len(views) == 1 else f"{views[0]}-{views[-1]}"
        status, reply = self.ask("PUT", f"/v1/scans/{scan.id}/projections/{name}", b"".join(VIEW[k] for k in views))
        if status == 404 and scan.deleting:  # another connection had its last view sent and deleted the scan
            return
        assert 200 <= status < 300, f"PUT {name} of scan {scan.id}: {status} {reply[:300]!r}"
        with self.lock:
            scan.acknowledged.update(views)
            self.counts["acknowledged"] += len(views)

    def delete(self, what: "Scan | Job", path: str) -> None:
        what.deleting = True
        status, reply = self.ask("DELETE", path)
        # 404: a try before it was cut off and took effect
        assert status in (200, 202, 204, 404), f"DELETE {path}: {status} {reply[:300]!r}"
        what.deleted = status != 202

    def finish(self, job: Job) -> None:
        end = time.monotonic() + 5 * PATIENCE
        while not self.see(job, wait=True):
            assert time.monotonic() < end, f"job {job.id} goes on for ever"

    def see(self, job: Job, wait: bool = False) -> bool:
        """True when it has ended. The bits are looked at whenever it has, those that it had stay."""
        document = json.loads(self.good("GET", f"/v1/jobs/{job.id}" + ("?wait=5" if wait else "")))
        assert document["state"] not in ("failed", "cancelled"), f"job {job.id} {document['state']}: {document['error']}"
        if document["state"] != "succeeded":
            assert not job.volumes, f"job {job.id} had succeeded and is {document['state']}"
            return False
        names = [row["name"] for row in json.loads(self.good("GET", f"/v1/jobs/{job.id}/volumes"))["volumes"]]
        volumes = {name: hashlib.sha256(self.good("GET", f"/v1/jobs/{job.id}/volumes/{name}?format=raw")).hexdigest() for name in names}
        assert job.volumes in ({}, volumes), f"job {job.id} has other volumes than before"
        undisturbed = self.reference.get(json.dumps(job.recipe), volumes)
        assert volumes == undisturbed, f"job {job.id} has other bits than a run that nobody disturbed: {sorted(volumes)}"
        self.counts["volumes"] += len(volumes)
        job.volumes = volumes
        return True

    # ---- deaths ----

    def end_abruptly(self, process: "subprocess.Popen[bytes]") -> None:
        """Of a daemon."""
        process.kill()

    def restore(self) -> None:
        """What must be there before the next daemon."""

    def restart(self) -> None:
        self.restore()
        if self.rng.random() < 0.15:  # dies again while it recovers
            starting = subprocess.Popen([f"{self.build}/cbctd", "--listen", "127.0.0.1:0", "--state-dir", f"{self.work}/state",
                                         "--backend", "cpu", "--threads", "1"], stdout=subprocess.DEVNULL, stderr=self.daemon.err)
            time.sleep(self.rng.uniform(0, 0.1))
            self.end_abruptly(starting)
            starting.wait()
            self.restore()
            self.counts["killed at the start"] += 1
        self.daemon.out.close()
        self.daemon.err.close()
        self.daemon = Daemon(self.build, self.work, None, *CHECKPOINT)
        assert self.daemon.port != 0, "the daemon does not start again"

    @staticmethod
    def children(pid: int) -> List[int]:
        try:
            return [int(child) for task in os.listdir(f"/proc/{pid}/task")
                    for child in open(f"/proc/{pid}/task/{task}/children").read().split()]
        except OSError:
            return []

    def worker(self) -> int:
        """Its process, or 0 between two."""
        children = self.children(self.daemon.process.pid)
        return children[0] if children else 0

    def checkpoint(self, job: Job) -> int:
        try:
            head = open(f"{self.work}/state/jobs/{job.id}/checkpoint.f32", "rb").read(40)
        except OSError:
            return 0
        match = re.match(rb"cbctd checkpoint (\d+)", head)
        return int(match.group(1)) if match else 0

    def given(self) -> Optional[List[Job]]:
        """Jobs that the worker has or may get at any moment; None where one made no progress since its last death."""
        with self.lock:
            jobs = [job for job in self.jobs if job.id and not job.volumes and not job.deleting]
        states = {job: json.loads(self.daemon.ask("GET", f"/v1/jobs/{job.id}")[1] or b'{"state": "queued"}')["state"] for job in jobs}
        given = [job for job in jobs if states[job] == "running"] or [job for job in jobs if states[job] == "queued"]
        return None if any(job.killed_at >= 0 and self.checkpoint(job) <= job.killed_at for job in given) else given

    def kill(self, worker: bool) -> None:
        """A worker only where that leaves each job with progress between two deaths: without, a job ends for good."""
        running = self.given() if worker else None
        pid = self.worker() if running is not None else 0
        if pid != 0:
            for job in running or []:
                job.killed_at = self.checkpoint(job)
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
            self.counts["workers killed"] += 1
        else:
            self.end_abruptly(self.daemon.process)
            self.counts["daemons killed"] += 1
        self.killed_worker = pid != 0

    # ---- what holds after each ----

    def verify(self) -> None:
        if not self.killed_worker:
            self.daemon.process.wait()
            self.restart()
        for scan in self.scans:
            if not scan.deleting:
                self.post_scan(scan)
        for job in self.jobs:
            if not job.deleting:
                self.post_job(job)
        known = {row["id"] for row in json.loads(self.good("GET", "/v1/scans?limit=1000"))["scans"]}
        for scan in self.scans:
            assert not scan.deleted or scan.id not in known, f"scan {scan.id} was deleted and is back"
            assert scan.deleting or scan.id in known, f"scan {scan.id} is not listed"
            if not scan.deleting:
                self.verify_scan(scan)
        for job in [job for job in self.jobs if job.deleting]:
            status, _ = self.ask("GET", f"/v1/jobs/{job.id}")
            assert status == 404 or not job.deleted, f"job {job.id} was deleted and is back"
            job.deleted = status == 404
            if not job.deleted:
                self.delete(job, f"/v1/jobs/{job.id}")
        for scan in [scan for scan in self.scans if scan.deleting and not scan.deleted]:
            self.delete(scan, f"/v1/scans/{scan.id}")
        self.jobs = [job for job in self.jobs if not job.deleted]
        self.scans = [scan for scan in self.scans if not scan.deleted]
        for job in self.jobs:
            self.see(job)
        aside = json.loads(self.good("GET", "/v1/quarantine"))
        assert not any(aside.values()), f"set aside: {aside}"

    def verify_scan(self, scan: Scan) -> None:
        document = json.loads(self.good("GET", f"/v1/scans/{scan.id}"))
        there = {view for first, last in document["received"] for view in range(first, last + 1)}
        assert scan.acknowledged <= there, f"projections {sorted(scan.acknowledged - there)} of scan {scan.id} were acknowledged and are missing"
        for view in sorted(there):
            # What was not acknowledged may be there, and then it is whole, or told to be damaged.
            status, reply = self.ask("GET", f"/v1/scans/{scan.id}/projections/{view}")
            if status == 500 and self.may_be_torn and view not in scan.acknowledged and b"urn:cbctd:problem:damaged" in reply:
                self.counts["torn and told"] += 1
                there.remove(view)
                continue
            assert status == 200, f"projection {view} of scan {scan.id}: {status} {reply[:300]!r}"
            assert reply == VIEW[view], f"projection {view} of scan {scan.id} has other bytes"
        self.counts["comparisons"] += len(there)
        scan.acknowledged = there

    # ---- what goes on meanwhile ----

    def client(self, seed: int, first: bool) -> None:
        rng = random.Random(seed)
        try:
            while not self.stopping.is_set():
                with self.lock:
                    open_scans = [scan for scan in self.scans if scan.id and not scan.deleting and len(scan.acknowledged) < VIEWS]
                    scan = rng.choice(open_scans) if open_scans else None
                    missing = [] if scan is None else [k for k in range(VIEWS) if k not in scan.acknowledged]
                if first and len(open_scans) < 2:
                    self.turn_over(rng)
                elif scan is None or not missing:
                    time.sleep(0.001)
                else:
                    start = rng.choice(missing)
                    length = rng.choice([1, 1, 1, 8])
                    self.upload(scan, list(range(start, min(start + length, VIEWS))))
        except (Gone, Broken):
            pass
        except Exception as error:
            if not self.stopping.is_set() or isinstance(error, AssertionError):
                self.wrong.append(error)

    def turn_over(self, rng: random.Random) -> None:
        """An old scan goes, a new one comes, with a job now or later."""
        if len(self.scans) >= SCANS_MOST:
            old = next((scan for scan in self.scans if not scan.deleting and len(scan.acknowledged) == VIEWS
                        and all(job.volumes for job in self.jobs if job.scan is scan)), None)
            if old is None:
                for job in self.jobs:
                    if job.id and not job.volumes and len(job.scan.acknowledged) == VIEWS:
                        self.see(job)
                time.sleep(0.005)
                return
            for job in [job for job in self.jobs if job.scan is old]:
                self.delete(job, f"/v1/jobs/{job.id}")
            self.delete(old, f"/v1/scans/{old.id}")
        scan = self.make_scan()
        if rng.random() < 0.6:
            self.make_job(scan, SMALL)

    def upload_round(self) -> None:
        self.stopping, self.wrong = threading.Event(), []  # type: threading.Event, List[Exception]
        threads = [threading.Thread(target=self.client, args=(self.rng.getrandbits(64), i == 0)) for i in range(CONNECTIONS)]
        for thread in threads:
            thread.start()
        time.sleep(self.rng.uniform(0, 0.4))
        self.kill(self.rng.random() < 0.4)
        if self.killed_worker:
            time.sleep(self.rng.uniform(0, 0.1))
        self.stopping.set()
        for thread in threads:
            thread.join()
        if self.wrong:
            raise self.wrong[0]
        self.verify()

    def job_round(self) -> None:
        unfinished = [job for job in self.jobs if not job.volumes and job.recipe is not SMALL]
        if not unfinished:
            for job in [job for job in self.jobs if not job.volumes]:
                self.upload(job.scan, list(range(VIEWS)))
                self.finish(job)
            if len(self.scans) >= SCANS_MOST:
                self.drop_old()
            scan = self.make_scan()
            self.upload(scan, list(range(VIEWS)))
            unfinished = [self.make_job(scan, self.rng.choice(self.long))]
        job = unfinished[0]
        end = time.monotonic() + PATIENCE
        while self.checkpoint(job) <= job.killed_at and not self.see(job):
            assert time.monotonic() < end, f"job {job.id} makes no progress"
            time.sleep(0.005)
        time.sleep(self.rng.uniform(0, 0.15))
        self.kill(self.rng.random() < 0.6)
        self.verify()

    def drop_old(self) -> None:
        for scan in self.scans[:-1]:
            for job in [job for job in self.jobs if job.scan is scan]:
                self.finish(job)
                self.delete(job, f"/v1/jobs/{job.id}")
            self.delete(scan, f"/v1/scans/{scan.id}")
        self.jobs = [job for job in self.jobs if not job.deleted]
        self.scans = [scan for scan in self.scans if not scan.deleted]

    def end(self) -> None:
        for job in self.jobs:
            self.upload(job.scan, list(range(VIEWS)))
            self.finish(job)
        status = self.daemon.stop()
        assert status == 0, f"the daemon ended with {status}"


def one_process(options: argparse.Namespace) -> int:
    rng = random.Random(options.seed)
    shutil.rmtree(options.work, ignore_errors=True)
    cell, done, begin = None, 0, time.monotonic()
    rounds = ["upload"] * options.uploads + ["job"] * options.jobs
    rng.shuffle(rounds)
    try:
        cell = Cell(options.build, options.work, rng)
        for kind in rounds:
            cell.upload_round() if kind == "upload" else cell.job_round()
            done += 1
        cell.end()
    except (AssertionError, Gone, Broken) as error:
        print(f"WRONG at round {done} of seed {options.seed} in {options.work}: {error!r}", flush=True)
        if cell is not None:
            cell.daemon.process.kill()
            cell.daemon.process.wait()
        return 1
    rows = ", ".join(f"{count} {what}" for what, count in sorted(cell.counts.items()))
    print(f"seed {options.seed}: {done} kills in {time.monotonic() - begin:.0f} s; {rows}", flush=True)
    return 0


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("build")
    parser.add_argument("work")
    parser.add_argument("--uploads", type=int, default=1000)
    parser.add_argument("--jobs", type=int, default=300)
    parser.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(10 ** 6))
    options = parser.parse_args()
    if options.processes == 1:
        return one_process(options)
    print(f"seed {options.seed}, {options.processes} processes", flush=True)
    parts = []
    for i in range(options.processes):
        uploads, jobs = (whole * (i + 1) // options.processes - whole * i // options.processes
                         for whole in (options.uploads, options.jobs))
        parts.append(subprocess.Popen(
            [sys.executable, __file__, options.build, f"{options.work}/{i}", "--uploads", str(uploads), "--jobs", str(jobs),
             "--processes", "1", "--seed", str(options.seed * 1000 + i)]))
    wrong = sum(part.wait() != 0 for part in parts)
    print(f"{options.uploads} kills during uploads and {options.jobs} during reconstructions, {wrong} of {options.processes} processes found something wrong")
    return wrong > 0


if __name__ == "__main__":
    sys.exit(main())
