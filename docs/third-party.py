#!/usr/bin/env python3
"""Writes docs/third-party.md: the parts of others that the built programs need, with version and licence.

    docs/third-party.py [BUILD]   writes the table of the programs in BUILD (default: build); needs Debian and the page
    docs/third-party.py --check   exits 1 if a library of the Makefile or a package of the page has no row

Libraries are those that the linker recorded in the programs. Version and licence of a library come from its Debian
package, those of the page's parts from build/web/files/licences-*.txt, which npm's packages were asked for.
"""
import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TABLE = ROOT / "docs" / "third-party.md"
PROGRAMS = ("cbctd", "cbct-worker", "cbct-dicom", "cbct")
# Packages whose copyright file is prose. Read in Debian 12.
PROSE = {
    "libc6": "LGPL-2.1+",
    "libgnutls30": "LGPL-2.1+",
    "libgomp1": "GPL-3+ with GCC Runtime Library Exception",
    "python3-numpy": "BSD-3-Clause",
}
# Programs and modules that are run or imported, not linked: package, what for.
BESIDE = (
    ("dcmtk", "`cbct import` runs its programs to read DICOM"),
    ("libpq5", "`cbctd` loads it where `--catalogue postgresql://...` is set"),
    ("libhdf5-103-1", "`cbct import` loads it for HDF5 files (NeXus)"),
    ("python3-numpy", "`clients/python/cbctd.py`"),
    ("python3-requests", "`clients/python/cbctd.py`"),
)
HEAD = """# Third-party parts

Written by `docs/third-party.py` (`make third-party`) on Debian {debian}; other machines may have other versions. cbctd
itself has no LICENSE yet: choosing one is the owner's to do.

A licence is what the package's `copyright` file says of `Files: *`; single files may have others, which
`/usr/share/doc/PACKAGE/copyright` lists.
"""


def output(*command):
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def needed(program):
    """The sonames that the linker recorded."""
    return re.findall(r"NEEDED\s+(\S+)", output("objdump", "-p", str(program)))


def loaded(program):
    """Each library that the loader takes, soname: path."""
    return dict(re.findall(r"^\s*(\S+) => (/\S+)", output("ldd", str(program)), re.MULTILINE))


def package_of(path):
    """The Debian package of a file; /usr/lib and /lib may be one folder under two names."""
    for name in (path, f"/usr{path}", path.removeprefix("/usr")):
        found = subprocess.run(["dpkg-query", "-S", name], capture_output=True, text=True)
        if found.returncode == 0:
            return found.stdout.split(":")[0]
    sys.exit(f"docs/third-party.py: no package has {path}")


def version_of(package):
    return output("dpkg-query", "-W", "-f", "${Version}\n", package).splitlines()[0]


def licence_of(package):
    text = Path(f"/usr/share/doc/{package}/copyright").read_text(errors="replace")
    match = re.search(r"^Files:\s*\*\s*\n(?:(?!\n\n).)*?^License:[ \t]*(\S[^\n]*)$", text, re.MULTILINE | re.DOTALL)
    if match:
        return match.group(1).strip()
    return PROSE.get(package) or sys.exit(f"docs/third-party.py: {package} needs a row in PROSE")


def linked_table(build):
    users, paths = {}, {}
    for program in PROGRAMS:
        paths |= loaded(build / program)
        for soname in needed(build / program):
            # CUDA's libraries have a table of their own; its C++ and the loader are the compiler's and libc's.
            if not re.match(r"libcud|libcufft|libstdc|libgcc_s|ld-linux", soname):
                users.setdefault(soname, []).append(program)
    rows, own = {}, set()
    for soname, programs in users.items():
        package = package_of(paths[soname])
        own.add(package)
        link = Path(re.sub(r"\.so\..*", ".so", paths[soname]))
        development = package_of(str(link)) if link.exists() else "gcc"
        row = rows.setdefault(package, [development, []])
        row[1] += [p for p in programs if p not in row[1]]
    out = ["## Linked", "", "| Debian package | version | licence | to build | used by |", "|---|---|---|---|---|"]
    for package, (development, programs) in sorted(rows.items()):
        used = ", ".join(p for p in PROGRAMS if p in programs)
        out.append(f"| {package} | {version_of(package)} | {licence_of(package)} | {development} | {used} |")
    brought = {package_of(path) for soname, path in paths.items() if not re.match(r"libcud|libcufft", soname)} - own
    out += ["", "These libraries load further ones, which `make bundle` copies too: "
            + ", ".join(f"{p} {version_of(p)}" for p in sorted(brought)) + "."]
    return out


def cuda_table():
    try:
        release = re.search(r"release ([\d.]+)", output("nvcc", "--version")).group(1)
    except FileNotFoundError:
        sys.exit("docs/third-party.py: nvcc is not here, the CUDA toolkit's version cannot be read")
    return ["## With CUDA", "", "| part | version | licence | used by |", "|---|---|---|---|",
            f"| CUDA toolkit: libcudart, libcufft | {release} | CUDA Toolkit End User License Agreement (proprietary; "
            "its Attachment A lists what may be redistributed) | cbct-worker, cbct-cuda |",
            "| libstdc++6 | the compiler's | GPL-3+ with GCC Runtime Library Exception | cbct-worker, cbct-cuda |"]


def page_parts(licences):
    """Name, version and licence of each npm package in the page's bundle."""
    blocks = re.split(r"^-{78}$", licences.read_text(), flags=re.MULTILINE)
    return [re.search(r"^(\S+) (\d\S*): (.+)$", block, re.MULTILINE).groups() for block in blocks]


def page_table(build):
    texts = list((build / "web" / "files").glob("licences-*.txt"))
    if len(texts) != 1:
        sys.exit("docs/third-party.py: the page is not built here (npm)")
    parts = page_parts(texts[0])
    out = ["## In the page", "",
           "The npm packages in the page's bundle. The daemon serves their licences, the page links to them.", "",
           "| npm package | version | licence |", "|---|---|---|"]
    out += [f"| {name} | {version} | {licence} |" for name, version, licence in parts]
    lock = json.loads((ROOT / "clients/web/package-lock.json").read_text())["packages"]["node_modules/esbuild"]
    out += ["", f"esbuild {lock['version']} ({lock['license']}) makes the bundle and is not part of it."]
    return out


def beside_table():
    out = ["## Run or imported", "", "| Debian package | version | licence | used by |", "|---|---|---|---|"]
    for package, use in BESIDE:
        out.append(f"| {package} | {version_of(package)} | {licence_of(package)} | {use} |")
    return out


def check():
    text = TABLE.read_text()
    pairs = re.search(r"^PACKAGES := ((?:.*\\\n)*.*)", (ROOT / "Makefile").read_text(), re.MULTILINE).group(1)
    wanted = [f"| {pair.split(':')[1]} |" for pair in pairs.replace("\\", " ").split() if pair != "check:check"]
    for name, version in json.loads((ROOT / "clients/web/package.json").read_text())["dependencies"].items():
        wanted.append(f"| {name} | {version} |")
    missing = [row for row in wanted if row not in text]
    if missing:
        sys.exit(f"docs/third-party.md lacks {', '.join(missing)}: make third-party")


def main():
    if sys.argv[1:] == ["--check"]:
        return check()
    build = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "build")
    sections = [linked_table(build), cuda_table(), page_table(build), beside_table()]
    debian = Path("/etc/debian_version").read_text().strip()
    TABLE.write_text(HEAD.format(debian=debian) + "".join("\n" + "\n".join(s) + "\n" for s in sections))


if __name__ == "__main__":
    main()
