#!/usr/bin/env python3
"""The software bill of materials of the built programs, CycloneDX 1.5 as JSON, on standard output.

    packages/sbom.py BUILD

Every library that the loader takes for a program (with the Debian package that has it and the file's SHA-256), CUDA's where
a program has them, the npm packages in the page, and who needs whom: of the programs what readelf says, of the
libraries likewise. The same build gives the same bytes.
"""
import datetime
import hashlib
import importlib.util
import json
import os
import re
import subprocess
import sys
import uuid
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
spec = importlib.util.spec_from_file_location("third_party", ROOT / "docs" / "third-party.py")
third_party = importlib.util.module_from_spec(spec)
spec.loader.exec_module(third_party)

BUILD = Path(sys.argv[1])
PROGRAMS = [name for name in ("cbctd", "cbct-worker", "cbct-dicom", "cbct", "cbct-cuda") if (BUILD / name).exists()]
# Of CUDA's toolkit, which is in no Debian package here.
CUDA = re.compile(r"lib(cudart|cufft|cuda|nv)")


def sha256(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def needed(path):
    text = subprocess.run(["readelf", "-d", str(path)], check=True, capture_output=True, text=True).stdout
    return re.findall(r"\(NEEDED\)\s+Shared library: \[([^]]+)\]", text)


def loaded(path):
    """Soname: file of everything that the loader takes, the loader itself included."""
    text = subprocess.run(["ldd", str(path)], check=True, capture_output=True, text=True).stdout
    found = dict(re.findall(r"^\s*(\S+) => (/\S+)", text, re.MULTILINE))
    found.update({Path(p).name: p for p in re.findall(r"^\s*(/\S+) \(0x", text, re.MULTILINE)})
    return found


def licence_of(package):
    try:
        return third_party.licence_of(package)
    except (SystemExit, OSError):  # prose: the package's copyright file has it
        return None


def packages_of(paths):
    """Path: its Debian package, as dpkg-query says of all of them at once; /usr/lib and /lib may be one folder."""
    names = {name: path for path in paths for name in (path, f"/usr{path}", path.removeprefix("/usr"), str(Path(path).resolve()))}
    said = subprocess.run(["dpkg-query", "-S", *names], capture_output=True, text=True).stdout
    return {names[name]: package.split(":")[0] for package, name in re.findall(r"^(\S+): (/\S+)$", said, re.MULTILINE) if name in names}


def versions_of(packages):
    said = subprocess.run(["dpkg-query", "-W", "-f", "${Package} ${Version}\n", *packages], capture_output=True, text=True).stdout
    return dict(line.split() for line in said.splitlines())


def library_component(soname, path, packages, versions):
    component = {"type": "library", "bom-ref": f"library:{soname}", "name": soname,
                 "hashes": [{"alg": "SHA-256", "content": sha256(path)}]}
    if CUDA.match(soname):
        release = re.search(r"cuda-([\d.]+)", str(Path(path).resolve()))
        component |= {"version": re.sub(r".*\.so\.?", "", str(Path(path).resolve())) or (release[1] if release else "unknown"),
                      "supplier": {"name": "NVIDIA Corporation"},
                      "licenses": [{"license": {"name": "CUDA Toolkit End User License Agreement"}}]}
        return component
    package = packages.get(path) or sys.exit(f"packages/sbom.py: no package has {path}")
    version = versions[package]
    component |= {"version": version, "supplier": {"name": "Debian"}, "purl": f"pkg:deb/debian/{package}@{version.replace(':', '%3A').replace('+', '%2B')}"}
    licence = licence_of(package)
    if licence:
        component["licenses"] = [{"license": {"name": licence}}]
    return component


def page_components():
    texts = list((BUILD / "web" / "files").glob("licences-*.txt"))
    return [{"type": "library", "bom-ref": f"npm:{name}", "name": name, "version": version,
             "purl": f"pkg:npm/{name.replace('@', '%40')}@{version}", "licenses": [{"license": {"name": licence}}]}
            for text in texts for name, version, licence in third_party.page_parts(text)]


def main():
    version = re.search(r'CBCT_VERSION "(.*)"', (ROOT / "proto" / "version.h").read_text())[1]
    components, dependencies, libraries = [], [], {}
    for name in PROGRAMS:
        path = BUILD / name
        libraries |= loaded(path)
        components.append({"type": "application", "bom-ref": f"program:{name}", "name": name, "version": version,
                           "hashes": [{"alg": "SHA-256", "content": sha256(path)}]})
        dependencies.append({"ref": f"program:{name}", "dependsOn": sorted(f"library:{s}" for s in needed(path))})
    page = page_components()
    packages = packages_of([path for soname, path in libraries.items() if not CUDA.match(soname)])
    versions = versions_of(sorted(set(packages.values())))
    for soname, path in sorted(libraries.items()):
        components.append(library_component(soname, path, packages, versions))
        dependencies.append({"ref": f"library:{soname}", "dependsOn": sorted(f"library:{s}" for s in needed(path) if s in libraries)})
    for dependency in dependencies:
        if dependency["ref"] == "program:cbctd":
            dependency["dependsOn"] += sorted(c["bom-ref"] for c in page)
    dependencies.insert(0, {"ref": "product:cbctd", "dependsOn": [f"program:{name}" for name in PROGRAMS]})
    bom = {"bomFormat": "CycloneDX", "specVersion": "1.5", "version": 1,
           "metadata": {"component": {"type": "application", "bom-ref": "product:cbctd", "name": "cbctd", "version": version},
                        "tools": {"components": [{"type": "application", "name": "packages/sbom.py"}]}},
           "components": components + page, "dependencies": dependencies}
    if "SOURCE_DATE_EPOCH" in os.environ:
        made = datetime.datetime.fromtimestamp(int(os.environ["SOURCE_DATE_EPOCH"]), datetime.timezone.utc)
        bom["metadata"]["timestamp"] = made.strftime("%Y-%m-%dT%H:%M:%SZ")
    # A number that stands for the content: the same for the same bill.
    bom["serialNumber"] = "urn:uuid:" + str(uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(bom, sort_keys=True)))
    json.dump(bom, sys.stdout, indent=1)
    print()


main()
