#!/usr/bin/env python3
"""Faults of a fleet under load, and a check of what became of each job that was acknowledged.

An owner without a device and two takers, with their ledger in a PostgreSQL server. Jobs are posted all the time, while daemons are killed
and started again, processes stand still, the database is killed, a host's clock is off by an hour and a disk is full. With --bridge each
taker is in a network namespace of its own behind that bridge, and its link is cut, which loses packets where a process that is killed
closes its connections. Every call and fault, and every line of the owner's log with the time at which it was seen, is kept in
FOLDER/history.jsonl.

Afterwards each acknowledged job must have succeeded, with one end, each iteration told once, and the bits of the undisturbed run; no run
on another host may have begun with an older claim than one before it, or before that one had ended; no job may have begun while one
of higher priority had waited for longer than PATIENCE without ever having come back; and neither jobs nor scans may be left on takers.

usage: fleet_faults.py BUILD FOLDER DATABASE-ADDRESS DATA-FOLDER START-COMMAND --faults N [--seed N] [--bridge NAME] [--seconds S]
"""
import argparse
import collections
import json
import os
import pathlib
import random
import re
import shlex
import signal
import ssl
import subprocess
import sys
import threading
import time

from fleet_host import Host, wait_for

LEASE = 3.0
PATIENCE = 10.0  # s: a look of each daemon, a lease of one that has just gone, and a machine with much else to do
GRID = {"size": [32, 32, 24], "spacing_mm": [5, 5, 5]}
RECIPES = [{"grid": GRID, "fdk": {}, "sart": {"iterations": n}, "emit": ["fdk"]} for n in (2, 8, 40)]


def run(*command):
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


class Network:
    """Namespaces behind a bridge, one for each taker, and what daemons want that listen on other addresses than the machine's own."""

    def __init__(self, options):
        self.options, self.holders = options, {}
        folder, key, cert = options.folder, options.folder / "key.pem", options.folder / "cert.pem"
        # Valid for who is a day behind or ahead.
        subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "4", "-subj", "/CN=fleet",
                        "-addext", "subjectAltName=IP:10.77.0.11,IP:10.77.0.12", "-keyout", str(key), "-out", str(cert)], check=True,
                       stderr=subprocess.DEVNULL, env=dict(os.environ, LD_PRELOAD=f"{options.build}/clock.so", CBCT_TEST_CLOCK="-86400"))
        key.chmod(0o600)
        (folder / "tokens").unlink(missing_ok=True)
        old = os.umask(0o077)
        made = subprocess.run([f"{options.build}/cbct", "token", "new", "all", "--role", "admin", "--file", str(folder / "tokens")], check=True,
                              capture_output=True, text=True)
        (folder / "token").write_text(made.stdout)
        os.umask(old)
        self.taker = ["--tokens", str(folder / "tokens"), "--tls-cert", str(cert), "--tls-key", str(key)]
        self.owner = ["--fleet-token", str(folder / "token"), "--fleet-cacert", str(cert)]
        self.context = ssl.create_default_context(cafile=str(cert))
        self.headers = {"Authorization": f"Bearer {made.stdout.strip()}"}

    def add(self, name, number):
        """The doors of a Host in a network of its own."""
        holder = subprocess.Popen(["unshare", "--net", "sleep", "86400"])
        own = os.readlink("/proc/self/ns/net")
        wait_for(lambda: os.readlink(f"/proc/{holder.pid}/ns/net") != own, 10, "a network namespace")
        self.holders[name] = holder
        within = ["nsenter", "-t", str(holder.pid), "--net", "--"]
        run("ip", "link", "add", f"link-{name}", "type", "veth", "peer", "name", "eth0", "netns", str(holder.pid))
        run("ip", "link", "set", f"link-{name}", "master", self.options.bridge, "up")
        run(*within, "ip", "link", "set", "lo", "up")
        run(*within, "ip", "address", "add", f"10.77.0.{number}/24", "dev", "eth0")
        run(*within, "ip", "link", "set", "eth0", "up")
        return (f"10.77.0.{number}", within, self.context, self.headers)

    def stop(self):
        for holder in self.holders.values():
            holder.kill()
            holder.wait()


