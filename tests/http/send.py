#!/usr/bin/python3
"""Archives for the tests of sending: one that does wrong, and a look into a real one.

Usage: send.py web MODE LOG           a DICOMweb archive on a free port, which it prints. MODE: lies (acknowledges, keeps
           nothing), forgets (keeps every other object), refuses (403 to STOW-RS), slow (a second for each request), drips (a byte of a reply every 0.2 s), drips-late (only of that to STOW-RS), token (401
           without the token "secret-token", keeps all). LOG: a line for each request
       send.py whose DIRECTORY JOBS   every object of the directory (files of DICOM) has the patient of its job; JOBS: a line
           "K SCAN JOB" for each, whose patient is "NameK^x", id-K, accK; prints for each job how many objects it has, twice
           counted ones named
"""
import collections
import json
import os
import re
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Dict, List


class Archive(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    mode = ""
    log = ""
    kept: List[str] = []
    count = 0
    lock = threading.Lock()

    def reply(self, status: int, body: bytes = b"") -> None:
        with self.lock, open(self.log, "a", encoding="utf-8") as file:
            print(self.command, self.path, status, self.headers.get("Authorization", "-"), file=file)
        self.send_response(status)
        self.send_header("Content-Type", "application/dicom+json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.mode == "drips" or (self.mode == "drips-late" and self.command == "POST"):
            for place in range(len(body)):
                self.wfile.write(body[place:place + 1])
                self.wfile.flush()
                time.sleep(0.2)
        else:
            self.wfile.write(body)

    def refused(self) -> bool:
        if self.mode == "slow":
            time.sleep(1)
        if self.mode == "token" and self.headers.get("Authorization") != "Bearer secret-token":
            self.reply(401)
            return True
        return False

    def do_GET(self) -> None:
        if self.refused():
            return
        offset = int(re.search(r"offset=(\d+)", self.path)[1]) if "offset=" in self.path else 0
        with self.lock:
            found = self.kept[offset:] if "/instances" in self.path else []
        if self.mode == "drips":
            found = ["1.2.3"] * 20
        self.reply(200, json.dumps([{"00080018": {"vr": "UI", "Value": [uid]}} for uid in found]).encode())

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.refused():
            return
        if self.mode == "refuses":
            self.reply(403, b"no, not for Doe^Jane")
            return
        # Media Storage SOP Instance UID, explicit little endian.
        uids = [m[1].rstrip(b"\0").decode() for m in re.finditer(rb"\x02\x00\x03\x00UI..([0-9.]+\0?)", body, re.DOTALL)]
        with self.lock:
            for uid in uids:
                Archive.count += 1
                if uid not in self.kept and (self.mode not in ("lies", "forgets") or (self.mode == "forgets" and self.count % 2)):
                    self.kept.append(uid)
        self.reply(200, b'{"00081199": {"vr": "SQ", "Value": []}}')

    def log_message(self, *_: object) -> None:
        pass


def web(mode: str, log: str) -> None:
    Archive.mode, Archive.log = mode, log
    server = ThreadingHTTPServer(("127.0.0.1", 0), Archive)
    print(server.server_address[1], flush=True)
    server.serve_forever()


def whose(directory: str, jobs: str) -> None:
    import pydicom

    with open(jobs, encoding="utf-8") as file:
        owner = {job: k for k, _, job in (line.split() for line in file)}
    found: Dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    for name in sorted(os.listdir(directory)):
        data = pydicom.dcmread(os.path.join(directory, name), stop_before_pixels=True)
        job = next(one for one in owner if one in data.ImageComments)
        k = owner[job]
        said = (str(data.PatientName), data.PatientID, data.AccessionNumber, data.StudyInstanceUID)
        if said != (f"Name{k}^x", f"id-{k}", f"acc{k}", f"1.2.{k}"):
            sys.exit(f"{name} of job {job}, scan {k}: {said}")
        found[job][(data.SeriesInstanceUID, data.InstanceNumber)] += 1
    for job, k in owner.items():
        again = [place for place, count in found[job].items() if count > 1]
        print(k, len(found[job]), "again: " + str(again) if again else "")


if sys.argv[1] == "web":
    web(*sys.argv[2:4])
else:
    whose(*sys.argv[2:4])
