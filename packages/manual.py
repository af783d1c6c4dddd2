#!/usr/bin/env python3
"""Man pages and shell completions, from what the programs say of themselves (--help).

    packages/manual.py BUILD OUT

writes OUT/man/{cbctd.8,cbct.1,cbct-worker.8,cbct-dicom.8} and OUT/completions/{bash,zsh,fish}/... The help is made from
the tables of settings, commands and options, so that these cannot say anything else.
"""
import os
import re
import subprocess
import sys
import time
from pathlib import Path

BUILD, OUT = Path(sys.argv[1]), Path(sys.argv[2])
DATE = time.strftime("%Y-%m-%d", time.gmtime(int(os.environ.get("SOURCE_DATE_EPOCH", time.time()))))


def said(program, *arguments):
    run = subprocess.run([BUILD / program, *arguments], capture_output=True, text=True)
    return run.stdout or run.stderr


def settings(text):
    """cbctd's help: [(flag, metavar, help)] and what stands before them."""
    rows = re.findall(r"^  (--[a-z-]+)(?: (\S.*))?\n((?:        .*\n?)+)", text, re.MULTILINE)
    return [(flag, metavar, " ".join(line.strip() for line in lines.splitlines())) for flag, metavar, lines in rows]


def sections(text):
    """A command's help behind its usage line: [(title, [(left, help)])]; the summary is the title without rows."""
    found = [("", [])]
    for line in text.splitlines()[1:]:
        row = re.match(r"^  (\S.*?)(?:\s{2,}(\S.*))?$", line)
        more = re.match(r"^ {20,}(\S.*)$", line)
        if more and found[-1][1]:
            left, help_text = found[-1][1][-1]
            found[-1][1][-1] = (left, f"{help_text} {more[1]}".strip())
        elif row and line.startswith("  "):
            found[-1][1].append((row[1], row[2] or ""))
        elif line.strip():
            found.append((line.strip(), []))
    return [(title, rows) for title, rows in found if title or rows]


# ---- man pages ----


def roff(text):
    text = text.replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{text}" if text[:1] in (".", "'") else text


def page(name, section, summary, body):
    head = f'.TH {name.upper()} {section} "{DATE}" "{VERSION}" "Cone-beam CT"\n.SH NAME\n{name} \\- {roff(summary)}\n'
    path = OUT / "man" / f"{name}.{section}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(head + body + "\n")


def rows_roff(rows):
    return "".join(f".TP\n.B {roff(left)}\n{roff(text) or chr(92) + '&'}\n" for left, text in rows)


FILES = """.SH FILES
.TP
.B /etc/cbctd/cbctd.conf
settings, lines NAME = VALUE
.TP
.B /var/lib/cbctd
scans, volumes and the catalogue
.TP
.B /run/cbctd/cbctd.sock
a Unix socket for members of the group cbctd
"""
EXIT = {
    "cbctd": "0 stopped as asked; 1 it cannot start, or the disk failed; 2 the settings are wrong.",
    "cbct": "0 done; 1 failed; 2 the command line is wrong.",
}


def write_man():
    text = said("cbctd", "--help")
    rows = [(f"{flag} {metavar}".strip(), help_text) for flag, metavar, help_text in settings(text)]
    prose = text.split("\n\n", 1)[1].split("\n  --", 1)[0]
    page("cbctd", 8, "cone-beam reconstruction as a service",
         f".SH SYNOPSIS\n.B cbctd\n[\\fB\\-\\-NAME\\fR \\fIVALUE\\fR ...]\n.SH DESCRIPTION\n{roff(prose)}\n.SH SETTINGS\n"
         + rows_roff(rows)
         + ".SH SIGNALS\n.TP\n.B SIGTERM\nstops: running jobs leave a checkpoint\n.TP\n.B SIGHUP\nreads tokens, certificates and "
         "log\\-level again\n" + FILES + f".SH EXIT STATUS\n{EXIT['cbctd']}\n.SH SEE ALSO\n.BR cbct (1),\n.BR cbct\\-worker (8)")
    body = ".SH SYNOPSIS\n.B cbct\n\\fICOMMAND\\fR [\\fIarguments\\fR]\n.SH COMMANDS\n"
    body += rows_roff(COMMANDS)
    for command, _ in COMMANDS:
        help_text = said("cbct", command, "--help")
        usage = help_text.splitlines()[0].removeprefix("usage: ")
        body += f".SH {command.upper()}\n.B {roff(usage)}\n"
        for title, rows in sections(help_text):
            body += (f".SS {roff(title)}\n" if rows and title else f".PP\n{roff(title)}\n" if title else "") + rows_roff(rows)
    page("cbct", 1, "client and tools for cone-beam CT", body + f".SH EXIT STATUS\n{EXIT['cbct']}\n.SH SEE ALSO\n.BR cbctd (8)")
    usage = "\n".join(roff(line) for line in said("cbct-worker", "--help").splitlines()[1:])
    page("cbct-worker", 8, "reconstructs for cbctd on one device",
         f".SH DESCRIPTION\nOne process for each device; cbctd starts, watches and restarts it, nobody else does.\n.PP\n.nf\n{usage}\n.fi\n"
         ".SH SEE ALSO\n.BR cbctd (8)")
    page("cbct-dicom", 8, "speaks DICOM with archives for cbctd",
         ".SH DESCRIPTION\nOne process for each task: a series that is sent, a question to a worklist, a port that projections come in "
         "by. It is cbctd that starts it, with the task on descriptor 3, and nobody else does.\n.SH SEE ALSO\n.BR cbctd (8)")


