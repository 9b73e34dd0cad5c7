"""Tables and plots about fields and trainings: ``mi-nerf report``.

Speed against error of a field that is there::

    from mi_nerf.report import Knobs, choose, open_subject, plot_speed, sweep

    subject = open_subject("runs/lego", variant)      # or a field file, or "shell"
    record = sweep(subject, Knobs(samples=(32, 64, 128)))
    plot_speed(record)                                 # a matplotlib figure
    choose(record, milliseconds=20)                    # the most exact point within 20 ms
    conclusions(record)                                # sentences

Quality against seconds of training::

    rows = rows_of(["nerf", "fast"], {"network.width": ["32", "64"]}, ["max_seconds=30"])
    record = training_curves("lego/", "out/", rows, variant, seeds=2)
    plot_curves(record)
    training_conclusions(record)

``load("report/")`` reads what ``mi-nerf report`` has written.
"""

from .curves import rows_of, training_curves
from .curves_text import conclusions as training_conclusions
from .curves_text import plot_curves
from .run import load, report, report_training
from .speed import Knobs, pareto_front, sweep
from .speed_plot import plot_speed
from .speed_text import choose, conclusions, describe
from .subject import Subject, open_subject

__all__ = [
    "Knobs",
    "Subject",
    "choose",
    "conclusions",
    "describe",
    "load",
    "open_subject",
    "pareto_front",
    "plot_curves",
    "plot_speed",
    "report",
    "report_training",
    "rows_of",
    "sweep",
    "training_conclusions",
    "training_curves",
]
