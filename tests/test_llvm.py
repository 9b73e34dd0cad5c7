"""The search for LLVM, in folders made up for the test, and the startup file that runs it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from mi_nerf import _llvm
from mi_nerf.base import variants
from mi_nerf.base.errors import InputError

CHECKOUT = Path(__file__).parents[1]
LINE = (CHECKOUT / "mi_nerf" / "_startup.pth").read_text()

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the search is for Linux")


def elf_header(machine=None, kind=3):
    """The first 20 bytes of an ELF file for this machine."""
    if machine is None:
        machine = _llvm.ELF_MACHINES.get(os.uname().machine, 0)
    ident = b"\x7fELF\x02\x01\x01" + bytes(9)
    return ident + kind.to_bytes(2, "little") + machine.to_bytes(2, "little")


def add(folder, name, content=None):
    """Makes a library in the folder and returns its path as text."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(elf_header() if content is None else content)
    return str(folder / name)


def add_carried(folder, name):
    """Makes a library with its completed link, as karellen-llvm-core has them."""
    path = add(folder, name)
    (folder / "libLLVM.so").symlink_to(name)
    return path


@pytest.fixture
def system(tmp_path, monkeypatch):
    """An empty system folder, the only one that is searched besides ``carried``."""
    monkeypatch.delenv(_llvm.VARIABLE, raising=False)
    monkeypatch.delenv("LD_LIBRARY_PATH", raising=False)
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    monkeypatch.setattr(_llvm, "SYSTEM_FOLDERS", (f"{tmp_path}/usr/lib/*-linux-gnu",))
    monkeypatch.setattr(_llvm, "_carried_folders", lambda: [str(tmp_path / "prefix" / "lib")])
    return tmp_path / "usr" / "lib" / "x86_64-linux-gnu"


@pytest.fixture
def carried(tmp_path):
    return tmp_path / "prefix" / "lib"


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-19.so", (19,)),
        ("libLLVM-15.so.1", (15,)),
        ("libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("libLLVM.so.19.1", (19, 1)),
        ("libLLVM.so.23.1", (23, 1)),
        ("libLLVM.so", None),
        ("libLLVM-19", None),
        ("libLLVM-19git.so", None),
        ("libLLVM-17-rust-1.75.0-stable.so", None),
        ("libLLVM.so.19.1-rust-1.84.0-stable", None),
        ("libLLVMCore.so.19", None),
        ("libLTO.so.19.1", None),
    ],
)
def test_version_comes_from_the_name(name, version):
    assert _llvm._version(name) == version


def test_the_variable_wins(system, monkeypatch):
    add(system, "libLLVM.so.19.1")
    monkeypatch.setenv(_llvm.VARIABLE, "/chosen/by/the/user.so")
    assert _llvm.find_llvm() == "/chosen/by/the/user.so"
    _llvm.ensure_llvm()
    assert os.environ[_llvm.VARIABLE] == "/chosen/by/the/user.so"


@pytest.mark.parametrize("before", [None, ""])
def test_ensure_sets_a_variable_that_is_unset_or_empty(system, monkeypatch, before):
    path = add(system, "libLLVM.so.19.1")
    if before is not None:
        monkeypatch.setenv(_llvm.VARIABLE, before)
    _llvm.ensure_llvm()
    assert os.environ.pop(_llvm.VARIABLE) == path


def test_without_llvm_nothing_is_found_or_set(system):
    assert _llvm.find_llvm() is None
    _llvm.ensure_llvm()
    assert _llvm.VARIABLE not in os.environ


@pytest.mark.parametrize(
    ("versions", "best"),
    [
        ((15, 16, 17), 17),
        ((15, 16), 16),
        ((14,), None),
        ((18, 21), 21),
        ((18, 19, 22), 19),  # tested before newer
        ((19, 23), 23),
        ((17, 99), 17),  # newer than any tested
        ((16, 99), 99),
    ],
)
def test_order_within_the_system(system, versions, best):
    paths = {version: add(system, f"libLLVM-{version}.so.1") for version in versions}
    assert _llvm.find_llvm() == paths.get(best)


@pytest.mark.parametrize(
    ("version", "system_wins"), [(14, False), (16, False), (17, True), (19, True), (99, False)]
)
def test_a_sound_system_library_comes_before_the_carried_one(system, carried, version, system_wins):
    of_system = add(system, f"libLLVM-{version}.so.1")
    of_package = add_carried(carried, "libLLVM.so.23.1")
    assert _llvm.find_llvm() == (of_system if system_wins else of_package)


def test_a_carried_library_without_its_links_is_not_used(carried, system):
    add(carried, "libLLVM.so.23.1")
    assert _llvm.find_llvm() is None


