"""Files of users are opened, written, unpacked and shown within limits."""

import os
import signal
import socket
import struct
import zipfile
import zlib

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rollerrig.configs import output_files, toml_text, unpacking, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.printable import printable, printable_drawing

TINY = user_files.Kind("a tiny file", 10)


def pipe(path):
    os.mkfifo(path)


def unix_socket(path):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))


def device(path):
    path.symlink_to("/dev/zero")


def folder(path):
    path.mkdir()


def nothing(path):
    pass


def circle(path):
    path.symlink_to(path)


# --- reading ---


@pytest.mark.parametrize(
    ("make", "part"),
    [
        (pipe, "is a pipe, and a tiny file is needed"),
        (unix_socket, "is a socket"),
        (device, "is a device"),
        (folder, "is a folder"),
        (nothing, "no such file; look again"),
        (circle, "cannot be read"),
    ],
)
def test_only_a_regular_file_is_opened(make, part, tmp_path):
    path = tmp_path / "given"
    make(path)
    for read in (user_files.check, user_files.read_bytes, user_files.read_text):
        with pytest.raises(ConfigError) as error:
            read(path, TINY, None, "look again")
        assert str(error.value).startswith(f"{path}: ")
        assert part in str(error.value)


def test_a_path_with_the_character_nul_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="NUL"):
        user_files.read_text(tmp_path / "a\0b", TINY, within=tmp_path)
    with pytest.raises(ConfigError, match="NUL"):
        output_files.write_text(tmp_path / "a\0b", "x")


def test_a_file_above_the_limit_of_its_kind_is_not_read(tmp_path):
    path = tmp_path / "given"
    path.write_text("0123456789")
    assert user_files.read_text(path, TINY) == "0123456789"
    path.write_text("0123456789+")
    with pytest.raises(ConfigError, match=r"has 0\.011 kB; a tiny file may have at most 0\.01 kB"):
        user_files.read_text(path, TINY)


def test_a_file_of_the_kernel_without_a_size_is_not_read_for_ever():
    with pytest.raises(ConfigError, match="more than"):
        user_files.read_text(user_files.Path("/proc/self/maps"), TINY)


@pytest.mark.parametrize("name", ["link", "../outside.txt", "sub/link"])
def test_a_file_of_a_folder_is_read_only_from_this_folder(name, tmp_path):
    inside = tmp_path / "dataset"
    (inside / "sub").mkdir(parents=True)
    (tmp_path / "outside.txt").write_text("secret")
    (inside / "link").symlink_to(tmp_path / "outside.txt")
    (inside / "sub" / "link").symlink_to("../../outside.txt")
    with pytest.raises(ConfigError, match="is outside of its folder") as error:
        user_files.read_text(inside / name, TINY, within=inside)
    assert "copy the file into the folder" in str(error.value)
    assert "secret" not in str(error.value)


def test_a_link_inside_of_the_folder_is_followed_and_the_folder_may_be_a_link(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("a")
    (tmp_path / "real" / "b.txt").symlink_to("a.txt")
    (tmp_path / "dataset").symlink_to("real")
    found = user_files.read_text(tmp_path / "dataset" / "b.txt", TINY, within=tmp_path / "dataset")
    assert found == "a"


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 6000, "{", ""])
def test_a_wrong_json_file_is_refused(text, tmp_path):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(ConfigError, match=r"a\.json: not valid JSON"):
        user_files.read_json(tmp_path / "a.json")


def test_toml_that_would_take_long_to_parse_is_refused_before(tmp_path):
    path = tmp_path / "large.toml"
    path.write_text("".join(f"key_{number} = 1\n" for number in range(100_000)))
    with pytest.raises(ConfigError, match=r"large\.toml: has 1\.\d+ MB; .* at most 1 MB"):
        user_files.read_text(path, user_files.TOML)


# --- writing ---


def test_a_written_file_replaces_a_link_and_leaves_its_target(tmp_path):
    target = tmp_path / "target"
    target.write_text("precious")
    out = tmp_path / "report"
    out.mkdir()
    for name in ("a.json", ".b.json.new", "c.log"):
        (out / name).symlink_to(target)

    output_files.write_text(out / "a.json", "new")
    output_files.write_bytes(out / "b.json", b"new")
    with output_files.create(out / "c.log") as log:
        log.write(b"new")

    assert target.read_text() == "precious"
    for name in ("a.json", "b.json", "c.log"):
        assert (out / name).read_text() == "new"
        assert not (out / name).is_symlink()


