#!/usr/bin/env python3
"""Jobs through the daemon on several cards of this host, beside the same jobs on one: volumes, bits, times, memory; kills,
cancels, jobs that make room, and a card that fails in the middle.

Usage: several_cards.py BUILD FOLDER [large]   ends with 1 where a check fails; large: times of 512^3 from 496 views, too

CARDS is how many, all that are there by default. Without a card (BACKEND=cpu) shares of the processor stand for them,
which tries this program only; SIZE is that of its volumes.
"""
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from typing import Any, Callable, Dict, List, Optional, Tuple

BUILD, WORK = (pathlib.Path(argument).resolve() for argument in sys.argv[1:3])
LARGE = "large" in sys.argv[3:]
BACKEND = os.environ.get("BACKEND", "cuda")
SIZE = int(os.environ.get("SIZE", "256"))
CARDS = int(os.environ.get("CARDS", "0"))
PATIENCE = 120.0  # s; no assertion
CONTEXT_MIB = 544  # of a process on a card, as daemon/jobs/memory.c counts it
BOUND_HU = 0.5  # root mean square between one card and several, as between a card and the processor
failures = 0
began = time.monotonic()


def say(text: str) -> None:
    print(f"{time.monotonic() - began:6.1f} s  {text}", flush=True)


def memory_used() -> List[int]:
    """MiB of each card."""
    if BACKEND != "cuda":
        return [0] * (CARDS or 2)
    query = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits"]
    return [int(line) for line in subprocess.run(query, capture_output=True, text=True, check=True).stdout.split()]


CARDS = CARDS or len(memory_used())
ALL = list(range(CARDS))


def check(what: str, good: bool) -> bool:
    global failures
    failures += not good
    say(("pass " if good else "FAIL ") + what)
    return good


class Daemon:
    def __init__(self, *options: str, worker: str = "cbct-worker", fault: Optional[pathlib.Path] = None):
        shutil.rmtree(WORK / "state", ignore_errors=True)
        self.log = open(WORK / "cbctd.err", "ab")
        self.log_from = self.log.tell()
        environment = dict(os.environ, **({"CBCT_FAULT": str(fault)} if fault else {}))
        devices = ["--devices", ",".join(map(str, ALL))] if BACKEND == "cuda" else ["--workers", str(CARDS)]
        self.process = subprocess.Popen(
            [BUILD / "cbctd", "--listen", "127.0.0.1:0", "--state-dir", WORK / "state", "--backend", BACKEND]
            + ["--worker", BUILD / worker, "--log-level", "info", *devices, *options],
            stdout=subprocess.PIPE, stderr=self.log, env=environment, text=True)
        assert self.process.stdout
        for line in self.process.stdout:
            if line.startswith("listening on "):
                self.url = line.split()[2]
                break
        self.until("/v1/devices", lambda d: sum(one["state"] == "idle" for one in d["devices"]) == CARDS)

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait()

    def call(self, method: str, path: str, body: Any = None) -> Any:
        data = json.dumps(body).encode() if body is not None else None
        request = urllib.request.Request(self.url + path, data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE) as reply:
                return json.load(reply)
        except urllib.error.HTTPError as error:
            raise RuntimeError(f"{method} {path}: {error.code} {error.read()[:300]!r}") from error

    def until(self, path: str, wanted: Callable[[Any], bool], patience: float = PATIENCE) -> Any:
        end = time.monotonic() + patience
        while True:
            document = self.call("GET", path)
            if wanted(document):
                return document
            if time.monotonic() > end:
                raise RuntimeError(f"{path} stays {json.dumps(document)[:600]}")
            time.sleep(0.005)

    def upload(self, scan: pathlib.Path) -> str:
        done = subprocess.run([BUILD / "cbct", "upload", scan, "--quiet", "--url", self.url], capture_output=True,
                              text=True, check=True)
        return done.stdout.split()[-1]

    def post(self, recipe: Dict[str, Any], **members: Any) -> str:
        return self.call("POST", "/v1/jobs", dict(recipe, **members))["id"]

    def job(self, job: str, wanted: Callable[[Any], bool]) -> Any:
        return self.until(f"/v1/jobs/{job}", wanted)

    def end(self, job: str, state: str = "succeeded") -> Any:
        document = self.job(job, lambda d: d["state"] in ("succeeded", "failed", "cancelled"))
        if document["state"] != state:
            raise RuntimeError(f"job ended {document['state']}: {document.get('error')}")
        return document

    def idle(self) -> None:
        self.until("/v1/devices", lambda d: all(one["state"] == "idle" for one in d["devices"]))

    def digests(self, job: str) -> Dict[str, str]:
        volumes = self.until(f"/v1/jobs/{job}/volumes", lambda d: all(v["digest"] for v in d["volumes"]))
        return {volume["name"]: volume["digest"] for volume in volumes["volumes"]}

    def volume(self, job: str, name: str, path: pathlib.Path) -> pathlib.Path:
        subprocess.run([BUILD / "cbct", "get", job, name, "-o", path, "--url", self.url], capture_output=True, check=True)
        return path

    def pids(self, worker: int) -> int:
        """The process of that worker, as the log tells."""
        with open(WORK / "cbctd.err", encoding="utf-8", errors="replace") as log:
            log.seek(self.log_from)
            return int(re.findall(rf"worker {worker} \(pid (\d+)\)", log.read())[-1])


