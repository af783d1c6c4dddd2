#!/usr/bin/python3
"""Requests as no client library sends them, over sockets of its own. Used by test_framing.sh and test_limits.sh.

Usage: raw_http.py PORT CASE [ARGUMENT ...]     exits with 1 and says what it expected
With RAW_TLS_CA=FILE in the environment the bytes go through TLS, whose certificate that authority has signed.
"""
import base64
import hashlib
import json
import os
import re
import resource
import socket
import ssl
import sys
import threading
import time
from typing import List, Optional, Tuple

PORT = int(sys.argv[1])
OK = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n"
PATIENCE = 10  # s, until an answer
TLS = ssl.create_default_context(cafile=os.environ["RAW_TLS_CA"]) if "RAW_TLS_CA" in os.environ else None


class Peer:
    """A connection, and the replies on it."""

    def __init__(self, data: bytes = b"", path: str = "", window: int = 0) -> None:
        self.socket = socket.socket(socket.AF_UNIX if path else socket.AF_INET, socket.SOCK_STREAM)
        self.socket.settimeout(PATIENCE)
        if window:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, window)
        self.socket.connect(path or ("127.0.0.1", PORT))
        if not path:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if TLS is not None:
                self.socket = TLS.wrap_socket(self.socket, server_hostname="localhost")
        self.rest = b""
        if data:
            self.send(data)

    def __enter__(self) -> "Peer":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, data: bytes) -> None:
        try:
            self.socket.sendall(data)
        except OSError:
            pass  # what was answered before is still to be read

    def more(self) -> bool:
        try:
            data = self.socket.recv(65536)
        except (ConnectionResetError, ssl.SSLEOFError):
            data = b""
        self.rest += data
        return bool(data)

    def reply(self) -> Optional[Tuple[int, dict, bytes]]:
        """Status, header fields, body; None when the connection ends before."""
        while b"\r\n\r\n" not in self.rest:
            if not self.more():
                return None
        head, self.rest = self.rest.split(b"\r\n\r\n", 1)
        lines = head.decode().split("\r\n")
        fields = {name.lower(): value.strip() for name, value in (line.split(":", 1) for line in lines[1:])}
        length = int(fields["content-length"])
        while len(self.rest) < length:
            if not self.more():
                raise AssertionError("the reply is cut off")
        body, self.rest = self.rest[:length], self.rest[length:]
        return int(lines[0].split()[1]), fields, body

    def ended(self) -> bool:
        """Whether the daemon has closed it by now."""
        self.socket.setblocking(False)
        try:
            while self.socket.recv(65536):
                pass
            return True
        except BlockingIOError:
            return False
        except ConnectionResetError:
            return True
        finally:
            self.socket.settimeout(PATIENCE)

    def statuses(self) -> List[int]:
        """Of all replies until the connection ends."""
        found = []
        while True:
            reply = self.reply()
            if reply is None:
                return found
            found.append(reply[0])


def expect(condition: bool, what: str) -> None:
    if not condition:
        print(f"expected: {what}", file=sys.stderr)
        sys.exit(1)


def is_refused(data: bytes, status: int, name: str, pieces: int = 0) -> None:
    """One problem document of this status, and the end of the connection. pieces: bytes sent at a time."""
    with Peer() as peer:
        if pieces:
            for i in range(0, len(data), pieces):
                peer.send(data[i : i + pieces])
        else:
            peer.send(data)
        try:
            reply = peer.reply()
        except socket.timeout:
            reply = (0, {}, b"")
        expect(reply is not None, f"{name}: {status}, the connection ended")
        expect(reply[0] == status, f"{name}: {status}, got {reply[0]}")
        expect(reply[1].get("content-type") == "application/problem+json", f"{name}: problem+json, got {reply[1]}")
        problem = json.loads(reply[2])
        expect(problem["status"] == status and problem["type"].startswith("urn:cbctd:problem:"), f"{name}: {problem}")
        expect(bool(problem["detail"]) and bool(problem["title"]) and bool(problem["request_id"]), f"{name}: {problem}")
        expect(reply[1].get("connection", "").lower() == "close", f"{name}: Connection: close")
        expect(not peer.more() and not peer.rest, f"{name}: the end of the connection, got {peer.rest[:80]!r}")


def head(*lines: bytes, first: bytes = b"GET /livez HTTP/1.1", host: bytes = b"Host: localhost") -> bytes:
    return b"\r\n".join([first, *([host] if host else []), *lines, b"", b""])


def chunked(body: bytes, first: bytes = b"POST /v1/scans HTTP/1.1") -> bytes:
    return head(b"Content-Type: application/json", b"Transfer-Encoding: chunked", first=first) + body


