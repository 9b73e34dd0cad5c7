"""The chessmen and the board of the scene diffuse/pieces."""

from __future__ import annotations

import numpy as np
from geometry import Array, output_folder, write_ply
from solids import Solid, arc, box, extrude, fragment, mesh, moved, spline, step, wedge

PARTS, STEPS = 8, 3
SQUARE, FLOOR = 0.36, -0.54  # Side of a square, and its height
Place = tuple[str, str, float, float, float]


def base(radius: float) -> list[tuple[float, float]]:
    """The foot that all pieces share."""
    r = radius
    points = [(0.0, 0.0), (r - 0.012, 0.0), (r, 0.012), (r, 0.05), (r - 0.012, 0.065)]
    return [*points, (r - 0.028, 0.068), (r - 0.022, 0.09), (r - 0.035, 0.115)]


def turned(radius: float, *curves: list[tuple[float, float]]) -> Array:
    """A profile of the foot and smooth curves above it, with an edge between two."""
    return np.vstack([base(radius), *(spline(curve, 2) for curve in curves)])


def profiles() -> dict[str, Array]:
    """The turned pieces."""
    stem = [(0.12, 0.12), (0.085, 0.22), (0.062, 0.4), (0.058, 0.56), (0.075, 0.66)]
    collar = [(0.12, 0.67), (0.127, 0.685), (0.12, 0.7)]
    waist = [(0.078, 0.71), (0.097, 0.735), (0.07, 0.765)]
    cup = [(0.07, 0.765), (0.082, 0.85), (0.12, 0.97)]
    low = [(0.12, 0.12), (0.08, 0.2), (0.06, 0.32), (0.062, 0.42)]
    knob = arc(0.105, -52, 90, 8) + [0.0, 0.55]
    knob[-1, 0] = 0.0
    return {
        "king": np.vstack(
            [turned(0.18, stem, collar, waist, cup), [[0.115, 0.985], [0.07, 1.02], [0, 1.03]]]
        ),
        "queen": np.vstack(
            [
                turned(0.175, stem, collar, waist, cup[:2] + [(0.13, 0.93)]),
                [[0.11, 0.925], [0.07, 0.94], [0.03, 0.97], [0, 0.975]],
            ]
        ),
        "bishop": turned(
            0.16,
            [(r * 0.92, z * 0.86) for r, z in stem],
            [(0.105, 0.58), (0.112, 0.593), (0.105, 0.605)],
            [(0.062, 0.612), (0.09, 0.66), (0.1, 0.7), (0.085, 0.77), (0.045, 0.84), (0.0, 0.865)],
        ),
        "rook": np.vstack(
            [
                turned(0.17, [(0.135, 0.12), (0.105, 0.25), (0.095, 0.4), (0.11, 0.5)]),
                [[0.135, 0.515], [0.143, 0.525], [0.143, 0.6], [0.1, 0.6], [0.1, 0.57], [0, 0.57]],
            ]
        ),
        "pawn": np.vstack([turned(0.145, low), [[0.1, 0.43], [0.108, 0.442], [0.1, 0.455]], knob]),
        "stand": np.vstack([base(0.17), [[0.125, 0.13], [0, 0.135]]]),
    }


def horse() -> Solid:
    """The head of the knight, looking along -x."""
    back = [(0.11, 0.12), (0.14, 0.24), (0.132, 0.38), (0.095, 0.51), (0.045, 0.6), (0.005, 0.67)]
    face = [(-0.035, 0.625), (-0.085, 0.575), (-0.135, 0.49), (-0.19, 0.41), (-0.2, 0.37)]
    jaw = [(-0.175, 0.335), (-0.125, 0.345), (-0.075, 0.38), (-0.03, 0.37)]
    chest = [(-0.045, 0.3), (-0.1, 0.2), (-0.115, 0.12)]
    outline = [spline(curve, 2) for curve in (back, face, jaw, chest)]
    return extrude(np.vstack(outline), 0.16, 0.02)


def merlons() -> Solid:
    """One battlement of the rook."""
    return moved(box((0.045, 0.085, 0.075), 0.008), (0.121, 0.0, 0.625))


def men() -> list[Place]:
    """Every piece: its kind, its colour, its square and its turn."""
    return [
        ("king", "ivory", 0, 3, 20),
        ("rook", "ivory", 3, 1, 15),
        ("bishop", "ivory", 0, 1, 0),
        ("knight", "ivory", 1.02, 0, 60),
        ("pawn", "ivory", 2.03, 1.98, 0),
        ("pawn", "ivory", 1, 2, 0),
        ("king", "oxblood", 3.02, 3, -30),
        ("queen", "oxblood", 1.97, 3.02, 0),
        ("knight", "oxblood", 2, 0.97, 200),
        ("pawn", "oxblood", 3, 2, 0),
        ("pawn", "oxblood", 0, 0.02, 0),
    ]


def piece(number: int, place: Place) -> list[str]:
    """The XML of a piece."""
    kind, colour, column, row, turn = place
    x, y = (column - 1.5) * SQUARE, (row - 1.5) * SQUARE
    move = step("translate", x=x, y=y, z=FLOOR)
    name, out = f"{kind}_{number}", []

    def add(file: str, label: str, angle: float) -> None:
        steps = [step("rotate", z=1, angle=angle), move]
        out.append(mesh(f"pieces_{file}.ply", f"{name}_{label}", steps, colour))

    for part in range(PARTS):
        add("stand" if kind == "knight" else kind, str(part), turn + part * 360 / PARTS)
    if kind == "knight":
        add("horse", "head", turn)
    if kind == "king":
        add("cross_post", "post", turn)
        add("cross_arm", "arm", turn)
    for part in range(6 if kind == "rook" else 0):
        add("merlon", f"merlon_{part}", turn + part * 60)
    return out


def squares() -> list[str]:
    """The XML of the squares of the board."""
    out = []
    for column in range(4):
        for row in range(4):
            tone = "maple" if (column + row) % 2 else "walnut"
            shade = f"{tone}_{(column * 3 + row * 5) % 3}"
            x, y = (column - 1.5) * SQUARE, (row - 1.5) * SQUARE
            move = step("translate", x=x, y=y, z=FLOOR - 0.02)
            out.append(mesh("pieces_square.ply", f"square_{column}_{row}", [move], shade))
    return out


def main() -> None:
    folder = output_folder()
    solids = {name: wedge(profile, PARTS, STEPS)[0] for name, profile in profiles().items()}
    solids["horse"] = horse()
    solids["merlon"] = merlons()
    solids["cross_post"] = moved(box((0.035, 0.035, 0.14), 0.007), (0, 0, 1.09))
    solids["cross_arm"] = moved(box((0.11, 0.034, 0.035), 0.007), (0, 0, 1.1))
    solids["square"] = box((SQUARE - 0.006, SQUARE - 0.006, 0.04), 0.006)
    solids["frame"] = box((4 * SQUARE + 0.16, 4 * SQUARE + 0.16, 0.1), 0.02)
    for name, solid in solids.items():
        path = folder / f"pieces_{name}.ply"
        write_ply(path, solid.vertices, solid.faces, normals=solid.normals)
    lines = squares()
    for number, place in enumerate(men()):
        lines += piece(number, place)
    text = fragment(lines, "Made by pieces.py: the game of diffuse/pieces.xml.")
    (folder / "pieces_game.xml").write_text(text)


if __name__ == "__main__":
    main()
