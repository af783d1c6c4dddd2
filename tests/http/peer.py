#!/usr/bin/python3
"""Peers of DICOM's own protocol (PS3.8, PS3.7): an archive that does right or wrong, on a free port of 127.0.0.1, which it prints,
and callers.

Usage: peer.py idle PORT ADDRESS COUNT    COUNT connections from ADDRESS that say nothing; prints "open" once all are there, and
                                          "closed" when the first one is closed; ends at the end of its input
       peer.py echo PORT ADDRESS TITLE    an association from ADDRESS as TITLE with CBCTD: prints accepted, refused or closed
       peer.py MODE LOG                   an archive; LOG: a line for each message. MODE:
    keeps     keeps all, and promises so on the association that asks
    lies      acknowledges all, keeps nothing
    refuses   answers C-STORE with A700
    regrets   keeps all; promises nothing when it is asked first, all when it is asked again
    unasked   takes objects, and knows neither C-FIND nor storage commitment
    silent    never answers C-STORE
    drips     answers C-FIND a byte every 0.2 s
    mixes-up  answers what is told of a performed step first as another message, then about another step, then rightly
    hangs-up  breaks the connection at every 20th object
    hangs     accepts associations, and answers nothing on them
"""
import socket
import struct
import sys
import threading
import time

FIND, COMMIT = "1.2.840.10008.5.1.4.1.2.2.1", "1.2.840.10008.1.20.1"
EXPLICIT = "1.2.840.10008.1.2.1"
LOCK = threading.Lock()
KEPT = {}
COUNT = {"stored": 0, "asked": 0}


def take(connection, count):
    data = b""
    while len(data) < count:
        more = connection.recv(count - len(data))
        if not more:
            raise ConnectionError
        data += more
    return data


def item(kind, data):
    return struct.pack(">BBH", kind, 0, len(data)) + data


def items(data):
    while data:
        kind, length = data[0], struct.unpack(">H", data[2:4])[0]
        yield kind, data[4:4 + length]
        data = data[4 + length:]


def uid(text):
    data = text.encode()
    return data + b"\0" * (len(data) % 2)


def element(group, number, value, vr=b"UI"):
    """Explicit little endian; sequences with a length of four bytes."""
    if vr == b"SQ":
        return struct.pack("<HH2sHI", group, number, vr, 0, len(value)) + value
    return struct.pack("<HH2sH", group, number, vr, len(value)) + value


def command(fields):
    """A command set: implicit little endian, group 0000."""
    body = b""
    for number, value in sorted(fields.items()):
        data = struct.pack("<H", value) if isinstance(value, int) else uid(value)
        body += struct.pack("<HHI", 0, number, len(data)) + data
    return struct.pack("<HHII", 0, 0, 4, len(body)) + body


def read_command(data):
    fields = {}
    while data:
        _, number, length = struct.unpack("<HHI", data[:8])
        value = data[8:8 + length]
        fields[number] = struct.unpack("<H", value)[0] if length == 2 else value.rstrip(b"\0 ").decode("latin-1")
        data = data[8 + length:]
    return fields


