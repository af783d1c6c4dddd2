#!/usr/bin/env python3
"""Faults of a fleet under load, and a check of what became of each job that was acknowledged.

An owner without a device and two takers, with their ledger in a PostgreSQL server. Jobs are posted all the time, while daemons are killed
and started again, processes stand still and the database is killed. Afterwards each acknowledged job must have succeeded, with one
end, each iteration told once, and the bits of the undisturbed run; and neither jobs nor offers may be left on takers.

usage: fleet_faults.py BUILD FOLDER DATABASE-ADDRESS DATA-FOLDER START-COMMAND --faults N [--seed N]
"""
import argparse
import collections
import json
import os
import pathlib
import random
import shlex
import signal
import subprocess
import sys
import time

from fleet_host import Host, wait_for

LEASE = 3.0
GRID = {"size": [32, 32, 24], "spacing_mm": [5, 5, 5]}
RECIPES = [{"grid": GRID, "fdk": {}, "sart": {"iterations": n}, "emit": ["fdk"]} for n in (2, 8, 40)]


def host_of(options, name, takes):
    return Host(options, "soak", name, takes, ["--fleet-lease", str(LEASE), "--fleet-keep-scans", "0"] + ([] if takes else ["--worker", str(options.no_device)]))


def stand_still(processes, seconds):
    for process in processes:
        try:
            os.kill(process, signal.SIGSTOP)
        except ProcessLookupError:
            pass
    time.sleep(seconds)
    for process in processes:
        try:
            os.kill(process, signal.SIGCONT)
        except ProcessLookupError:
            pass


def children(process):
    return [int(pid) for pid in pathlib.Path(f"/proc/{process}/task/{process}/children").read_text().split()]


