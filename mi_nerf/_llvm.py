"""Finds the LLVM with which Dr.Jit compiles for the CPU (Linux; elsewhere Dr.Jit finds its own).

Dr.Jit loads the library that ``DRJIT_LIBLLVM_PATH`` names when the first LLVM variant starts, which
may be before anyone imports ``mi_nerf``. So a startup file, installed as ``mi_nerf.pth``, watches
for the import of Dr.Jit and then, unless the variable is set, runs :func:`ensure_llvm` from this
file alone, without the package around it. Hence this file imports nothing but ``os`` and ``sys``
and loads no library. ``docs/how-it-works.md`` explains it to users.
"""

import os
import sys

VARIABLE = "DRJIT_LIBLLVM_PATH"

# Measured: on a machine with AVX-512, LLVM 15 and 16 abort the whole process ("Cannot select:
# fminimum" or "fmaximum") as soon as code uses min or max, which Mitsuba's own BSDFs do. So an LLVM
# of at least SOUND is looked for everywhere before one of at least OLDEST (Dr.Jit's own limit) is
# taken. 19 and 23 work; what is newer than the newest of them has not been tried.
OLDEST = 15
SOUND = 17
TESTED = (19, 23)

# Where distributions put libLLVM; each part of a path may hold one "*".
SYSTEM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64/llvm*/lib*",
    "/usr/lib/llvm/*/lib*",
    "/usr/local/lib",
)

# What users may point the variable at, by ``sys.platform``; the package brings one for Linux on
# x86-64 only. Homebrew's prefix is /usr/local on Intel Macs.
PLACES = {
    "linux": "such as /usr/lib/aarch64-linux-gnu/libLLVM.so.19.1 of the package libllvm19",
    "darwin": "such as /opt/homebrew/opt/llvm/lib/libLLVM.dylib after 'brew install llvm'",
    "win32": r"such as C:\Program Files\LLVM\bin\LLVM-C.dll of LLVM's own installer",
}

# e_machine of an ELF header.
ELF_MACHINES = {"x86_64": 62, "aarch64": 183}


def ensure_llvm() -> None:
    """Points Dr.Jit to the LLVM of :func:`find_llvm`, unless the user already chose one."""
    if not os.environ.get(VARIABLE):
        path = find_llvm()
        if path is not None:
            os.environ[VARIABLE] = path


def where_llvm_is() -> str:
    """An example of what the variable may name on this system."""
    place = PLACES.get(sys.platform, "a shared library")
    if sys.platform == "linux":
        place = place.replace("aarch64", os.uname().machine)
    return place


def find_llvm() -> str | None:
    """Returns the path of the LLVM shared library to use, or None if none is fit.

    ``DRJIT_LIBLLVM_PATH`` always wins. Otherwise the order is: an LLVM of the system from ``SOUND``
    up to the newest tested one; the one installed next to this package (``karellen-llvm-core``); a
    newer one; one of at least ``OLDEST``.
    """
    if os.environ.get(VARIABLE):
        return os.environ[VARIABLE]
    if sys.platform != "linux":
        return None
    system = [
        os.path.join(folder, name)
        for folder in _system_folders()
        for name in _list(folder)
        if name.startswith(("libLLVM-", "libLLVM.so"))
    ]
    carried = [os.path.join(folder, "libLLVM.so") for folder in _carried_folders()]
    found = [(_rank(version, False), path) for path, version in _libraries(system)]
    found += [(_rank(version, True), path) for path, version in _libraries(carried)]
    found.sort(key=lambda item: item[0])  # stable: among equals, the first folder wins
    return next((path for _, path in found if _is_loadable(path)), None)


def _rank(version: tuple[int, ...], carried: bool) -> tuple[int, bool, tuple[int, ...]]:
    """Sort key of a library: the smallest is the best."""
    major = version[0]
    if major < SOUND:
        group = 3
    elif major > max(TESTED):
        group = 2
    else:
        group = int(carried)
    return group, major not in TESTED, tuple(-number for number in version)


def _system_folders() -> list[str]:
    """The folders that belong to the machine or to the user's active environment."""
    folders = [path for path in os.environ.get("LD_LIBRARY_PATH", "").split(":") if path[:1] == "/"]
    for pattern in SYSTEM_FOLDERS:
        folders += _expand(pattern)
    if os.environ.get("CONDA_PREFIX"):
        folders.append(os.path.join(os.environ["CONDA_PREFIX"], "lib"))
    return folders


def _carried_folders() -> list[str]:
    """The folders where pip puts the library of ``karellen-llvm-core``: ``<prefix>/lib``.

    Its links, ``libLLVM.so`` among them, are made at the first start of an interpreter after the
    installation. Without them the library lacks others that it needs, so only the link counts.
    """
    folders = [os.path.join(sys.prefix, "lib")]
    site = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    if os.path.basename(site) in ("site-packages", "dist-packages"):
        folders.append(os.path.dirname(os.path.dirname(site)))  # pip install --user or --prefix
    return folders


def _expand(pattern: str) -> list[str]:
    """The folders that match an absolute path with at most one ``*`` in each part."""
    folders = ["/"]
    for part in pattern.strip("/").split("/"):
        head, star, tail = part.partition("*")
        if star:
            folders = [
                os.path.join(folder, name)
                for folder in folders
                for name in sorted(_list(folder))
                if name.startswith(head) and name[len(head) :].endswith(tail)
            ]
        else:
            folders = [os.path.join(folder, part) for folder in folders]
    return folders


def _list(folder: str) -> list[str]:
    """The names in a folder; none if it is not a folder that can be read."""
    try:
        return os.listdir(folder)
    except OSError:
        return []


def _libraries(paths: list[str]) -> list[tuple[str, tuple[int, ...]]]:
    """Those of the paths that name an LLVM library new enough, and their versions."""
    found = []
    for path in paths:
        version = _version(os.path.basename(path))
        if version is None:  # libLLVM.so, a link to one that has a version
            path = os.path.realpath(path)
            version = _version(os.path.basename(path))
        if version is not None and version[0] >= OLDEST:
            found.append((path, version))
    return found


def _version(name: str) -> tuple[int, ...] | None:
    """The version in a file name such as libLLVM-19.so, libLLVM-15.so.1 or libLLVM.so.19.1.

    Other names have none, among them those of the reduced LLVM that belongs to a Rust compiler
    (libLLVM.so.19.1-rust-1.84.0-stable).
    """
    stem, suffix, tail = name.partition(".so")
    before = stem.removeprefix("libLLVM-") if stem != "libLLVM" else ""
    after = tail.removeprefix(".")
    numbers = [part.split(".") for part in (before, after) if part]
    if not suffix or not numbers or not all(text.isdecimal() for part in numbers for text in part):
        return None
    return tuple(int(text) for text in numbers[0])


def _is_loadable(path: str) -> bool:
    """Whether the file is a shared object for this machine, judging by its ELF header."""
    try:
        with open(path, "rb") as file:
            header = file.read(20)
    except OSError:
        return False
    machine = ELF_MACHINES.get(os.uname().machine)
    return (
        header[:6] == b"\x7fELF\x02\x01"  # 64 bits, little-endian
        and header[16:18] == b"\x03\x00"  # ET_DYN
        and (machine is None or header[18:20] == machine.to_bytes(2, "little"))
    )
