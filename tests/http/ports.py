#!/usr/bin/env python3
"""Ports that a test may leave and come back to.

Usage: ports.py COUNT

They lie below those that the kernel gives to whoever asks for any: of such a one another test's daemon, or the near end
of a connection, may take hold while nobody listens there."""
import random
import socket
import sys

FIRST, LAST = 20000, 32767  # Linux gives from 32768 on, where nobody has set it otherwise


def free(count=1):
    ends = []
    while len(ends) < count:
        end = socket.socket()
        try:
            end.bind(("127.0.0.1", random.randint(FIRST, LAST)))
            ends.append(end)
        except OSError:
            end.close()
    ports = [end.getsockname()[1] for end in ends]
    for end in ends:
        end.close()
    return ports


if __name__ == "__main__":
    print(*free(int(sys.argv[1])))