@pytest.fixture(params=["files without a name", "no files without a name"])
def file_system(request, monkeypatch):
    """The tests run also as on a file system that gives each file a name; returns whether it is."""
    if request.param.startswith("no"):
        # what a kernel that does not know O_TMPFILE sees
        monkeypatch.setattr(os, "O_TMPFILE", os.O_DIRECTORY)
    return request.param.startswith("no")


def attacked(path, suffix, target):
    """Write a file, while another program puts links to `target` in its folder."""
    with output_files.replaced(path, suffix) as new:
        for name in [*os.listdir(path.parent), path.name, f".{path.name}.new{suffix}"]:
            (path.parent / name).unlink(missing_ok=True)
            (path.parent / name).symlink_to(target)
        # a writer that opens by name, changes its mind, and opens again
        new.write_text("first")
        new.write_text("new")


@pytest.mark.parametrize("suffix", ["", ".png"])
def test_a_link_that_another_user_makes_while_a_file_is_written_leads_nowhere(
    tmp_path, suffix, file_system
):
    target = tmp_path / "target"
    target.write_text("precious")
    out = tmp_path / "shared"
    out.mkdir()
    if file_system:
        with pytest.raises(ConfigError, match=r"report: another program has replaced"):
            attacked(out / "report", suffix, target)
    else:
        attacked(out / "report", suffix, target)
        assert (out / "report").read_text() == "new"
        assert not (out / "report").is_symlink()
    assert target.read_text() == "precious"


def fail_to_write(path):
    with output_files.replaced(path) as new:
        new.write_text("half" * 1000)
        raise ZeroDivisionError


@pytest.mark.usefixtures("file_system")
def test_a_failed_write_leaves_nothing(tmp_path):
    (tmp_path / "report").write_text("old")
    with pytest.raises(ZeroDivisionError):
        fail_to_write(tmp_path / "report")
    assert os.listdir(tmp_path) == ["report"]
    assert (tmp_path / "report").read_text() == "old"


def test_a_killed_write_leaves_nothing(tmp_path):
    try:
        os.close(os.open(tmp_path, os.O_RDWR | os.O_TMPFILE))
    except OSError:
        pytest.skip("this file system has no files without a name")
    process = os.fork()
    if process == 0:
        with output_files.replaced(tmp_path / "report") as new:
            new.write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(process, 0)
    assert os.listdir(tmp_path) == []


def test_a_new_file_has_the_permissions_of_the_umask(tmp_path):
    for umask, permissions in ((0o022, 0o644), (0o077, 0o600)):
        before = os.umask(umask)
        try:
            output_files.write_text(tmp_path / "report", "new")
        finally:
            os.umask(before)
        assert (tmp_path / "report").stat().st_mode & 0o777 == permissions


@pytest.mark.parametrize("make", [pipe, unix_socket, folder])
def test_a_written_file_replaces_no_folder_and_no_pipe(make, tmp_path):
    path = tmp_path / "report.json"
    make(path)
    for write in (output_files.create, lambda path: output_files.write_text(path, "x")):
        with pytest.raises(ConfigError, match="a file cannot replace it"):
            write(path)
    assert not path.is_file()


def test_a_folder_of_results_that_is_a_link_is_refused(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "dataset").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="results are not written through a link"):
        output_files.make_folder(tmp_path / "report", "dataset", "runs")
    assert not list((tmp_path / "elsewhere").iterdir())
    # the folder that the user names may be a link
    (tmp_path / "named").symlink_to("elsewhere")
    assert output_files.make_folder(tmp_path / "named", "runs").is_dir()


# --- TOML ---


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("a = " + "[" * 300 + "]" * 300, "at most 32 deep"),
        ("a = " + "[" * 3000 + "]" * 3000, "at most 32 deep"),
        ("a = " + "{a = " * 400 + "1" + "}" * 400, "at most 32 deep"),
        # the standard library takes minutes for this key
        ("title = 1\n[" + ".".join(["a"] * 500_000) + "]", "line 2: tables, lists and dotted keys"),
        ('b = { "x"' + ". 'y'" * 40 + " = 1 }", "at most 32 deep"),
        ("a = 1\nb = " + "9" * 6000, "line 2: a number has too many digits"),
        ("[t]\na = [1, 9223372036854775808]", "t.a: the number is too large"),
        ("a = 0x" + "f" * 600, "a: the number is too large"),
    ],
)
def test_toml_beyond_the_limits_is_refused(text, part):
    with pytest.raises(ConfigError) as error:
        toml_text.parse(text, "own.toml")
    assert str(error.value).startswith("own.toml")
    assert part in str(error.value)


def test_toml_within_the_limits_is_read():
    text = "a.b.c = [[1, 2], [-9223372036854775808]]\nd = '" + "1." * 100 + "'"
    assert toml_text.parse(text, "") == {
        "a": {"b": {"c": [[1, 2], [-(2**63)]]}},
        "d": "1." * 100,
    }