class Association:
    def __init__(self, connection, mode, log):
        self.connection, self.mode, self.log = connection, mode, log
        self.contexts = {}

    def send(self, data):
        if self.mode == "drips" and data[0] == 4:
            for byte in data:
                self.connection.sendall(bytes([byte]))
                time.sleep(0.2)
        else:
            self.connection.sendall(data)

    def message(self, context, fields, dataset=None):
        fields[0x0800] = 0x0101 if dataset is None else 0
        for data, flags in ((command(fields), 3),) + (((dataset, 2),) if dataset is not None else ()):
            value = struct.pack(">IBB", len(data) + 2, context, flags) + data
            self.send(struct.pack(">BBI", 4, 0, len(value)) + value)

    def accept(self, body):
        reply = body[:68]
        for kind, data in items(body[68:]):
            if kind == 0x10:
                reply += item(0x10, data)
            elif kind == 0x20:
                abstract = next(value for part, value in items(data[4:]) if part == 0x30).decode()
                known = self.mode != "unasked" or abstract not in (FIND, COMMIT)
                self.contexts[data[0]] = abstract
                reply += item(0x21, bytes([data[0], 0, 0 if known else 3, 0]) + item(0x40, EXPLICIT.encode()))
            elif kind == 0x50:
                reply += item(0x50, item(0x51, struct.pack(">I", 16384)) + item(0x52, b"1.2.3") + item(0x55, b"PEER"))
        self.send(struct.pack(">BBI", 2, 0, len(reply)) + reply)

    def store(self, context, fields):
        with LOCK:
            COUNT["stored"] += 1
            if self.mode in ("keeps", "regrets", "silent", "drips", "hangs-up", "unasked"):
                KEPT[fields[0x1000]] = True
            broken = self.mode == "hangs-up" and COUNT["stored"] % 20 == 0
        if broken:
            raise ConnectionError
        if self.mode != "silent":
            self.message(context, {0x0002: fields[0x0002], 0x0100: 0x8001, 0x0120: fields[0x0110], 0x1000: fields[0x1000],
                                   0x0900: 0xA700 if self.mode == "refuses" else 0})

    def find(self, context, fields):
        answer = {0x0002: fields[0x0002], 0x0100: 0x8020, 0x0120: fields[0x0110]}
        with LOCK:
            found = sorted(KEPT)
        for one in found:
            self.message(context, answer | {0x0900: 0xFF00}, element(8, 0x18, uid(one)))
        self.message(context, answer | {0x0900: 0})

    def commit(self, context, fields, dataset):
        """The transaction comes first in the request; the instances are what follows each (0008,1155)."""
        length = struct.unpack("<H", dataset[6:8])[0]
        transaction = dataset[8:8 + length]
        named, at = [], 0
        while (at := dataset.find(b"\x08\x00\x55\x11UI", at)) >= 0:
            length = struct.unpack("<H", dataset[at + 6:at + 8])[0]
            named.append(dataset[at + 8:at + 8 + length])
            at += 8
        self.message(context, {0x0002: COMMIT, 0x0100: 0x8130, 0x0120: fields[0x0110], 0x0900: 0, 0x1000: fields[0x1001],
                               0x1008: 1})
        with LOCK:
            COUNT["asked"] += 1
            refuses = self.mode == "regrets" and COUNT["asked"] == 1
        listed = b"".join(
            struct.pack("<HHI", 0xFFFE, 0xE000, len(one)) + one
            for one in (element(8, 0x1150, uid("1.2.840.10008.5.1.4.1.1.2")) + element(8, 0x1155, name) +
                        (element(8, 0x1197, struct.pack("<H", 0x0112), b"US") if refuses else b"") for name in named))
        self.message(context, {0x0002: COMMIT, 0x0100: 0x0100, 0x0110: 1, 0x1000: fields[0x1001], 0x1002: 2 if refuses else 1},
                     element(8, 0x1195, transaction) + element(8, 0x1198 if refuses else 0x1199, listed, b"SQ"))

    def step(self, context, fields):
        with LOCK:
            COUNT["asked"] += 1
            asked = COUNT["asked"] if self.mode == "mixes-up" else 3
        named = fields.get(0x1000) or fields[0x1001]
        self.message(context, {0x0002: fields.get(0x0002) or fields[0x0003], 0x0100: 0x8000 | fields[0x0100], 0x0900: 0,
                               0x0120: fields[0x0110] + (7 if asked == 1 else 0), 0x1000: "1.2.3" if asked == 2 else named})

    def serve(self):
        parts = {1: b"", 0: b""}
        fields = None
        while True:
            kind, _, length = struct.unpack(">BBI", take(self.connection, 6))
            body = take(self.connection, length)
            if kind == 1:
                self.accept(body)
            elif kind == 5:
                self.send(struct.pack(">BBI", 6, 0, 4) + b"\0" * 4)
            elif kind != 4:
                return
            while kind == 4 and body:
                size, context, flags = struct.unpack(">IBB", body[:6])
                parts[flags & 1] += body[6:4 + size]
                body = body[4 + size:]
                if not flags & 2:
                    continue
                if flags & 1:
                    fields, parts[1] = read_command(parts[1]), b""
                    with LOCK, open(self.log, "a", encoding="utf-8") as file:
                        print(f"{fields[0x0100]:04x}", fields.get(0x1000, ""), file=file)
                if flags & 1 and fields[0x0800] != 0x0101:
                    continue
                dataset, parts[0] = parts[0], b""
                if self.mode == "hangs":
                    continue
                if fields[0x0100] == 1:
                    self.store(context, fields)
                elif fields[0x0100] == 0x20:
                    self.find(context, fields)
                elif fields[0x0100] == 0x130:
                    self.commit(context, fields, dataset)
                elif fields[0x0100] in (0x140, 0x120):
                    self.step(context, fields)
                elif fields[0x0100] == 0x30:
                    self.message(context, {0x0002: fields[0x0002], 0x0100: 0x8030, 0x0120: fields[0x0110], 0x0900: 0})


def serve(connection, mode, log):
    try:
        Association(connection, mode, log).serve()
    except (ConnectionError, OSError):
        pass
    connection.close()


def main(mode, log):
    server = socket.socket()
    server.bind(("127.0.0.1", 0))
    server.listen(16)
    print(server.getsockname()[1], flush=True)
    while True:
        connection, _ = server.accept()
        threading.Thread(target=serve, args=(connection, mode, log), daemon=True).start()


def call(port, address):
    connection = socket.create_connection(("127.0.0.1", int(port)), source_address=(address, 0))
    connection.settimeout(30)
    return connection


def idle(port, address, count):
    connections = [call(port, address) for _ in range(int(count))]
    print("open", flush=True)
    try:
        print("closed" if connections[0].recv(1) == b"" else "spoken to", flush=True)
    except ConnectionError:
        print("closed", flush=True)
    sys.stdin.read()


def echo(port, address, title):
    context = item(0x30, b"1.2.840.10008.1.1") + item(0x40, b"1.2.840.10008.1.2")
    body = struct.pack(">HH16s16s32x", 1, 0, b"CBCTD".ljust(16), title.encode().ljust(16))
    body += item(0x10, b"1.2.840.10008.3.1.1.1") + item(0x20, bytes([1, 0, 0, 0]) + context)
    body += item(0x50, item(0x51, struct.pack(">I", 16384)) + item(0x52, b"1.2.3"))
    try:
        connection = call(port, address)
        connection.sendall(struct.pack(">BBI", 1, 0, len(body)) + body)
        print({2: "accepted", 3: "refused"}.get(take(connection, 1)[0], "closed"))
    except ConnectionError:
        print("closed")


if sys.argv[1] == "idle":
    idle(*sys.argv[2:5])
elif sys.argv[1] == "echo":
    echo(*sys.argv[2:5])
else:
    main(*sys.argv[1:3])
