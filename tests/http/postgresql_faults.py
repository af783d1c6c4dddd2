#!/usr/bin/env python3
"""The catalogue's server is killed, stopped, loses sessions and answers, the daemon is killed, under load; then the history
of all calls is held against what is there.

postgresql_faults.py BUILD WORK DATABASE DATA LOSSY START [--faults N] [--clients N] [--seed S]

DATABASE  the address for --catalogue, through lossy.py in the folder LOSSY
DATA      the server's own directory, START the command that starts it again

Clients post jobs, each with an Idempotency-Key, and try again whatever they are answered until it is 202. At the end: a key
has had one job, in every answer; each job that was acknowledged is there, and no other; each has succeeded with the
bits of an undisturbed run, and has ended once in its events; rows, directories and documents are as many. Prints the seed,
the history is WORK/history.jsonl; exit status 1 when something does not hold.
"""
import argparse
import collections
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

GRID = {"size": [24, 24, 12], "spacing_mm": [3, 3, 4]}
RECIPES = [
    {"grid": GRID, "fdk": {}, "sart": {"iterations": 3}, "emit": ["fdk"]},
    {"grid": GRID, "fdk": {}, "sart": {"iterations": 60}, "emit": [20, 40]},
]
PATIENCE = 120  # s until a daemon, or a job, that should be there is not any more


class History:
    def __init__(self, path: Path):
        self.out, self.lock = path.open("w"), threading.Lock()

    def add(self, **what):
        with self.lock:
            self.out.write(json.dumps({"at": round(time.monotonic(), 4), **what}) + "\n")
            self.out.flush()