def host_of(options, name, takes, network=None, number=0):
    arguments = ["--fleet-lease", str(LEASE), "--fleet-keep-scans", "0"] + ([] if takes else ["--worker", str(options.no_device)])
    if network is not None:
        arguments += network.taker if takes else network.owner
    return Host(options, "soak", name, takes, arguments, doors=network.add(name, number) if network is not None and takes else None)


def small_disk(folder, megabytes):
    """A file system of its own for that folder; False where none can be mounted."""
    folder.mkdir(parents=True, exist_ok=True)
    return subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)], stderr=subprocess.DEVNULL).returncode == 0


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
    """Of any of its threads."""
    return [int(pid) for file in pathlib.Path(f"/proc/{process}/task").glob("*/children") for pid in file.read_text().split()]


class Run:
    def __init__(self, options):
        self.options, self.random = options, random.Random(options.seed)
        self.network = Network(options) if options.bridge else None
        self.owner = host_of(options, "owner", False, self.network)
        self.takers = [host_of(options, f"taker{i}", True, self.network, 10 + i) for i in (1, 2)]
        self.posted, self.count = {}, 0  # id: recipe, priority and when it was acknowledged
        self.counts = collections.Counter()
        self.history, self.lines, self.seconds = open(options.folder / "history.jsonl", "w"), [], []
        self.disks = [host for host in [self.owner] + self.takers if small_disk(host.folder, 96)] if options.bridge else []

    def note(self, **what):
        self.history.write(json.dumps(dict(at=round(time.monotonic(), 3), **what)) + "\n")

    def follow(self):
        """The owner's log, by this process's clock: the owner's own may be off."""
        with open(self.owner.log) as log:
            while not self.ended_following:
                line = log.readline()
                if line.endswith("\n"):
                    self.lines.append((time.monotonic(), line))
                    self.note(log=line.rstrip())
                else:
                    time.sleep(0.02)

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
        while status in (0, 503, 507):  # an answer that was lost: the key makes it one job; or a disk that was full a moment ago
            status, reply = host.ask("POST", "/v1/jobs", body, key)
            self.note(call="POST /v1/jobs", key=self.count, priority=priority, recipe=recipe, status=status, reply=reply.decode()[:60])
            time.sleep(0.05 if status != 202 else 0)
        assert status == 202, reply
        self.posted[json.loads(reply)["id"]] = (recipe, priority, time.monotonic())

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

    def fault_clock_off_by_an_hour(self):
        host = self.random.choice([self.owner] + self.takers)
        host.kill()
        if "CBCT_TEST_CLOCK" in host.environment:
            del host.environment["CBCT_TEST_CLOCK"], host.environment["LD_PRELOAD"]
        else:
            host.environment.update(LD_PRELOAD=f"{self.options.build}/clock.so", CBCT_TEST_CLOCK=self.random.choice(["3600", "-3600"]))
        host.start()

    def fault_link_down(self):
        host, seconds = self.random.choice(self.takers), self.random.choice([1, 5, 30])
        there = [job for job in self.posted if ((self.owner.json("GET", f"/v1/jobs/{job}") or {}).get("device") or "").startswith(host.name)
                 and self.owner.json("GET", f"/v1/jobs/{job}")["state"] == "running"] if seconds > LEASE else []
        run("ip", "link", "set", f"link-{host.name}", "down")
        began = time.monotonic()
        time.sleep(seconds)
        run("ip", "link", "set", f"link-{host.name}", "up")
        self.counts[f"of them for {seconds} s"] += 1
        for job in there:
            back = [at for at, line in self.lines if at > began and re.search(rf"job {job}: running -> (queued|succeeded)", line)]
            self.seconds += [(back[0] - began) if back else float("inf")]

    def fault_disk_full(self):
        host = self.random.choice(self.disks)
        filler = host.folder / "filler"
        with open(filler, "wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(1 << 20))
            except OSError:
                pass
        time.sleep(self.random.choice([1, 3, LEASE + 1]))
        filler.unlink()

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
        wrong = self.check_claims() + self.check_priorities()
        for job, (recipe, _, _) in self.posted.items():
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

    def check_claims(self):
        """By the owner's log: the numbers of a job's claims grow, and each run has ended before the next begins."""
        wrong, last, runs = [], {}, set()
        for _, line in self.lines:
            goes = re.search(r"job (\w+) goes to \S+, claim (\d+)", line)
            state = re.search(r"job (\w+): (\w+) -> (\w+)", line)
            if goes:
                job, number = goes[1], int(goes[2])
                if number < last.get(job, 0):  # the same goes on when the owner was started again
                    wrong.append(f"{job}: claim {number} behind claim {last[job]}")
                if job in runs:
                    wrong.append(f"{job}: claim {number} while a run goes on")
                last[job] = number
            elif state:
                (runs.add if state[3] == "running" else runs.discard)(state[1])
        return wrong

    def check_priorities(self):
        """No job is claimed while one of higher priority waits that others may have at once."""
        order, wrong, waiting, claims = ["routine", "urgent", "stat"], [], {}, set()
        for job, (_, priority, at) in self.posted.items():
            waiting[job] = (order.index(priority), at)
        for at, line in self.lines:
            goes = re.search(r"job (\w+) goes to \S+, claim (\d+)", line)
            if goes is None or goes[1] not in self.posted or goes[2] in claims:
                continue
            claims.add(goes[2])
            priority = order.index(self.posted[goes[1]][1])
            waiting.pop(goes[1], None)
            wrong += [f"{goes[1]} was claimed before {job}, which had waited {at - since:.1f} s" for job, (other, since) in waiting.items()
                      if other > priority and at > since + PATIENCE]
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
        self.ended_following, follower = False, threading.Thread(target=self.follow)
        follower.start()
        self.scan = self.post_scan(self.owner, folder)
        faults = [name for name in dir(self) if name.startswith("fault_") and (self.network or name != "fault_link_down")
                  and (self.disks or name != "fault_disk_full")]
        began, done = time.monotonic(), 0
        while done < self.options.faults and time.monotonic() < began + self.options.seconds:
            self.load()
            time.sleep(self.random.uniform(0, 1.5))
            name = self.random.choice(faults)
            self.note(fault=name[6:])
            getattr(self, name)()
            self.note(ended=name[6:])
            self.counts[name[6:]] += 1
            done += 1
        wait_for(self.ended, 60 + 10 * len(self.posted), "the end of every job")
        wait_for(lambda: not self.left(), 60, f"nothing of others on takers, there is {self.left()}")
        self.ended_following = True
        follower.join()
        wrong = self.check(reference)
        for host in [self.owner] + self.takers:
            host.kill()
        print(", ".join(f"{count} x {name}" for name, count in sorted(self.counts.items())))
        if self.seconds:
            print(f"{len(self.seconds)} jobs ran behind a link that was cut for longer than a lease of {LEASE:g} s, and were another's to claim after "
                  f"{', '.join(f'{s:.1f}' for s in sorted(self.seconds))} s")
        print(f"{len(self.posted)} jobs, {done} faults, {len(wrong)} violations")
        for line in wrong:
            print(line)
        return 1 if wrong else 0


def main():
    parser = argparse.ArgumentParser()
    for name in ("build", "folder", "database", "data", "start"):
        parser.add_argument(name)
    parser.add_argument("--faults", type=int, required=True)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--bridge", default="", help="of this network namespace, with the address 10.77.0.1")
    parser.add_argument("--seconds", type=float, default=86400, help="no fault begins later")
    options = parser.parse_args()
    options.folder = pathlib.Path(options.folder)
    options.folder.mkdir(parents=True, exist_ok=True)
    options.no_device = options.folder / "no-device"
    options.no_device.write_text("#!/bin/sh\nexec false\n")
    options.no_device.chmod(0o755)
    print(f"seed {options.seed}")
    subprocess.run([f"{options.build}/cbct", "simulate", "-o", str(options.folder / "scan"), "--phantom", "head", "--scale", "70", "--views", "40",
                    "--columns", "48", "--rows", "36", "--pixel", "7"], check=True, stdout=subprocess.DEVNULL)
    test = Run(options)
    try:
        return test.go()
    finally:
        test.ended_following = True
        for host in [test.owner] + test.takers:
            if host.process is not None and host.process.poll() is None:
                host.kill()
        if test.network:
            test.network.stop()


sys.exit(main())
