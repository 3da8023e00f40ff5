"""rosbag2 recordings: each form reads the same, and a hostile one costs neither disk nor memory.

The attacks are files that unpack to much more than their size, a database with rows without end,
and files that are cut or changed at any place.
"""

import sqlite3
import tempfile
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.train_recorder import recording

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
recorded_bag = pytest.importorskip("recorded_bag")
zstd = pytest.importorskip("backports.zstd")

MODES = recorded_bag.MODES
PLUGINS = recorded_bag.PLUGINS
MB = 1_000_000


def load(folder, run="run"):
    """Return the run of the recording. Raises ConfigError."""
    (folder / "dataset.toml").write_text(recorded_bag.DATASET.replace("RUN", run))
    return recording.load(folder).runs[0]


def refusal(folder):
    """Return the message with which the recording is refused, or None."""
    try:
        load(folder)
    except ConfigError as error:
        return str(error)
    return None


def size_of(folder):
    return sum(file.stat().st_size for file in folder.iterdir())


FORMS = {
    "plain SQLite": (MODES.NONE, PLUGINS.SQLITE3),
    "compressed file": (MODES.FILE, PLUGINS.SQLITE3),
    "compressed messages": (MODES.MESSAGE, PLUGINS.SQLITE3),
    "plain MCAP": (MODES.NONE, PLUGINS.MCAP),
    "compressed MCAP chunks": (MODES.STORAGE, PLUGINS.MCAP),
    "compressed MCAP messages": (MODES.MESSAGE, PLUGINS.MCAP),
    "compressed MCAP file": (MODES.FILE, PLUGINS.MCAP),
}
COMPRESSED = [form for form in FORMS if form.startswith("compressed")]


def test_headers_without_stamps_have_the_time_of_reception(tmp_path):
    recorded_bag.write(tmp_path, has_stamps=False)
    (tmp_path / "dataset.toml").write_text(recorded_bag.DATASET.replace("RUN", "run"))
    recorded = recording.load(tmp_path)
    gnss = recorded.runs[0].channels["gnss"]
    assert gnss.time_s == pytest.approx(recorded_bag.TIME_S - recorded_bag.TIME_S[0], abs=1e-6)
    assert any("/gnss all have the stamp 0 s" in note for note in recorded.warnings)


@pytest.mark.parametrize("form", FORMS)
def test_a_rosbag_reads_as_the_csv(tmp_path, form):
    recorded_bag.write(tmp_path, *FORMS[form])
    run = load(tmp_path)
    np.testing.assert_allclose(run.channels["axle"].values, recorded_bag.SPEED_M_S)
    np.testing.assert_allclose(
        run.channels["axle"].time_s, recorded_bag.TIME_S - recorded_bag.TIME_S[0], atol=1e-6
    )
    # a channel with a header has the stamps of the header
    stamps_s = np.floor(recorded_bag.TIME_S) + 1.0
    np.testing.assert_allclose(
        run.channels["gnss"].time_s, stamps_s - recorded_bag.TIME_S[0], atol=1e-6
    )


@pytest.mark.parametrize("form", COMPRESSED)
def test_a_rosbag_that_unpacks_to_a_thousand_times_its_size_is_refused(tmp_path, form):
    recorded_bag.write(tmp_path, *FORMS[form], zeros=60 * MB)
    assert size_of(tmp_path / "run") < 0.1 * MB
    with pytest.raises(ConfigError, match=r"run: unpacks to more than 50 MB.*split it"):
        load(tmp_path)


def test_a_compressed_file_is_refused_before_it_is_on_the_disk(tmp_path, monkeypatch):
    recorded_bag.write(tmp_path, MODES.FILE, PLUGINS.SQLITE3, zeros=60 * MB)
    # a folder for temporary files into which nothing can be written
    monkeypatch.setattr(tempfile, "tempdir", str(Path("/proc/self/none")))
    with pytest.raises(ConfigError, match="unpacks to more than 50 MB"):
        load(tmp_path)


def test_a_chunk_beyond_its_limit_is_refused_where_the_whole_recording_is_within(tmp_path):
    recorded_bag.write(tmp_path, MODES.STORAGE, PLUGINS.MCAP, zeros=260 * MB)
    # a large file beside it allows more for the whole recording
    noise = np.random.default_rng(1).bytes(4 * MB)
    (tmp_path / "run" / "notes.bin").write_bytes(noise)
    with pytest.raises(ConfigError, match=r"unpacks to more than 256 MB.*smaller chunks"):
        load(tmp_path)


@pytest.mark.parametrize(
    "compression", list(rosbag1.Writer.CompressionFormat), ids=lambda c: c.name
)
def test_a_bag_of_ros_1_that_unpacks_to_a_thousand_times_its_size_is_refused(tmp_path, compression):
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    bag = rosbag1.Writer(tmp_path / "run.bag")
    bag.set_compression(compression)
    with bag:
        axle = bag.add_connection("/axle", "std_msgs/msg/Float64", typestore=store)
        bag.add_connection("/gnss", "geometry_msgs/msg/TwistStamped", typestore=store)
        bag.write(axle, 1, bytes(60 * MB))
    with pytest.raises(ConfigError, match=r"run.bag: unpacks to more than 50 MB"):
        load(tmp_path, "run.bag")


def test_a_database_with_rows_without_end_is_refused(tmp_path):
    recorded_bag.write(tmp_path)
    with sqlite3.connect(next((tmp_path / "run").glob("*.db3"))) as database:
        database.executescript(
            """
            DROP TABLE message_definitions;
            CREATE VIEW message_definitions AS
            WITH RECURSIVE rows(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM rows)
            SELECT id, 'a' AS topic_type, 'ros2msg' AS encoding,
                   'a' AS encoded_message_definition, '' AS type_description_hash FROM rows;
            """
        )
    with pytest.raises(ConfigError, match=r"run: cannot be read as rosbag2: .*contains views"):
        load(tmp_path)


def test_a_value_that_the_database_computes_has_a_limit(tmp_path):
    recorded_bag.write(tmp_path)
    with sqlite3.connect(next((tmp_path / "run").glob("*.db3"))) as database:
        database.executescript(
            """
            DROP TABLE messages;
            CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                                  data BLOB AS (zeroblob(900000000)));
            INSERT INTO messages VALUES (1, 1, 1);
            """
        )
    with pytest.raises(ConfigError, match=r"run: cannot be read as rosbag2: .*too big"):
        load(tmp_path)


def test_large_metadata_are_refused(tmp_path):
    recorded_bag.write(tmp_path)
    with (tmp_path / "run" / "metadata.yaml").open("a") as metadata:
        metadata.write("#" * 2 * MB)
    with pytest.raises(ConfigError, match=r"metadata.yaml: has more than 1 MB"):
        load(tmp_path)


@pytest.mark.parametrize("form", FORMS)
def test_a_damaged_rosbag_gives_a_message_with_its_file(tmp_path, form):
    recorded_bag.write(tmp_path, *FORMS[form])
    rng = np.random.default_rng(7)
    refused = 0
    for file in sorted((tmp_path / "run").iterdir()):
        whole = file.read_bytes()
        places = rng.integers(0, len(whole), 12)
        damaged = [whole[:place] for place in places[:4]]
        for place in places[4:]:
            damaged.append(whole[:place] + rng.bytes(8) + whole[place + 8 :])
        for content in damaged:
            file.write_bytes(content)
            message = refusal(tmp_path)
            assert message is None or str(tmp_path) in message
            refused += message is not None
        file.write_bytes(whole)
    assert refused >= 4