def difference_hu(one: pathlib.Path, other: pathlib.Path) -> float:
    done = subprocess.run([BUILD / "cbct", "compare", one, other, "--hu", "--json"], capture_output=True, text=True, check=True)
    return float(re.findall(r'"rmse": *([^,}]*)', done.stdout)[0])


def simulate(name: str, views: int, columns: int, rows: int, pixel: float, *options: str) -> pathlib.Path:
    folder = WORK / name
    subprocess.run([BUILD / "cbct", "simulate", "-o", folder, "--phantom", "head", "--scale", "62", "--density", "0.0192"]
                   + ["--views", str(views), "--arc", "200", "--columns", str(columns), "--rows", str(rows)]
                   + ["--pixel", str(pixel), "--kind", "matrices", *options], capture_output=True, check=True)
    return folder


GRID = {"size": [SIZE, SIZE, SIZE], "spacing_mm": [128 / SIZE] * 3}
METHODS: List[Tuple[str, Dict[str, Any]]] = [
    ("FDK", {"fdk": {}}),
    ("FDK and TV", {"fdk": {}, "tv": {}}),
    ("SART 10, TV", {"fdk": {}, "sart": {"iterations": 10}, "tv": {}, "emit": ["fdk"]}),
    ("OS-SART 10", {"fdk": {}, "sart": {"iterations": 10, "subsets": 10}}),
    ("SIRT 10", {"fdk": {}, "sart": {"iterations": 10, "subsets": 1}}),
    ("CGLS 5", {"cgls": {"iterations": 5}}),
    ("FISTA 10, TV", {"fista": {"iterations": 10}, "tv": {}}),
    ("SART auto", {"fdk": {}, "sart": {"iterations": "auto"}}),
    ("rings, held out", {"fdk": {}, "sart": {"iterations": 5}, "rings": True, "hold_out": True}),
    ("metal", {"fdk": {}, "metal": {"threshold_hu": 1500}}),
    ("reference", {"fdk": {}, "sart": {"iterations": 3}, "precision": "reference"}),
]


def seconds_of(document: Any) -> str:
    stages = {name: value for name, value in document["timings"].items() if name not in ("waiting", "queued") and value}
    return ", ".join(f"{name} {value:.2f}" for name, value in stages.items())


def off_hu(daemon: Daemon, job: Any, other: Any) -> float:
    """Between the last volumes of both."""
    files = [daemon.volume(document["id"], "final", WORK / name) for document, name in ((job, "a.nii"), (other, "b.nii"))]
    return difference_hu(*files)


def run_once(daemon: Daemon, scan: str, recipe: Dict[str, Any], devices: int) -> Any:
    """The job's document at its end; seen_lent: a device was seen to be lent to it."""
    job = daemon.post(recipe, scan=scan, grid=recipe.get("grid", GRID), devices=devices)
    lent = False
    while True:
        document = daemon.call("GET", f"/v1/jobs/{job}")
        if document["state"] in ("succeeded", "failed", "cancelled"):
            break
        if devices > 1 and not lent:
            states = daemon.call("GET", "/v1/devices")["devices"]
            lent = any(one["state"] == "lent" and one["job"] == job for one in states)
    if document["state"] != "succeeded":
        raise RuntimeError(f"{document['state']}: {document.get('error')}")
    daemon.idle()
    document["seen_lent"] = lent
    return document


def several(daemon: Daemon, scan: str) -> None:
    for name, recipe in METHODS:
        try:
            one, all_of = run_once(daemon, scan, recipe, 1), run_once(daemon, scan, recipe, CARDS)
            again = run_once(daemon, scan, recipe, CARDS)
            off = off_hu(daemon, all_of, one)
            same = daemon.digests(all_of["id"]) == daemon.digests(again["id"])
            lent = all_of["seen_lent"] or again["seen_lent"]
            check(f"{name}: {off:.2g} HU, {'the same bits again' if same else 'OTHER BITS'}, ran_on {all_of['ran_on']}, "
                  f"lent {lent}", off <= BOUND_HU and same and sorted(all_of["ran_on"]) == ALL and len(one["ran_on"]) == 1)
            say(f"     1: {seconds_of(one)};  {CARDS}: {seconds_of(again)};  "
                f"iterations {one['iteration']} and {all_of['iteration']}")
            if name in ("FDK", "SART 10, TV"):
                say(f"     plan: {all_of['plan']}")
        except RuntimeError as error:
            check(f"{name}: {error}", False)


