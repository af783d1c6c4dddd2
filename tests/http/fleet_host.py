"""One daemon of a fleet, as the fault test and the benchmarks of fleets have many of them."""
import http.client
import json
import os
import subprocess
import sys
import time

import ports


def wait_for(condition, seconds, what):
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            sys.exit(f"expected: {what}, within {seconds} s")
        time.sleep(0.05)


class Host:
    """options: build, folder, database. takes: it has an address, so that it may take other hosts' jobs. doors: of a host in another
    network, its address, the command that starts programs there, the SSL context and the headers of requests to it."""

    def __init__(self, options, fleet, name, takes, arguments=(), environment=None, doors=None):
        self.name, self.port = name, ports.free()[0]
        self.address, self.within, self.context, self.headers = doors or ("127.0.0.1", [], None, {})
        self.folder, self.log = options.folder / name, options.folder / f"{name}.err"
        self.arguments = [f"{options.build}/cbctd", "--listen", f"{self.address}:{self.port}", "--state-dir", str(self.folder), "--backend", "cpu",
                          "--threads", "1", "--fleet", fleet, "--fleet-database", options.database, "--fleet-host", name, *arguments]
        if takes:
            self.arguments += ["--fleet-address", f"{'https' if self.context else 'http'}://{self.address}:{self.port}"]
        self.environment = dict(os.environ, **(environment or {}))
        self.process = None

    def start(self):
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen([*self.within, *self.arguments], stdout=subprocess.DEVNULL, stderr=log, env=self.environment)
        wait_for(lambda: self.ask("GET", "/livez")[0] == 200, 60, f"host {self.name} answers")

    def kill(self):
        self.process.kill()
        self.process.wait()

    def ask(self, method, path, body=None, headers=None):
        """Status and body; status 0: no answer."""
        if self.context:
            connection = http.client.HTTPSConnection(self.address, self.port, timeout=60, context=self.context)
        else:
            connection = http.client.HTTPConnection(self.address, self.port, timeout=60)
        try:
            connection.request(method, path, body, dict(self.headers, **(headers or {})))
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
