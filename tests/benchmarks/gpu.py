"""What the program does on a GPU, in under six minutes and without preparation.

    python -m tests.benchmarks.gpu --seconds 60
    python -m tests.benchmarks.gpu --variant llvm_ad_rgb --seconds 5 --small --out FILE

Part after part, each in a process of its own with a time limit: the device and what it is capable
of, the tests marked ``cuda``, the preset ``fast`` on full-size Lego for a quarter of the seconds
and for all of them, ``mi.render`` of that field at 800x800, training steps of all presets and of
half precision. Everything goes into one JSON file after every part, ``docs/results/gpu.json``; of
a part that fails or runs out of time, there is its error in one line and what it had found.

Images are those of ``lego_800`` in the folder that MI_NERF_DATA names; without it, a scene is
path-traced first, which takes OptiX. ``--small`` has tiny ones, to try all of this on a CPU.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from tests.benchmarks import gpu_tests
from tests.benchmarks.results import ROOT, commit

RESULT = ROOT / "docs" / "results" / "gpu.json"

_BUDGET = 345.0  # seconds of all parts together
_LEAST = 5.0  # seconds left, below which no part begins
_POLL = 0.5  # seconds between looks at the memory of the device

Record = dict[str, Any]


@dataclass(frozen=True)
class Part:
    """One of the measurements: what it is called, and how long it may take."""

    name: str
    limit: float  # seconds
    arguments: tuple[str, ...] = ()  # of tests.benchmarks.gpu_parts
    function: str | None = None  # there; default: its name


def parts(options: argparse.Namespace) -> list[Part]:
    """All of them, in order: what matters most comes first."""
    short, long = options.seconds / 4, options.seconds
    return [
        Part("device", 40),
        Part("tests", 100),
        Part("data", 60),
        Part("train_short", short + 40, ("--train-seconds", f"{short:g}"), "train"),
        Part("train_long", long + 50, ("--train-seconds", f"{long:g}"), "train"),
        Part("render", 30),
        Part("steps", 75),
        Part("train_half", short + 40, ("--train-seconds", f"{short:g}", "--half"), "train"),
    ]


def main() -> None:
    """Runs the parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the longer training")
    parser.add_argument("--variant", default="cuda_ad_rgb")
    parser.add_argument("--small", action="store_true", help="tiny images and models")
    parser.add_argument("--views", type=int, default=25, help="measured after a training")
    parser.add_argument("--budget", type=float, default=_BUDGET, help="seconds of all parts")
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--only", nargs="*", help="of the parts; device always runs")
    options = parser.parse_args()
    start = time.monotonic()
    record = {
        "command": " ".join(["python -m tests.benchmarks.gpu", *sys.argv[1:]]),
        "commit": commit(),
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": None,
        "parts": {},
    }
    with tempfile.TemporaryDirectory() as folder:
        for part in parts(options):
            if options.only is not None and part.name not in ("device", *options.only):
                continue
            left = start + options.budget - time.monotonic()
            if left < _LEAST:
                record["parts"][part.name] = {"error": "no time was left"}
            else:
                found = run_part(part, min(part.limit, left), options, Path(folder))
                record["parts"][part.name] = found
            if part.name == "device":
                _require_device(record, options)
            record["seconds"] = round(time.monotonic() - start, 1)
            write_result(options.out, record)
            print(f"{part.name}: {_line(record['parts'][part.name])}", flush=True)
    print(f"{record['seconds']} s, {options.out}")


def run_part(part: Part, limit: float, options: argparse.Namespace, folder: Path) -> Record:
    """What a part found, with ``seconds``, ``device_mib`` and, if it failed, ``error``."""
    file = folder / f"{part.name}.json"
    command = [sys.executable, "-m", "tests.benchmarks.gpu_parts", part.function or part.name]
    command += ["--name", part.name, "--variant", options.variant, "--folder", str(folder)]
    command += ["--views", str(options.views), "--started", str(time.monotonic())]
    command += [*part.arguments, *(["--small"] if options.small else [])]
    start = time.monotonic()
    with _watched_memory(options.variant) as peak:
        if part.name == "tests":
            found = gpu_tests.run(options.variant, limit, options.small)
        else:
            error = _run(command, limit, folder / f"{part.name}.log")
            found = json.loads(file.read_text()) if file.exists() else {}
            if error and "error" not in found:
                found["error"] = error
    found["seconds"] = round(time.monotonic() - start, 1)
    if peak:
        found["device_mib"] = max(peak)
    return found


def _run(command: Sequence[str], limit: float, log: Path) -> str | None:
    """Runs a process and all that it starts; its error in one line, or none."""
    with log.open("w") as out:
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            status = process.wait(limit)
        except subprocess.TimeoutExpired:
            return f"stopped after {limit:.0f} s"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    if status == 0:
        return None
    lines = log.read_text(errors="replace").strip().splitlines()
    return f"exit status {status}: {lines[-1] if lines else 'nothing was said'}"[:500]


@contextlib.contextmanager
def _watched_memory(variant: str) -> Iterator[list[int]]:
    """Collects the MiB in use on the device, as its driver counts them; on a CPU nothing."""
    seen: list[int] = []
    done = threading.Event()

    def watch() -> None:
        while not done.wait(_POLL):
            if (used := query_device("memory.used")) is not None:
                seen.append(int(used.split()[0]))

    thread = threading.Thread(target=watch, daemon=True)
    if variant.startswith("cuda") and shutil.which("nvidia-smi"):
        thread.start()
    try:
        yield seen
    finally:
        done.set()
        if thread.is_alive():
            thread.join()


def query_device(what: str) -> str | None:
    """What ``nvidia-smi`` says of the first device; nothing where it does not work."""
    command = ["nvidia-smi", f"--query-gpu={what}", "--format=csv,noheader,nounits"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    lines = found.stdout.splitlines()
    return lines[0].strip() if lines else None


def _require_device(record: Record, options: argparse.Namespace) -> None:
    """Ends with a sentence where the variant does not work."""
    found = record["parts"]["device"]
    record["machine"] = found.pop("machine", None)
    if record["machine"] is None:
        reason = found.get("error", "no reason was given")
        sys.exit(
            f"{options.variant} does not work on this machine ({reason}), expected an NVIDIA GPU "
            "with driver R535 or newer, or --variant llvm_ad_rgb --small"
        )


def write_result(path: Path, record: Record) -> None:
    """Puts the record in its file, whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".part")
    draft.write_text(json.dumps(record, indent=1) + "\n")
    draft.replace(path)


def _line(found: Record) -> str:
    """The figures of a part that are single numbers or words."""
    return ", ".join(f"{k} {v}" for k, v in found.items() if not isinstance(v, (dict, list)))


if __name__ == "__main__":
    main()