def memory(daemon: Daemon, scan: str, before: List[int]) -> None:
    """What contexts take, and that a job on all cards takes no more than it says, beside one context for each of them."""
    recipe = dict(METHODS[2][1], sart={"iterations": 100000})
    for devices in (1, CARDS):
        daemon.idle()
        idle = memory_used()
        job = daemon.post(recipe, scan=scan, grid=GRID, devices=devices)
        document = daemon.job(job, lambda d: d["iteration"] > 2)
        time.sleep(0.3)
        busy = memory_used()
        daemon.call("DELETE", f"/v1/jobs/{job}")
        daemon.end(job, "cancelled")
        daemon.idle()
        told = document["memory"]["total"] / 2**20
        grown, after = sum(busy) - sum(idle), memory_used()
        # A job on several cards leaves nothing of itself on those that were lent to it.
        kept = max(now - then for now, then in zip(after[1:], idle[1:])) if devices > 1 else 0
        check(f"memory, {devices} devices: MiB before any worker {before}, idle {idle}, busy {busy}, after {after}; "
              f"told {told:.0f}, seen {grown}", grown <= told + CONTEXT_MIB * (devices - 1) and kept < 32)


def kills(daemon: Daemon, scan: str) -> None:
    recipe = dict(scan=scan, grid=GRID, fdk={}, sart={"iterations": 60}, emit=["fdk", 10], devices=CARDS)
    job = daemon.post(recipe)
    document = daemon.end(job)
    whole = daemon.digests(job)
    check(f"undisturbed: {document['attempts']} attempt, {seconds_of(document)}", document["attempts"] == 1)
    for at in (8, 30):
        daemon.idle()
        job = daemon.post(recipe)
        document = daemon.job(job, lambda d, at=at: d["iteration"] >= at or d["state"] == "succeeded")
        seen = document["iteration"]
        os.kill(daemon.pids(0), signal.SIGKILL)
        document = daemon.end(job)
        same = daemon.digests(job) == whole
        check(f"kill -9 at iteration {seen}: attempts {document['attempts']}, ran_on {document['ran_on']}, "
              f"{'the undisturbed bits' if same else 'OTHER BITS'}", same and document["attempts"] == 2)
    # The idle worker whose card is lent.
    daemon.idle()
    job = daemon.post(recipe)
    daemon.job(job, lambda d: d["iteration"] >= 5)
    os.kill(daemon.pids(1), signal.SIGKILL)
    document = daemon.end(job)
    same = daemon.digests(job) == whole
    check(f"kill -9 of the idle worker of the lent card: attempts {document['attempts']}, "
          f"{'the undisturbed bits' if same else 'OTHER BITS'}", same and document["attempts"] == 1)
    daemon.idle()


def cancels(daemon: Daemon, scan: str) -> None:
    for name, recipe in (("OS-SART", {"fdk": {}, "sart": {"iterations": 100000}, "tv": {}}),
                         ("CGLS", {"cgls": {"iterations": 100000}})):
        worst = 0.0
        for _ in range(3):
            job = daemon.post(recipe, scan=scan, grid=GRID, devices=CARDS)
            daemon.job(job, lambda d: d["iteration"] > 0 or d["state"] != "running" and d["state"] != "queued")
            started = time.monotonic()
            daemon.call("DELETE", f"/v1/jobs/{job}")
            daemon.end(job, "cancelled")
            daemon.idle()
            worst = max(worst, time.monotonic() - started)
        check(f"cancel of {name}: at most {worst:.2f} s until all cards are idle", worst < 2)


