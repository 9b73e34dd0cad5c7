"""What curves of training say, in words, a table and a figure."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from ..base.machine import machine_line
from ..tasks.tables import markdown_table, number, spread, time_axis

Record = dict[str, Any]


def conclusions(record: Record) -> list[str]:
    """What follows, a sentence or two each, computed from the record alone."""
    rows = sorted((r for r in record["rows"] if r["psnr"] is not None), key=lambda r: -r["psnr"])
    if not rows:
        return ["No run has come to an end."]
    first, *others = rows
    values = _endings(first)
    seeds = f"{len(values)} seeds, {spread(values)}" if len(values) > 1 else "1 seed"
    result = [
        f"`{first['name']}` comes to the best end: {first['psnr']:.2f} dB after "
        f"{first['seconds']:.0f} s ({seeds})."
    ]
    for other in others:
        passed = seconds_to(first["curve"], other["psnr"])
        when = "" if passed is None else f", and passes that after {passed:.0f} s"
        result.append(
            f"It ends {first['psnr'] - other['psnr']:.2f} dB above `{other['name']}` "
            f"({other['psnr']:.2f} dB after {other['seconds']:.0f} s){when}."
        )
    for row in rows:
        if len(row["curve"]) > 1:
            before, last = row["curve"][-2:]
            gain = last["psnr"] - before["psnr"]
            result.append(
                f"The last {last['seconds'] - before['seconds']:.0f} s of `{row['name']}` bought "
                f"{gain:+.2f} dB."
            )
    if failures := sum(row["failures"] for row in record["rows"]):
        result.append(f"{failures} runs failed and are left out of the means.")
    return result


def seconds_to(curve: list[Record], psnr: float) -> float | None:
    """When a curve first reaches a PSNR, between looks linear in the logarithm of time."""
    for before, after in zip([None, *curve], curve, strict=False):
        if after["psnr"] >= psnr:
            if before is None or before["psnr"] >= psnr:
                return float(after["seconds"])
            share = (psnr - before["psnr"]) / (after["psnr"] - before["psnr"])
            ratio = after["seconds"] / before["seconds"]
            return float(before["seconds"] * math.exp(share * math.log(ratio)))
    return None


def markdown(record: Record, figure: str) -> list[str]:
    """``report.md`` of a record of :func:`mi_nerf.report.training_curves`."""
    settings = record["settings"]
    lines = [f"# Training on {settings['data']}", ""]
    lines += [f"- {sentence}" for sentence in conclusions(record)]
    if not record["complete"]:
        lines += ["", "**Interrupted**: the same command goes on."]
    lines += [
        "",
        f"![PSNR against seconds of training]({figure})",
        "",
        f"PSNR is the mean of {settings['views']} views of the split {settings['split']} by the "
        "nerf2020 protocol. The clock of training stands still while they are rendered; it "
        f"includes reading the images and compiling. {machine_line(record['machine'])}.",
        "",
        *_table(record),
        "",
        "Seconds, dB of each look (mean of the seeds):",
        "",
    ]
    for row in record["rows"]:
        points = "; ".join(f"{p['seconds']:.1f} s {p['psnr']:.2f}" for p in row["curve"])
        lines.append(f"- `{row['name']}`: {points or 'none'}")
    return lines


def _table(record: Record) -> list[str]:
    head = "model|PSNR (dB)|range|SSIM|train (s)|steps|queries/ray|parameters|failures"
    rows = []
    for row in record["rows"]:
        steps = [run["steps"] for run in row["runs"] if run["failed"] is None]
        cells = [
            f"`{row['name']}`",
            number(row["psnr"], ".2f"),
            spread(_endings(row)),
            number(row["ssim"], ".4f"),
            number(row["seconds"], ".0f"),
            spread(sorted(set(steps)), "d") or "".join(map(str, steps[:1])),
            number(row["queries_per_ray"], ".1f"),
            number(row["parameters"], ",.0f"),
            f"{row['failures']} of {row['seeds']}",
        ]
        rows.append(cells)
    return markdown_table(head.split("|"), rows)


def _endings(row: Record) -> list[float]:
    """The PSNR of every seed at the end, where it is a number."""
    last = [
        run["curve"][-1]["psnr"] for run in row["runs"] if run["failed"] is None and run["curve"]
    ]
    return [value for value in last if value is not None]


def plot_curves(record: Record) -> Any:
    """A matplotlib figure of a record of :func:`mi_nerf.report.training_curves`.

    Lines are means of the seeds, bands reach from the worst to the best one.
    """
    from matplotlib.figure import Figure

    settings = record["settings"]
    figure = Figure(figsize=(8.5, 5.2), layout="constrained")
    axes = figure.subplots()
    for k, row in enumerate(r for r in record["rows"] if r["curve"]):
        x, y, least, greatest = (
            [p[key] for p in row["curve"]] for key in ("seconds", "psnr", "least", "greatest")
        )
        color, count = f"C{k}", row["seeds"] - row["failures"]
        seeds = f"{count} seed{'s' if count > 1 else ''}"
        axes.plot(x, y, "o-", color=color, ms=4, label=f"{row['name']} ({seeds})")
        axes.fill_between(x, least, greatest, color=color, alpha=0.2, lw=0)
        place: dict[str, Any] = {"xytext": (6, -3), "textcoords": "offset points"}
        axes.annotate(f"{y[-1]:.2f}", (x[-1], y[-1]), color=color, fontsize=9, **place)
    time_axis(axes, "seconds of training, compilation included")
    axes.margins(x=0.08)
    axes.set_ylabel(f"PSNR of {settings['views']} held-out views (dB)")
    axes.legend(fontsize=9)
    axes.set_title(
        f"{Path(settings['data']).name}: quality against time of training. Lines: mean of the "
        f"seeds, bands: worst to best.\n{machine_line(record['machine'])}",
        fontsize=9,
    )
    return figure
