#!/usr/bin/python3
"""proto/openapi.yaml as the JSON that the daemon serves, in C.

Usage: openapi.py openapi.yaml > openapi.c     (--json: the JSON itself)

Read by the rules of YAML 1.2, as OpenAPI wants it: the library's own are those of 1.1, where `off` is false and
`12:30` a number. Names that come twice are refused.
"""
import hashlib
import json
import re
import sys

import yaml


class Loader(yaml.SafeLoader):
    """YAML 1.2's core schema."""

    yaml_implicit_resolvers: dict = {}

    def construct_mapping(self, node, deep=False):
        names = [self.construct_object(key, deep=True) for key, _ in node.value]
        twice = {name for name in names if names.count(name) > 1}
        if twice:
            raise yaml.constructor.ConstructorError(None, None, f"{sorted(twice)} twice", node.start_mark)
        return super().construct_mapping(node, deep)


for tag, pattern, first in [
    ("bool", r"true|false", "tf"),
    ("null", r"null|~|", ["n", "~", ""]),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+.0123456789"),
]:
    Loader.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(f"(?:{pattern})$"), first)
# The library's own would take 0777 for octal and refuse 1e6.
Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))
Loader.add_constructor("tag:yaml.org,2002:float", lambda loader, node: float(node.value))


def main() -> None:
    with open(sys.argv[-1], encoding="utf-8") as file:
        text = json.dumps(yaml.load(file, Loader), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    if sys.argv[1] == "--json":
        print(text)
        return
    data = text.encode()
    print('#include "proto/openapi.h"')
    print(f"const size_t openapi_json_size = {len(data)};")
    print(f'const char openapi_json_etag[] = "\\"{hashlib.sha256(data).hexdigest()[:32]}\\"";')
    print("const unsigned char openapi_json[] = {")
    for at in range(0, len(data), 24):
        print(",".join(map(str, data[at : at + 24])) + ",")
    print("};")


main()