def room(daemon: Daemon, scan: str) -> None:
    endless = dict(scan=scan, grid=GRID, fdk={}, sart={"iterations": 100000})
    short = dict(scan=scan, grid=GRID, fdk={}, priority="stat")
    for wide, devices in ((CARDS, 1), (1, CARDS)):
        daemon.idle()
        jobs = [daemon.post(endless, devices=wide) for _ in range(CARDS // wide)]
        for job in jobs:
            daemon.job(job, lambda d: d["iteration"] > 3)
        started = time.monotonic()
        stat = daemon.post(short, devices=devices)
        daemon.job(stat, lambda d: d["state"] in ("running", "succeeded"))
        took = time.monotonic() - started
        document = daemon.end(stat)
        again = [daemon.job(job, lambda d: d["state"] == "running" and d["iteration"] > 3) for job in jobs]
        check(f"stat on {devices} before {CARDS // wide} on {wide}: begins after {took:.2f} s, ran_on {document['ran_on']}; "
              f"the others go on, attempts {[a['attempts'] for a in again]}",
              all(a["attempts"] == 1 for a in again) and len(document["ran_on"]) == devices)
        for job in jobs:
            daemon.call("DELETE", f"/v1/jobs/{job}")
        for job in jobs:
            daemon.end(job, "cancelled")


def dies(scan_folder: pathlib.Path) -> None:
    """An illegal access on the lent card, then on the job's own: the other card goes on."""
    fault = WORK / "fault"
    daemon = Daemon("--checkpoint-seconds", "0.02", worker="cbct-worker-faulty", fault=fault)
    scan = daemon.upload(scan_folder)
    recipe = dict(scan=scan, grid=GRID, fdk={}, sart={"iterations": 12}, tv={"method": "proximal", "alpha": 1, "iterations": 8})
    whole = daemon.end(daemon.post(recipe, devices=1))
    for card in (1, 0):
        try:
            daemon.idle()
            job = daemon.post(recipe, devices=CARDS)
            daemon.job(job, lambda d: d["iteration"] >= 2)
            fault.write_text(str(card))
            while fault.exists():
                time.sleep(0.005)
            failed = time.monotonic()
            daemon.job(job, lambda d: d["attempts"] == 2 and d["state"] != "queued")
            gave_up = time.monotonic() - failed
            document = daemon.end(job)
            devices = daemon.call("GET", "/v1/devices")["devices"]
            warnings = [w["code"] for w in document["warnings"]]
            off = off_hu(daemon, document, whole)
            rows = [row["iteration"] for row in document["history"]]
            check(f"card {card} fails: goes on after {gave_up:.2f} s, attempts {document['attempts']}, "
                  f"ran_on {document['ran_on']}, warnings {warnings}, "
                  f"{off:.2g} HU from one card, errors {[d['errors'] for d in devices]}, "
                  f"{devices[card]['last_error']}",
                  gave_up < 5 and document["attempts"] == 2 and sorted(document["ran_on"]) == [c for c in ALL if c != card]
                  and off <= BOUND_HU and rows == list(range(1, 13)) and "fewer_devices" in warnings)
            say(f"     last errors: {[d['last_error'] for d in devices]}")
        except RuntimeError as error:
            check(f"card {card} fails: {error}", False)
    daemon.stop()


def large_times() -> None:
    folder = simulate("large", 496, 1240, 960, 0.308, "--raw", "air", "--photons", "200000", "--sample", "uint16")
    daemon = Daemon()
    say("large scan made")
    scan = daemon.upload(folder)
    say("large scan uploaded")
    grid = {"size": [512, 512, 512], "spacing_mm": [0.25, 0.25, 0.25]}
    for name, recipe in (("FDK", {"fdk": {}}), ("SIRT 10", {"sart": {"iterations": 10, "subsets": 1}}),
                         ("OS-SART 10", {"fdk": {}, "sart": {"iterations": 10, "subsets": 10}}),
                         ("SART 10, TV", {"fdk": {}, "sart": {"iterations": 10}, "tv": {}}),
                         ("CGLS 5", {"cgls": {"iterations": 5}})):
        documents = {}
        try:
            for devices in sorted({1, 2, CARDS}):
                documents[devices] = run_once(daemon, scan, dict(recipe, grid=grid), devices)
                say(f"large {name} on {devices}: {seconds_of(documents[devices])}; "
                    f"told {documents[devices]['memory']['total'] / 2**30:.2f} GiB")
            off = off_hu(daemon, documents[CARDS], documents[1])
            check(f"large {name}: {off:.2g} HU", off <= BOUND_HU)
        except RuntimeError as error:
            check(f"large {name}: {error}", False)
    daemon.stop()


def main() -> int:
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    before = memory_used()
    folder = simulate("scan", 240, 2 * SIZE, 2 * SIZE, 0.75 * 256 / SIZE, "--wobble", "2", "--photons", "100000")
    say(f"scan of 240 views of {2 * SIZE}^2 made; volumes of {SIZE}^3")
    daemon = Daemon("--checkpoint-seconds", "0.05")
    scan = daemon.upload(folder)
    for part in (lambda: several(daemon, scan), lambda: memory(daemon, scan, before), lambda: kills(daemon, scan),
                 lambda: cancels(daemon, scan), lambda: room(daemon, scan)):
        try:
            part()
        except RuntimeError as error:
            check(str(error), False)
    daemon.stop()
    if (BUILD / "cbct-worker-faulty").exists() and BACKEND == "cuda":
        dies(folder)
    if LARGE:
        large_times()
    say(f"{failures} failures")
    return failures > 0


if __name__ == "__main__":
    sys.exit(main())
