"""One daemon of a fleet, as the fault test and the benchmarks of fleets have many of them."""
import http.client
import json
import os
import socket
import subprocess
import sys
import time


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def wait_for(condition, seconds, what):
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            sys.exit(f"expected: {what}, within {seconds} s")
        time.sleep(0.05)


class Host:
    """options: build, folder, database. takes: it has an address, so that it may take other hosts' jobs."""

    def __init__(self, options, fleet, name, takes, arguments=(), environment=None):
        self.name, self.port = name, free_port()
        self.folder, self.log = options.folder / name, options.folder / f"{name}.err"
        self.arguments = [f"{options.build}/cbctd", "--listen", f"127.0.0.1:{self.port}", "--state-dir", str(self.folder), "--backend", "cpu",
                          "--threads", "1", "--fleet", fleet, "--fleet-database", options.database, "--fleet-host", name, *arguments]
        if takes:
            self.arguments += ["--fleet-address", f"http://127.0.0.1:{self.port}"]
        self.environment = dict(os.environ, **(environment or {}))
        self.process = None

    def start(self):
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(self.arguments, stdout=subprocess.DEVNULL, stderr=log, env=self.environment)
        wait_for(lambda: self.ask("GET", "/livez")[0] == 200, 60, f"host {self.name} answers")

    def kill(self):
        self.process.kill()
        self.process.wait()

    def ask(self, method, path, body=None, headers=None):
        """Status and body; status 0: no answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request(method, path, body, headers or {})
            reply = connection.getresponse()
            return reply.status, reply.read()
        except (OSError, http.client.HTTPException):
            return 0, b""
        finally:
            connection.close()

    def json(self, method, path, document=None):
        """The document of a reply, None where it is none of success."""
        body = None if document is None else json.dumps(document)
        status, text = self.ask(method, path, body, {"Content-Type": "application/json"} if body else {})
        return json.loads(text) if status in (200, 201, 202) else None
