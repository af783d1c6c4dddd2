#!/usr/bin/env python3
"""A file system in memory that forgets at a power cut what was not synced, for the tests: FUSE's protocol over /dev/fuse.

unsynced.py FOLDER [--image NAME BYTES]    commands on standard input, a line of reply each

It promises no more than POSIX does. fsync and fdatasync of a file keep its bytes and its size, and no name of it; fsync
of a directory keeps the names made, changed and removed in it. All else may be lost. At a cut each operation that was not
synced is lost or kept by chance: names one by one (a rename is whole or was not), bytes in pieces of 512 or 4096 or as they
were written, sizes by themselves, so that a file may be longer than its bytes and is zero there. Writes reach it at once and
mapped memory when the kernel writes it back, which every sync does first.

  cut SEED   from now on nothing is kept and nothing answered: the power is off. The reply tells the operations that were open
  killed     the processes have their SIGKILL: what they wait for fails
  again      after FOLDER was unmounted: mounts what the cut left
  quit

With --image there is one file of that size, for a loop device with the kernel's own file system on it.
Needs the right to mount: root, or root of a namespace (unshare --user --map-root-user --mount).
"""
import argparse
import ctypes
import errno
import os
import random
import stat
import struct
import sys
import threading
import time
from typing import Dict, List, Tuple

LOOKUP, FORGET, GETATTR, SETATTR, MKDIR, UNLINK, RMDIR, RENAME, LINK, OPEN = 1, 2, 3, 4, 9, 10, 11, 12, 13, 14
READ, WRITE, STATFS, RELEASE, FSYNC, FLUSH, INIT, OPENDIR, READDIR, RELEASEDIR = 15, 16, 17, 18, 20, 25, 26, 27, 28, 29
FSYNCDIR, ACCESS, CREATE, INTERRUPT, DESTROY, BATCH_FORGET, FALLOCATE, RENAME2 = 30, 34, 35, 36, 38, 42, 43, 45
WRITE_MOST = 1 << 17
BIG_WRITES, MAX_PAGES, ASYNC_READ = 1 << 5, 1 << 22, 1 << 0
FOR_EVER = 1 << 30  # s: nobody else changes what the kernel knows
FATTR_MODE, FATTR_UID, FATTR_GID, FATTR_SIZE, FATTR_MTIME = 1, 2, 4, 8, 32
SPACE, BLOCK = 1 << 32, 4096
TREE = 1
libc = ctypes.CDLL(None, use_errno=True)


class Node:
    """A file or a directory. `open` has what happened since its last sync, with what was there before."""

    def __init__(self, mode: int) -> None:
        self.mode, self.links, self.opened = mode, 0, 0
        self.uid, self.gid, self.mtime = os.getuid(), os.getgid(), time.time_ns()
        self.data = bytearray()
        self.names: Dict[bytes, int] = {}
        self.places: Dict[bytes, int] = {}  # of the names in lists, so that a list goes on where it was while names go
        self.open: List[Tuple[int, bytes, bytes, int, int]] = []  # files: offset, bytes before, bytes, size before, size


class Name:
    """A change of names that was not synced: (directory, name, number before, number after), 0 for none. All or nothing."""

    def __init__(self, *changes: Tuple[int, bytes, int, int]) -> None:
        self.changes = changes