def test_a_link_without_version_is_followed(system):
    path = add(system / "elsewhere", "libLLVM.so.19.1")
    (system / "libLLVM.so").symlink_to(path)
    assert _llvm.find_llvm() == path


@pytest.mark.parametrize(
    "content",
    [b"", b"INPUT(-lLLVM-19)\n", elf_header(machine=8), elf_header(kind=2)],
    ids=["empty", "linker script", "other machine", "executable"],
)
def test_what_cannot_be_loaded_is_passed_over(system, content):
    add(system, "libLLVM-23.so", content)
    (system / "libLLVM-22.so").symlink_to("missing")
    path = add(system, "libLLVM-18.so")
    assert _llvm.find_llvm() == path


def test_folders_of_the_environment_are_searched(system, tmp_path, monkeypatch):
    conda = add(tmp_path / "conda" / "lib", "libLLVM.so.19.1")
    monkeypatch.setenv("CONDA_PREFIX", str(tmp_path / "conda"))
    assert _llvm.find_llvm() == conda
    module = add(tmp_path / "module", "libLLVM.so.19.1")
    monkeypatch.setenv("LD_LIBRARY_PATH", f"{tmp_path / 'missing'}::{tmp_path / 'module'}")
    assert _llvm.find_llvm() == module


def test_patterns_match_parts_of_paths(tmp_path):
    for name in ("llvm-19/lib", "llvm-20/lib", "llvm-x", "other/lib"):
        (tmp_path / name).mkdir(parents=True)
    assert _llvm._expand(f"{tmp_path}/llvm-*/lib") == [
        f"{tmp_path}/{name}/lib" for name in ("llvm-19", "llvm-20", "llvm-x")
    ]
    assert _llvm._expand(f"{tmp_path}/missing/*") == []


def test_carried_folders_of_each_kind_of_installation(monkeypatch):
    def folders(site):
        monkeypatch.setattr(_llvm, "__file__", f"{site}/mi_nerf/_llvm.py")
        return _llvm._carried_folders()

    monkeypatch.setattr(sys, "prefix", "/venv")
    assert set(folders("/venv/lib/python3.12/site-packages")) == {"/venv/lib"}
    assert "/home/me/.local/lib" in folders("/home/me/.local/lib/python3.12/site-packages")
    assert folders("/home/me/src/checkout") == ["/venv/lib"]  # nothing around it


# ---- The startup file -------------------------------------------------------------------------


@pytest.fixture
def site(tmp_path):
    """A folder like site-packages: the startup file, the module it runs, and a fake Dr.Jit."""
    folder = tmp_path / "lib" / "python3" / "site-packages"
    package = folder / "mi_nerf"
    package.mkdir(parents=True)
    (folder / "mi_nerf.pth").write_text(LINE)
    (folder / "drjit.py").write_text(f"import os; path = os.environ.get({_llvm.VARIABLE!r})")
    (package / "__init__.py").write_text("raise RuntimeError('the package was imported')")
    shutil.copy(_llvm.__file__, package)
    return folder


def start(site, code, **variables):
    """What the code prints, as :func:`run` runs it; it says nothing else."""
    found, errors = run(site, code, **variables)
    assert errors == ""
    return found


