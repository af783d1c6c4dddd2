#!/usr/bin/python3
"""Every operation of the schema with every kind of proof: allowed or refused as its security says.

Usage: access.py URL OPENAPI.JSON PROOFS.JSON [CA]     URL: http://HOST:PORT, https://HOST:PORT or unix:PATH

PROOFS.JSON: {"view": TOKEN, "acquire": TOKEN, "admin": TOKEN, "expired": TOKEN}. Each request has a query parameter that
no operation knows: whoever gets past the question who may is answered 400 with its name, and nothing happens.
"""
import http.client
import json
import socket
import ssl
import sys
from typing import Any, Dict, List, Optional, Tuple

ROLES = ["anyone", "view", "acquire", "admin"]
Header = Tuple[str, str]


class UnixConnection(http.client.HTTPConnection):
    def __init__(self, path: str) -> None:
        super().__init__("localhost")
        self.path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX)
        self.sock.connect(self.path)


def connection(url: str, authority: Optional[str]) -> http.client.HTTPConnection:
    scheme, _, rest = url.partition(":")
    if scheme == "unix":
        return UnixConnection(rest)
    if scheme == "https":
        return http.client.HTTPSConnection(rest.strip("/"), context=ssl.create_default_context(cafile=authority))
    return http.client.HTTPConnection(rest.strip("/"))


def ask(
    peer: http.client.HTTPConnection, method: str, path: str, headers: List[Header]
) -> Tuple[int, Dict[str, str], Dict[str, Any]]:
    peer.putrequest(method, path + "?nobody_knows=1", skip_accept_encoding=True)
    for name, value in headers:
        peer.putheader(name, value)
    if method in ("PUT", "POST"):
        peer.putheader("Content-Length", "2")
        peer.putheader("Content-Type", "application/json")
    try:
        peer.endheaders(b"{}" if method in ("PUT", "POST") else None)
    except (BrokenPipeError, ssl.SSLEOFError):
        pass  # refused at its head
    reply = peer.getresponse()
    text = reply.read()
    if reply.getheader("Connection") == "close":
        peer.close()
    return reply.status, {k.lower(): v for k, v in reply.getheaders()}, json.loads(text) if text else {}


def operations(document: Dict[str, Any]) -> List[Tuple[str, str, str]]:
    """Method, path, least role."""
    found = []
    for path, item in document["paths"].items():
        for method in ("get", "put", "post", "delete"):
            if method in item:
                security = item[method].get("security", document["security"])
                roles = {role for kind in security for some in kind.values() for role in some}
                names = {name for kind in security for name in kind}
                assert names <= set(document["components"]["securitySchemes"]), f"{method} {path}: {names}"
                assert len(roles) <= 1, f"{method} {path}: one least role for every way to show it"
                while "{" in path:
                    path = path[: path.index("{")] + "x" + path[path.index("}") + 1 :]
                found.append((method.upper(), path, roles.pop() if roles else "anyone"))
    return found


def main() -> int:
    url, schema, proofs = sys.argv[1:4]
    with open(schema, encoding="utf-8") as file:
        document = json.load(file)
    with open(proofs, encoding="utf-8") as file:
        tokens = json.load(file)
    peer = connection(url, sys.argv[4] if len(sys.argv) > 4 else None)
    bearer = lambda token: ("Authorization", f"Bearer {token}")
    port = url.rpartition(":")[2].strip("/")
    cookie = f"cbctd_session_{port}" if port.isdecimal() else "cbctd_session"
    good = bearer(tokens["admin"])
    # what is shown: header fields, and who that is, or the status and the error that refuse it
    shown: Dict[str, Tuple[List[Header], str, int, str]] = {
        "nothing": ([], "", 401, ""),
        "an expired token": ([bearer(tokens["expired"])], "", 401, "invalid_token"),
        "a wrong token": ([bearer(tokens["admin"][:-1] + "=")], "", 401, "invalid_token"),
        "a token cut short": ([bearer(tokens["admin"][:-1])], "", 401, "invalid_token"),
        "a longer token": ([bearer(tokens["admin"] + "A")], "", 401, "invalid_token"),
        "a token with another behind it": ([bearer(f"{tokens['admin']} {tokens['admin']}")], "", 401, "invalid_token"),
        "a token and a comma": ([bearer(f"{tokens['admin']}, Bearer x")], "", 401, "invalid_token"),
        "a quoted token": ([bearer(f'"{tokens["admin"]}"')], "", 401, "invalid_token"),
        "no token behind Bearer": ([("Authorization", "Bearer")], "", 401, "invalid_token"),
        "an empty field": ([("Authorization", "")], "", 401, "invalid_token"),
        "a bare token": ([("Authorization", tokens["admin"])], "", 401, "invalid_token"),
        "Basic": ([("Authorization", "Basic YWRtaW46YWRtaW4=")], "", 401, "invalid_token"),
        "a token twice": ([good, good], "", 400, "twice"),
        "a good token and a wrong one": ([good, bearer("x")], "", 400, "twice"),
        "a cookie that nobody gave": ([("Cookie", f"{cookie}={tokens['admin']}")], "", 401, ""),
        "a token of 20 kB": ([bearer("x" * 20000)], "", 401, "invalid_token"),
    }
    for role in ROLES[1:]:
        shown[f"a token for {role}"] = ([bearer(tokens[role])], role, 0, "")
        if f"cookie {role}" in tokens:
            shown[f"a session for {role}"] = ([("Cookie", f"{cookie}={tokens[f'cookie {role}']}")], role, 0, "")
    shown["a token in another case of Bearer"] = ([("authorization", f"bearer  {tokens['view']}")], "view", 0, "")

    wrong = 0
    all_operations = operations(document)
    for method, path, least in all_operations:
        for what, (headers, who, status, error) in shown.items():
            got, fields, problem = ask(peer, method, path, headers)
            challenge = fields.get("www-authenticate", "")
            if error == "twice":  # refused before anybody asks who it is
                fits = got == 400 and "twice" in problem["detail"]
            elif ROLES.index(who or "anyone") >= ROLES.index(least):
                fits = got == 400 and "nobody_knows" in problem["detail"]
            elif who:
                fits = got == 403 and problem["type"].endswith(":forbidden") and f'scope="{least}"' in challenge
            else:
                fits = got == status and challenge == 'Bearer realm="cbctd"' + (f', error="{error}"' if error else "")
            if not fits:
                wrong += 1
                print(f"{method} {path} for {least}, with {what}: {got} {challenge} {problem.get('detail')}")
    # The gate takes no head of that size, whoever sends it.
    peer.close()
    big = connection(url, sys.argv[4] if len(sys.argv) > 4 else None)
    try:
        got = ask(big, "GET", "/v1/scans", [bearer("x" * (1 << 20))])[0]
    except (BrokenPipeError, ConnectionResetError, ssl.SSLError):
        got = 431
    if got != 431:
        wrong += 1
        print(f"a token of 1 MB: {got}")
    print(f"  {len(all_operations)} operations with {len(shown)} proofs each")
    return 1 if wrong or len(all_operations) < 30 else 0


sys.exit(main())
