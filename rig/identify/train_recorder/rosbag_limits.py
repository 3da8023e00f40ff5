"""Limits what the library rosbags unpacks while it reads a recording.

A small recording can unpack to more than the disk or the memory holds, by intent or by damage. The
library unpacks whole files into a temporary folder, and whole chunks and messages into memory,
whatever their size. So files are counted before the library opens them. For chunks and messages
its tables of decompressors are replaced, while it reads, by ones that stop at a limit. SQLite gets
a limit for each value, and no views, because a view can have rows without end.
"""

import bz2
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import apsw
from backports import zstd
from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import storage_mcap

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError

_MB = 1_000_000

MOST_PART = 256 * _MB  # a chunk, a message or a value of SQLite; chunks usually have 1 to 4 MB
# all that one recording unpacks to
_ALWAYS_ALLOWED = 50 * _MB
_MOST_RATIO = 100  # unpacked over packed; recordings have 2 to 20
_MOST_UNPACKED = 8_000 * _MB
_MOST_METADATA = 1 * _MB  # metadata.yaml; its parser needs about 10 s for a megabyte
_MOST_FRAMES = 1000  # compressed streams one after another in a part

_ZSTD_BEGIN = b"\x28\xb5\x2f\xfd"  # RFC 8878
_PIECE = 1 * _MB


class Unpacking:
    """Unpacks the parts of one recording, and counts their bytes.

    Its functions raise ConfigError beyond a limit, and what the decompressors raise for damaged
    data.
    """

    def __init__(self, path: Path, packed_bytes: int) -> None:
        self._path = path
        self._allowed = min(max(_ALWAYS_ALLOWED, _MOST_RATIO * packed_bytes), _MOST_UNPACKED)
        self._left = self._allowed

    def zstd(self, data: bytes, _size: int = 0) -> bytes:
        """Return the content of data that are compressed by Zstandard."""
        return self._unpacked(zstd.ZstdDecompressor, data)

    def lz4(self, data: bytes, _size: int = 0) -> bytes:
        """Return the content of data that are compressed by LZ4."""
        return self._unpacked(LZ4FrameDecompressor, data)

    def bz2(self, data: bytes) -> bytes:
        """Return the content of data that are compressed by bzip2."""
        return self._unpacked(bz2.BZ2Decompressor, data)

    def count_file(self, file: Path) -> None:
        """Count what a file unpacks to, if Zstandard has compressed it."""
        with user_files.open_binary(file, user_files.ROSBAG) as content:
            if content.read(len(_ZSTD_BEGIN)) != _ZSTD_BEGIN:
                return
            content.seek(0)
            with zstd.ZstdFile(content) as unpacked:
                while piece := unpacked.read(_PIECE):
                    self._take(len(piece))

    def _unpacked(self, new_stream: Callable[[], Any], data: bytes) -> bytes:
        parts = []
        size = 0
        for _ in range(_MOST_FRAMES):
            stream = new_stream()
            part = stream.decompress(data, min(MOST_PART - size, self._left) + 1)
            parts.append(part)
            size += len(part)
            self._take(len(part))
            if size > MOST_PART:
                raise ConfigError(
                    f"{self._path}: a chunk or message unpacks to more than {MOST_PART / _MB:.4g} "
                    "MB, which are allowed; record it again in smaller chunks"
                )
            if not stream.eof:
                raise ValueError("the end of a compressed chunk or message is missing")
            data = stream.unused_data
            if not data:
                return b"".join(parts)
        raise ValueError(f"a chunk or message has more than {_MOST_FRAMES} compressed streams")

    def _take(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise ConfigError(
                f"{self._path}: unpacks to more than {self._allowed / _MB:.4g} MB, which are "
                "allowed for a recording of this size; split it into several recordings"
            )


def check(path: Path) -> Unpacking:
    """Return the unpacking of a recording, a file or a folder, after its files are counted.

    Raises ConfigError beyond a limit, and OSError.
    """
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    unpacking = Unpacking(path, sum(file.stat().st_size for file in files))
    for file in files:
        if file.suffix == ".yaml" and file.stat().st_size > _MOST_METADATA:
            raise ConfigError(
                f"{file}: has more than {_MOST_METADATA / _MB:.4g} MB; metadata of a recording may "
                "not be larger: is it the right file?"
            )
        unpacking.count_file(file)
    return unpacking


@contextlib.contextmanager
def applied(unpacking: Unpacking) -> Iterator[None]:
    """Let the library unpack within the limits as long as the context lasts."""
    of_mcap = dict(storage_mcap.DECOMPRESSORS)
    of_rosbag1 = dict(rosbag1.decompressors)
    storage_mcap.DECOMPRESSORS.update(zstd=unpacking.zstd, lz4=unpacking.lz4)
    rosbag1.decompressors.update(bz2=unpacking.bz2, lz4=unpacking.lz4)
    apsw.connection_hooks.append(_limit_database)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(_limit_database)
        storage_mcap.DECOMPRESSORS.update(of_mcap)
        rosbag1.decompressors.update(of_rosbag1)


def compressed_messages(bag: Any) -> bool:
    """Return whether each message of an open recording is compressed.

    If so, the library hands them out as they are from now on, because it would unpack them without
    a limit.
    """
    for reader in bag.readers:
        storage = getattr(reader, "storage", None)
        if storage is not None and storage.metadata.compression_mode == "message":
            storage.metadata = storage.metadata._replace(compression_mode=None)
            return True
    return False


def _limit_database(connection: apsw.Connection) -> None:
    """Limit the values of a database. Raises ValueError if it contains views or the like."""
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, MOST_PART)
    query = (
        "SELECT count(*) FROM sqlite_master "
        "WHERE type NOT IN ('table', 'index') OR sql LIKE 'CREATE VIRTUAL%'"
    )
    ((others,),) = connection.execute(query)
    if others:
        raise ValueError("its database contains views, triggers or virtual tables")
