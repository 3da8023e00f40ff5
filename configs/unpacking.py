"""Unpacks what users give, within limits: archives, compressed text, XML and Parquet files.

A small file can unpack to more than the memory holds, by intent or by damage. Sizes that a file
declares are checked before anything is unpacked, and what is unpacked is counted, because a
declared size can be wrong.
Source: APPNOTE 6.3 (ZIP); RFC 1950 (zlib); XML 1.0; Apache Parquet.
"""

import contextlib
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from xml.parsers import expat

from rollerrig.configs.errors import ConfigError

_MB = 1_000_000

# a ZIP archive: files, bytes of all of them, and their share that is allowed whatever its ratio
_MOST_FILES = 10_000
_MOST_DIRECTORY = 400 * _MOST_FILES  # bytes of the list of the files
_DIRECTORY_BYTES = 5  # place of its size in what `zipfile` returns of the end of an archive
_MOST_UNPACKED = 1_000 * _MB
_ALWAYS_ALLOWED = 50 * _MB
_MOST_RATIO = 100  # unpacked over packed; programs and text have 2 to 20

_MOST_XML = 32 * _MB
_MOST_ELEMENTS = 200_000
_DEEPEST_ELEMENT = 64

_PIECE = 64_000  # bytes that are unpacked at a time

# bytes of a Parquet file in memory
_MOST_TABLE = 1_000 * _MB
_VALUE_BYTES = 8
_TEXT = "BYTE_ARRAY"  # physical types of Parquet
_FIXED_TEXT = "FIXED_LEN_BYTE_ARRAY"
_NUMBERS = ("BOOLEAN", "INT32", "INT64", "FLOAT", "DOUBLE")


class _BeyondLimitError(Exception):
    """A limit is exceeded; the text is the end of the message."""


# --- ZIP ---


