#!/usr/bin/env python3
"""A service manager for tests, in place of systemd: gives a program its notification socket, a watchdog and sockets.

manager.py LOG [--watchdog SECONDS] [--tcp ADDRESS] [--unix PATH] [--datagram] -- PROGRAM ARGUMENT...

The program takes this process's place. Another one writes what it tells to LOG, a datagram to a line, newlines as
blanks, until the program has ended.
"""
import argparse
import fcntl
import os
import socket
import sys
import tempfile

parser = argparse.ArgumentParser()
parser.add_argument("log")
parser.add_argument("--watchdog", type=float)
parser.add_argument("--tcp")
parser.add_argument("--unix")
parser.add_argument("--datagram", action="store_true")
cut = sys.argv.index("--")
options, program = parser.parse_args(sys.argv[1:cut]), sys.argv[cut + 1:]

sockets = []
if options.tcp:
    tcp = socket.socket()
    tcp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    tcp.bind((options.tcp, 0))
    tcp.listen()
    sockets.append(tcp)
if options.unix:
    unix = socket.socket(socket.AF_UNIX)
    unix.bind(options.unix)
    unix.listen()
    sockets.append(unix)
if options.datagram:
    sockets.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))

notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
path = tempfile.mktemp(prefix="cbct-notify-")
notify.bind(path)
watched = os.getpid()

if os.fork() == 0:  # and once more, so that the program has no child of ours
    if os.fork() == 0:
        null = os.open(os.devnull, os.O_RDWR)
        for number in range(3):
            os.dup2(null, number)
        notify.settimeout(0.1)
        with open(options.log, "a", buffering=1) as log:
            while True:
                try:
                    log.write(notify.recv(4096).decode().replace("\n", " ") + "\n")
                except socket.timeout:
                    if not os.path.exists(f"/proc/{watched}"):
                        break
        os.unlink(path)
    os._exit(0)
os.wait()

# Where they must be: from 3 on.
saved = [fcntl.fcntl(s.fileno(), fcntl.F_DUPFD, 64) for s in sockets]
for i, descriptor in enumerate(saved):
    os.dup2(descriptor, 3 + i, inheritable=True)
environment = dict(os.environ, NOTIFY_SOCKET=path)
if sockets:
    environment.update(LISTEN_FDS=str(len(sockets)), LISTEN_PID=str(os.getpid()), LISTEN_FDNAMES=":".join("x" for _ in sockets))
if options.watchdog:
    environment.update(WATCHDOG_USEC=str(int(1e6 * options.watchdog)), WATCHDOG_PID=str(os.getpid()))
os.execve(program[0], program, environment)
