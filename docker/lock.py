"""Write the image's lock files: each package with one version, and with the hashes of all its
files.

    python docker/lock.py [TORCH_WHEEL ...]

Versions are those of constraints.txt; hashes are those of the package index that uv asks. There is
a file for all images, one for what builds the guide, and one more for each kind of torch. The index
has torch's wheels for graphics processors, which need more packages than constraints.txt has. Its
wheels for other processors (+cpu) lie in another index: name the files that may be installed, as
they were downloaded from there. Without a name the hashes that were locked before stay.
"""

import hashlib
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOCK, CPU_LOCK, GPU_LOCK, DOCS_LOCK = (
    ROOT / "docker" / f"requirements{kind}.lock" for kind in ("", "-cpu", "-gpu", "-docs")
)

MACHINES = ("x86_64-manylinux_2_28", "aarch64-manylinux_2_28")

NOT_FROZEN = {"setuptools"}
"""Packages at run time that pip freeze, and so constraints.txt, leaves out; the wheel is built by
them as well.
"""

HEADER = (
    "# {about} Linux on x86_64 and aarch64; pip install --no-deps --require-hashes -r. Made by:"
    " make lock\n"
)

Entries = dict[str, list[str]]
"""Hashes of a package's files by its requirement, ``name==version``."""


def normal(name: str) -> str:
    """The name of a package as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def read_entries(text: str) -> Entries:
    """The requirements of a lock file with their hashes, in their order."""
    entries: Entries = {}
    for part in re.split(r"\n(?=[\w-]+==)", "\n" + text):
        if found := re.match(r"([\w.-]+)==(\S+)", part):
            name = f"{normal(found[1])}=={found[2]}"
            entries[name] = re.findall(r"--hash=(sha256:[0-9a-f]{64})", part)
    return entries


def write_entries(path: Path, about: str, entries: Entries) -> None:
    """A lock file that `read_entries` reads."""
    lines = [
        " \\\n    ".join([name, *(f"--hash={one}" for one in hashes)])
        for name, hashes in sorted(entries.items())
    ]
    path.write_text(HEADER.format(about=about) + "\n".join(lines) + "\n", encoding="utf-8")


def resolve(machine: str, *options: str) -> Entries:
    """All packages that the image needs on a machine, by uv."""
    command = [
        "uv",
        "pip",
        "compile",
        "pyproject.toml",
        "-c",
        "constraints.txt",
        "--python-version",
        "3.11.5",
    ]
    command += [
        *options,
        "--python-platform",
        machine,
        "--generate-hashes",
        "--no-annotate",
        "--no-header",
        "--quiet",
    ]
    return read_entries(
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    )


def constrained_names() -> set[str]:
    """Names of the packages that constraints.txt holds."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return {normal(line.partition("==")[0]) for line in lines if "==" in line}


def cpu_hashes(wheels: list[str]) -> list[str]:
    """Hashes of torch's wheels for other processors: of these files, or those that are locked
    already.
    """
    if wheels:
        return sorted(
            f"sha256:{hashlib.sha256(Path(wheel).read_bytes()).hexdigest()}" for wheel in wheels
        )
    (hashes,) = read_entries(CPU_LOCK.read_text(encoding="utf-8")).values()
    return hashes


def main() -> None:
    """Write the files."""
    entries: Entries = {}
    for machine in MACHINES:
        entries |= resolve(machine)
    names = {entry: entry.partition("==")[0] for entry in entries}
    assert len(set(names.values())) == len(names), "the machines need different versions"
    everywhere = (constrained_names() | NOT_FROZEN) - {"torch"}
    (torch,) = (entry for entry in entries if names[entry] == "torch")
    locks: dict[tuple[Path, str], Entries] = {
        (LOCK, "What every image needs:"): {
            entry: entries[entry] for entry in entries if names[entry] in everywhere
        },
        (CPU_LOCK, "torch without graphics processors:"): {
            f"{torch}+cpu": cpu_hashes(sys.argv[1:])
        },
        (DOCS_LOCK, "What builds the guide, besides:"): {
            entry: hashes
            for entry, hashes in resolve(MACHINES[0], "--extra", "docs").items()
            if entry not in entries
        },
        (GPU_LOCK, "torch for graphics processors, and what only it needs:"): {
            entry: entries[entry] for entry in entries if names[entry] not in everywhere
        },
    }
    for (path, about), held in locks.items():
        write_entries(path, about, held)


if __name__ == "__main__":
    main()