class Daemon:
    def __init__(self, build: Path, work: Path, address: str):
        self.build, self.work, self.address = build, work, address
        self.url, self.process = "", None
        self.changing = threading.Lock()

    def start(self):
        end = time.monotonic() + PATIENCE
        while True:
            with (self.work / "cbctd.err").open("a") as err:
                self.process = subprocess.Popen(
                    [self.build / "cbctd-held", "--listen", "127.0.0.1:0", "--state-dir", self.work / "state", "--backend",
                     "cpu", "--catalogue", self.address, "--catalogue-timeout", "0.5", "--checkpoint-seconds", "0.1"],
                    stdout=subprocess.PIPE, stderr=err, text=True)
            line = self.process.stdout.readline()
            if match := re.match(r"listening on (\S+)", line):
                self.url = match.group(1)
                return
            self.process.wait()  # the server is not there: systemd would try again, too
            assert time.monotonic() < end, "the daemon does not start"
            time.sleep(0.3)

    def kill(self, number):
        self.process.send_signal(number)
        self.process.wait()

    def ask(self, method, path, document=None, key=None, timeout=30.0):
        """The status and the document, or text; 0 where nobody answers."""
        data = None if document is None else json.dumps(document).encode()
        head = {} if data is None else {"Content-Type": "application/json"}
        if key is not None:
            head["Idempotency-Key"] = key
        try:
            request = urllib.request.Request(self.url + path, data, head, method=method)
            with urllib.request.urlopen(request, timeout=timeout) as reply:
                status, text = reply.status, reply.read()
        except urllib.error.HTTPError as error:
            status, text = error.code, error.read()
        except (OSError, ValueError):
            return 0, None
        try:
            return status, json.loads(text)
        except ValueError:
            return status, text.decode()

    def get(self, path):
        """Asks until it is answered with 200."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            status, document = self.ask("GET", path)
            if status == 200:
                return document
            time.sleep(0.05)
        raise AssertionError(f"no answer to {path}")


class Server:
    def __init__(self, data: Path, start: str):
        self.data, self.command = data, shlex.split(start)

    def processes(self):
        main = int((self.data / "postmaster.pid").read_text().split()[0])
        children = subprocess.run(["pgrep", "-P", str(main)], capture_output=True, text=True).stdout.split()
        return [main, *map(int, children)]

    def signal(self, number, processes):
        for process in processes:
            try:
                os.kill(process, number)
            except ProcessLookupError:
                pass

    def kill(self):
        processes = self.processes()
        self.signal(signal.SIGKILL, processes)
        while Path(f"/proc/{processes[0]}").exists():
            time.sleep(0.02)

    def start(self):
        subprocess.run(self.command, check=True, stdout=subprocess.DEVNULL)

    def sessions(self):
        """Processes that serve sessions of ours."""
        listed = subprocess.run(["ps", "-o", "pid=,args=", "-p", ",".join(map(str, self.processes()))],
                                capture_output=True, text=True).stdout
        return [int(line.split()[0]) for line in listed.splitlines() if "[local]" in line]


def client(daemon, history, scan, stop, posted, seed):
    chance = random.Random(seed)
    number = 0
    while not stop.is_set():
        key, recipe = f"{seed}-{number}", chance.choices([0, 1], [3, 1])[0]
        number += 1
        end = time.monotonic() + PATIENCE
        while True:
            status, document = daemon.ask("POST", "/v1/jobs", {"scan": scan, **RECIPES[recipe]}, key)
            job = document.get("id") if status == 202 else None
            history.add(call="post", key=key, recipe=recipe, status=status, job=job)
            if job is not None:
                break
            if status not in (0, 503):
                posted.append((key, recipe, f"answered {status}: {document}"))
                return
            if time.monotonic() > end:
                posted.append((key, recipe, "never taken"))
                return
            time.sleep(chance.uniform(0.01, 0.2))
        posted.append((key, recipe, job))
        # An answer may get lost on its way: a client that asks again must hear of the same job.
        if chance.random() < 0.3:
            status, document = daemon.ask("POST", "/v1/jobs", {"scan": scan, **RECIPES[recipe]}, key)
            job = document.get("id") if status == 202 else None
            history.add(call="again", key=key, recipe=recipe, status=status, job=job)
            if job is not None:
                posted.append((key, recipe, job))
        time.sleep(chance.uniform(0, 0.5))


def fault(daemon, server, lossy, chance):
    """Does one, and mends it; returns its name."""
    name = chance.choice(["kill server", "stop server", "kill sessions", "lose before", "lose after", "kill daemon", "both"])
    if name in ("kill server", "both"):
        server.kill()
        if name == "both":
            daemon.kill(signal.SIGKILL)
        time.sleep(chance.uniform(0, 2))
        server.start()
        if name == "both":
            daemon.start()
    elif name == "stop server":
        processes = server.processes()
        server.signal(signal.SIGSTOP, processes)
        time.sleep(chance.uniform(0.1, 2))
        server.signal(signal.SIGCONT, processes)
    elif name == "kill sessions":
        server.signal(signal.SIGTERM, server.sessions())
    elif name == "kill daemon":
        daemon.kill(signal.SIGKILL)
        time.sleep(chance.uniform(0, 0.3))
        daemon.start()
    else:
        (lossy / "lose").write_text(name.split()[1])
        time.sleep(chance.uniform(0.2, 1))
    return name


def wait_for(daemon, job):
    end = time.monotonic() + 2 * PATIENCE
    while time.monotonic() < end:
        document = daemon.get(f"/v1/jobs/{job}?wait=5")
        if document["state"] in ("succeeded", "failed", "cancelled"):
            return document
    raise AssertionError(f"job {job} does not end: {document}")


def digest(daemon, job):
    volumes = daemon.get(f"/v1/jobs/{job}/volumes")["volumes"]
    names = collections.Counter(volume["name"] for volume in volumes)
    assert max(names.values()) == 1, f"job {job} has volumes twice: {names}"
    return {volume["name"]: volume["digest"] for volume in volumes}


def check(daemon, work, posted, bits):
    jobs_of, recipe_of = collections.defaultdict(set), {}
    for key, recipe, job in posted:
        jobs_of[key].add(job)
        recipe_of[job] = recipe
    for key, jobs in jobs_of.items():
        assert len(jobs) == 1, f"key {key} had the jobs {jobs}"
    listed, after = [], ""
    while True:
        page = daemon.get(f"/v1/jobs?limit=100{after}")
        listed += [job["id"] for job in page["jobs"]]
        if not page.get("next"):
            break
        after = f"&after={page['next']}"
    assert sorted(listed) == sorted(recipe_of), f"acknowledged and listed differ: {set(listed) ^ set(recipe_of)}"
    assert sorted(listed) == sorted(os.listdir(work / "state/jobs")), "jobs and directories differ"
    for job in listed:
        document = wait_for(daemon, job)
        assert document["state"] == "succeeded", f"job {job}: {document}"
        assert digest(daemon, job) == bits[recipe_of[job]], f"job {job}: other bits"
        iterations = [row["iteration"] for row in document["history"]]
        assert iterations == sorted(set(iterations)), f"job {job}: history {iterations}"
        events = daemon.get(f"/v1/jobs/{job}/events")
        assert events.count("event: end\n") == 1, f"job {job} ends {events.count('event: end')} times"
    assert daemon.get("/readyz") == "ready\n", f"set aside: {daemon.get('/v1/quarantine')}"
    return len(listed)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("build", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("database")
    parser.add_argument("data", type=Path)
    parser.add_argument("lossy", type=Path)
    parser.add_argument("start")
    parser.add_argument("--faults", type=int, default=300)
    parser.add_argument("--clients", type=int, default=3)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 30))
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    chance, work = random.Random(options.seed), options.work
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    subprocess.run([options.build / "cbct", "simulate", "--phantom", "ball", "--scale", "30", "--views", "40", "--columns", "32",
                    "--rows", "24", "--pixel", "8", "-o", work / "scan"], check=True, stdout=subprocess.DEVNULL)
    daemon, server = Daemon(options.build, work, options.database), Server(options.data, options.start)
    history, stop, posted, threads, bits = History(work / "history.jsonl"), threading.Event(), [], [], []
    daemon.start()
    counts = collections.Counter()
    try:
        status, scan = daemon.ask("POST", "/v1/scans", json.loads((work / "scan/scan.json").read_text()))
        assert status == 201, scan
        request = urllib.request.Request(f"{daemon.url}/v1/scans/{scan['id']}/projections",
                                         (work / "scan/projections.raw").read_bytes(), method="PUT")
        with urllib.request.urlopen(request) as reply:
            assert reply.status == 201
        for i, recipe in enumerate(RECIPES):
            status, job = daemon.ask("POST", "/v1/jobs", {"scan": scan["id"], **recipe}, f"first-{i}")
            assert status == 202, job
            posted.append((f"first-{i}", i, job["id"]))
            wait_for(daemon, job["id"])
            bits.append(digest(daemon, job["id"]))
        for i in range(options.clients):
            threads.append(threading.Thread(target=client, args=(daemon, history, scan["id"], stop, posted,
                                                                 options.seed + i)))
            threads[-1].start()
        for _ in range(options.faults):
            time.sleep(chance.uniform(0.1, 1.5))
            name = fault(daemon, server, options.lossy, chance)
            history.add(fault=name)
            counts[name] += 1
            if daemon.process.poll() is not None:
                raise AssertionError(f"the daemon has ended with {daemon.process.returncode}, see {work}/cbctd.err")
        stop.set()
        for thread in threads:
            thread.join()
        (options.lossy / "lose").unlink(missing_ok=True)
        jobs = check(daemon, work, posted, bits)
        daemon.kill(signal.SIGKILL)
        daemon.start()
        again = check(daemon, work, posted, bits)
        assert again == jobs
        print(f"{sum(counts.values())} faults ({dict(counts)}), {len(posted)} acknowledged calls, {jobs} jobs: all hold")
    except AssertionError as error:
        print(f"VIOLATION: {error} (seed {options.seed}, {work})")
        sys.exit(1)
    finally:
        stop.set()
        if daemon.process.poll() is None:
            daemon.kill(signal.SIGTERM)


main()
