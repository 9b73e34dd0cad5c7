"""Figures of ``mi-nerf report``: speed against error, and quality against seconds of training.

    MI_NERF_DATA=… python -m tests.benchmarks.reports speed
    MI_NERF_DATA=… python -m tests.benchmarks.reports curves

The first trains lego_200 at half its size with the preset ``fast`` for a minute, sweeps samples
a ray of that field and of two formulas, and profiles training steps of ``fast`` and ``nerf``. The
second looks at trainings of both.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import mi_nerf
from mi_nerf.base.variants import choose_variant
from mi_nerf.report import Knobs, open_subject, rows_of, sweep, training_curves
from mi_nerf.report.profile import profile_run
from tests.benchmarks import data_folder, machine
from tests.benchmarks.results import REPORT, Figure, Protocol, Row, add_options, save

SIZE = (100, 100)
FORMULAS: dict[str, dict[str, float]] = {"shell": {"edge": 0.0}, "gaussian": {"peak": 20.0}}
LOOKS = {2: "after_6", 4: "after_12", 6: "after_27", 7: "after_40", 8: "after_60"}  # of 60 s


def main() -> None:
    """Measures one of both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["speed", "curves"])
    parser.add_argument("--seconds", type=float, default=60.0, help="of training")
    parser.add_argument("--variant")
    add_options(parser)
    options = parser.parse_args()
    variant, data = choose_variant(options.variant), data_folder("lego_200")
    print(f"{machine()}, {variant}")
    with tempfile.TemporaryDirectory() as place:
        if options.what == "curves":
            rows = curves(data, Path(place), variant, options.seconds)
            save("training_curve", rows, options, variant, REPORT, whole=True)
            return
        runs = {name: Path(place) / name for name in ("fast", "nerf")}
        for name, folder in runs.items():
            run = mi_nerf.start(
                data, folder, preset=name, max_seconds=options.seconds, downscale=2, variant=variant
            )
            run.train(show_bar=False)
        rows = samples(runs["fast"], variant)
        save("speed_error", rows, options, variant, REPORT, whole=True)
        rows = [row for name in FORMULAS for row in formula(name, variant)]
        save("speed_error_formulas", rows, options, variant, REPORT, whole=True)
        rows = [step(name, folder, variant) for name, folder in runs.items()]
        save("training_step", rows, options, variant, REPORT, whole=True)


def samples(run: Path, variant: str) -> list[Row]:
    """What samples a ray buy."""
    subject = open_subject(run, variant, split="val", views=10)
    own = subject.marched.settings.samples
    record = sweep(subject, _knobs((16, 32, 64, 128, 256)))
    protocol = Protocol("lego_200", "val", 10, SIZE, metric=f"{record['rays']} pixels together")
    rows = []
    for point in _sorted(record):
        label = f"{point['samples']} (default)" if point["samples"] == own else point["samples"]
        figures = {
            "ms": _time(point),
            "queries_per_ray": Figure(point["queries_per_ray"]),
            "quadrature_error": Figure(point["error"]["color"]),
            "psnr": Figure(point["psnr"], "dB"),
        }
        rows.append(Row({"samples": str(label)}, figures, protocol, (0,)))
    perfect = {"psnr": Figure(record["reference"]["psnr"], "dB")}
    label = "perfect quadrature: the model error alone"
    return [*rows, Row({"samples": label}, perfect, protocol, (0,))]


def formula(name: str, variant: str) -> list[Row]:
    """The same of a field with a known integral, and of another rule beside the usual one."""
    values = FORMULAS[name]
    field = ", ".join([name, *(f"{key}={value:g}" for key, value in values.items())])
    record = sweep(open_subject(name, variant, values=values), _knobs((16, 64, 256), both=True))
    points = {(p["samples"], p["rule"]): p for p in record["points"]}
    rows = []
    for count in (16, 64, 256):
        usual, linear = points[count, "constant"], points[count, "linear"]
        figures = {"depth_error": Figure(usual["error"]["depth"]), "ms": _time(usual)}
        rows.append(Row({"field": field, "samples": str(count)}, figures))
        ratios = {
            "error_ratio": Figure(linear["error"]["depth"] / usual["error"]["depth"], "times"),
            "time_ratio": Figure(linear["milliseconds"] / usual["milliseconds"], "times"),
        }
        rows.append(Row({"field": f"{field}, rule `linear`", "samples": str(count)}, ratios))
    return rows


def step(preset: str, run: Path, variant: str) -> Row:
    """Time and rate of a training step."""
    found = profile_run(mi_nerf.open_target(run), variant)
    label = f"a training step of `{preset}`, {found['queries']:,.0f} queries"
    spread = (found["fastest_ms"], found["slowest_ms"])
    figures = {
        "milliseconds": Figure(found["step_ms"], "ms", spread),
        "rate": Figure(found["gflops"], "GFLOP/s"),
        "share of a plain product": Figure(100 * found["share"], "%"),
    }
    return Row({"what": label}, figures)


def curves(data: Path, out: Path, variant: str, seconds: float) -> list[Row]:
    """Quality after shares of a minute."""
    models = rows_of(["fast", "nerf"], {}, [])
    models = {
        name: replace(config, max_seconds=seconds, downscale=2) for name, config in models.items()
    }
    record = training_curves(data, out, models, variant, seeds=1, split="val", views=10)
    protocol = Protocol("lego_200", "val", 10, SIZE)
    rows = []
    for entry in record["rows"]:
        looks = {look["look"]: look["psnr"] for look in entry["runs"][0]["curve"]}
        figures = {name: Figure(looks[k], "dB") for k, name in LOOKS.items() if k in looks}
        rows.append(Row({"preset": entry["name"]}, figures, protocol, (0,)))
    return rows


def _knobs(counts: tuple[int, ...], *, both: bool = False) -> Knobs:
    rules: Any = ("constant", "linear") if both else ("constant",)
    return Knobs(samples=counts, rules=rules, splits=(), stops=(), resolutions=(), thresholds=())


def _sorted(record: dict[str, Any]) -> list[dict[str, Any]]:
    return sorted(record["points"], key=lambda point: point["samples"])


def _time(point: dict[str, Any]) -> Figure:
    return Figure(point["milliseconds"], "ms", (point["fastest"], point["slowest"]))


if __name__ == "__main__":
    main()
