#!/usr/bin/python3
"""Clients that ask for more pictures than can be drawn, and go away: nobody else waits for them.

Usage: pictures.py URL UNIX-SOCKET VOLUME-PATH SCAN HOLD [late]

HOLD is the file that CBCT_TEST_HOLD_DRAWING names; SCAN lacks projections of 8 x 8 float32.

Drawings are held up, so that what is there meanwhile is known by its number and not by a time.
"""
import json
import os
import re
import socket
import sys
import time
import urllib.parse
import urllib.request
from typing import Dict, Tuple

PATIENCE = 900  # s for what must come
GONE, LIVE, WAITING_CLIENT_MAX = 300, 20, 128
PLACES = min(len(os.sched_getaffinity(0)), 8)  # of one client; there is one more

url, unix_socket, volume, scan, hold = sys.argv[1:6]
address = urllib.parse.urlsplit(url)


def expect(condition: bool, what: str) -> None:
    if not condition:
        sys.exit(f"expected: {what}")


def get(path: str, method: str = "GET", body: bytes = b"") -> Tuple[int, bytes]:
    wanted = urllib.request.Request(url + path, method=method, data=body or None)
    with urllib.request.urlopen(wanted, timeout=PATIENCE) as reply:
        return reply.status, reply.read()


def counts() -> Dict[str, int]:
    """cbctd_pictures_*: drawing, waiting, and by how they ended."""
    text = get("/metrics")[1].decode()
    found = {name: int(value) for name, value in re.findall(r"^cbctd_pictures_(drawing|waiting) (\d+)$", text, re.M)}
    found.update((how, int(value)) for how, value in re.findall(r'^cbctd_pictures_ended_total{how="(\w+)"} (\d+)$', text, re.M))
    return found


def until(condition, what: str) -> Dict[str, int]:
    end = time.monotonic() + PATIENCE
    while not condition(now := counts()):
        expect(time.monotonic() < end, f"{what}, got {now}")
        time.sleep(0.02)
    return now


class Client:
    """A request for a large slab."""

    def __init__(self, i: int, unix: str = "") -> None:
        self.socket = socket.socket(socket.AF_UNIX if unix else socket.AF_INET)
        self.socket.settimeout(PATIENCE)
        self.socket.connect(unix or (address.hostname, address.port))
        query = f"normal=1,{i},2&size=600,600&spacing=0.2&thickness=9.9"
        self.socket.sendall(f"GET {volume}/slice?{query} HTTP/1.1\r\nHost: {address.netloc}\r\nConnection: close\r\n\r\n".encode())

    def reply(self) -> Tuple[int, Dict[str, str], bytes]:
        got = b""
        while piece := self.socket.recv(1 << 16):
            got += piece
        self.socket.close()
        head, _, body = got.partition(b"\r\n\r\n")
        lines = head.decode().split("\r\n")
        return int(lines[0].split()[1]), {k.lower(): v for k, v in (line.split(": ", 1) for line in lines[1:])}, body


def holding(yes: bool) -> None:
    if yes:
        open(hold, "w").close()
    else:
        os.unlink(hold)


def flood() -> None:
    """More than can be drawn, of one address; most have gone by the time they could be."""
    before = counts()
    holding(True)
    live = [Client(i) for i in range(LIVE)]
    until(lambda n: n["drawing"] == PLACES and n["waiting"] == LIVE - PLACES, f"{LIVE} pictures, {PLACES} of them being drawn")
    for i in range(GONE):
        Client(i).socket.close()
    all_gone = lambda n: n["waiting"] + n["gone"] + n["drawing"] == before["gone"] + LIVE + GONE
    now = until(all_gone, f"{LIVE + GONE} pictures")
    expect(now["drawing"] == PLACES and now["drawn"] == before["drawn"], f"{PLACES} drawings, none ended, got {now}")
    # The place that is left is for other clients, as a user of the Unix socket is one.
    other = Client(1, unix_socket)
    until(lambda n: n["drawing"] == PLACES + 1, "a drawing of another client beside them")
    holding(False)
    for client in live + [other]:
        status, headers, body = client.reply()
        expect(status == 200 and headers["content-type"] == "image/png" and body[:4] == b"\x89PNG", f"a picture, got {status}")
    now = until(lambda n: n["drawing"] + n["waiting"] == 0, "all at an end")
    made = {how: now[how] - before[how] for how in ("drawn", "gone", "refused", "failed")}
    expect(made == {"drawn": LIVE + 1, "gone": GONE, "refused": 0, "failed": 0}, f"only pictures of who is there, got {made}")
    print(f"  {PLACES} places of one client; {made}")


def served_meanwhile() -> None:
    """Whoever asks for anything else is served while no picture gets on. One of another client, too."""
    before = counts()
    holding(True)
    clients = [Client(i) for i in range(LIVE)]
    until(lambda n: n["drawing"] + n["waiting"] == LIVE, f"{LIVE} pictures")
    for path in ["/livez", "/readyz", "/v1/jobs", "/v1/scans"] + ["/livez"] * 20:
        expect(get(path)[0] == 200, f"200 of {path}")
    expect(get(f"/v1/scans/{scan}/projections/0", "PUT", bytes(8 * 8 * 4))[0] == 201, "201 of a projection")
    now = counts()
    expect(now["drawn"] == before["drawn"] and now["drawing"] > 0, f"all of that before the first drawing, got {now}")
    for client in clients:  # amid their drawings, too
        client.socket.close()
    holding(False)
    now = until(lambda n: n["drawing"] + n["waiting"] == 0, "all at an end")
    expect(now["gone"] == before["gone"] + LIVE and now["drawn"] == before["drawn"], f"none drawn, got {now} after {before}")


def full() -> None:
    """One too many is told so, and when to come again."""
    before = counts()
    holding(True)
    clients = [Client(i) for i in range(PLACES)]
    until(lambda n: n["drawing"] == PLACES, f"{PLACES} being drawn")
    clients += [Client(i) for i in range(WAITING_CLIENT_MAX)]
    until(lambda n: n["waiting"] == WAITING_CLIENT_MAX, f"{WAITING_CLIENT_MAX} that wait")
    for _ in range(3):
        status, headers, body = Client(0).reply()
        told = json.loads(body)
        expect(status == 503 and int(headers["retry-after"]) > 0 and headers["content-type"] == "application/problem+json"
               and told["type"] == "urn:cbctd:problem:busy", f"503 of one too many, got {status} {headers} {body}")
    expect(get("/livez")[0] == 200, "200 of /livez")
    for client in clients:
        client.socket.close()
    other = Client(0)  # those who have gone make room
    until(lambda n: n["waiting"] == 1, "one that waits")
    holding(False)
    status, headers, body = other.reply()
    expect(status == 200, f"a picture, got {status} {body[:300]}")
    now = counts()
    expect(now["refused"] == before["refused"] + 3, f"3 refused, got {now} after {before}")


def late() -> None:
    """With --picture-patience: a turn that does not come by then is not waited for."""
    before = counts()
    holding(True)
    clients = [Client(i) for i in range(LIVE)]
    now = until(lambda n: n["drawing"] + n["refused"] == before["refused"] + LIVE, "none that waits")
    drawing = now["drawing"]
    holding(False)
    statuses = sorted(client.reply()[0] for client in clients)
    expect(statuses == [200] * drawing + [503] * (LIVE - drawing), f"{drawing} drawn, the others told to come again, got {statuses}")


if sys.argv[6:] == ["late"]:
    late()
else:
    served_meanwhile()
    flood()
    full()