# ---- completions ----


def flags_of(command):
    rows = [row for _, rows in sections(said("cbct", command, "--help")) for row in rows]
    return [(re.search(r"--[a-z-]+", left)[0], text) for left, text in rows if "--" in left]


def quoted(text):
    return "'" + text.replace("'", "'\\''") + "'"


def write(path, text):
    path = OUT / "completions" / path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def write_completions():
    flags = {command: flags_of(command) for command, _ in COMMANDS}
    daemon = [flag for flag, _, _ in settings(said("cbctd", "--help"))]
    names = " ".join(name for name, _ in COMMANDS)
    cases = "".join(f"\t{name}) words={quoted(' '.join(flag for flag, _ in rows) + ' --help')} ;;\n" for name, rows in flags.items())
    write("bash/cbct", f"""# Completion of cbct and cbctd for bash, made from their --help.
_cbct() {{
	local words current=${{COMP_WORDS[COMP_CWORD]}}
	if [ "$COMP_CWORD" = 1 ]; then
		COMPREPLY=($(compgen -W '{names} help --help --version' -- "$current"))
		return
	fi
	case ${{COMP_WORDS[1]}} in
	help) words='{names}' ;;
{cases}	*) words= ;;
	esac
	COMPREPLY=($(compgen -W "$words" -- "$current"))
	[[ $current == -* ]] || COMPREPLY+=($(compgen -f -- "$current"))
}}
_cbctd() {{
	local current=${{COMP_WORDS[COMP_CWORD]}}
	COMPREPLY=($(compgen -W '{' '.join(daemon)} --version' -- "$current"))
	[[ $current == -* ]] || COMPREPLY+=($(compgen -f -- "$current"))
}}
complete -o filenames -F _cbct cbct
complete -o filenames -F _cbctd cbctd
""")
    arms = "".join(f"\t\t{name}) _arguments {' '.join(quoted(flag + '[' + re.sub(r'[][:]', ' ', text) + ']') for flag, text in rows)} '*:file:_files' ;;\n"
                   for name, rows in flags.items())
    shown = " ".join(quoted(name + ":" + summary) for name, summary in COMMANDS)
    write("zsh/_cbct", f"""#compdef cbct
# Completion of cbct for zsh, made from its --help.
_cbct() {{
	local -a commands=({shown})
	if (( CURRENT == 2 )); then
		_describe command commands
	else
		local command=$words[2]
		shift words
		(( CURRENT-- ))
		case $command in
{arms}		esac
	fi
}}
_cbct "$@"
""")
    lines = ["# Completion of cbct and cbctd for fish, made from their --help."]
    for name, summary in COMMANDS:
        lines.append(f"complete -c cbct -n __fish_use_subcommand -a {name} -d {quoted(summary)}")
        lines += [f"complete -c cbct -n '__fish_seen_subcommand_from {name}' -l {flag[2:]} -d {quoted(text)}" for flag, text in flags[name]]
    lines += [f"complete -c cbctd -l {flag[2:]}" for flag in daemon]
    write("fish/cbct.fish", "\n".join(lines) + "\n")


VERSION = said("cbct", "--version").strip().replace(" ", " ")
COMMANDS = re.findall(r"^  ([a-z-]+)\s+(\S.*)$", said("cbct", "help"), re.MULTILINE)
write_man()
write_completions()