def check_archive(path: Path) -> None:
    """Raise ConfigError unless a ZIP archive may be unpacked into a folder.

    Raises OSError if it cannot be read, and BadZipFile if it is no archive.
    """
    # `ZipFile` reads the list of all files, so its size is checked before
    with path.open("rb") as file:
        end = zipfile._EndRecData(file)  # type: ignore[attr-defined]
    if end and end[_DIRECTORY_BYTES] > _MOST_DIRECTORY:
        raise ConfigError(
            f"{path}: its list of files has {end[_DIRECTORY_BYTES] / _MB:.4g} MB; at most "
            f"{_MOST_DIRECTORY / _MB:.4g} MB are allowed: leave out what is not needed"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
    except (NotImplementedError, ValueError) as error:
        raise zipfile.BadZipFile(str(error)) from None
    if len(members) > _MOST_FILES:
        raise ConfigError(
            f"{path}: contains {len(members)} files; at most {_MOST_FILES} are allowed: leave out "
            "what is not needed"
        )
    for member in members:
        # APPNOTE 4.4.17.1: all slashes are forward slashes
        if "\\" in member.filename:
            raise ConfigError(
                f"{path}: contains '{member.filename}', whose folders are separated by \\; a ZIP "
                "archive separates them by /: pack it again with a program that does so, such as zip"
            )
        name = PurePosixPath(member.filename)
        if name.is_absolute() or ".." in name.parts:
            raise ConfigError(
                f"{path}: contains '{member.filename}', which leads out of the folder; names "
                "without .. are allowed: pack it again"
            )
    unpacked = sum(member.file_size for member in members)
    allowed = min(max(_ALWAYS_ALLOWED, _MOST_RATIO * path.stat().st_size), _MOST_UNPACKED)
    if unpacked > allowed:
        raise ConfigError(
            f"{path}: would unpack to {unpacked / _MB:.4g} MB; at most {allowed / _MB:.4g} MB are "
            "allowed for an archive of this size: leave out what is not needed"
        )


def read_xml(archive: zipfile.ZipFile, name: str, where: str) -> bytes:
    """Return the checked XML of a file in an archive.

    Raises ConfigError, which begins with `where`, KeyError if there is no such file, and BadZipFile
    if it is damaged.
    """
    try:
        with archive.open(name) as file:
            # not more than this is unpacked, whatever the archive declares
            content = file.read(_MOST_XML + 1)
    except (zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ConfigError(f"{where}: {name} cannot be unpacked: {error}; pack it again") from None
    check_xml(content, f"{where}: {name}")
    return content


# --- XML ---


class _Counter:
    """Counts the elements of an XML text while it is parsed.

    Raises _BeyondLimitError beyond a limit.
    """

    def __init__(self) -> None:
        self._elements = 0
        self._depth = 0

    def begin(self, name: str, attributes: dict[str, str]) -> None:
        """An element begins."""
        self._elements += 1
        self._depth += 1
        if self._elements > _MOST_ELEMENTS:
            raise _BeyondLimitError(f"has more than {_MOST_ELEMENTS} elements, which are allowed")
        if self._depth > _DEEPEST_ELEMENT:
            raise _BeyondLimitError(
                f"is nested deeper than {_DEEPEST_ELEMENT} elements, which are allowed"
            )

    def end(self, name: str) -> None:
        """An element ends."""
        self._depth -= 1

    def doctype(self, *_: Any) -> None:
        """A document type begins: it can define entities, which grow or read other files."""
        raise _BeyondLimitError("has a document type (<!DOCTYPE), and none is allowed")


def check_xml(content: bytes, where: str) -> None:
    """Raise ConfigError, which begins with `where`, unless an XML text may be parsed."""
    try:
        if len(content) > _MOST_XML:
            raise _BeyondLimitError(f"has more than {_MOST_XML / _MB:.4g} MB, which are allowed")
        counter = _Counter()
        parser = expat.ParserCreate()
        parser.StartElementHandler = counter.begin
        parser.EndElementHandler = counter.end
        parser.StartDoctypeDeclHandler = counter.doctype
        parser.Parse(content, True)
    except _BeyondLimitError as error:
        raise ConfigError(f"{where} {error}; export it again without this") from None
    except (expat.ExpatError, LookupError, ValueError) as error:
        raise ConfigError(f"{where} cannot be read: {error}; export it again") from None


# --- zlib ---


def inflate(content: bytes, most_bytes: int) -> bytes:
    """Return what was compressed by zlib. Raises ValueError if it is damaged, or has more bytes."""
    unpacking = zlib.decompressobj()
    try:
        unpacked = unpacking.decompress(content, most_bytes + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if len(unpacked) > most_bytes:
        raise ValueError(f"it unpacks to more than {most_bytes} bytes, which are allowed")
    if not unpacking.eof:
        raise ValueError("its end is missing")
    return unpacked


def inflated_bytes(content: bytes | memoryview, most_bytes: int) -> int:
    """Return how many bytes compressed content unpacks to; counting stops above `most_bytes`.

    Content that is damaged counts up to the damage.
    """
    unpacking = zlib.decompressobj()
    count = 0
    with contextlib.suppress(zlib.error):
        for begin in range(0, len(content), _PIECE):
            waiting = bytes(content[begin : begin + _PIECE])
            while waiting and count <= most_bytes and not unpacking.eof:
                count += len(unpacking.decompress(waiting, _MB))
                waiting = unpacking.unconsumed_tail
            if count > most_bytes or unpacking.eof:
                break
    return count


# --- Parquet ---


def check_parquet(path: Path, metadata: Any, most_ratio: int = 0) -> None:
    """Raise ConfigError if a Parquet file with these metadata of pyarrow is too large in memory.

    It may be `most_ratio` times the size of the file where that is more than the limit. Columns of
    text count as they are when they are read as dictionaries (see `text_columns`).
    """
    needed = 0
    for group in range(metadata.num_row_groups):
        for number in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(number)
            width = _VALUE_BYTES
            if chunk.physical_type == _FIXED_TEXT:
                width = metadata.schema.column(number).length
            elif chunk.physical_type == _TEXT and "DELTA_BYTE_ARRAY" in chunk.encodings:
                # each value can repeat all that comes before
                width = chunk.total_uncompressed_size
            needed += chunk.total_uncompressed_size + width * chunk.num_values

    allowed = max(_MOST_TABLE, most_ratio * path.stat().st_size)
    if needed > allowed:
        raise ConfigError(
            f"{path}: its {metadata.num_rows} rows need {needed / _MB:.4g} MB of memory; at most "
            f"{allowed / _MB:.4g} MB are allowed: split it into several files"
        )


def text_columns(metadata: Any) -> list[str]:
    """Return the names of the columns of text: pyarrow must read them as dictionaries.

    Otherwise a long text that is stored once would be in memory once for each row.
    """
    columns = [metadata.schema.column(number) for number in range(metadata.num_columns)]
    return [column.path for column in columns if column.physical_type == _TEXT]


def not_numbers(metadata: Any) -> Sequence[str]:
    """Return the names of the columns of a Parquet file that hold something else than numbers."""
    columns = [metadata.schema.column(number) for number in range(metadata.num_columns)]
    return [column.path for column in columns if column.physical_type not in _NUMBERS]
