"""The toy blocks of the scene diffuse/arches: a small set of shapes, and the building."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_ply
from solids import Solid, arc, box, extrude, fragment, mesh, step, wedge

DEPTH = 0.2  # Blocks are this deep; their sizes are multiples of 0.1
BEVEL = 0.014
FLOOR = -0.62  # The top of the plinth
DECK = FLOOR + 0.58  # The top of the first storey
Block = tuple[str, str, tuple[float, float, float], float]


def arch(width: float, height: float, radius: float) -> Solid:
    """A block that stands on two feet, with a round opening of this radius."""
    half = width / 2
    opening = arc(radius, 180, 0, 13)
    outside = [[half, 0], [half, height], [-half, height], [-half, 0]]
    return extrude(np.vstack([opening, outside]), DEPTH, BEVEL)


def bow(outer: float, inner: float) -> Solid:
    """Half a ring, standing."""
    profile = np.vstack([arc(outer, 0, 180, 17), arc(inner, 180, 0, 13)])
    return extrude(profile, DEPTH, BEVEL)


def roof(width: float, height: float) -> Solid:
    """A triangular prism."""
    return extrude(np.array([[-width / 2, 0], [width / 2, 0], [0, height]]), DEPTH, BEVEL)


def half_disc(radius: float) -> Solid:
    """Half a disc, standing on its flat side."""
    return extrude(arc(radius, 0, 180, 15), DEPTH, BEVEL)


def turned(profile: Array) -> Solid:
    """A quarter of a turned block."""
    return wedge(np.asarray(profile, float), 4, 9)[0]


def library() -> dict[str, Solid]:
    """All shapes of the set; those named turned_* are quarters."""
    b = BEVEL
    return {
        "cube": box((0.2, DEPTH, 0.2), b),
        "brick": box((0.4, DEPTH, 0.2), b),
        "plank": box((0.8, DEPTH, 0.08), b),
        "arch": arch(0.4, 0.3, 0.12),
        "gate": arch(0.8, 0.5, 0.28),
        "bow_large": bow(0.4, 0.28),
        "bow_middle": bow(0.27, 0.16),
        "bow_small": bow(0.15, 0.07),
        "roof": roof(0.44, 0.22),
        "half_disc": half_disc(0.2),
        "turned_pillar": turned(
            [[0, 0], [0.09 - b, 0], [0.09, b], [0.09, 0.4 - b], [0.09 - b, 0.4], [0, 0.4]]
        ),
        "turned_cone": turned([[0, 0], [0.13 - b, 0], [0.13, b], [0.012, 0.34], [0, 0.345]]),
        "turned_plinth": turned(
            [[0, 0], [0.9, 0], [0.92, 0.02], [0.92, 0.08], [0.9, 0.1], [0, 0.1]]
        ),
    }


def building() -> list[Block]:
    """Every block: its shape, its colour, where it stands (its foot) and its turn."""
    top, attic = DECK + 0.3, DECK + 0.6
    return [
        ("turned_plinth", "cream", (0, 0, FLOOR - 0.1), 0),
        # The first storey: three gates and a colonnade around a court, and its deck.
        ("gate", "coral", (0, -0.3, FLOOR), 0),
        ("gate", "teal", (0, 0.3, FLOOR), 0),
        ("gate", "mustard", (-0.5, 0, FLOOR), 90),
        ("turned_pillar", "cream", (0.5, -0.3, FLOOR), 0),
        ("turned_pillar", "rose", (0.5, 0, FLOOR), 0),
        ("turned_pillar", "cream", (0.5, 0.3, FLOOR), 0),
        ("plank", "navy", (0.5, 0, FLOOR + 0.4), 90),
        ("plank", "cream", (0, -0.3, FLOOR + 0.5), 0),
        ("plank", "rose", (0, -0.1, FLOOR + 0.5), 0),
        ("plank", "cream", (0, 0.1, FLOOR + 0.5), 0),
        ("plank", "sage", (0, 0.3, FLOOR + 0.5), 0),
        ("plank", "navy", (-0.5, 0, FLOOR + 0.5), 90),
        # On the deck: the rainbow in front, the tower behind, a turret and a ridge.
        ("bow_large", "coral", (-0.0, -0.3, DECK), 0),
        ("bow_middle", "mustard", (-0.0, -0.3, DECK), 0),
        ("bow_small", "teal", (-0.0, -0.3, DECK), 0),
        ("arch", "sage", (0.1, 0.1, DECK), 0),
        ("arch", "navy", (0.1, 0.3, DECK), 0),
        ("arch", "rose", (0.0, 0.2, top), 90),
        ("arch", "cream", (0.2, 0.2, top), 90),
        ("roof", "coral", (0.1, 0.1, attic), 0),
        ("roof", "teal", (0.1, 0.3, attic), 0),
        ("turned_pillar", "cream", (-0.5, -0.22, DECK), 0),
        ("turned_cone", "teal", (-0.5, -0.22, DECK + 0.4), 0),
        ("cube", "rose", (-0.5, 0.1, DECK), 4),
        ("half_disc", "coral", (-0.5, 0.1, DECK + 0.2), 90),
        ("half_disc", "mustard", (0.5, -0.14, FLOOR + 0.48), 90),
        ("cube", "coral", (0.5, 0.27, FLOOR + 0.48), -6),
        ("turned_cone", "navy", (0.5, 0.27, FLOOR + 0.68), 0),
        # On the ground: steps, trees and what was left over.
        ("plank", "cream", (0.0, -0.52, FLOOR), 0),
        ("turned_cone", "sage", (-0.5, -0.56, FLOOR), 0),
        ("turned_cone", "sage", (0.22, 0.62, FLOOR), 0),
        ("turned_cone", "teal", (-0.02, 0.68, FLOOR), 0),
        ("arch", "navy", (0.56, -0.52, FLOOR), 38),
        ("roof", "rose", (0.56, -0.52, FLOOR + 0.3), 38),
        ("cube", "mustard", (-0.72, 0.34, FLOOR), 31),
        ("brick", "coral", (-0.45, 0.6, FLOOR), 24),
        ("roof", "cream", (-0.45, 0.6, FLOOR + 0.2), 24),
        ("cube", "rose", (0.76, 0.22, FLOOR), 18),
        ("cube", "teal", (-0.73, -0.16, FLOOR + 0.2), 12),
        ("brick", "sage", (-0.74, -0.2, FLOOR), 82),
    ]


def lines(shapes: dict[str, Solid]) -> list[str]:
    """The XML of the building."""
    out = []
    for number, (name, colour, place, turn) in enumerate(building()):
        lift = 0.0 if name.startswith("turned") else -float(shapes[name].vertices[:, 2].min())
        x, y, z = place
        for part in range(4 if name.startswith("turned") else 1):
            steps = [step("rotate", z=1, angle=turn + 90 * part)]
            steps.append(step("translate", x=x, y=y, z=z + lift))
            label = f"{name}_{number}" + (f"_{part}" if name.startswith("turned") else "")
            out.append(mesh(f"arches_{name}.ply", label, steps, colour))
    return out


def main() -> None:
    folder, shapes = output_folder(), library()
    for name, solid in shapes.items():
        path = folder / f"arches_{name}.ply"
        write_ply(path, solid.vertices, solid.faces, normals=solid.normals)
    text = fragment(lines(shapes), "Made by arches.py: the building of diffuse/arches.xml.")
    (folder / "arches_blocks.xml").write_text(text)


if __name__ == "__main__":
    main()
