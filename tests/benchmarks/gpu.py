"""What the program does on a GPU, in under six minutes and without preparation.

    python -m tests.benchmarks.gpu --seconds 60
    python -m tests.benchmarks.gpu --variant llvm_ad_rgb --seconds 5 --small --results FOLDER

Part after part, each in a process of its own with a time limit: the device and what it is capable
of, the tests marked ``cuda``, the preset ``fast`` on full-size Lego for a quarter of the seconds
and for all of them, ``mi.render`` of that field at 800x800, training steps of all presets and of
half precision. After every part, everything goes into ``docs/results/gpu.json``, with the name of
the card; of a part that fails or runs out of time, there is its error in one line and what it had
found.

Images are those of ``lego_800`` in the folder that MI_NERF_DATA names; without it, a scene is
path-traced first, or a ball is drawn where OptiX is missing. ``--small`` has tiny images, to try
all of this on a CPU.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_nerf.base.machine import gpu_query
from tests.benchmarks import gpu_tests, trained
from tests.benchmarks.results import (
    RENDERING,
    ROOT,
    TRAINING,
    Figure,
    Protocol,
    Row,
    add_options,
    save,
)

PARTS = tuple(sorted({*TRAINING, *RENDERING}))  # of mi_nerf that the figures depend on

_BUDGET = 345.0  # seconds of all parts together
_LEAST = 5.0  # seconds left, below which no part begins
_POLL = 0.5  # seconds between looks at the memory of the device

Record = dict[str, Any]

# Names and units of what the parts find; of a trained field, see trained.UNITS.
_FIGURES = {
    "took": ("took", "s"),
    "product_gflops": ("product", "GFLOP/s"),
    "passed": ("passed", ""),
    "failed": ("failed", ""),
    "skipped": ("skipped", ""),
    "begun": ("begun", "s"),
    "first_step": ("first_step", "s"),
    "first": ("first_frame", "s"),
    "median": ("frame", "s"),
    "step_ms": ("step", "ms"),
    "steps_per_second": ("steps_a_second", ""),
    "samples_per_second": ("samples_a_second", ""),
    "gflops": ("rate", "GFLOP/s"),
    "watermark_mib": ("allocated", "MiB"),
    "device_mib": ("device_memory", "MiB"),
    "resident_mb": ("resident_memory", "MB"),
    **{name: (name, unit) for name, unit in trained.UNITS.items()},
}
_SPREADS = {"median": ("least", "greatest"), "step_ms": ("fastest_ms", "slowest_ms")}
_NOTES = ("driver", "surfaces", "half_precision", "images", "as", "error", "failures")


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
    parser.add_argument("--only", nargs="*", help="of the parts; device always runs")
    add_options(parser)
    options = parser.parse_args()
    start = time.monotonic()
    found: Record = {}
    with tempfile.TemporaryDirectory() as folder:
        for part in parts(options):
            if options.only is not None and part.name not in ("device", *options.only):
                continue
            left = start + options.budget - time.monotonic()
            if left < _LEAST:
                found[part.name] = {"error": "no time was left", "took": 0.0}
            else:
                found[part.name] = run_part(part, min(part.limit, left), options, Path(folder))
            if part.name == "device":
                _require_device(found["device"], options)
            print(f"{part.name}: {_line(found[part.name])}", flush=True)
            rows = list(rows_of(found, options))
            save("gpu", rows, options, options.variant, PARTS, whole=True)
    print(f"{time.monotonic() - start:.1f} s")


def run_part(part: Part, limit: float, options: argparse.Namespace, folder: Path) -> Record:
    """What a part found, with what it ``took`` and, if it failed, an ``error``."""
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
    found["took"] = round(time.monotonic() - start, 1)
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
            if (used := gpu_query("memory.used")) is not None:
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


def _require_device(found: Record, options: argparse.Namespace) -> None:
    """Ends with a sentence where the variant does not work."""
    if found.pop("machine", None) is None:
        reason = found.get("error", "no reason was given")
        sys.exit(
            f"{options.variant} does not work on this machine ({reason}), expected an NVIDIA GPU "
            "with driver R535 or newer, or --variant llvm_ad_rgb --small"
        )


# ---- Rows ---------------------------------------------------------------------------


def rows_of(found: Mapping[str, Record], options: argparse.Namespace) -> Iterator[Row]:
    """A row of every part, and of every kind of steps."""
    kinds = {part.name: part for part in parts(options)}
    size = "32×32" if options.small else "800×800"
    for name, record in found.items():
        part = kinds[name]
        if part.function == "train":
            half = ", half precision" if "--half" in part.arguments else ""
            what = f"`fast`{half}, trained for {part.arguments[1]} s"
        else:
            what = {
                "device": "the device",
                "tests": f"tests marked `{record.get('marks')}`",
                "data": "the images",
                "render": f"a frame by mi.render, {size}",
                "steps": "profiles of training steps",
            }[name]
        yield _row(what, record, _protocol(record, found.get("data", {})))
        if name == "steps":
            for kind, steps in record.items():
                if isinstance(steps, dict):
                    took = {"took": 0.0} if "step_ms" not in steps else {}
                    yield _row(f"steps: {kind}", {**took, **steps})


def _row(what: str, record: Mapping[str, Any], protocol: Protocol | None = None) -> Row:
    figures = {}
    for key, (name, unit) in _FIGURES.items():
        if record.get(key) is not None:
            spread = [record[k] for k in _SPREADS.get(key, ()) if k in record]
            limits = (spread[0], spread[1]) if len(spread) == 2 else None
            figures[name] = Figure(float(record[key]), unit, limits)
    for name, milliseconds in record.get("stages", {}).items():
        figures[f"stage_{name}"] = Figure(milliseconds, "ms")
    notes = {key: record[key] for key in _NOTES if record.get(key)}
    return Row({"what": what, "notes": _said(notes) or "–"}, figures, protocol)


def _protocol(record: Mapping[str, Any], images: Mapping[str, Any]) -> Protocol | None:
    if "psnr" not in record:
        return None
    width, height = record["size"]
    return Protocol(images["images"], record["split"], record["views"], (width, height))


def _said(notes: Mapping[str, Any]) -> str:
    """Words in one line, folders of this machine and what a table would break at left out."""
    parts = []
    for key, value in notes.items():
        words = "; ".join(value) if isinstance(value, list) else str(value)
        parts.append(words if key in ("driver", "images") else f"{key}: {words}")
    text = re.sub(r"(?<![\w.])/[^\s:;,()'\"]*/", "", "; ".join(parts))
    return text.replace("|", "/").strip()[:1000]


def _line(found: Record) -> str:
    """The figures of a part that are single numbers or words."""
    return ", ".join(f"{k} {v}" for k, v in found.items() if not isinstance(v, (dict, list)))


if __name__ == "__main__":
    main()