# --- text ---


def test_hidden_characters_become_visible():
    assert printable("a\x1b[31mb\r\x00\x9b") == "a\\x1b[31mb\\r\\x00\\x9b"
    assert printable("\u202efdp.exe\u2066 \u2028 \ufeff \ud800 \U000e0041") == (
        "\\u202efdp.exe\\u2066 \\u2028 \\ufeff \\ud800 \\U000e0041"
    )
    ordinary = "Zürich 10 µs, 试验\n\tμ = 0,1"
    assert printable(ordinary) == ordinary


def test_the_sequences_of_a_library_that_draws_stay():
    assert printable_drawing("\r\x1b[2K\x1b[1;31mbar\x1b[0m\x1b]0;title\x07") == (
        "\r\x1b[2K\x1b[1;31mbar\x1b[0m\\x1b]0;title\\x07"
    )


# --- unpacking ---


def test_compressed_text_is_unpacked_up_to_a_limit():
    assert unpacking.inflate(zlib.compress(b"a" * 1000), 1000) == b"a" * 1000
    for content in (zlib.compress(b"a" * 1001), zlib.compress(b"a" * 100)[:-5], b"no zlib"):
        with pytest.raises(ValueError, match=r"."):
            unpacking.inflate(content, 1000)
    assert unpacking.inflated_bytes(zlib.compress(bytes(30_000_000)), 1_000_000) < 3_000_000


@pytest.mark.parametrize("name", ["../a", "/etc/a", "a/../../b"])
def test_an_archive_that_leads_out_of_its_folder_is_refused(name, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(name, "x")
    with pytest.raises(ConfigError, match="leads out of the folder"):
        unpacking.check_archive(tmp_path / "a.zip")


def test_an_archive_with_backslashes_is_refused_with_how_to_pack_it(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("binaries\\linux64\\unit.so", "x")
    with pytest.raises(ConfigError, match=r"whose folders are separated by .*; a ZIP archive"):
        unpacking.check_archive(tmp_path / "a.zip")


def test_an_archive_of_too_many_files_is_refused_before_they_are_listed(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for number in range(10_001):
            archive.writestr(str(number), "")
    with pytest.raises(ConfigError, match="10001 files"):
        unpacking.check_archive(tmp_path / "a.zip")

    # the end of an archive declares a list of 100 MB
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, 100_000_000, 0, 0)
    (tmp_path / "b.zip").write_bytes(end)
    with pytest.raises(ConfigError, match="its list of files has 100 MB"):
        unpacking.check_archive(tmp_path / "b.zip")


def test_a_file_in_an_archive_that_is_longer_than_declared_is_not_unpacked(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.xml", b"<a>" + bytes(40_000_000))
    # declare 3 bytes, in the list of files
    content = path.read_bytes()
    content = content.replace(struct.pack("<L", 40_000_003), struct.pack("<L", 3))
    path.write_bytes(content)
    unpacking.check_archive(path)
    with (
        zipfile.ZipFile(path) as archive,
        pytest.raises((ConfigError, zipfile.BadZipFile)),
    ):
        unpacking.read_xml(archive, "a.xml", "a.zip")


@pytest.mark.parametrize(
    ("xml", "part"),
    [
        (b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "document type"),
        (b'<!DOCTYPE a SYSTEM "file:///etc/passwd"><a/>', "document type"),
        (b"<a>" + b"<b/>" * 200_000 + b"</a>", "more than 200000 elements"),
        (b"<a>" * 100, "nested deeper than 64"),
        (b"<a>" + b" " * 32_000_000, "more than 32 MB"),
        (b"<a>", "cannot be read"),
        (b"<?xml version='1.0' encoding='utf-7'?><a/>", "cannot be read"),
    ],
)
def test_xml_beyond_the_limits_is_refused(xml, part):
    with pytest.raises(ConfigError) as error:
        unpacking.check_xml(xml, "a.fmu: modelDescription.xml")
    assert str(error.value).startswith("a.fmu: modelDescription.xml ")
    assert part in str(error.value)


def test_a_parquet_file_that_repeats_a_few_values_is_refused(tmp_path):
    path = tmp_path / "a.parquet"
    schema = pa.schema([("time_s", pa.float64())])
    block = pa.table({"time_s": pa.nulls(10_000_000, pa.float64())})
    with pq.ParquetWriter(path, schema) as writer:
        for _ in range(13):
            writer.write_table(block, row_group_size=10_000_000)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(ConfigError, match="its 130000000 rows need 1040 MB of memory"):
        unpacking.check_parquet(path, pq.read_metadata(path))