MALFORMED = {
    "a blank before the colon": (400, head(b"X-A : 1")),
    "a tab before the colon": (400, head(b"X-A\t: 1")),
    "a blank before Host's colon": (400, head(host=b"Host : localhost")),
    "a blank before the length's colon": (400, head(b"Content-Length : 5", first=b"POST /v1/scans HTTP/1.1") + b"{}{}{"),
    "bare LF after the first line": (400, b"GET /livez HTTP/1.1\nHost: localhost\r\n\r\n"),
    "bare LF after a field": (400, b"GET /livez HTTP/1.1\r\nHost: localhost\nX: 1\r\n\r\n"),
    "bare LF everywhere": (400, b"GET /livez HTTP/1.1\nHost: localhost\n\n"),
    "LF for the empty line": (400, b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\n"),
    "bare CR in a value": (400, head(b"X: a\rb")),
    "bare CR before a name": (400, head(b"\rX: a")),
    "CR CR LF": (400, b"GET /livez HTTP/1.1\r\nHost: localhost\r\r\n\r\n"),
    "bare CR in the first line": (400, b"GET /livez\rX HTTP/1.1\r\nHost: localhost\r\n\r\n"),
    "NUL in a value": (400, head(b"X: a\0b")),
    "NUL in a name": (400, head(b"X\0: a")),
    "NUL in Host": (400, head(host=b"Host: localhost\0.evil")),
    "NUL in the target": (400, head(first=b"GET /livez\0 HTTP/1.1")),
    "a control character in a value": (400, head(b"X: \x01")),
    "DEL in a value": (400, head(b"X: \x7f")),
    "a blank in a name": (400, head(b"X Y: 1")),
    "a name in quotes": (400, head(b'"X": 1')),
    "a name of other letters": (400, head("Ü: 1".encode())),
    "an empty name": (400, head(b": 1")),
    "no colon": (400, head(b"X")),
    "a folded field": (400, head(b"X: a", b" b")),
    "a folded field with a tab": (400, head(b"X: a", b"\tb")),
    "a folded first field": (400, b"GET /livez HTTP/1.1\r\n Host: localhost\r\n\r\n"),
    "a folded length": (400, head(b"Content-Length:", b" 5", first=b"POST /v1/scans HTTP/1.1") + b"{}{}{"),
    "no Host": (400, head(host=b"")),
    "two Hosts": (400, head(b"Host: localhost")),
    "two Hosts that differ": (400, head(b"Host: evil.example")),
    "two Hosts with HTTP/1.0": (400, head(b"host: evil.example", first=b"GET /livez HTTP/1.0")),
    "another server in the target": (400, head(first=b"GET http://evil.example/livez HTTP/1.1")),
    "another port in the target": (400, head(first=b"GET http://localhost:81/livez HTTP/1.1")),
    "user information in the target": (400, head(first=b"GET http://a@localhost/livez HTTP/1.1")),
    "another scheme in the target": (400, head(first=b"GET ftp://localhost/livez HTTP/1.1")),
    "an authority for a target": (400, head(first=b"CONNECT localhost:80 HTTP/1.1")),
    "no slash": (400, head(first=b"GET livez HTTP/1.1")),
    "a fragment": (400, head(first=b"GET /livez#a HTTP/1.1")),
    "two blanks before the target": (400, head(first=b"GET  /livez HTTP/1.1")),
    "two blanks behind the target": (400, head(first=b"GET /livez  HTTP/1.1")),
    "a blank at the end": (400, head(first=b"GET /livez HTTP/1.1 ")),
    "a blank in the target": (400, head(first=b"GET /li vez HTTP/1.1")),
    "a tab for a blank": (400, head(first=b"GET\t/livez HTTP/1.1")),
    "a byte above 127 in the target": (400, head(first="GET /ü HTTP/1.1".encode())),
    "no version": (400, head(first=b"GET /livez")),
    "no target": (400, head(first=b"GET HTTP/1.1")),
    "a version in small letters": (400, head(first=b"GET /livez http/1.1")),
    "a version of three digits": (400, head(first=b"GET /livez HTTP/1.10")),
    "no version at all": (400, b"GARBAGE\r\n"),
    "nothing but zeros": (400, b"\0\0\0\0"),
    "TLS": (400, bytes.fromhex("1603010200010001fc0303") + bytes(64)),
    "two empty lines in front": (400, b"\r\n\r\n" + OK),
    "LF in front": (400, b"\n" + OK),
    "HTTP/2's preface": (505, b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"),
    "HTTP/0.9": (505, head(first=b"GET /livez HTTP/0.9")),
    "HTTP/3.0": (505, head(first=b"GET /livez HTTP/3.0")),
    "a length beside chunks": (400, head(b"Content-Length: 3", b"Transfer-Encoding: chunked", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n"),
    "chunks beside a length": (400, head(b"Transfer-Encoding: chunked", b"Content-Length: 5", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n"),
    "chunks with HTTP/1.0": (400, chunked(b"0\r\n\r\n", first=b"POST /v1/scans HTTP/1.0")),
    "chunked twice": (400, head(b"Transfer-Encoding: chunked", b"Transfer-Encoding: chunked", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n"),
    "chunked, chunked": (400, head(b"Transfer-Encoding: chunked, chunked", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n"),
    "gzip, chunked": (400, head(b"Transfer-Encoding: gzip, chunked", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n"),
    "identity": (400, head(b"Transfer-Encoding: identity", b"Content-Length: 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "xchunked": (400, head(b"Transfer-Encoding: xchunked", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n"),
    "chunked behind a vertical tab": (400, head(b"Transfer-Encoding: \x0bchunked", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n"),
    "two origins": (400, head(b"Origin: http://localhost", b"Origin: http://evil.example", b"Content-Type: application/json", b"Content-Length: 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "an expectation twice": (400, head(b"Expect: 100-continue", b"Expect: 100-continue")),
    "two sites": (400, head(b"Sec-Fetch-Site: same-origin", b"sec-fetch-site: cross-site", b"Content-Type: application/json", b"Content-Length: 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "two keys": (400, head(b"Idempotency-Key: a", b"Idempotency-Key: b", b"Content-Type: application/json", b"Content-Length: 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "two types": (400, head(b"Content-Type: text/plain", b"Content-Type: application/json", b"Content-Length: 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "two lengths": (400, head(b"Content-Length: 2", b"Content-Length: 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "two lengths that differ": (400, head(b"Content-Length: 2", b"Content-Length: 3", first=b"POST /v1/scans HTTP/1.1") + b"{}x"),
    "a list of lengths": (400, head(b"Content-Length: 2, 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "a length with a sign": (400, head(b"Content-Length: +2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "a negative length": (400, head(b"Content-Length: -2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "a hexadecimal length": (400, head(b"Content-Length: 0x2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "a length with a blank": (400, head(b"Content-Length: 1 2", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "no length's number": (400, head(b"Content-Length:", first=b"POST /v1/scans HTTP/1.1")),
    "a length beyond all": (400, head(b"Content-Length: 18446744073709551618", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "a length of GET that is none": (400, head(b"Content-Length: x")),
    "a chunk without a number": (400, chunked(b"\r\n\r\n")),
    "a chunk of a bad number": (400, chunked(b"5g\r\nhello\r\n0\r\n\r\n")),
    "a chunk with a sign": (400, chunked(b"+5\r\nhello\r\n0\r\n\r\n")),
    "a negative chunk": (400, chunked(b"-5\r\nhello\r\n0\r\n\r\n")),
    "a chunk of 0x": (400, chunked(b"0x5\r\nhello\r\n0\r\n\r\n")),
    "a chunk with a blank": (400, chunked(b" 5\r\nhello\r\n0\r\n\r\n")),
    "a chunk with a blank behind": (400, chunked(b"5 \r\nhello\r\n0\r\n\r\n")),
    "a chunk ended by LF": (400, chunked(b"5\nhello\r\n0\r\n\r\n")),
    "a chunk's data ended by LF": (400, chunked(b"5\r\nhello\n0\r\n\r\n")),
    "a chunk's data ended by CR": (400, chunked(b"5\r\nhello\rx0\r\n\r\n")),
    "a chunk longer than it says": (400, chunked(b"5\r\nhello, world\r\n0\r\n\r\n")),
    "LF in an extension": (400, chunked(b"5;a\nb\r\nhello\r\n0\r\n\r\n")),
    "CR in an extension": (400, chunked(b"5;a\rb\r\nhello\r\n0\r\n\r\n")),
    "NUL in an extension": (400, chunked(b"5;a\0\r\nhello\r\n0\r\n\r\n")),
    "a chunk's endless line": (400, chunked(b"5;" + b"a" * 5000)),
    "a chunk beyond all": (413, chunked(b"ffffffffffffffff\r\n")),
    "a chunk beyond 64 bits": (413, chunked(b"10000000000000005\r\nhello\r\n0\r\n\r\n")),
    "an end ended by LF": (400, chunked(b"0\n\n")),
    "a trailer ended by LF": (400, chunked(b"0\r\n\n")),
    "a trailer without a colon": (400, chunked(b"0\r\nX\r\n\r\n")),
    "a folded trailer": (400, chunked(b"0\r\nX: a\r\n b\r\n\r\n")),
    "a length in a trailer": (400, chunked(b"0\r\nContent-Length: 5\r\n\r\n")),
    "a digest in a trailer": (400, chunked(b"0\r\nContent-Digest: sha-256=:AAAA:\r\n\r\n")),
    "Host in a trailer": (400, chunked(b"0\r\nHost: evil.example\r\n\r\n")),
    "an endless trailer": (431, chunked(b"0\r\n" + b"X: a\r\n" * 5000)),
    "24,000 parameters": (414, head(first=b"GET /v1/scans?" + b"a=1&" * 24000 + b" HTTP/1.1")),
    "3,000 parameters": (400, head(first=b"GET /v1/scans?" + b"a&" * 3000 + b" HTTP/1.1")),
    "a target of 9,000 bytes": (414, head(first=b"GET /" + b"a" * 9000 + b" HTTP/1.1")),
    "a target without an end": (414, b"GET /" + b"a" * 200000),
    "a first line without an end": (414, b"A" * 200000),
    "5,000 fields": (431, head(*[b"X: a"] * 5000)),
    "a field of 30,000 bytes": (431, head(b"X: " + b"a" * 30000)),
    "a field without an end": (431, b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 200000),
    "10,000 cookies": (431, head(b"Cookie: " + b"a;" * 10000)),
    "cookies in 90 fields": (431, head(*[b"Cookie: " + b"a, b;" * 20] * 90)),
}

# Each one request, and a status below 500 that is not of the gate.
FINE = {
    "an empty line in front": (200, b"\r\n" + OK),
    "blanks behind a value": (200, head(b"X: a \t ")),
    "blanks behind Host": (200, head(host=b"Host:  localhost \t")),
    "no blank before a value": (200, head(b"X:a")),
    "an empty value": (200, head(b"X:")),
    "a value of blanks": (200, head(b"X:  \t ")),
    "a value of other letters": (200, head("X: ü".encode())),
    "blanks behind a length": (400, head(b"Content-Type: application/json", b"Content-Length: 2  ", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "zeros before a length": (400, head(b"Content-Type: application/json", b"Content-Length: 0002", first=b"POST /v1/scans HTTP/1.1") + b"{}"),
    "blanks behind chunked": (400, head(b"Content-Type: application/json", b"Transfer-Encoding:Chunked\t ", first=b"POST /v1/scans HTTP/1.1") + b"2\r\n{}\r\n0\r\n\r\n"),
    "a chunk's extension": (400, chunked(b'2;a=b;c="d e"\r\n{}\r\n0;x\r\n\r\n')),
    "a trailer": (400, chunked(b"2\r\n{}\r\n0\r\nX: a \r\nY: b\r\n\r\n")),
    "small chunks": (400, chunked(b"01\r\n{\r\n1\r\n}\r\n0000\r\n\r\n")),
    "a body of GET": (200, head(b"Content-Length: 5") + b"hello"),
    "chunks of GET": (200, head(b"Transfer-Encoding: chunked") + b"5\r\nhello\r\n0\r\n\r\n"),
    "the absolute form": (200, head(first=b"GET http://localhost/livez HTTP/1.1")),
    "the absolute form in capitals": (200, head(first=b"GET HTTP://LOCALHOST/livez HTTP/1.1")),
    "the absolute form through TLS": (200, head(first=b"GET https://localhost/livez HTTP/1.1")),
    "HTTP/1.2": (200, head(first=b"GET /livez HTTP/1.2")),
    "90 fields": (200, head(*[b"X-%d: a" % i for i in range(90)])),
    "a head of 20,000 bytes": (200, head(*[b"X: " + b"a" * 4900] * 4)),
    "all limits at once": (400, head(b"Cookie: " + b"a;" * 150, *[b"X: " + b"a" * 130] * 90, first=b"GET /livez?" + b"a&" * 63 + b"a=" + b"b" * 8000 + b" HTTP/1.1")),
    "63 parameters": (400, head(first=b"GET /v1/scans?" + b"a&" * 62 + b"a HTTP/1.1")),
    "an unknown method": (405, head(first=b"BREW /v1/scans HTTP/1.1")),
    "OPTIONS *": (400, head(first=b"OPTIONS * HTTP/1.1")),
}


def case_malformed() -> None:
    for name, (status, data) in MALFORMED.items():
        is_refused(data, status, name)
        if len(data) < 400:
            is_refused(data, status, f"{name}, byte by byte", 1)
    print(f"  {len(MALFORMED)} forms refused")


def case_fine() -> None:
    """The request, then another on the same connection: both are understood as they are meant."""
    for name, (status, data) in FINE.items():
        with Peer(data + OK) as peer:
            first, second = peer.reply(), peer.reply()
            expect(first is not None and first[0] == status, f"{name}: {status}, got {first}")
            expect(second is not None and second[0] == 200, f"{name}: 200 for the next, got {second}")
        with Peer() as peer:
            for i in range(0, len(data), max(1, len(data) // 200)):
                peer.send(data[i : i + max(1, len(data) // 200)])
            first = peer.reply()
            expect(first is not None and first[0] == status, f"{name}, in pieces: {status}, got {first}")
    with Peer(b"GET /livez HTTP/1.0\r\n\r\n") as peer:
        expect(peer.statuses() == [200], "HTTP/1.0 without Host: 200 and the end")
    with Peer(b"GET /livez HTTP/1.0\r\nConnection: keep-alive\r\n\r\n" + OK) as peer:
        expect(peer.reply()[0] == 200 and peer.reply()[0] == 200, "HTTP/1.0 with keep-alive: two answers")


def case_smuggling() -> None:
    """What a proxy may have forwarded as one request's body or head never becomes a request here."""
    hidden = b"DELETE /v1/scans/smuggled HTTP/1.1\r\nHost: localhost\r\n\r\n"
    pairs = {
        "CL.TE": head(b"Content-Length: %d" % (len(hidden) + 5), b"Transfer-Encoding: chunked", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n" + hidden,
        "TE.CL": head(b"Transfer-Encoding: chunked", b"Content-Length: 4", first=b"POST /v1/scans HTTP/1.1") + b"%x\r\n" % len(hidden) + hidden + b"\r\n0\r\n\r\n",
        "TE.TE": head(b"Transfer-Encoding: chunked", b"Transfer-Encoding: x", first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n" + hidden,
        "CL.CL": head(b"Content-Length: 0", b"Content-Length: %d" % len(hidden), first=b"POST /v1/scans HTTP/1.1") + hidden,
        "space before the colon": head(b"Content-Length : %d" % len(hidden), first=b"POST /v1/scans HTTP/1.1") + hidden,
        "TE behind a bare LF": head(b"X: y\nTransfer-Encoding: chunked", b"Content-Length: %d" % (len(hidden) + 5), first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n" + hidden,
        "TE behind a bare CR": head(b"X: y\rTransfer-Encoding: chunked", b"Content-Length: %d" % (len(hidden) + 5), first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n" + hidden,
        "folded TE": head(b"Transfer-Encoding:", b" chunked", b"Content-Length: %d" % (len(hidden) + 5), first=b"POST /v1/scans HTTP/1.1") + b"0\r\n\r\n" + hidden,
        "a head in the head": b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX: y\n\n" + hidden,
        "a chunk that ends early": chunked(b"2\r\n{}" + hidden),
        "a number too long": chunked(b"10000000000000000\r\n" + hidden),
        "a request in a trailer": chunked(b"0\r\nX: y\n\n" + hidden),
        "a request in an extension": chunked(b"0;\n\n" + hidden),
    }
    for name, data in pairs.items():
        for before in (b"", OK, OK * 3):
            with Peer(before + data + OK) as peer:
                got = peer.statuses()
                wanted = [200] * before.count(b"GET") + [413 if "too long" in name else 400]
                expect(got == wanted, f"{name}: {wanted} and the end, got {got}")
    # and what is one request stays one
    body = b"hello" + hidden
    with Peer(head(b"Content-Length: %d" % len(body)) + body + OK) as peer:
        expect((peer.reply()[0], peer.reply()[0]) == (200, 200), "a body is a body")
        peer.socket.settimeout(0.3)
        try:
            expect(not peer.more(), "no third answer")
        except socket.timeout:
            pass


def case_refused_early() -> None:
    """A body that is refused by its head and sent all the same does not cost the replies before it, however slowly they are read."""
    before = head(first=b"GET /v1/openapi.json HTTP/1.1") * 3
    for expectation in ((b"Expect: 100-continue",), ()):
        for size in (10, 70_000, 3_000_000):
            first = b"PUT /v1/scans/nope/projections HTTP/1.1"
            with Peer(before + head(b"Content-Length: %d" % size, *expectation, first=first), window=8192) as peer:
                sender = threading.Thread(target=peer.send, args=(b"x" * size,))
                sender.start()
                time.sleep(0.2)
                got = []
                while len(got) < 4:
                    reply = peer.reply()
                    got.append(reply and reply[0])
                    if reply is None:
                        break
                expect(got == [200, 200, 200, 404], f"all replies before a body of {size} bytes ({expectation}), got {got}")
                expect(not expectation or reply[1]["connection"].lower() == "close", f"the end is told, got {reply[1]}")
                sender.join()


def case_digest_behind(scan: str, size: str) -> None:
    """A digest in the trailer is refused, right or wrong, and nothing of the body is kept."""
    body = b"\0" * int(size)
    right = base64.b64encode(hashlib.sha256(body).digest())
    for digest in (right, base64.b64encode(hashlib.sha256(b"other").digest())):
        data = head(b"Transfer-Encoding: chunked", first=b"PUT /v1/scans/%s/projections/0 HTTP/1.1" % scan.encode())
        with Peer(data + b"%x\r\n" % len(body) + body + b"\r\n0\r\nContent-Digest: sha-256=:" + digest + b":\r\n\r\n") as peer:
            reply = peer.reply()
            expect(reply is not None and reply[0] == 400 and b"trailer" in reply[2], f"400, got {reply}")


def case_pipelining() -> None:
    """Requests back to back, cut at every place: as many answers, in their order."""
    chunks = b"3\r\n{ }\r\n2;x\r\n{}\r\n0\r\nX: y\r\n\r\n"
    requests = [
        (200, OK),
        (404, head(b"Content-Length: 7", first=b"GET /nowhere HTTP/1.1") + b"GET / H"),
        (400, chunked(chunks)),
        (404, head(first=b"DELETE /v1/scans/x HTTP/1.1")),
        (415, head(b"Content-Length: 2", b"Content-Type: text/plain", first=b"POST /v1/jobs HTTP/1.1") + b"{}"),
        (200, b"\r\n" + OK),
    ]
    data = b"".join(request for _, request in requests)
    wanted = [status for status, _ in requests]
    for cut in range(1, len(data)):
        with Peer(data[:cut]) as peer:
            if cut % 3 == 0:
                time.sleep(0.002)
            peer.send(data[cut:])
            got = [peer.reply()[0] for _ in requests]
            expect(got == wanted, f"cut at {cut}: {wanted}, got {got}")
    with Peer(data * 50) as peer:
        got = [peer.reply()[0] for _ in requests * 50]
        expect(got == wanted * 50, "300 answers to 300 requests in one piece")
    # heads and bodies longer than the library's buffer, at odd offsets to it
    body = b"x" * 100003
    one = head(b"X: " + b"a" * 15000, b"Content-Length: %d" % len(body), first=b"GET /nowhere HTTP/1.1") + body
    with Peer(one * 20 + OK) as peer:
        got = [peer.reply()[0] for _ in range(21)]
        expect(got == [404] * 20 + [200], f"20 long requests and a short one, got {got}")


def case_broken_body(scan: str, one: str) -> None:
    """Two projections in good chunks, then a bad one: refused, and nothing of it stored."""
    body = b"".join(b"%x\r\n" % int(one) + bytes(int(one)) + b"\r\n" for _ in range(2))
    is_refused(chunked(body + b"zz\r\n", first=b"PUT /v1/scans/%s/projections HTTP/1.1" % scan.encode()), 400, "a bad chunk")


def memory(pid: str) -> int:
    with open(f"/proc/{pid}/status", encoding="utf-8") as file:
        return int(re.search(r"VmRSS:\s+(\d+)", file.read()).group(1))


def case_leaks(pid: str) -> None:
    """1,000 bad connections of each costly kind; the growth of the daemon in KiB."""
    kinds = ["24,000 parameters", "3,000 parameters", "10,000 cookies", "5,000 fields", "a field without an end", "an endless trailer",
             "a chunk longer than it says"]
    for name in kinds:
        status, data = MALFORMED[name]
        for _ in range(50):
            is_refused(data, status, name)
        before = memory(pid)
        for _ in range(1000):
            is_refused(data, status, name)
        growth = memory(pid) - before
        expect(growth < 4096, f"less than 4096 KiB for 1,000 of \"{name}\", got {growth}")
        print(f"  growth after 1,000 of \"{name}\" = {growth} KiB")
    # dropped midway, without an answer: what so many connections at once take stays with the allocator, once
    for _ in range(2):
        before = memory(pid)
        for _ in range(1000):
            Peer(b"GET /v1/scans?" + b"a=1&" * 1000).socket.close()
            Peer(head(b"Content-Length: 5000", first=b"POST /v1/scans HTTP/1.1") + b"{").socket.close()
        time.sleep(2.5)
        growth = memory(pid) - before
        print(f"  growth after 2,000 broken requests = {growth} KiB")
    expect(growth < 4096, f"less than 4096 KiB for another 2,000 broken requests, got {growth}")


# ---- replies without a body ----

# Resources that the schema does not spell out, in forms whose length nobody knows before they are made among them.
FORMS = {
    "/v1/jobs/{job}/volumes/{volume}": ["", "?type=int16", "?format=nifti.gz"],
    "/v1/scans/{scan}/projections/{run}": ["", "?format=png"],
    "/v1/jobs/{job}/volumes/{volume}/slice": ["", "?sheet=1", "?normal=1,1,1&up=0,0,1"],
}


def bodiless(peer: Peer, method: bytes, target: str, *lines: bytes) -> dict:
    """Asks, and asks for /livez behind it: the fields of the first reply, which is followed by the other one or the end."""
    first = f"{method.decode()} {target} HTTP/1.1".encode()
    what = f"{first.decode()} {lines}"
    peer.send(head(*lines, first=first) + OK)
    while b"\r\n\r\n" not in peer.rest:
        expect(peer.more(), f"{what}: a reply, got {peer.rest[:80]!r}")
    head_bytes, peer.rest = peer.rest.split(b"\r\n\r\n", 1)
    fields = {name.lower(): value.strip() for name, value in (line.split(":", 1) for line in head_bytes.decode().split("\r\n")[1:])}
    fields["status"] = head_bytes.split()[1].decode()
    if fields.get("connection") == "close":
        expect(not peer.more() and not peer.rest, f"{what}: nothing behind the reply but the end, got {peer.rest[:80]!r}")
    else:
        alive = peer.reply()
        expect(alive is not None and alive[0] == 200 and not peer.rest, f"{what}: the next reply behind it, got {alive}")
    return fields


def case_bodiless(scan: str, job: str) -> None:
    """What HEAD is answered with, and a 304, ends with its head, whatever the resource: for each GET of the schema."""
    with Peer(head(first=b"GET /v1/openapi.json HTTP/1.1")) as peer:
        reply = peer.reply()
    with Peer(head(first=b"GET / HTTP/1.1")) as peer:
        page = peer.reply()
    assets = re.findall(r"/assets/([^\"]+)", page[2].decode()) if page is not None else []
    known = {"scan": scan, "job": job, "volume": "final", "run": "0", "file": assets[0] if assets else "none"}
    count, kept = 0, 0
    for path, operations in json.loads(reply[2])["paths"].items():
        if "get" not in operations or any(name not in known for name in re.findall(r"{(\w+)}", path)):
            continue
        for form in FORMS.get(path, [""]):
            target = re.sub(r"{(\w+)}", lambda found: known[found[1]], path) + form
            for coding in (b"Accept-Encoding: identity", b"Accept-Encoding: gzip, zstd"):
                with Peer() as peer:
                    fields = bodiless(peer, b"HEAD", target, coding)
                if "etag" not in fields or fields["status"] != "200":
                    continue
                condition = b"If-None-Match: " + fields["etag"].encode()
                for method in (b"GET", b"HEAD"):
                    with Peer() as peer:
                        fields = bodiless(peer, method, target, coding, condition)
                    expect(fields["status"] == "304", f"{target}: 304 for its tag, got {fields}")
                    kept += fields.get("connection") != "close"
                    count += 1
    for refused in (b"HEAD /" + b"a" * 9000 + b" HTTP/1.1", b"HEAD /livez?" + b"a&" * 300 + b" HTTP/1.1"):
        with Peer(head(first=refused)) as peer:
            while peer.more():
                pass
            expect(peer.rest.startswith(b"HTTP/1.1 4") and peer.rest.endswith(b"\r\n\r\n") and peer.rest.count(b"\r\n\r\n") == 1,
                   f"a refusal without a body, got {peer.rest[-200:]!r}")
    for length in ([], [b"Content-Length: 0"]):  # nothing to go on with
        with Peer(head(b"Expect: 100-continue", *length) + OK) as peer:
            for _ in range(2):
                reply = peer.reply()
                expect(reply is not None and reply[0] == 200, f"200 in spite of a needless expectation, got {reply}")
    print(f"  {count} replies of 304, {kept} of them kept their connection")
    expect(count > 20 and kept > 0, f"more than 20 replies of 304, got {count}, {kept} on connections that go on")


def case_left() -> None:
    """A client that shuts its side down behind a request gets the answer, and the end soon after, not by the header's timeout."""
    peers = [Peer(OK) for _ in range(30)]
    for peer in peers:
        peer.socket.shutdown(socket.SHUT_WR)
    for peer in peers:
        reply = peer.reply()
        expect(reply is not None and reply[0] == 200, f"200, got {reply}")
        expect(not peer.more(), f"the end of the connection, got {peer.rest!r}")
        peer.socket.close()
    with Peer(b"\r\n" + head()[:20]) as peer:  # half a head is none
        peer.socket.shutdown(socket.SHUT_WR)
        expect(not peer.more(), f"the end of the connection, got {peer.rest!r}")


# ---- limits ----

SCAN = json.dumps(
    {
        "detector": {"columns": 512, "rows": 512, "pixel_mm": [1, 1]},
        "projections": {"count": 40, "sample": "float32", "quantity": "line_integral"},
        "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000, "first_angle_deg": 0, "angle_step_deg": 9},
    }
).encode()
ONE = 512 * 512 * 4  # bytes of a projection


def posted_scan(path: str = "") -> bytes:
    request = head(b"Content-Type: application/json", b"Content-Length: %d" % len(SCAN), first=b"POST /v1/scans HTTP/1.1")
    with Peer(request + SCAN, path) as peer:
        reply = peer.reply()
        expect(reply is not None and reply[0] == 201, f"201 for a scan, got {reply}")
        return json.loads(reply[2])["id"].encode()


def put(scan: bytes, view: int) -> bytes:
    return head(b"Content-Length: %d" % ONE, first=b"PUT /v1/scans/%s/projections/%d HTTP/1.1" % (scan, view))


def acquisition_gets_in(view: int, scan: bytes, path: str = "") -> None:
    """A projection over a connection of its own, at once."""
    started = time.monotonic()
    with Peer(put(scan, view) + bytes(ONE), path) as peer:
        reply = peer.reply()
        expect(reply is not None and reply[0] == 201, f"201 for projection {view}, got {reply}")
    seconds = time.monotonic() - started
    expect(seconds < 5, f"projection {view} within 5 s, took {seconds:.1f}")


def count_ended(peers: List[Peer]) -> int:
    return sum(peer.ended() for peer in peers)


def case_idle(limit: str) -> None:
    scan = posted_scan()
    peers = [Peer(b"" if i % 2 else b"GET /livez HT") for i in range(3 * int(limit))]
    time.sleep(1.2)  # before, a request may be on its way
    kept = Peer(OK)
    expect(kept.reply()[0] == 200, "200 for a request among idle connections")
    for view in range(10):
        acquisition_gets_in(view, scan)
    time.sleep(0.2)
    ended = [peer.ended() for peer in peers]
    expect(ended == sorted(ended, reverse=True) and any(ended), f"the oldest to be closed, got {ended}")


def case_trickling(limit: str) -> None:
    """As many half heads as there are places, opened again as they are closed, a byte on each every 20 ms."""
    scan = posted_scan()
    peers = [Peer(b"GET /livez HTTP/1.1\r\nX: ") for _ in range(int(limit))]
    for view in range(20):
        for i, peer in enumerate(peers):
            peer.send(b"a")
            if peer.ended():
                peer.socket.close()
                peers[i] = Peer(b"GET /livez HTTP/1.1\r\nX: ")
        acquisition_gets_in(view, scan)
        time.sleep(0.02)


def case_slow_uploads(limit: str) -> None:
    scan = posted_scan()
    peers = [Peer(put(scan, 20 + i) + b"abc") for i in range(int(limit))]
    time.sleep(2.5)
    for view in range(5):
        for peer in peers:
            peer.send(b"a")
        acquisition_gets_in(view, scan)
    time.sleep(0.2)
    expect(0 < count_ended(peers) < int(limit), "some of the slow uploads to be closed, not all")


def case_slow_readers(limit: str) -> None:
    """Of 40 MB each, that nobody takes from the socket."""
    scan = posted_scan()
    for view in range(40):
        acquisition_gets_in(view, scan)
    request = head(first=b"GET /v1/scans/%s/projections/0 HTTP/1.1" % scan) * 8
    peers = [Peer(request, window=4096) for _ in range(int(limit))]
    time.sleep(2.5)
    other = posted_scan()
    for view in range(5):
        acquisition_gets_in(view, other)


def case_stalled(job: str, path: str = "") -> None:
    """Replies of unknown length that nobody takes from the socket are cut off; who reads slowly, or waits, is left."""
    volume = f"/v1/jobs/{job}/volumes/final"
    forms = [(volume, [b"Accept-Encoding: zstd"]), (volume + "?format=nifti.gz", []), (f"/v1/jobs/{job}/stream?format=raw", [])]

    def ask(target: str, fields: List[bytes]) -> Peer:
        return Peer(head(*fields, first=f"GET {target} HTTP/1.1".encode()), path, window=4096)

    stalled = [ask(*form) for form in forms]
    slow = ask(*forms[0])
    waiting = ask("/v1/events", [])
    for _ in range(30):  # 6 s, at three times the minimum rate
        time.sleep(0.2)
        wanted = len(slow.rest) + 40000
        while len(slow.rest) < wanted and slow.more():
            pass
    for peer, (target, _) in zip(stalled, forms):
        while peer.more():
            pass
        expect(peer.rest.startswith(b"HTTP/1.1 200") and not peer.rest.endswith(b"0\r\n\r\n"), f"{target} to be cut off, got {len(peer.rest)} bytes and the end")
    for wanted in range(len(slow.rest), len(slow.rest) + 400000, 50000):
        while len(slow.rest) < wanted and slow.more():
            pass
        expect(len(slow.rest) >= wanted, f"a slow reader to get on, got {len(slow.rest)} bytes")
    waiting.rest = b""
    expect(not waiting.ended(), "a watcher to stay")


def case_vanished(job: str) -> None:
    """Clients that went away while their request waits make room for others."""
    peers = [Peer(head(first=f"GET /v1/jobs/{job}?wait=60 HTTP/1.1".encode())) for _ in range(12)]
    time.sleep(0.5)
    for peer in peers:
        peer.socket.close()
    for _ in range(3):
        with Peer(OK) as peer:
            reply = peer.reply()
            expect(reply is not None and reply[0] == 200, f"200 in the place of one that has gone, got {reply}")


def case_busy(limit: str, refusal: str, path: str = "") -> None:
    """As many watchers as there are places: they stay, others may write only."""
    scan = posted_scan(path)
    watchers: List[Peer] = []
    deadline = time.monotonic() + PATIENCE
    while len(watchers) < int(limit):
        watcher = Peer(head(first=b"GET /v1/events HTTP/1.1"), path)
        watcher.more()
        # The place of the scan's connection may not be free yet.
        if watcher.rest.startswith(b"HTTP/1.1 " + refusal.encode()) and time.monotonic() < deadline:
            watcher.socket.close()
            continue
        expect(watcher.rest.startswith(b"HTTP/1.1 200"), f"200 for a watcher, got {watcher.rest[:40]!r}")
        watchers.append(watcher)
    for view in range(5):
        with Peer(OK, path) as peer:
            reply = peer.reply()
            expect(reply is not None and reply[0] == int(refusal), f"{refusal} beyond the limit, got {reply}")
            expect("retry-after" in reply[1] and reply[1]["connection"].lower() == "close", f"Retry-After and close, got {reply[1]}")
            expect(reply[1]["content-type"] == "application/problem+json", "a problem document")
            expect(not peer.more(), "the end of the connection")
        acquisition_gets_in(view, scan, path)
    expect(count_ended(watchers) == 0, "all watchers to stay")
    for watcher in watchers[:3]:  # the place of one that has gone is free at once
        watcher.socket.close()
        gone = time.monotonic()
        status = 429
        while status != 200 and time.monotonic() < gone + 0.5:  # the end of the connection before may be on its way still
            with Peer(OK, path) as peer:
                status = peer.reply()[0]
        expect(status == 200, f"200 where a watcher has gone, got {status}")


def processor_time(pid: str) -> float:
    with open(f"/proc/{pid}/stat", encoding="utf-8") as file:
        fields = file.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def case_descriptors(pid: str) -> None:
    """Five descriptors are left, 40 watchers come: it neither spins nor fails, and takes the rest when there is room."""
    before = resource.prlimit(int(pid), resource.RLIMIT_NOFILE)
    resource.prlimit(int(pid), resource.RLIMIT_NOFILE, (len(os.listdir(f"/proc/{pid}/fd")) + 5, before[1]))
    watchers = [Peer(head(first=b"GET /v1/events HTTP/1.1")) for _ in range(40)]
    time.sleep(1)
    started = processor_time(pid)
    time.sleep(2)
    used = processor_time(pid) - started
    expect(used < 0.2, f"less than 0.2 s of processor time in 2 s, used {used:.2f}")
    for watcher in watchers:
        watcher.socket.close()
    with Peer(OK) as peer:
        expect(peer.reply()[0] == 200, "200 when there are descriptors again")
    # idle ones make room
    idle = [Peer() for _ in range(40)]
    with Peer(OK) as peer:
        expect(peer.reply()[0] == 200, "200 while the descriptors are held by idle connections")
    for peer in idle:
        peer.socket.close()
    resource.prlimit(int(pid), resource.RLIMIT_NOFILE, before)


if __name__ == "__main__":
    globals()["case_" + sys.argv[2]](*sys.argv[3:])
