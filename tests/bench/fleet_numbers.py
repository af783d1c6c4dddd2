#!/usr/bin/env python3
"""Two numbers of a fleet of three takers and an owner without a device: how long a job is without a host when its taker is killed, and
whether takers stand idle while a queue of small jobs is drained, by the time stamps of their logs.

usage: fleet_numbers.py BUILD FOLDER DATABASE-ADDRESS [--jobs N] [--takeovers N] [--lease S]
"""
import argparse
import datetime
import http.client
import json
import pathlib
import re
import socket
import subprocess
import sys
import time


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Host:
    def __init__(self, options, name, takes):
        self.name, self.port, self.log = name, free_port(), options.folder / f"{name}.err"
        self.arguments = [f"{options.build}/cbctd", "--listen", f"127.0.0.1:{self.port}", "--state-dir", str(options.folder / name), "--backend", "cpu",
                          "--threads", "1", "--fleet", "numbers", "--fleet-database", options.database, "--fleet-host", name,
                          "--fleet-lease", str(options.lease), "--checkpoint-seconds", "1"]
        self.arguments += ["--fleet-address", f"http://127.0.0.1:{self.port}"] if takes else ["--worker", "/bin/false"]
        self.start()

    def start(self):
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(self.arguments, stdout=subprocess.DEVNULL, stderr=log)
        while self.ask("GET", "/livez")[0] != 200:
            time.sleep(0.05)

    def ask(self, method, path, body=None):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request(method, path, body, {"Content-Type": "application/json"} if isinstance(body, str) else {})
            reply = connection.getresponse()
            return reply.status, reply.read()
        except OSError:
            return 0, b""
        finally:
            connection.close()

    def json(self, method, path, document=None):
        return json.loads(self.ask(method, path, None if document is None else json.dumps(document))[1])


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
        victim.process.kill()
        victim.process.wait()
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
        takers = {name: Host(options, name, True) for name in ("taker1", "taker2", "taker3")}
        owner = Host(options, "owner", False)
        hosts = [owner] + list(takers.values())
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
            host.process.kill()
            host.process.wait()
    return 0


sys.exit(main())
