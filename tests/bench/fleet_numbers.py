#!/usr/bin/env python3
"""Two numbers of a fleet of three takers and an owner without a device: how long a job is without a host when its taker is killed, and
whether takers stand idle while a queue of small jobs is drained, by the time stamps of their logs.

usage: fleet_numbers.py BUILD FOLDER DATABASE-ADDRESS [--jobs N] [--takeovers N] [--lease S]
"""
import argparse
import datetime
import json
import pathlib
import re
import subprocess
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "http"))
from fleet_host import Host


def host_of(options, name, takes):
    host = Host(options, "numbers", name, takes, ["--fleet-lease", str(options.lease), "--checkpoint-seconds", "1"] + ([] if takes else ["--worker", "/bin/false"]))
    host.start()
    return host


def post(owner, scan, iterations):
    return owner.json("POST", "/v1/jobs", {"scan": scan, "grid": {"size": [16, 16, 8], "spacing_mm": [12, 12, 12]}, "fdk": {},
                                           "sart": {"iterations": iterations}, "emit": []})["id"]


def device(owner, job):
    document = owner.json("GET", f"/v1/jobs/{job}")
    return (document["device"] or "").split(":")[0] if document["state"] == "running" else ""


def takeovers(options, owner, takers, scan):
    """Seconds from the kill of a taker until the job runs at another one."""
    seconds = []
    for _ in range(options.takeovers):
        job = post(owner, scan, 10000)
        while device(owner, job) not in takers:
            time.sleep(0.02)
        victim = takers[device(owner, job)]
        time.sleep(1)
        victim.kill()
        began = time.monotonic()
        while device(owner, job) in ("", victim.name):
            time.sleep(0.02)
        seconds.append(time.monotonic() - began)
        owner.ask("DELETE", f"/v1/jobs/{job}")
        victim.start()
    return seconds


def drain(options, owner, takers, scan):
    """Seconds, and the longest time that a taker was without a job before the last one began."""
    began = time.monotonic()
    jobs = [post(owner, scan, 5) for _ in range(options.jobs)]
    posted = time.monotonic() - began
    for job in jobs:
        while owner.json("GET", f"/v1/jobs/{job}?wait=20")["state"] not in ("succeeded", "failed"):
            pass
    spans = {}
    for name, taker in takers.items():
        for line in taker.log.read_text().splitlines():
            found = re.match(r"(\S+)Z \w+: job \w+: \w+ -> (running|succeeded)", line)
            if found:
                spans.setdefault(name, []).append((datetime.datetime.fromisoformat(found[1]).timestamp(), found[2]))
    last = max(at for events in spans.values() for at, what in events if what == "running")
    gaps = [after[0] - before[0] for events in spans.values() for before, after in zip(events, events[1:])
            if before[1] == "succeeded" and after[1] == "running" and after[0] <= last]
    return posted, time.monotonic() - began, sorted(gaps), {name: sum(what == "succeeded" for _, what in events) for name, events in spans.items()}


def main():
    parser = argparse.ArgumentParser()
    for name in ("build", "folder", "database"):
        parser.add_argument(name)
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--takeovers", type=int, default=10)
    parser.add_argument("--lease", type=float, default=5)
    options = parser.parse_args()
    options.folder = pathlib.Path(options.folder)
    options.folder.mkdir(parents=True, exist_ok=True)
    subprocess.run([f"{options.build}/cbct", "simulate", "-o", str(options.folder / "scan"), "--phantom", "head", "--scale", "70", "--views", "16",
                    "--columns", "24", "--rows", "16", "--pixel", "14"], check=True, stdout=subprocess.DEVNULL)
    hosts = []
    try:
        for name in ("taker1", "taker2", "taker3", "owner"):
            hosts.append(host_of(options, name, name != "owner"))
        *takers, owner = hosts
        takers = {taker.name: taker for taker in takers}
        scan = owner.json("POST", "/v1/scans", json.loads((options.folder / "scan" / "scan.json").read_text()))["id"]
        owner.ask("PUT", f"/v1/scans/{scan}/projections", (options.folder / "scan" / "projections.raw").read_bytes())
        posted, seconds, gaps, each = drain(options, owner, takers, scan)
        print(f"{options.jobs} jobs posted in {posted:.1f} s, ended after {seconds:.1f} s, by taker {each}")
        print(f"a taker without a job while others waited: median {gaps[len(gaps) // 2]:.3f} s, 99 % {gaps[int(.99 * len(gaps))]:.3f} s, longest {gaps[-1]:.3f} s")
        seconds = sorted(takeovers(options, owner, takers, scan))
        if seconds:
            print(f"{len(seconds)} takers killed, lease {options.lease:g} s: the job ran elsewhere after {', '.join(f'{s:.1f}' for s in seconds)} s")
    finally:
        for host in hosts:
            host.kill()
    return 0


sys.exit(main())
