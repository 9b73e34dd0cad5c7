"""A picture of a plan: the scene from above and from the side, with all cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..base.files import replacing
from .plan import Plan, View
from .viewpoints import horizontal_axes

Array = np.ndarray[Any, Any]

PICTURE = "cameras.png"

_COLORS = {"train": "#1b6ca8", "val": "#4c9f50", "test": "#c8553d"}
_POINTS = 20_000  # of surfaces that are drawn
_FRUSTUM = 0.12  # length of drawn cameras, per half width of the picture
_BEYOND = 1.3  # how far the picture reaches past cameras and object


def draw(plan: Plan, path: Path) -> None:
    """Writes the picture to a PNG file."""
    figure = plan_figure(plan)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100)


def plan_figure(plan: Plan) -> Any:
    """A matplotlib figure of a plan: from above and from the side, in scene units."""
    from matplotlib.figure import Figure

    up = np.array(plan.up)
    side, front = horizontal_axes(up)
    figure = Figure(figsize=(13, 7.2), layout="constrained")
    half = _half_width(plan)
    for axes, (across, along, title) in zip(
        figure.subplots(1, 2),
        ((side, front, "from above"), (side, up, "from the side")),
        strict=True,
    ):
        plane = np.stack([across, along])
        _surfaces(axes, plan, plane)
        for split, color in _COLORS.items():
            _cameras(axes, plan.of_split(split), plane, _FRUSTUM * half, color)
        middle = plane @ _middle(plan)
        axes.set_xlim(middle[0] - half, middle[0] + half)
        axes.set_ylim(middle[1] - half, middle[1] + half)
        axes.set_aspect("equal")
        axes.set_title(title)
        axes.set_xlabel(_direction(across))
        axes.set_ylabel(_direction(along))
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles), markerscale=4)
    figure.suptitle("\n".join(line[:150] for line in str(plan).splitlines()), fontsize=9)
    return figure


def _middle(plan: Plan) -> Array:
    """What is in the middle of the picture."""
    return np.asarray(_seen_box(plan).mean(axis=0))


def _half_width(plan: Plan) -> float:
    return _BEYOND * float(np.ptp(_seen_box(plan), axis=0).max()) / 2


def _seen_box(plan: Plan) -> Array:
    """The box of the cameras and the object, (2, 3); what surrounds it may reach beyond."""
    places = np.array([view.pose[:3, 3] for view in plan.views])
    points = np.concatenate([places, np.array(plan.subject.box)])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _surfaces(axes: Any, plan: Plan, plane: Array) -> None:
    """Points that the cameras see, the lowest first: those above hide those below."""
    survey = plan.survey
    step = max(1, len(survey.points) // _POINTS)
    points, of_object = survey.points[::step], survey.of_object[::step]
    toward = np.cross(plane[0], plane[1])
    order = np.argsort(points @ toward)
    for what, chosen, color in (
        ("surroundings", ~of_object, "#b8b8b8"),
        ("object", of_object, "#444444"),
    ):
        if chosen.any():
            x, y = plane @ points[order][chosen[order]].T
            axes.scatter(x, y, s=1.0, c=color, linewidths=0, label=what, rasterized=True)


def _cameras(axes: Any, views: list[View], plane: Array, length: float, color: str) -> None:
    """A dot where a camera stands, and a line along which it looks."""
    if not views:
        return
    places = np.array([view.pose[:3, 3] for view in views])
    ahead = -np.array([view.pose[:3, 2] for view in views])
    start, end = places @ plane.T, (places + length * ahead) @ plane.T
    lines = np.stack([start, end, np.full_like(start, np.nan)], axis=1).reshape(-1, 2)
    axes.plot(lines[:, 0], lines[:, 1], color=color, linewidth=0.7, alpha=0.8)
    label = f"{len(views)} {views[0].split}"
    axes.scatter(start[:, 0], start[:, 1], s=9, c=color, linewidths=0, label=label, zorder=3)


def _direction(axis: Array) -> str:
    """The name of an axis of the picture: x, -z, or a direction."""
    best = int(np.argmax(np.abs(axis)))
    if abs(axis[best]) > 1 - 1e-6:
        return ("-" if axis[best] < 0 else "") + "xyz"[best]
    return "(" + ", ".join(f"{value:.2f}" for value in axis) + ")"