class Run:
    def __init__(self, options):
        self.options, self.random = options, random.Random(options.seed)
        self.owner = host_of(options, "owner", False)
        self.takers = [host_of(options, "taker1", True), host_of(options, "taker2", True)]
        self.posted, self.count = {}, 0  # id: recipe
        self.counts = collections.Counter()

    # ---- load ----
    def post_scan(self, host, folder):
        document = (folder / "scan.json").read_bytes()
        status, body = host.ask("POST", "/v1/scans", document, {"Content-Type": "application/json"})
        assert status == 201, body
        scan = json.loads(body)["id"]
        status, body = host.ask("PUT", f"/v1/scans/{scan}/projections", (folder / "projections.raw").read_bytes())
        assert status == 201, body
        return scan

    def post_job(self, host, scan, recipe, priority):
        self.count += 1
        key = {"Content-Type": "application/json", "Idempotency-Key": f"load {self.count}"}
        body = json.dumps(dict(RECIPES[recipe], scan=scan, priority=priority))
        status = 0
        while status == 0:  # an answer that was lost: the key makes it one job
            status, reply = host.ask("POST", "/v1/jobs", body, key)
            time.sleep(0.05 if status == 0 else 0)
        assert status == 202, reply
        self.posted[json.loads(reply)["id"]] = recipe

    def load(self):
        for _ in range(self.random.randint(1, 3)):
            self.post_job(self.owner, self.scan, self.random.randrange(len(RECIPES)), self.random.choice(["routine", "routine", "urgent", "stat"]))

    # ---- faults ----
    def fault_taker_killed(self):
        host = self.random.choice(self.takers)
        host.kill()
        time.sleep(self.random.choice([0, 1, LEASE + 1]))
        host.start()

    def fault_taker_stands_still(self):
        stand_still([self.random.choice(self.takers).process.pid], self.random.choice([0.5, 2, LEASE + 2]))

    def fault_worker_stands_still(self):
        stand_still(children(self.random.choice(self.takers).process.pid), self.random.choice([0.5, 2, 6]))

    def fault_fetching_process_stands_still(self):
        stand_still(children(self.owner.process.pid), self.random.choice([0.5, 2, 6]))

    def fault_fetching_process_killed(self):
        for process in children(self.owner.process.pid)[:2]:
            try:
                os.kill(process, signal.SIGKILL)
            except ProcessLookupError:
                pass

    def fault_owner_killed(self):
        self.owner.kill()
        time.sleep(self.random.choice([0, 1]))
        self.owner.start()

    def fault_owner_stands_still(self):
        stand_still([self.owner.process.pid], self.random.choice([0.5, 2, LEASE + 2]))

    def database_processes(self):
        first = int((pathlib.Path(self.options.data) / "postmaster.pid").read_text().split()[0])
        return [first] + children(first)

    def fault_database_killed(self):
        for process in self.database_processes():
            try:
                os.kill(process, signal.SIGKILL)
            except ProcessLookupError:
                pass
        time.sleep(self.random.choice([0.2, 1, LEASE + 1]))
        # Processes of the one before may take a moment to go.
        wait_for(lambda: subprocess.run(shlex.split(self.options.start), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode == 0, 60,
                 "the database starts again")

    def fault_database_stands_still(self):
        stand_still(self.database_processes(), self.random.choice([0.5, 2, LEASE + 1]))

    # ---- the check ----
    def ended(self):
        jobs = [self.owner.json("GET", f"/v1/jobs/{job}") for job in self.posted]
        return all(job is not None and job["state"] in ("succeeded", "failed", "cancelled") for job in jobs)

    def check(self, reference):
        wrong = []
        for job, recipe in self.posted.items():
            document = self.owner.json("GET", f"/v1/jobs/{job}")
            volumes = {v["name"]: v.get("digest") for v in self.owner.json("GET", f"/v1/jobs/{job}/volumes")["volumes"]}
            _, events = self.owner.ask("GET", f"/v1/jobs/{job}/events")
            lines = events.decode().split("\n")
            rows = [json.loads(after[6:])["iteration"] for line, after in zip(lines, lines[1:]) if line == "event: progress"]
            if document["state"] != "succeeded":
                wrong.append(f"{job} is {document['state']}: {document['error']}")
            if lines.count("event: end") != 1:
                wrong.append(f"{job} has {lines.count('event: end')} ends")
            if len(rows) != len(set(rows)) or len(rows) != RECIPES[recipe]["sart"]["iterations"]:
                wrong.append(f"{job} has told of {len(rows)} iterations, {len(set(rows))} of them once")
            if volumes != reference[recipe]:
                wrong.append(f"{job} has other bits: {volumes} in place of {reference[recipe]}")
        return wrong

    def left(self):
        return [(host.name, path) for host in self.takers for path in ("jobs", "scans") if (host.json("GET", f"/v1/{path}") or {path: [1]})[path]]

    def references(self, folder):
        """Digests of the volumes of each recipe, by a daemon that is in no fleet."""
        alone = host_of(self.options, "alone", True)
        alone.arguments = [a for i, a in enumerate(alone.arguments) if not a.startswith("--fleet") and not alone.arguments[i - 1].startswith("--fleet")]
        alone.start()
        scan, found = self.post_scan(alone, folder), []
        for recipe in RECIPES:
            _, body = alone.ask("POST", "/v1/jobs", json.dumps(dict(recipe, scan=scan)), {"Content-Type": "application/json"})
            job = json.loads(body)["id"]

            def volumes():
                document = alone.json("GET", f"/v1/jobs/{job}/volumes") or {"volumes": []}
                return {v["name"]: v.get("digest") for v in document["volumes"]}
            wait_for(lambda: (alone.json("GET", f"/v1/jobs/{job}") or {}).get("state") == "succeeded" and None not in volumes().values(), 300, "a job alone")
            found.append(volumes())
        alone.kill()
        return found

    def go(self):
        folder = self.options.folder / "scan"
        reference = self.references(folder)
        for host in [self.owner] + self.takers:
            host.start()
        self.scan = self.post_scan(self.owner, folder)
        faults = [name for name in dir(self) if name.startswith("fault_")]
        for _ in range(self.options.faults):
            self.load()
            time.sleep(self.random.uniform(0, 1.5))
            name = self.random.choice(faults)
            getattr(self, name)()
            self.counts[name[6:]] += 1
        wait_for(self.ended, 60 + 10 * len(self.posted), "the end of every job")
        wait_for(lambda: not self.left(), 60, f"nothing of others on takers, there is {self.left()}")
        wrong = self.check(reference)
        for host in [self.owner] + self.takers:
            host.kill()
        print(", ".join(f"{count} x {name}" for name, count in sorted(self.counts.items())))
        print(f"{len(self.posted)} jobs, {self.options.faults} faults, {len(wrong)} violations")
        for line in wrong:
            print(line)
        return 1 if wrong else 0


def main():
    parser = argparse.ArgumentParser()
    for name in ("build", "folder", "database", "data", "start"):
        parser.add_argument(name)
    parser.add_argument("--faults", type=int, required=True)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    options.folder = pathlib.Path(options.folder)
    options.folder.mkdir(parents=True, exist_ok=True)
    options.no_device = options.folder / "no-device"
    options.no_device.write_text("#!/bin/sh\nexec false\n")
    options.no_device.chmod(0o755)
    print(f"seed {options.seed}")
    subprocess.run([f"{options.build}/cbct", "simulate", "-o", str(options.folder / "scan"), "--phantom", "head", "--scale", "70", "--views", "40",
                    "--columns", "48", "--rows", "36", "--pixel", "7"], check=True, stdout=subprocess.DEVNULL)
    run = Run(options)
    try:
        return run.go()
    finally:
        for host in [run.owner] + run.takers:
            if host.process is not None and host.process.poll() is None:
                host.kill()


sys.exit(main())