class Files:
    def __init__(self) -> None:
        self.nodes: Dict[int, Node] = {TREE: Node(stat.S_IFDIR | 0o700)}
        self.next, self.place = TREE + 1, 2
        self.names: List[Name] = []

    def add(self, mode: int) -> int:
        self.nodes[self.next] = Node(mode)
        self.next += 1
        return self.next - 1

    def rename(self, *changes: Tuple[int, bytes, int, int]) -> None:
        """Makes, changes and removes names."""
        self.names.append(Name(*changes))
        self.apply(changes)

    def apply(self, changes: Tuple[Tuple[int, bytes, int, int], ...]) -> None:
        for directory, name, _, number in changes:
            names = self.nodes[directory].names
            if number == 0:
                names.pop(name, None)
                self.nodes[directory].places.pop(name, None)
            else:
                names[name] = number
                self.place += 1
                self.nodes[directory].places.setdefault(name, self.place)

    def write(self, node: Node, offset: int, data: bytes) -> None:
        size = len(node.data)
        after = max(size, offset + len(data))
        node.open.append((offset, bytes(node.data[offset:offset + len(data)]), data, size, after))
        if offset > size:
            node.data.extend(bytes(offset - size))
        node.data[offset:offset + len(data)] = data
        node.mtime = time.time_ns()

    def resize(self, node: Node, size: int) -> None:
        before = len(node.data)
        if size == before:
            return
        node.open.append((size, bytes(node.data[size:]), b"", before, size))
        if size < before:
            del node.data[size:]
        else:
            node.data.extend(bytes(size - before))
        node.mtime = time.time_ns()

    def sync(self, number: int) -> None:
        node = self.nodes[number]
        node.open = []
        if stat.S_ISDIR(node.mode):
            self.names = [name for name in self.names if all(change[0] != number for change in name.changes)]

    def cut(self, rng: random.Random) -> str:
        """Loses what was not synced, by chance. What is not to be reached any more goes."""
        open_names, open_writes, kept = len(self.names), 0, 0
        chance = rng.choice([0.0, 0.3, 0.7, 0.95, 1.0])
        piece = rng.choice([512, 4096, 1 << 30])
        for name in reversed(self.names):
            self.apply(tuple((d, n, after, before) for d, n, before, after in reversed(name.changes)))
        for name in self.names:
            if rng.random() < chance:
                self.apply(name.changes)
                kept += 1
        self.names = []
        for node in self.nodes.values():
            open_writes += len(node.open)
            self.cut_file(node, rng, chance, piece)
            node.opened = 0
        self.sweep()
        return f"{open_names} names, {open_writes} writes were open; {kept} names kept; chance {chance}, pieces of {piece}"

    @staticmethod
    def cut_file(node: Node, rng: random.Random, chance: float, piece: int) -> None:
        data = node.data
        if not node.open:
            return
        for offset, before, written, size, after in reversed(node.open):
            if after < size:
                data.extend(before)
            else:
                data[offset:offset + len(before)] = before
                del data[size:]
        sizes = [len(data)] + [row[4] for row in node.open]
        size = sizes[sum(rng.random() < chance for _ in node.open)]
        for offset, _, written, _, _ in node.open:
            at = 0
            while at < len(written):
                end = min((offset + at) // piece * piece + piece - offset, len(written))
                if rng.random() < chance:
                    if offset + end > len(data):
                        data.extend(bytes(offset + end - len(data)))
                    data[offset + at:offset + end] = written[at:end]
                at = end
        del data[size:]
        data.extend(bytes(size - len(data)))
        node.open = []

    def sweep(self) -> None:
        for node in self.nodes.values():
            node.links = 0
        waiting, seen = [TREE], {TREE}
        while waiting:
            for number in self.nodes[waiting.pop()].names.values():
                self.nodes[number].links += 1
                if number not in seen:
                    seen.add(number)
                    waiting.append(number)
        self.nodes = {number: node for number, node in self.nodes.items() if number in seen}


class Failure(Exception):
    def __init__(self, number: int) -> None:
        self.number = number


class Server:
    """Answers the kernel for one mount of the files."""

    def __init__(self, files: Files, folder: str) -> None:
        self.files = files
        self.off, self.killed = False, threading.Event()
        self.lock = threading.Lock()  # files and off
        self.device = os.open("/dev/fuse", os.O_RDWR | os.O_CLOEXEC)
        options = f"fd={self.device},rootmode=40000,user_id={os.getuid()},group_id={os.getgid()},default_permissions"
        # MS_NOSUID | MS_NODEV
        if libc.mount(b"unsynced", folder.encode(), b"fuse", 6, options.encode()) != 0:
            raise OSError(ctypes.get_errno(), f"mount of {folder}: {os.strerror(ctypes.get_errno())}")
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        buffer = bytearray(WRITE_MOST + 8192)
        while True:
            try:
                size = os.readv(self.device, [buffer])
            except OSError as error:
                if error.errno in (errno.ENOENT, errno.EINTR, errno.EAGAIN):
                    continue
                break  # ENODEV: unmounted
            _, call, unique, node, uid, gid, _, _, _ = struct.unpack_from("<IIQQIIIHH", buffer)
            body = memoryview(buffer)[40:size]
            if call in (FORGET, BATCH_FORGET, INTERRUPT):
                continue
            if self.off and call not in (RELEASE, RELEASEDIR, DESTROY, FLUSH):
                self.killed.wait()
            try:
                with self.lock:
                    reply = self.answer(call, node, body)
                number = 0
            except Failure as failure:
                reply, number = b"", failure.number
            except KeyError:
                reply, number = b"", errno.ESTALE
            try:
                os.write(self.device, struct.pack("<IiQ", 16 + len(reply), -number, unique) + reply)
            except OSError as error:
                if error.errno != errno.ENOENT:  # the caller was interrupted
                    break
        os.close(self.device)

    # ---- what the kernel is told ----

    def attributes(self, number: int) -> bytes:
        node = self.files.nodes[number]
        s, ns = divmod(node.mtime, 10 ** 9)
        links = max(node.links, 1) if stat.S_ISREG(node.mode) else 2
        size = len(node.data)
        return struct.pack("<6Q10I", number, size, (size + 511) // 512, s, s, s, ns, ns, ns, node.mode, links, node.uid,
                           node.gid, 0, BLOCK, 0)

    def entry(self, number: int) -> bytes:
        return struct.pack("<4QII", number, 0, FOR_EVER, FOR_EVER, 0, 0) + self.attributes(number)

    def found(self, directory: int, name: bytes) -> int:
        number = self.files.nodes[directory].names.get(name, 0)
        if number == 0:
            raise Failure(errno.ENOENT)
        return number

    def answer(self, call: int, number: int, body: memoryview) -> bytes:
        files = self.files
        if call == INIT:
            major, minor, ahead, flags = struct.unpack_from("<4I", body)
            return struct.pack("<4IHHIIHH8I", 7, 31, ahead, flags & (BIG_WRITES | MAX_PAGES | ASYNC_READ), 16, 12, WRITE_MOST, 1,
                               WRITE_MOST // 4096, 0, *[0] * 8)
        if call in (RELEASE, RELEASEDIR, DESTROY, FLUSH):
            if call == RELEASE:
                self.release(number)
            return b""
        if self.off:
            raise Failure(errno.EIO)
        node = files.nodes[number] if number != 0 else files.nodes[TREE]
        if call == LOOKUP:
            return self.entry(self.found(number, bytes(body).split(b"\0")[0]))
        if call == GETATTR:
            return struct.pack("<QII", FOR_EVER, 0, 0) + self.attributes(number)
        if call == SETATTR:
            return self.set_attributes(number, node, body)
        if call in (MKDIR, CREATE):
            return self.make(call, number, body)
        if call in (UNLINK, RMDIR):
            return self.remove(call, number, bytes(body).split(b"\0")[0])
        if call in (RENAME, RENAME2):
            head = 8 if call == RENAME else 16
            source, target = bytes(body[head:]).split(b"\0")[:2]
            flags = 0 if call == RENAME else struct.unpack_from("<QI", body)[1]
            return self.move(number, source, struct.unpack_from("<Q", body)[0], target, flags)
        if call == LINK:
            old, name = struct.unpack_from("<Q", body)[0], bytes(body[8:]).split(b"\0")[0]
            if name in node.names:
                raise Failure(errno.EEXIST)
            files.nodes[old].links += 1
            files.rename((number, name, 0, old))
            return self.entry(old)
        if call in (OPEN, OPENDIR):
            node.opened += call == OPEN
            return struct.pack("<QII", 0, 0, 0)
        if call == READ:
            _, offset, size = struct.unpack_from("<QQI", body)
            return bytes(node.data[offset:offset + size])
        if call == WRITE:
            _, offset, size = struct.unpack_from("<QQI", body)
            files.write(node, offset, bytes(body[40:40 + size]))
            return struct.pack("<II", size, 0)
        if call in (FSYNC, FSYNCDIR):
            files.sync(number)
            return b""
        if call == FALLOCATE:
            _, offset, length, mode = struct.unpack_from("<QQQI", body)
            if mode & ~1:
                raise Failure(errno.EOPNOTSUPP)
            if mode == 0 and offset + length > len(node.data):
                files.resize(node, offset + length)
            return b""
        if call == READDIR:
            return self.list(number, node, body)
        if call == STATFS:
            blocks = SPACE // BLOCK
            free = blocks - sum(len(node.data) for node in files.nodes.values()) // BLOCK
            return struct.pack("<5Q10I", blocks, free, free, 1 << 20, 1 << 20, BLOCK, 255, BLOCK, 0, *[0] * 6)
        raise Failure(errno.ENOSYS)

    def release(self, number: int) -> None:
        node = self.files.nodes.get(number)
        if node is None or self.off:
            return
        node.opened -= 1
        self.forget(number, node)

    def forget(self, number: int, node: Node) -> None:
        """Its bytes go with its last name and its last descriptor, unless a cut may give the name back."""
        if node.links > 0 or node.opened > 0 or stat.S_ISDIR(node.mode):
            return
        if not any(number in change[2:] for name in self.files.names for change in name.changes):
            del self.files.nodes[number]

    def set_attributes(self, number: int, node: Node, body: memoryview) -> bytes:
        valid, _, _, size, _, _, mtime, _, _, mtime_ns, _, mode, _, uid, gid, _ = struct.unpack_from("<IIQQQQQQIIIIIIII", body)
        if valid & FATTR_SIZE:
            self.files.resize(node, size)
        if valid & FATTR_MODE:
            node.mode = stat.S_IFMT(node.mode) | stat.S_IMODE(mode)
        if valid & FATTR_UID:
            node.uid = uid
        if valid & FATTR_GID:
            node.gid = gid
        if valid & FATTR_MTIME:
            node.mtime = mtime * 10 ** 9 + mtime_ns
        return struct.pack("<QII", FOR_EVER, 0, 0) + self.attributes(number)

    def make(self, call: int, directory: int, body: memoryview) -> bytes:
        head = 8 if call == MKDIR else 16
        mode = struct.unpack_from("<I", body, 0 if call == MKDIR else 4)[0]
        name = bytes(body[head:]).split(b"\0")[0]
        if name in self.files.nodes[directory].names:
            raise Failure(errno.EEXIST)
        number = self.files.add(stat.S_IMODE(mode) | (stat.S_IFDIR if call == MKDIR else stat.S_IFREG))
        node = self.files.nodes[number]
        node.links = 1
        self.files.rename((directory, name, 0, number))
        if call == MKDIR:
            return self.entry(number)
        node.opened = 1
        return self.entry(number) + struct.pack("<QII", 0, 0, 0)

    def remove(self, call: int, directory: int, name: bytes) -> bytes:
        number = self.found(directory, name)
        node = self.files.nodes[number]
        if call == RMDIR and node.names:
            raise Failure(errno.ENOTEMPTY)
        node.links -= 1
        self.files.rename((directory, name, number, 0))
        self.forget(number, node)
        return b""

    def move(self, source: int, name: bytes, target: int, other: bytes, flags: int) -> bytes:
        number, there = self.found(source, name), self.files.nodes[target].names.get(other, 0)
        if flags & ~1:
            raise Failure(errno.EINVAL)
        if there != 0 and flags & 1:
            raise Failure(errno.EEXIST)
        if there == number:
            return b""
        if there != 0 and self.files.nodes[there].names:
            raise Failure(errno.ENOTEMPTY)
        self.files.rename((target, other, there, number), (source, name, number, 0))
        if there != 0:
            self.files.nodes[there].links -= 1
            self.forget(there, self.files.nodes[there])
        return b""

    def list(self, number: int, node: Node, body: memoryview) -> bytes:
        _, offset, size = struct.unpack_from("<QQI", body)
        rows = [(1, b".", number, stat.S_IFDIR), (2, b"..", number, stat.S_IFDIR)]
        rows += sorted((node.places[name], name, child, self.files.nodes[child].mode) for name, child in node.names.items())
        reply = b""
        for place, name, child, mode in rows:
            row = struct.pack("<QQII", child, place, len(name), stat.S_IFMT(mode) >> 12) + name
            row += bytes(-len(row) % 8)
            if place > offset and len(reply) + len(row) > size:
                break
            reply += row if place > offset else b""
        return reply


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder")
    parser.add_argument("--image", nargs=2)
    options = parser.parse_args()
    files = Files()
    if options.image:
        number = files.add(stat.S_IFREG | 0o600)
        node = files.nodes[number]
        node.links, node.data = 1, bytearray(int(options.image[1]))
        files.apply(((TREE, options.image[0].encode(), 0, number),))
    server = Server(files, options.folder)
    print("mounted", flush=True)
    for line in sys.stdin:
        words = line.split()
        if words[0] == "cut":
            with server.lock:
                server.off = True
            print(files.cut(random.Random(int(words[1]))), flush=True)
        elif words[0] == "killed":
            server.killed.set()
            print("off", flush=True)
        elif words[0] == "again":
            server.thread.join()
            server = Server(files, options.folder)
            print("mounted", flush=True)
        else:
            break
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