def run(site, code, **variables):
    """Runs code in a new interpreter that has only ``site`` besides the standard library."""
    done = subprocess.run(
        [sys.executable, "-S", "-c", f"import site; site.addsitedir({str(site)!r}); {code}"],
        env=without_choice() | variables,
        cwd=site.parent,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def without_choice():
    """This process's variables, without a choice of LLVM."""
    return {name: value for name, value in os.environ.items() if name != _llvm.VARIABLE}


def test_startup_file_is_one_line_that_site_executes():
    assert LINE.startswith("import ")
    assert LINE.count("\n") == 1 and LINE.endswith("\n")


def test_startup_chooses_llvm_when_drjit_is_imported(site, tmp_path):
    path = add(tmp_path / "module", "libLLVM-23.so")
    code = (
        "import os, sys; print(os.environ.get('DRJIT_LIBLLVM_PATH')); import drjit; "
        "print(drjit.path); print('mi_nerf' in sys.modules)"
    )
    assert start(site, code, LD_LIBRARY_PATH=str(tmp_path / "module")).split() == [
        "None",
        path,
        "False",
    ]


def test_startup_leaves_a_chosen_llvm_alone(site):
    chosen = {_llvm.VARIABLE: "/chosen.so"}
    assert start(site, "import drjit; print(drjit.path)", **chosen) == "/chosen.so"


@pytest.mark.parametrize(
    ("content", "said"),
    [("1 / 0", "ZeroDivisionError"), ("syntax error", "SyntaxError"), (None, "FileNotFoundError")],
)
def test_a_failing_startup_says_so_and_lets_drjit_start(site, content, said):
    file = site / "mi_nerf" / "_llvm.py"
    if content is None:
        file.unlink()
    else:
        file.write_text(content)
    found, errors = run(site, "import drjit; print(drjit.path)")
    assert found == "None"
    assert "RuntimeWarning: mi_nerf.pth found no LLVM for Dr.Jit: " + said in errors
    assert "Traceback" not in errors
    # Who has chosen a library has switched it off.
    assert start(site, "import drjit; print(drjit.path)", **{_llvm.VARIABLE: "/x.so"}) == "/x.so"


def test_a_startup_file_without_its_package_does_nothing(site):
    shutil.rmtree(site / "mi_nerf")
    assert start(site, "import drjit; print(drjit.path)") == "None"


def test_startup_makes_mitsubas_llvm_variants_work(tmp_path, monkeypatch):
    monkeypatch.delenv(_llvm.VARIABLE, raising=False)
    path = _llvm.find_llvm()
    if path is None:
        pytest.skip("no LLVM on this machine")
    (tmp_path / "mi_nerf.pth").write_text(LINE)
    code = (
        f"import os, site; site.addsitedir({str(tmp_path)!r}); import mitsuba as mi; "
        "mi.set_variant('llvm_ad_rgb'); print(mi.Float(1) + 1, os.environ['DRJIT_LIBLLVM_PATH'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=without_choice() | {"PYTHONPATH": str(CHECKOUT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, f"[2] {path}\n"), done.stderr


# ---- Other systems ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "machine", "brought"),
    [
        ("linux", "x86_64", True),
        ("linux", "aarch64", False),
        ("darwin", "arm64", False),
        ("darwin", "x86_64", False),
        ("win32", "AMD64", False),
    ],
)
def test_only_linux_on_x86_64_brings_an_llvm(system, machine, brought):
    """The wheel exists nowhere else: elsewhere the package must install without it."""
    listed = re.search(
        r"^dependencies = \[\n(.*?)^\]", (CHECKOUT / "pyproject.toml").read_text(), re.S | re.M
    )[1]
    environment = {"sys_platform": system, "platform_machine": machine, "python_version": "3.12"}
    wanted = [
        requirement.name
        for requirement in map(Requirement, re.findall(r'^    "([^"]*)"', listed, re.M))
        if requirement.marker is None or requirement.marker.evaluate(environment)
    ]
    assert ("karellen-llvm-core" in wanted) == brought
    assert {"mitsuba", "drjit", "numpy"} < set(wanted)


@pytest.mark.parametrize(
    ("system", "example"),
    [("darwin", "libLLVM.dylib"), ("win32", "LLVM-C.dll"), ("linux", "libLLVM.so.19.1")],
)
def test_without_llvm_one_sentence_says_what_to_point_at(monkeypatch, system, example):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(variants, "_works", lambda name: False)
    for requested, said in ((None, "no usable backend"), ("llvm_ad_rgb", "no usable backend")):
        with pytest.raises(InputError, match=said) as caught:
            variants.choose_variant(requested)
        sentence = str(caught.value)
        assert _llvm.VARIABLE in sentence and example in sentence and "\n" not in sentence
    # With a GPU beside it, who asks for LLVM is still told.
    monkeypatch.setattr(variants, "_works", lambda name: name.startswith("cuda"))
    assert variants.choose_variant() == "cuda_ad_rgb"
    with pytest.raises(InputError, match=f"'llvm_ad_rgb': does not work.*{_llvm.VARIABLE}"):
        variants.choose_variant("llvm_ad_rgb")


@pytest.mark.slow
def test_the_command_without_llvm(tmp_path):
    """In a process that has none: Dr.Jit is pointed at a library that is not there."""
    code = (
        "import sys; from mi_nerf.cli import main; import drjit as dr; "
        "assert not dr.has_backend(dr.JitBackend.LLVM); sys.exit(main(sys.argv[1:]))"
    )
    (tmp_path / "field.safetensors").write_bytes(b"")
    arguments = ["render", "shell", "-o", "out.png", "--variant", "llvm_ad_rgb"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=without_choice() | {_llvm.VARIABLE: "/missing.so", "PYTHONPATH": str(CHECKOUT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    said = [line for line in done.stderr.splitlines() if line.startswith("mi-nerf: ")]
    assert done.returncode == 2 and len(said) == 1, done.stderr
    assert "no usable backend" in said[0] and _llvm.VARIABLE in said[0]
