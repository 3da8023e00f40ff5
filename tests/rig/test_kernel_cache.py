"""The folder of compiled kernels: nobody else can put a program into it, and it may be moved."""

import os
import pickle
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numba
import pytest

from rollerrig.rig.compiled import kernel_cache

ROOT = Path(__file__).parents[2]
# a module with a kernel, and a program that calls it and prints what it has done
MODULE = """
from rollerrig.rig.compiled.kernel import kernel

@kernel
def doubled(x):
    return x * 2.0
"""
PROGRAM = """
import os, shutil, sys
os.umask(int(sys.argv[1], 8))
from rollerrig.rig.compiled import compile_progress, kernel_cache
import small_kernel
{before_call}
assert small_kernel.doubled(3.0) == 6.0
print("compiled" if compile_progress.has_compiled() else "loaded")
"""
ANOTHER_USER = 12345
needs_root = pytest.mark.skipif(
    os.geteuid() != 0, reason="only root can give a file to another user"
)
by_each_variable = pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", "NUMBA_CACHE_DIR"])


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    """Return a folder with the module `small_kernel`."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "small_kernel.py").write_text(MODULE)
    return folder


def start(modules, cache, before_call="", umask="022", **environment):
    """Run the program with this cache.

    Returns "compiled" or "loaded", and the warning that nothing is kept, "" without one.
    """
    variables = {**os.environ, "XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(modules)}
    # the user who runs the tests may have chosen a cache
    variables.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(before_call=before_call), umask],
        env=variables | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    # a slow machine also announces that it compiles
    warnings = [line for line in done.stderr.splitlines() if "not kept" in line]
    return done.stdout.strip(), "\n".join(warnings)


@pytest.fixture(scope="module")
def filled(modules, tmp_path_factory):
    """Return a cache in which `small_kernel` is compiled, made with no mask of permissions."""
    cache = tmp_path_factory.mktemp("filled") / "cache"
    assert start(modules, cache, umask="000") == ("compiled", "")
    return cache


@pytest.fixture
def cache(filled, tmp_path, monkeypatch):
    """Return a copy of the filled cache, which this process would choose."""
    copy = tmp_path / "cache"
    shutil.copytree(filled, copy)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(copy))
    return copy


def folder_of_kernels(cache):
    """Return the folder of the present sources."""
    (folder,) = (cache / "rollerrig").glob("kernels-*")
    return folder


def modes(folder):
    """Return the modes of a folder and of everything in it."""
    return {path.stat().st_mode & 0o777 for path in (folder, *folder.rglob("*"))}


# --- who may write ---


class Planted:
    """An object that writes a file when it is read."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@pytest.fixture
def mark(cache, tmp_path):
    """Return the file that a planted program writes, if a process loads it from the cache."""
    (index,) = cache.rglob("*.nbi")
    mark = tmp_path / "planted program has run"
    index.write_bytes(pickle.dumps(numba.__version__) + pickle.dumps(Planted(mark)))
    return mark


def test_each_level_belongs_to_the_user_alone_also_without_a_mask_of_permissions(filled, modules):
    assert modes(filled) == {0o700, 0o600}
    names = {path.suffix for path in filled.rglob("*") if path.is_file()}
    assert names == {".nbi", ".nbc", ".lock"}
    assert start(modules, filled) == ("loaded", "")


def test_a_program_in_a_cache_that_was_never_open_would_run(mark, modules, cache):
    """Shows that the next test plants what a process loads."""
    with pytest.raises(subprocess.CalledProcessError):
        start(modules, cache)
    assert mark.exists()


def test_a_program_in_a_cache_that_was_open_does_not_run(mark, modules, cache):
    folder_of_kernels(cache).chmod(0o777)
    assert start(modules, cache) == ("compiled", "")
    assert not mark.exists()
    assert modes(cache) == {0o700, 0o600}
    assert start(modules, cache) == ("loaded", "")


LEVELS = {
    "folder of the product": lambda folder: folder.parent,
    "folder of the sources": lambda folder: folder,
    "folder of a module": lambda folder: next(folder.rglob("*.nbi")).parent,
    "index": lambda folder: next(folder.rglob("*.nbi")),
    "code": lambda folder: next(folder.rglob("*.nbc")),
}


