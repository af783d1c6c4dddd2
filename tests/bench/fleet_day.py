#!/usr/bin/env python3
"""A day of a hospital's fleet in minutes: carts and GPU servers are real daemons with their ledger in PostgreSQL, their workers take the time
of the jobs that stand in JOBS (paced_worker.py). Prints the waiting times as a table.

The clocks of the daemons are not compressed: each real second of theirs (a look at the ledger, a process that starts) counts as
--compression seconds, so that the waits are upper bounds.

usage: fleet_day.py BUILD FOLDER DATABASE-ADDRESS [--carts N] [--servers N] [--hours H] [--compression C] [--seed N]
"""
import argparse
import json
import pathlib
import random
import subprocess
import sys
import threading
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "http"))
from fleet_host import Host, wait_for

HERE = pathlib.Path(__file__).resolve().parent
# Seconds on a server's H200: the kernels of tests/bench/results (2026-11-27-h200-b19f1f5.txt, any geometry) and 1 s a gigabyte for reading
# and writing. Bytes: of the scan and the volume that is kept. Share: jobs a patient.
JOBS = {
    "FDK 512^3, urgent": dict(iterations=0, size=[16, 16, 8], priority="urgent", seconds=0.064 + 1.7, gigabytes=1.2 + 0.5, share=1.0),
    "SIRT 512^3, 50 iterations": dict(iterations=50, size=[16, 16, 8], priority="routine", seconds=0.064 + 50 * 0.133 + 1.7, gigabytes=1.2 + 0.5, share=1.0),
    "SIRT 1024^3, 100 iterations": dict(iterations=100, size=[32, 32, 16], priority="routine", seconds=0.62 + 100 * 1.06 + 5.8, gigabytes=1.5 + 4.3, share=0.33),
}
CART = 6.0  # times as slow as a server: an assumption
LINK = 0.11  # gigabytes a second: 1 Gbit/s
PATIENTS = 12  # a cart in eight hours


def host_of(options, name, server):
    slow = 1.0 if server else CART
    seconds = {}
    for job in JOBS.values():
        way = job["gigabytes"] / LINK if server else 0.0
        seconds[job["iterations"]] = (job["seconds"] * slow + way) / options.compression
    host = Host(options, "day", name, server, ["--worker", str(HERE / "paced_worker.py"), "--http-threads", "2"],
                {"PACED_WORKER": f"{options.build}/cbct-worker", "OMP_NUM_THREADS": "1", "PACED_SECONDS": ",".join(f"{n}:{s}" for n, s in seconds.items())})
    host.start()
    return host


def patients(options, cart, folder, begin, posted):
    """Posts the scans and jobs of one cart's day, at random times."""
    draw = random.Random(f"{options.seed} {cart.name}")
    document, samples = json.loads((folder / "scan.json").read_text()), (folder / "projections.raw").read_bytes()
    count = round(PATIENTS * options.hours / 8)
    for at in sorted(draw.uniform(0, options.hours * 3600) for _ in range(count)):
        time.sleep(max(0.0, begin + at / options.compression - time.monotonic()))
        scan = cart.json("POST", "/v1/scans", document)["id"]
        status, _ = cart.ask("PUT", f"/v1/scans/{scan}/projections", samples)
        assert status == 201, status
        for name, job in JOBS.items():
            if draw.random() >= job["share"]:
                continue
            made = cart.json("POST", "/v1/jobs", {"scan": scan, "grid": {"size": job["size"], "spacing_mm": [192 / job["size"][0]] * 3},
                                                  "fdk": {}, "sart": {"iterations": job["iterations"], "subsets": 1} if job["iterations"] else None,
                                                  "emit": [], "priority": job["priority"]})
            posted.append((cart, made["id"], name))


def percentile(values, share):
    values = sorted(values)
    return values[min(len(values) - 1, int(share * len(values)))] if values else float("nan")


def words(seconds):
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.1f} min"


def report(options, posted):
    rows, failed = {}, 0
    for cart, job, name in posted:
        document = cart.json("GET", f"/v1/jobs/{job}")
        failed += document["state"] != "succeeded"
        times = document["timings"]
        away = (document["device"] or "").startswith("server")
        rows.setdefault(name, []).append((times["queued"], times["total"], away))
    print(f"{options.carts} carts, {options.servers} servers, {options.hours:g} h in {options.hours * 3600 / options.compression:.0f} s, seed {options.seed}")
    print("| jobs | number | on a server | wait, median | 95 % | longest | posted to done, median | 95 % |\n|---|---|---|---|---|---|---|---|")
    for name in JOBS:
        of = rows.get(name, [])
        wait = [options.compression * row[0] for row in of]
        total = [options.compression * row[1] for row in of]
        print(f"| {name} | {len(of)} | {100 * sum(row[2] for row in of) / max(1, len(of)):.0f} % | {words(percentile(wait, .5))} | "
              f"{words(percentile(wait, .95))} | {words(max(wait, default=0))} | {words(percentile(total, .5))} | {words(percentile(total, .95))} |")
    print(f"{failed} of {len(posted)} jobs did not succeed")
    return failed


def main():
    parser = argparse.ArgumentParser()
    for name in ("build", "folder", "database"):
        parser.add_argument(name)
    parser.add_argument("--carts", type=int, default=20)
    parser.add_argument("--servers", type=int, default=4)
    parser.add_argument("--hours", type=float, default=8)
    parser.add_argument("--compression", type=float, default=60)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    options.folder = pathlib.Path(options.folder)
    options.folder.mkdir(parents=True, exist_ok=True)
    scan = options.folder / "scan"
    subprocess.run([f"{options.build}/cbct", "simulate", "-o", str(scan), "--phantom", "head", "--scale", "70", "--views", "16", "--columns", "24",
                    "--rows", "16", "--pixel", "14"], check=True, stdout=subprocess.DEVNULL)
    hosts, posted, code = [], [], 1
    try:
        for i in range(options.servers):
            hosts.append(host_of(options, f"server{i + 1}", True))
        for i in range(options.carts):
            hosts.append(host_of(options, f"cart{i + 1}", False))
        for host in hosts:
            wait_for(lambda: host.ask("GET", "/readyz")[0] == 200, 60, f"host {host.name} is ready")
        begin = time.monotonic() + 1
        carts = [threading.Thread(target=patients, args=(options, host, scan, begin, posted)) for host in hosts[options.servers:]]
        for thread in carts:
            thread.start()
        for thread in carts:
            thread.join()
        for cart, job, _ in list(posted):
            while cart.json("GET", f"/v1/jobs/{job}?wait=20")["state"] not in ("succeeded", "failed", "cancelled"):
                pass
        code = 1 if report(options, posted) > 0 else 0
    finally:
        for host in hosts:
            host.process.terminate()
        for host in hosts:
            host.process.wait()
    return code


sys.exit(main())
