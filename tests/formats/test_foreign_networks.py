"""Networks from elsewhere: that they mean here what they mean there, and what is refused."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_nerf import load_field
from mi_nerf.cli import main
from mi_nerf.fields.neural import NeuralField
from mi_nerf.formats.field_file import FieldFile, save_field
from mi_nerf.formats.foreign_networks import ImportSettings, import_network
from mi_nerf.tasks.describe import describe
from tests.support.arrays import unit, vectors
from tests.support.checkpoints import WRITERS, Pickler, Raw, State, Transposed, write_old, write_zip
from tests.support.fields import scene_dict

Arrays = dict[str, Any]
Refused = Callable[..., str]

ORIGINAL = ("network_fn_state_dict", "network_fine_state_dict")
FLEXIBLE = ("model_coarse_state_dict", "model_fine_state_dict")


# --------------------------------------------------------------------------
#   The two codes, in NumPy
# --------------------------------------------------------------------------


def random_layers(shapes: dict[str, tuple[int, int]], seed: int = 0) -> Arrays:
    """Weights and biases of (outputs, inputs) layers."""
    rng = np.random.default_rng(seed)
    arrays = {}
    for name, (outputs, inputs) in shapes.items():
        weight = rng.normal(0, np.sqrt(2 / max(inputs, 1)), (outputs, inputs))
        arrays[f"{name}.weight"] = weight.astype(np.float32)
        arrays[f"{name}.bias"] = rng.normal(0, 0.3, outputs).astype(np.float32)
    return arrays


def features(octaves: int, identity: bool = True) -> int:
    return 6 * octaves + 3 * identity


def original(
    depth: int = 3,
    width: int = 16,
    skip: int | None = 0,
    octaves: tuple[int, int] = (4, 2),
    identity: bool = True,
    directions: bool = True,
    seed: int = 0,
) -> Arrays:
    """A network of the original code's port; ``skip`` as it counts."""
    position, direction = (features(n, identity) for n in octaves)
    shapes = {"pts_linears.0": (width, position)}
    for i in range(1, depth):
        shapes[f"pts_linears.{i}"] = (width, width + position * (skip == i - 1))
    if directions:
        shapes["views_linears.0"] = (width // 2, width + direction)
        shapes["feature_linear"] = (width, width)
        shapes["alpha_linear"] = (1, width)
        shapes["rgb_linear"] = (3, width // 2)
    else:
        shapes["views_linears.0"] = (width // 2, width)  # there, but unused
        shapes["output_linear"] = (5, width)
    return random_layers(shapes, seed)


def flexible(
    layers: int = 4,
    width: int = 16,
    skip: int = 4,
    octaves: tuple[int, int] = (4, 2),
    identity: bool = True,
    directions: bool = True,
    seed: int = 0,
) -> Arrays:
    """A network of the flexible model; ``skip`` is its ``skip_connect_every``."""
    position, direction = (features(n, identity) for n in octaves)
    shapes = {"layer1": (width, position)}
    for i in range(layers - 1):
        again = i > 0 and i % skip == 0
        shapes[f"layers_xyz.{i}"] = (width, width + position * again)
    if directions:
        shapes["layers_dir.0"] = (width // 2, width + direction)
        shapes |= {"fc_alpha": (1, width), "fc_rgb": (3, width // 2), "fc_feat": (width, width)}
    else:
        shapes["fc_out"] = (4, width)
    return random_layers(shapes, seed)


def relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)


def encode(v: np.ndarray, size: int, factor: float) -> np.ndarray:
    """``size`` features of (N, 3) vectors."""
    octaves, identity = divmod(size, 6)
    parts = [v] if identity else []
    for k in range(octaves):
        parts += [np.sin(factor * 2.0**k * v), np.cos(factor * 2.0**k * v)]
    return np.concatenate(parts, axis=1)


def linear(state: Arrays, name: str, x: np.ndarray) -> np.ndarray:
    weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
    weight = weight.array if isinstance(weight, Transposed) else weight
    return x @ weight.T.astype(float) + bias.astype(float)


def activate(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density (N,) and colour (3, N) from columns r, g, b, σ."""
    return relu(raw[:, 3]), 1 / (1 + np.exp(-raw[:, :3].T))


def original_forward(
    state: Arrays, p: np.ndarray, d: np.ndarray, factor: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    first = state["pts_linears.0.weight"]
    width, size = first.shape
    x = encode(p, size, factor)
    h, i = x, 0
    while f"pts_linears.{i}.weight" in state:
        if h.shape[1] != state[f"pts_linears.{i}.weight"].shape[1]:
            h = np.concatenate([x, h], axis=1)  # position first
        h = relu(linear(state, f"pts_linears.{i}", h))
        i += 1
    if "output_linear.weight" in state:
        return activate(linear(state, "output_linear", h))
    size = state["views_linears.0.weight"].shape[1] - width
    feature = linear(state, "feature_linear", h)
    v = np.concatenate([feature, encode(d, size, factor)], axis=1)
    v = relu(linear(state, "views_linears.0", v))
    heads = [linear(state, "rgb_linear", v), linear(state, "alpha_linear", h)]
    return activate(np.concatenate(heads, axis=1))


def flexible_forward(
    state: Arrays, p: np.ndarray, d: np.ndarray, factor: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    width, size = state["layer1.weight"].shape
    x = encode(p, size, factor)
    h, i = linear(state, "layer1", x), 0  # not rectified
    while f"layers_xyz.{i}.weight" in state:
        if h.shape[1] != state[f"layers_xyz.{i}.weight"].shape[1]:
            h = np.concatenate([h, x], axis=1)  # position last
        h = relu(linear(state, f"layers_xyz.{i}", h))
        i += 1
    if "fc_out.weight" in state:
        return activate(linear(state, "fc_out", h))
    size = state["layers_dir.0.weight"].shape[1] - width
    feature = relu(linear(state, "fc_feat", h))  # rectified
    v = np.concatenate([feature, encode(d, size, factor)], axis=1)
    v = relu(linear(state, "layers_dir.0", v))
    heads = [linear(state, "fc_rgb", v), linear(state, "fc_alpha", h)]
    return activate(np.concatenate(heads, axis=1))


def content(keys: tuple[str, str], fine: Any, coarse: Any = None) -> dict[str, Any]:
    """A checkpoint with what such codes save besides."""
    networks = {keys[0]: fine if coarse is None else coarse, keys[1]: fine}
    state = {0: {"step": 3, "exp_avg": np.ones((2, 3), np.float32)}}
    groups = [{"lr": 5e-4, "betas": (0.9, 0.999), "amsgrad": False, "params": [0, 1]}]
    optimizer = {"state": state, "param_groups": groups}
    return {"global_step": 7, **networks, "optimizer_state_dict": optimizer, "psnr": 21.5}


def compare(ad: Any, contents: FieldFile, forward: Any, state: Arrays, factor: float = 1.0) -> None:
    """The field in single precision against a forward pass in double precision."""
    rng = np.random.default_rng(3)
    p = rng.uniform(-1.5, 1.5, (200, 3)).astype(np.float32)
    d = unit(rng.normal(size=(200, 3))).astype(np.float32)
    field = NeuralField(contents.config, contents.weights, ad.TensorXf)
    density, color = field.density_emission(vectors(ad, p), vectors(ad, d))
    expected_density, expected_color = forward(state, p.astype(float), d.astype(float), factor)
    assert expected_density.any() and np.ptp(expected_color) > 0.1
    assert np.array(density) == pytest.approx(expected_density, rel=1e-4, abs=1e-4)
    assert np.array([np.array(c) for c in color]) == pytest.approx(expected_color, abs=1e-4)


# --------------------------------------------------------------------------
#   Values
# --------------------------------------------------------------------------


@pytest.mark.parametrize("format", WRITERS)
@pytest.mark.parametrize(
    ("keys", "state", "forward"),
    [
        (ORIGINAL, original(8, 32, 4, (10, 4)), original_forward),
        (ORIGINAL, original(directions=False), original_forward),
        (FLEXIBLE, flexible(4, 32, 4, (10, 4)), flexible_forward),
        (FLEXIBLE, flexible(8, 32, 4), flexible_forward),
        (FLEXIBLE, flexible(directions=False), flexible_forward),
    ],
    ids=["original", "original-output", "flexible", "flexible-skip", "flexible-output"],
)
def test_same_density_and_colour(
    ad: Any, tmp_path: Path, format: str, keys: tuple[str, str], state: Arrays, forward: Any
) -> None:
    path = WRITERS[format](tmp_path / "c.ckpt", content(keys, State(state)))
    compare(ad, import_network(path, ImportSettings()), forward, state)


@pytest.mark.slow
@settings(max_examples=15)
@given(
    depth=st.integers(1, 6),
    width=st.integers(2, 20),
    skip=st.integers(0, 5),
    octaves=st.tuples(st.integers(1, 6), st.integers(1, 4)),
    identity=st.booleans(),
    seed=st.integers(0, 99),
)
def test_any_original_architecture(
    ad: Any,
    tmp_path_factory: pytest.TempPathFactory,
    depth: int,
    width: int,
    skip: int,
    octaves: tuple[int, int],
    identity: bool,
    seed: int,
) -> None:
    state = original(depth, width, skip, octaves, identity, seed=seed)
    contents = import_network(save(tmp_path_factory, ORIGINAL, state), ImportSettings())
    network = contents.config.network
    assert (network.depth, network.width) == (depth, width)
    assert network.skip == (skip + 1 if skip + 1 < depth else -1)
    assert contents.config.position.frequencies == octaves[0]
    assert contents.config.direction.frequencies == octaves[1]
    assert contents.config.position.include_input == identity
    same_values(ad, contents, original_forward, state)


@pytest.mark.slow
@settings(max_examples=15)
@given(
    layers=st.integers(2, 6),
    width=st.integers(2, 20),
    skip=st.integers(3, 5),
    octaves=st.tuples(st.integers(1, 6), st.integers(1, 4)),
    identity=st.booleans(),
    seed=st.integers(0, 99),
)
def test_any_flexible_architecture(
    ad: Any,
    tmp_path_factory: pytest.TempPathFactory,
    layers: int,
    width: int,
    skip: int,
    octaves: tuple[int, int],
    identity: bool,
    seed: int,
) -> None:
    state = flexible(layers, width, skip, octaves, identity, seed=seed)
    contents = import_network(save(tmp_path_factory, FLEXIBLE, state), ImportSettings())
    network = contents.config.network
    assert (network.depth, network.width) == (layers - 1, width)  # layer1 is multiplied in
    assert network.skip == (skip if skip < layers - 1 else -1)
    same_values(ad, contents, flexible_forward, state)


def save(factory: pytest.TempPathFactory, keys: tuple[str, str], state: Arrays) -> Path:
    return write_zip(factory.mktemp("checkpoint") / "c.ckpt", content(keys, State(state)))


def same_values(ad: Any, contents: FieldFile, forward: Any, state: Arrays) -> None:
    """As ``compare``, for networks that may well be dead."""
    rng = np.random.default_rng(3)
    p, d = rng.uniform(-1.5, 1.5, (20, 3)), unit(rng.normal(size=(20, 3)))
    field = NeuralField(contents.config, contents.weights, ad.TensorXf64)
    density, color = field.density_emission(vectors(ad, p, "64"), vectors(ad, d, "64"))
    expected_density, expected_color = forward(state, p, d)
    assert np.array(density) == pytest.approx(expected_density, rel=1e-5, abs=1e-5)
    assert np.array([np.array(c) for c in color]) == pytest.approx(expected_color, abs=1e-5)


@pytest.mark.parametrize(("convention", "factor"), [("pi", np.pi), ("two_pi", 2 * np.pi)])
def test_other_frequencies(ad: Any, tmp_path: Path, convention: Any, factor: float) -> None:
    state = original()
    path = write_zip(tmp_path / "c.ckpt", content(ORIGINAL, State(state)))
    contents = import_network(path, ImportSettings(convention=convention))
    compare(ad, contents, original_forward, state, factor)


@pytest.mark.parametrize("format", WRITERS)
def test_tensors_of_other_types_and_orders(ad: Any, tmp_path: Path, format: str) -> None:
    state = original()
    state["pts_linears.0.weight"] = state["pts_linears.0.weight"].astype(np.float64)
    state["rgb_linear.bias"] = state["rgb_linear.bias"].astype(np.float16)
    stored = {**state, "feature_linear.weight": Transposed(state["feature_linear.weight"])}
    # As torch.nn.DataParallel names them.
    stored = {f"module.{name}": value for name, value in stored.items()}
    path = WRITERS[format](tmp_path / "c.ckpt", content(ORIGINAL, State(stored)))
    compare(ad, import_network(path, ImportSettings()), original_forward, state)


def test_fine_is_the_default(tmp_path: Path) -> None:
    fine, coarse = original(seed=1), original(seed=2)
    path = write_zip(tmp_path / "c.ckpt", content(ORIGINAL, State(fine), State(coarse)))

    def bias(settings: ImportSettings) -> np.ndarray:
        return import_network(path, settings).weights["trunk_0.bias"]

    assert np.array_equal(bias(ImportSettings()), fine["pts_linears.0.bias"])
    assert np.array_equal(bias(ImportSettings("fine")), fine["pts_linears.0.bias"])
    assert np.array_equal(bias(ImportSettings("coarse")), coarse["pts_linears.0.bias"])
    path = write_zip(tmp_path / "c.ckpt", {FLEXIBLE[0]: State(flexible()), FLEXIBLE[1]: None})
    assert import_network(path, ImportSettings()).provenance["state_dict"] == FLEXIBLE[0]


def test_the_coarse_network_places_samples(tmp_path: Path) -> None:
    fine, coarse = original(seed=1), original(seed=2)
    path = write_zip(tmp_path / "c.ckpt", content(ORIGINAL, State(fine), State(coarse)))
    both = import_network(path, ImportSettings())
    assert both.coarse is not None
    assert np.array_equal(both.coarse["trunk_0.bias"], coarse["pts_linears.0.bias"])
    assert (both.march.samples, both.march.fine) == (64, 128)
    told = import_network(path, ImportSettings(samples=32, fine=16)).march
    assert (told.samples, told.fine) == (32, 16)
    for only in ("fine", "coarse"):
        one = import_network(path, ImportSettings(only))
        assert one.coarse is None and (one.march.samples, one.march.fine) == (256, 0)
    other = original(1, 4)  # of another architecture: of no use to this field
    path = write_zip(tmp_path / "d.ckpt", content(ORIGINAL, State(fine), State(other)))
    one = import_network(path, ImportSettings())
    assert one.coarse is None and (one.march.samples, one.march.fine) == (256, 0)
    out = tmp_path / "field.safetensors"
    save_field(out, both)
    again = load_field(out)
    assert again.coarse is not None and again.march == both.march
    for name, array in both.coarse.items():
        assert np.array_equal(again.coarse[name], array)


def test_against_pytorch(ad: Any, tmp_path: Path) -> None:
    """Files that PyTorch wrote, and its own sums; where it is installed."""
    torch = pytest.importorskip("torch")
    state = original()
    tensors = State({name: torch.from_numpy(array) for name, array in state.items()})
    path = tmp_path / "c.ckpt"
    for zipped in (True, False):
        torch.save(content(ORIGINAL, tensors), path, _use_new_zipfile_serialization=zipped)
        compare(ad, import_network(path, ImportSettings()), original_forward, state)


# --------------------------------------------------------------------------
#   The command
# --------------------------------------------------------------------------


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """A small checkpoint that a test may change."""
    return write_zip(tmp_path / "c.ckpt", content(ORIGINAL, State(original())))


def test_command(checkpoint: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = checkpoint.parent / "new" / "field.safetensors"
    box = ["--box", "-1", "-2", "-3", "1", "2", "3.5"]
    assert main(["import", str(checkpoint), "-o", str(out), "--samples", "99", *box]) == 0
    printed = capsys.readouterr().out
    assert str(out) in printed and "network_fine_state_dict, 3x16 with 4 octaves" in printed
    contents = load_field(out)
    assert (contents.config.lower, contents.config.upper) == ((-1, -2, -3), (1, 2, 3.5))
    assert contents.march.samples == 99
    assert contents.config.density_activation == "relu" and contents.config.color_space == "srgb"
    assert contents.occupancy is None
    assert contents.provenance["imported_from"] == "c.ckpt"
    assert "convention one" in describe(out)
    assert main(["import", str(checkpoint), "-o", str(out), "--network", "coarse"]) == 0
    assert load_field(out).provenance["state_dict"] == ORIGINAL[0]


def test_empty_space_is_found(tmp_path: Path) -> None:
    """A network whose density is relu(x − 0.5): the half of the box beyond is dense."""
    state = {name: np.zeros_like(array) for name, array in original(1, 4).items()}
    state["pts_linears.0.weight"][0, 0] = 1
    state["alpha_linear.weight"][0, 0] = 1
    state["alpha_linear.bias"][0] = -0.5
    path = write_zip(tmp_path / "c.ckpt", content(ORIGINAL, State(state)))
    out = tmp_path / "field.safetensors"
    assert main(["import", str(path), "-o", str(out), "--occupancy", "12"]) == 0
    cells = load_field(out).occupancy
    assert cells is not None and cells.shape == (12, 12, 12)
    assert cells[9:].all() and not cells[:6].any()  # 0.75 and more; up to 0


@pytest.mark.slow
def test_renders_in_mitsuba(checkpoint: Path) -> None:
    import mitsuba as mi

    from mi_nerf.base.variants import available_variants

    out = checkpoint.parent / "field.safetensors"
    assert main(["import", str(checkpoint), "-o", str(out), "--samples", "16"]) == 0
    mi.set_variant(available_variants()[0])
    image = np.array(mi.render(mi.load_dict(scene_dict(out))))
    assert np.isfinite(image).all() and image[..., 3].max() > 0.1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--box 0 0 0 1 1 0", "--box 0 0 0 1 1 0: expected three minima, then three larger"),
        ("--box 0 0 0 1 1 nan", "--box 0 0 0 1 1 nan: expected three minima"),
        ("--samples 0", "--samples 0: expected a number above 0"),
        ("--occupancy 0", "--occupancy 0: expected 1 to 512 cells"),
        ("--network both", "both"),
        ("--convention three", "three"),
    ],
)
def test_bad_options(checkpoint: Path, refused: Refused, options: str, said: str) -> None:
    out = checkpoint.parent / "field.safetensors"
    assert said in refused("import", checkpoint, "-o", out, *options.split())


def test_bad_output(checkpoint: Path, refused: Refused) -> None:
    folder = checkpoint.parent
    assert "expected an output file .safetensors" in refused("import", checkpoint, "-o", checkpoint)
    (folder / "a.safetensors").mkdir()
    assert "this is a folder" in refused("import", checkpoint, "-o", folder / "a.safetensors")


# --------------------------------------------------------------------------
#   What is refused
# --------------------------------------------------------------------------


def import_refused(refused: Refused, path: Path) -> str:
    message = refused("import", path, "-o", path.parent / "field.safetensors")
    assert str(path) in message
    return message


class Evil:
    """Calls the given function when it is unpickled."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_nothing_in_a_pickle_is_run(tmp_path: Path, refused: Refused, protocol: int) -> None:
    trace = tmp_path / "trace"
    for evil in (Evil(os.mkdir, str(trace)), Evil(eval, f"open({str(trace)!r}, 'w')")):
        path = tmp_path / "c.ckpt"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("archive/data.pkl", pickle.dumps({"x": evil}, protocol))
        message = import_refused(refused, path)
        assert "refused as a checkpoint: its pickle" in message
        assert not trace.exists()


@pytest.mark.parametrize("format", WRITERS)
@pytest.mark.parametrize(
    ("value", "said"),
    [
        (b"cposix\nsystem\n(X\x02\x00\x00\x00ls\x85tR", "asks for posix.system"),
        (b"cbuiltins\neval\n", "asks for builtins.eval"),
        (b"ctorch\nload\n", "asks for torch.load"),
        (b"ccollections\nOrderedDict.__init__\n", "asks for collections.OrderedDict.__init__"),
        (b"(iposix\nsystem\n", "the instruction INST"),
        (b"\x82\x01", "the instruction EXT1"),
        (b"ccollections\nOrderedDict\n)\x81", "the instruction NEWOBJ"),
        (b"K\x01)R", "calls something that is no function"),
        (b"ctorch\nFloatStorage\n)R", "calls torch.FloatStorage"),
        (b"ccollections\nOrderedDict\n}b", "fills something that is no dictionary"),
        (b"}])K\x01s", "fills something that is no dictionary"),
        (b"})K\x01s", "a key that is neither text nor number"),
        (b")K\x01a", "fills something that is no list"),
        (b"K\x01Q", "damaged"),
        (b"(K\x01K\x01K\x01K\x01K\x01tQ", "describes a storage wrongly"),
        (b"h\x07", "damaged"),
        (b"u", "damaged"),
        (b"\xff", "damaged"),
    ],
)
def test_pickles_that_ask_for_more(
    tmp_path: Path, refused: Refused, format: str, value: bytes, said: str
) -> None:
    path = WRITERS[format](tmp_path / "c.ckpt", {"x": Raw(value)})
    message = import_refused(refused, path)
    assert "refused as a checkpoint" in message and said in message


@pytest.mark.parametrize(
    ("offset", "shape", "strides", "said"),
    [
        (0, (3, 2), (2, 1), "reaches beyond its 4 numbers"),
        (1, (4,), (1,), "reaches beyond its 4 numbers"),
        (0, (2,), (9,), "reaches beyond its 4 numbers"),
        (0, (1 << 30, 1 << 30), (0, 0), "reaches beyond its 4 numbers"),
        (0, (-1,), (1,), "describes a tensor wrongly"),
        (-1, (2,), (1,), "describes a tensor wrongly"),
        (0, (2,), (1, 1), "describes a tensor wrongly"),
        (0, (2,), 1, "damaged"),
    ],
)
def test_views_beyond_their_storage(
    tmp_path: Path, refused: Refused, offset: Any, shape: Any, strides: Any, said: str
) -> None:
    kind = Raw(b"ctorch\nFloatStorage\n")
    storage = Raw(Pickler().write(("storage", kind, "100", "cpu", 4)) + b"Q")
    arguments = Pickler().write((storage, offset, shape, strides))
    tensor = Raw(b"ctorch._utils\n_rebuild_tensor_v2\n" + arguments + b"R")
    path = write_zip(tmp_path / "c.ckpt", {"x": tensor})
    assert said in import_refused(refused, path)


@pytest.mark.parametrize("format", WRITERS)
def test_cut_off_anywhere(tmp_path: Path, refused: Refused, format: str) -> None:
    path = WRITERS[format](tmp_path / "c.ckpt", content(FLEXIBLE, State(flexible(2, 2))))
    whole = path.read_bytes()
    for size in np.linspace(0, len(whole) - 1, 25).astype(int):
        path.write_bytes(whole[:size])
        import_refused(refused, path)


@settings(max_examples=60)
@given(where=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255))
def test_any_damaged_byte(
    tmp_path_factory: pytest.TempPathFactory, where: float, value: int
) -> None:
    """It is refused in one line, or nothing that matters was damaged."""
    from mi_nerf.base.errors import InputError

    path = tmp_path_factory.mktemp("damaged") / "c.ckpt"
    data = bytearray(write_old(path, content(FLEXIBLE, State(flexible(2, 2)))).read_bytes())
    data[int(where * len(data))] = value
    path.write_bytes(data)
    try:
        import_network(path, ImportSettings())
    except InputError as error:
        assert str(path) in str(error)


def test_files_that_are_no_checkpoints(tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / "c.ckpt"
    assert "not found, expected a PyTorch checkpoint" in import_refused(refused, path)
    path.write_text("hello")
    assert "not a checkpoint of PyTorch, or cut off" in import_refused(refused, path)
    path.write_bytes(pickle.dumps({"a": 1}))
    assert "not a checkpoint of PyTorch" in import_refused(refused, path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme", "hello")
    assert "without the one data.pkl" in import_refused(refused, path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02}.")
    assert "it is compressed" in import_refused(refused, path)
    write_zip(path, {"a": 1}, byteorder=b"big")
    assert "big-endian" in import_refused(refused, path)
    write_zip(path, [1, 2])
    assert "holds no dictionary" in import_refused(refused, path)
    write_zip(path, {"a": 1, "b": 2})
    message = import_refused(refused, path)
    assert "holds a, b, expected network_fn_state_dict or model_coarse_state_dict" in message


def test_missing_storage(checkpoint: Path, refused: Refused) -> None:
    with zipfile.ZipFile(checkpoint) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(checkpoint, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data[: len(data) // 2] if "data/" in name else data)
    assert "bytes, expected" in import_refused(refused, checkpoint)


def changed(state: Arrays, **changes: Any) -> State:
    """Replaces tensors (``__`` for dots); ``None`` takes them away."""
    result = {**state, **{name.replace("__", "."): value for name, value in changes.items()}}
    return State({name: value for name, value in result.items() if value is not None})


def zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.float32)


@pytest.mark.parametrize(
    ("keys", "state", "said"),
    [
        (ORIGINAL, State(), "tensor 'pts_linears.0.weight' is missing"),
        (ORIGINAL, changed(original(), pts_linears__1__bias=None), "'pts_linears.1.bias' is miss"),
        (ORIGINAL, changed(original(), rgb_linear__weight=None), "'rgb_linear.weight' is missing"),
        (ORIGINAL, changed(original(), extra__weight=zeros(2, 2)), "unexpected tensor 'extra.wei"),
        (ORIGINAL, changed(original(), pts_linears__1__weight=None), "unexpected tensor 'pts_line"),
        (
            ORIGINAL,
            changed(original(), pts_linears__2__weight=zeros(16, 17)),
            "'pts_linears.2' has",
        ),
        (
            ORIGINAL,
            changed(original(), pts_linears__2__weight=zeros(16, 43)),
            "'pts_linears.1' and 'pts_linears.2' both see the position again",
        ),
        (
            ORIGINAL,
            changed(original(skip=None), pts_linears__0__weight=zeros(16, 28)),
            "28 features of a position, expected 6 an octave, or 3 more",
        ),
        (ORIGINAL, original(skip=None, octaves=(25, 2)), "frequencies=25, expected 0 to 24"),
        (ORIGINAL, changed(original(), views_linears__0__weight=zeros(8, 20)), "of a direction"),
        (ORIGINAL, changed(original(), views_linears__0__weight=zeros(8, 9)), "'views_linears.0'"),
        (ORIGINAL, changed(original(), alpha_linear__weight=zeros(2, 16)), "'alpha_linear' has"),
        (ORIGINAL, changed(original(), alpha_linear__bias=zeros(1, 1)), "expected (outputs, inp"),
        (ORIGINAL, changed(original(), alpha_linear__bias=3), "'alpha_linear.bias' is no tensor"),
        (
            ORIGINAL,
            changed(original(), alpha_linear__bias=np.zeros(1, np.int64)),
            "'alpha_linear.bias' holds int64 numbers, expected finite ones",
        ),
        (
            ORIGINAL,
            changed(original(), alpha_linear__bias=np.full(1, np.nan, np.float32)),
            "'alpha_linear.bias' holds infinite or undefined numbers",
        ),
        (
            ORIGINAL,
            changed(
                original(directions=False),
                output_linear__weight=zeros(6, 16),
                output_linear__bias=zeros(6),
            ),
            "'output_linear' has 6 outputs, expected 4 or 5",
        ),
        (ORIGINAL, [1], "holds no tensors, expected a state dict"),
        (FLEXIBLE, flexible(1), "'layers_xyz.0.weight' is missing"),
        (FLEXIBLE, changed(flexible(), layers_xyz__0__weight=zeros(16, 9)), "expected 16 and 16"),
        (FLEXIBLE, changed(flexible(), layer1__weight=None), "'layer1.weight' is missing"),
        (FLEXIBLE, flexible(9, skip=3), "'layers_xyz.3' and 'layers_xyz.6' both see"),
    ],
)
def test_networks_that_do_not_fit(
    tmp_path: Path, refused: Refused, keys: tuple[str, str], state: Any, said: str
) -> None:
    path = write_zip(tmp_path / "c.ckpt", content(keys, state))
    message = import_refused(refused, path)
    assert f"{path}: {keys[1]}: " in message and said in message


def test_network_that_is_not_there(tmp_path: Path, refused: Refused) -> None:
    path = write_zip(tmp_path / "c.ckpt", {FLEXIBLE[0]: State(flexible()), FLEXIBLE[1]: None})
    message = refused("import", path, "-o", tmp_path / "f.safetensors", "--network", "fine")
    assert "holds no fine network, expected --network coarse" in message


# --------------------------------------------------------------------------
#   A network that someone else has trained
# --------------------------------------------------------------------------


@pytest.mark.data
@pytest.mark.skipif("MI_NERF_DATA" not in os.environ, reason="needs MI_NERF_DATA")
def test_published_checkpoint_shows_its_scene(tmp_path: Path) -> None:
    from mi_nerf.base.variants import choose_variant
    from mi_nerf.tasks.evaluate import evaluate
    from mi_nerf.tasks.target import open_target

    data = Path(os.environ["MI_NERF_DATA"])
    checkpoint = data / "checkpoints" / "nerf-pytorch_lego-lowres.ckpt"
    out = tmp_path / "field.safetensors"
    assert main(["import", str(checkpoint), "-o", str(out), "--occupancy", "32"]) == 0
    record = evaluate(
        open_target(out),
        choose_variant(),
        data=data / "lego_200",
        split="val",
        downscale=4,
        views=2,
    )
    assert record["mean"]["psnr"] > 23