@pytest.mark.parametrize("level", LEVELS.values(), ids=LEVELS)
@pytest.mark.parametrize("bit", [0o020, 0o002], ids=["group", "all"])
def test_a_cache_to_which_others_could_write_is_discarded(level, bit, cache):
    place = level(folder_of_kernels(cache))
    place.chmod(place.stat().st_mode | bit)
    assert kernel_cache.choose().folder == folder_of_kernels(cache)
    assert not list(cache.rglob("*.nbi"))
    assert modes(cache) == {0o700}


@needs_root
@pytest.mark.parametrize("level", LEVELS.values(), ids=LEVELS)
def test_a_cache_with_something_of_another_user_in_it_is_not_used(level, cache):
    place = level(folder_of_kernels(cache))
    os.chown(place, ANOTHER_USER, -1)
    chosen = kernel_cache.choose()
    if place == cache / "rollerrig":
        assert chosen == (None, f"{place} belongs to another user")
    else:
        assert not list(cache.rglob("*.nbi"))


def test_a_link_in_the_cache_is_removed_and_not_followed(cache, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    folder = folder_of_kernels(cache)
    folder.rename(elsewhere)
    folder.symlink_to(elsewhere)
    assert kernel_cache.choose().folder == folder
    assert not list(folder.rglob("*.nbi"))
    assert list(elsewhere.rglob("*.nbi"))


@by_each_variable
def test_nothing_is_kept_below_a_folder_that_others_may_write_to(
    variable, cache, tmp_path, monkeypatch
):
    shared = tmp_path / "shared"
    mine = shared / "mine"
    mine.mkdir(parents=True)
    monkeypatch.setenv(variable, str(mine))
    shared.chmod(0o777)
    folder, refusal = kernel_cache.choose()
    assert folder is None
    assert f"chmod go-w {shared}" in refusal
    assert not list(mine.iterdir())
    # as /tmp: each user replaces only what belongs to him
    shared.chmod(0o1777)
    assert kernel_cache.choose().folder.is_relative_to(mine)


@by_each_variable
def test_the_chosen_folder_itself_is_not_used_while_others_may_write_to_it(
    variable, cache, tmp_path, monkeypatch
):
    chosen = tmp_path / "chosen"
    chosen.mkdir()
    monkeypatch.setenv(variable, str(chosen))
    chosen.chmod(0o770)
    folder, refusal = kernel_cache.choose()
    assert folder is None
    assert f"chmod go-w {chosen}" in refusal
    assert not list(chosen.iterdir())
    chosen.chmod(0o700)
    assert kernel_cache.choose().folder.is_relative_to(chosen)


@needs_root
@by_each_variable
def test_nothing_is_kept_in_a_folder_of_another_user(variable, cache, tmp_path, monkeypatch):
    theirs = tmp_path / "theirs"
    (theirs / "mine").mkdir(parents=True)
    monkeypatch.setenv(variable, str(theirs / "mine"))
    os.chown(theirs, ANOTHER_USER, -1)
    assert kernel_cache.choose() == (None, f"{theirs} belongs to another user")
    assert not list((theirs / "mine").iterdir())


def test_a_link_of_the_user_is_followed_to_a_folder_that_is_checked(cache, tmp_path, monkeypatch):
    real = tmp_path / "real"
    real.mkdir()
    link = tmp_path / "link"
    link.symlink_to(real)
    monkeypatch.setenv("XDG_CACHE_HOME", str(link))
    assert kernel_cache.choose().folder.is_relative_to(real)
    real.chmod(0o777)
    assert f"chmod go-w {real}" in kernel_cache.choose().refusal


@needs_root
def test_a_link_of_another_user_is_not_followed(cache, tmp_path, monkeypatch):
    real = tmp_path / "real"
    real.mkdir()
    link = tmp_path / "link"
    link.symlink_to(real)
    os.lchown(link, ANOTHER_USER, -1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(link))
    assert kernel_cache.choose() == (None, f"{link} belongs to another user")
    assert not list(real.iterdir())


def test_a_process_that_keeps_no_kernels_warns_and_states_what_to_change(modules, tmp_path):
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    printed, warning = start(modules, shared)
    assert printed == "compiled"
    assert "each start compiles them again" in warning
    assert f"chmod go-w {shared}" in warning
    assert "XDG_CACHE_HOME" in warning
    assert not list(shared.iterdir())


def test_without_a_folder_for_it_nothing_is_kept(tmp_path, cache, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    folder, refusal = kernel_cache.choose()
    assert folder is None
    assert str(tmp_path / "file") in refusal


def test_a_folder_that_disappears_is_made_again_for_the_user_alone(modules, tmp_path):
    cache = tmp_path / "cache"
    gone = "shutil.rmtree(kernel_cache.folder().parent)"
    assert start(modules, cache, gone, umask="000") == ("compiled", "")
    assert modes(cache) == {0o700, 0o600}
    assert list(cache.rglob("*.nbi"))


def test_a_kernel_that_cannot_be_written_is_used_all_the_same(modules, tmp_path):
    no_folder = "shutil.rmtree(kernel_cache.folder()); kernel_cache.folder().touch()"
    assert start(modules, tmp_path / "cache", no_folder) == ("compiled", "")


# --- what is kept ---


def test_a_kernel_whose_source_has_changed_is_compiled_again(modules, cache):
    module = modules / "small_kernel.py"
    before = module.stat()
    try:
        # a source of the same size, with the same time of change
        module.write_text(MODULE.replace("x * 2.0", "2.0 * x"))
        os.utime(module, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert start(modules, cache) == ("compiled", "")
    finally:
        module.write_text(MODULE)


@pytest.mark.parametrize(
    "name",
    [
        "configs/vehicle.py",  # numbers of axles, the acceleration of free fall
        "firmware_sim/wsp/phases.py",
        "rig/multibody/coordinates.py",
        "wsp_interface/magnets.py",
        "wsp_interface/signals.py",
        "rig/params.py",
        "rig/compiled/kernel.py",  # options of the compiler
        "rig/compiled/generated.py",
        "rig/contact/polach.py",
    ],
)
def test_the_folder_depends_on_each_source_that_is_compiled_into_kernels(name):
    assert kernel_cache.sources()[name] == (ROOT / name).read_bytes()


def test_the_folder_does_not_depend_on_sources_without_effect_on_kernels():
    """Otherwise each change of a report would compile everything again."""
    names = list(kernel_cache.sources())
    assert not [name for name in names if name.startswith(("realtime/reports", "realtime/desk"))]
    assert "rig/compiled/kernel_cache.py" not in names


def test_the_folder_in_use_stays_where_older_ones_are_removed_however_large_it_is(cache):
    # this process uses and locks the folder
    folder = kernel_cache.choose().folder
    with (folder / "kernel.nbc").open("wb") as file:
        file.truncate(2 * kernel_cache.BYTES_KEPT)
    older = folder.with_name("kernels-older")
    older.mkdir()
    os.utime(older, (time.time() - 1000, time.time() - 1000))
    kernel_cache.remove_old(folder.parent)
    assert not older.exists()
    assert (folder / "kernel.nbc").exists()


# --- moved to another place ---


def test_with_a_fixed_processor_a_copy_of_the_folder_needs_no_compiler(modules, tmp_path):
    fixed = {"NUMBA_CPU_NAME": "generic"}
    assert start(modules, tmp_path / "cache", **fixed) == ("compiled", "")
    # a copy as from an image or an archive: all files have other times
    copy = tmp_path / "copy"
    shutil.copytree(tmp_path / "cache", copy, copy_function=shutil.copy)
    for path in (*copy.rglob("*"), modules / "small_kernel.py"):
        os.utime(path, (1e9, 1e9))
    assert start(modules, copy, **fixed) == ("loaded", "")
    # without the setting, and with another one, that code is not for this processor
    assert start(modules, copy) == ("compiled", "")
    assert start(modules, copy, **fixed, NUMBA_CPU_FEATURES="+sse3") == ("compiled", "")


def test_kernels_of_the_product_are_found_wherever_it_is_installed(tmp_path):
    program = (
        "from rollerrig.rig.compiled import compile_progress, kernel_cache\n"
        "from rollerrig.rig.contact import polach\n"
        "polach.eps_per_creepage(6e-3, 6e-3, 4.0, 8e10, 5e4)\n"
        "print(kernel_cache.ROOT, compile_progress.has_compiled())"
    )
    printed = []
    for name in ("first", "second"):
        product = tmp_path / name / "rollerrig"
        for room in ("configs", "firmware_sim", "realtime", "rig", "wsp_interface"):
            shutil.copytree(ROOT / room, product / room)
        environment = {
            "NUMBA_CACHE_DIR": str(tmp_path / "kernels"),
            "PYTHONPATH": str(product.parent),
        }
        done = subprocess.run(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=True,
        )
        printed.append(done.stdout.strip())
    assert printed == [f"{tmp_path}/first/rollerrig True", f"{tmp_path}/second/rollerrig False"]
