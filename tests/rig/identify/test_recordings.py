"""What a recorder hid is named: where, when, on which channel, how large; nothing hidden, nothing named.

The twin (`recorder_twin`) shares no code with what explains.
"""

import json
import re

import numpy as np
import pytest
import recorder_twin as twin

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import recording, verdict

SOME = (36, 30, 27, 24)
SEEDS = (11,)


def explained(folder, kind, seed, hide=(), speeds=SOME, **how):
    told = twin.dataset(folder, twin.stops(kind, speeds), seed, hide, **how)
    return told, verdict.explain(recording.load(folder))


def fits(found, true, bound_s=0.35):
    """Whether a finding names the channel, the run and, within a bound, the time of what was hidden."""
    name, channel, run, start_s, end_s, _ = true
    near = [
        True if told is None else abs(mine - told) < bound_s
        for mine, told in ((found.start_s, start_s), (found.end_s, end_s))
    ]
    return (
        found.name == name and channel in found.channels and run in (None, found.run) and all(near)
    )


@pytest.mark.parametrize(
    "hide",
    [one for one in (*twin.BEFORE, *twin.AFTER) if one not in (twin.drift, twin.noise)],
    ids=lambda one: one.__name__,
)
def test_what_is_hidden_is_named_with_its_channel_its_time_and_its_size(tmp_path, hide):
    for seed in SEEDS:
        told, account = explained(tmp_path / str(seed), "clean", seed, (hide,))
        assert account.verdict == "explained", report.story(account)
        assert {f.name for f in account.findings} == {row[0] for row in told}
        for row in told:
            mine = [f for f in account.findings if fits(f, row)]
            assert mine, f"{row} is not among {report.story(account)}"
            # the 95 % interval, doubled: a law, no lottery
            assert abs(mine[0].size - row[5]) <= mine[0].high - mine[0].low


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"reference": False},
        {"axles": 1},
        {"axles": 2, "reference": False},
        {"axles": 1, "reference": False, "position": False},
    ],
    ids=str,
)
def test_a_clean_recording_is_consistent(tmp_path, how):
    _, account = explained(tmp_path, "clean", 21, **how)
    assert account.verdict == "consistent", report.story(account)


@pytest.mark.parametrize("hide", [twin.drift, twin.noise], ids=lambda one: one.__name__)
def test_what_is_not_in_the_list_is_described_and_not_named(tmp_path, hide):
    told, account = explained(tmp_path, "clean", 31, (hide,))
    assert account.verdict == "unexplained", report.story(account)
    assert {(f.channels, f.run) for f in account.unknown} == {((told[0][1],), told[0][2])}


def test_defects_that_come_together_are_all_named(tmp_path):
    hide = (twin.radius, twin.late, twin.zeros, twin.old_messages, twin.stuck)
    told, account = explained(tmp_path, "clean", 41, hide)
    assert account.verdict == "explained", report.story(account)
    for row in told:
        assert any(fits(f, row) for f in account.findings), f"{row}: {report.story(account)}"
    assert {f.name for f in account.findings} == {row[0] for row in told}


@pytest.mark.parametrize("how", [{}, {"reference": False}], ids=str)
def test_slides_give_a_lower_bound_of_the_adhesion_and_show_the_place_that_runs_share(
    tmp_path, how
):
    _, account = explained(tmp_path, "patch", 51, speeds=twin.SPEEDS, **how)
    assert {f.name for f in account.findings} == {"slide", "slippery_place"}, report.story(account)
    assert {s.run for s in account.slides} == set(range(len(twin.SPEEDS)))
    for s in account.slides:
        own = account.aligned[s.run]
        true = twin.stops("patch", twin.SPEEDS)[own.run.name]
        within = (true["position_m"] >= own.position[s.first]) & (
            true["position_m"] <= own.position[s.last]
        )
        load = sum(true[f"wheel_load_{j}_N"] for j in range(1, 5))[within]
        used = (
            sum(true[f"adhesion_{j}"] * true[f"wheel_load_{j}_N"] for j in range(1, 5))[within]
            / load
        )
        assert 0.3 * used.mean() < s.adhesion[1] < 1.05 * used.mean()
    place = next(f for f in account.findings if f.name == "slippery_place").place_m
    assert 590.0 < place[0] < 640.0
    assert 640.0 < place[1] < 720.0


def test_driving_is_no_defect(tmp_path):
    def there_and_back(name, x):
        if name == "time_s":
            return np.arange(2 * x.size) * float(x[1] - x[0])
        return np.concatenate(
            [x[-1] - x[::-1], x[-1] + x] if name == "position_m" else [x[::-1], x]
        )

    runs = {
        run: {name: there_and_back(name, x) for name, x in columns.items()}
        for run, columns in twin.stops("clean", SOME).items()
    }
    for how in ({}, {"reference": False}, {"axles": 2, "reference": False}):
        twin.dataset(tmp_path, runs, 61, **how)
        account = verdict.explain(recording.load(tmp_path))
        assert account.verdict == "consistent", report.story(account)


def test_the_report_tells_the_same_as_the_page_and_the_recording(tmp_path, capsys):
    twin.dataset(tmp_path / "data", twin.stops("patch", SOME), 71, (twin.radius_step, twin.zeros))
    assert (
        cli.main(["explain", str(tmp_path / "data"), "--out", str(tmp_path / "out"), "--json"]) == 0
    )
    told = json.loads((tmp_path / "out" / "report.json").read_text())
    assert json.loads(capsys.readouterr().out)["causes"] == told["causes"]
    assert told["verdict"] == "explained"
    assert {f["name"] for f in told["causes"]} >= {"wheel_radius_step", "sensor_dropout"}
    assert told["causes"][0]["axles"]
    assert all(0.0 < one["adhesion_used_at_least"] < 0.2 for one in told["episodes"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert "step of a wheel radius" in page
    assert (tmp_path / "out" / "report.rrd").stat().st_size > 10_000


# --- files ---


def test_other_separators_a_row_of_units_and_dates_with_times_read_the_same(tmp_path):
    twin.dataset(tmp_path, twin.stops("clean", SOME[:1]), 81)
    plain = recording.load(tmp_path).runs[0]
    path = tmp_path / "clean_36.csv"
    lines = path.read_text().replace(",", ";").replace(".", ",").splitlines()
    head = lines[0].split(";")
    units = ["ms", *("km/h" if name[0] in "ag" else "" for name in head[1:])]
    rows = [line.split(";") for line in lines[1:]]
    rows = [
        [str(1000 * float(row[0].replace(",", "."))).replace(".", ","), *row[1:]] for row in rows
    ]
    path.write_text("\n".join([";".join(head), ";".join(units), *map(";".join, rows)]) + "\n")
    toml = tmp_path / "dataset.toml"
    toml.write_text('decimal = ","\n' + toml.read_text())
    other = recording.load(tmp_path).runs[0]
    for name, channel in plain.channels.items():
        np.testing.assert_allclose(other.channels[name].values, channel.values)
        np.testing.assert_allclose(other.channels[name].time_s, channel.time_s, atol=1e-6)


def test_a_rosbag_reads_as_the_csv(tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    types = typesys.get_typestore(typesys.Stores.LATEST)
    float64, twist = (
        types.types["std_msgs/msg/Float64"],
        types.types["geometry_msgs/msg/TwistStamped"],
    )
    vector, header = types.types["geometry_msgs/msg/Vector3"], types.types["std_msgs/msg/Header"]
    stamp, one_twist = (
        types.types["builtin_interfaces/msg/Time"],
        types.types["geometry_msgs/msg/Twist"],
    )
    t = 1000.0 + 0.1 * np.arange(300)
    v = 20.0 - 0.05 * np.arange(300)
    with rosbag2.Writer(tmp_path / "run", version=9) as bag:
        axle = bag.add_connection("/axle", float64.__msgtype__, typestore=types)
        gnss = bag.add_connection("/gnss", twist.__msgtype__, typestore=types)
        for at, speed in zip(t, v, strict=True):
            bag.write(
                axle, round(at * 1e9), types.serialize_cdr(float64(speed), float64.__msgtype__)
            )
            zero = vector(0.0, 0.0, 0.0)
            message = twist(
                header(stamp(int(at) + 1, 0), ""), one_twist(vector(speed, 0.0, 0.0), zero)
            )
            bag.write(gnss, round(at * 1e9), types.serialize_cdr(message, twist.__msgtype__))
    (tmp_path / "dataset.toml").write_text(
        'kind = "recorder"\n[channels]\nbogie_speed_1_m_s = { column = "/axle:data", name = "axle" }\n'
        'reference_speed_m_s = { column = "/gnss:twist.linear.x", name = "gnss" }\n[[run]]\nfile = "run"\n'
    )
    run = recording.load(tmp_path).runs[0]
    np.testing.assert_allclose(run.channels["axle"].values, v)
    np.testing.assert_allclose(run.channels["axle"].time_s, t - t[0], atol=1e-6)
    np.testing.assert_allclose(
        run.channels["gnss"].time_s, np.floor(t) + 1.0 - t[0], atol=1e-6
    )  # the header's stamp


BAD = {
    "no such column": (
        'column = "axle_1"',
        'column = "axel_1"',
        "column 'axel_1' is missing.*axle_1",
    ),
    "no such file": ('file = "clean_36.csv"', 'file = "clean.csv"', "clean.csv: no such file"),
    "no such unit": ('unit = "km/h"', 'unit = "kmh"', "kmh.*allowed: .*km/h"),
    "no such channel": (
        "reference_speed_m_s",
        "gps_speed_m_s",
        "gps_speed_m_s is no channel.*reference_speed_m_s",
    ),
    "two of a name": ('name = "axle_2"', 'name = "axle_1"', "two channels are called 'axle_1'"),
    "no speed": (None, '[channels]\ntime_s = { column = "t" }\n', "no speed of an axle or a bogie"),
    "no time": ('column = "t"', 'column = "zeit"', "column 'zeit' is missing"),
    "unknown key": ("[channels]", "sample_time_s = 0.1\n[channels]", "unknown key 'sample_time_s'"),
    "no rosbag": ('file = "clean_36.csv"', 'file = "."', "names no field of a topic"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_read_is_refused_with_file_and_remedy(tmp_path, case):
    twin.dataset(tmp_path, twin.stops("clean", SOME[:1]), 91)
    old, new, message = BAD[case]
    toml = tmp_path / "dataset.toml"
    text = toml.read_text()
    toml.write_text(
        text.replace(old, new) if old else re.sub(r"(?s)\[channels\].*?(?=\[\[run)", new, text)
    )
    assert toml.read_text() != text
    with pytest.raises(ConfigError) as error:
        recording.load(tmp_path)
    assert re.search(message, str(error.value)), error.value


@pytest.mark.parametrize("verb", ["tune", "validate"])
def test_a_recorder_is_not_fitted(tmp_path, capsys, verb):
    twin.dataset(tmp_path / "data", twin.stops("clean", SOME[:1]), 92)
    assert cli.main([verb, str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 2
    assert "use rollerrig explain" in capsys.readouterr().err


def test_columns_of_standard_names_need_no_table_and_turns_become_speeds(tmp_path):
    t = np.arange(0.0, 20.0, 0.1)
    rows = "\n".join(f"{a:.1f},{(20.0 - 0.5 * a) / 0.5:.4f},{20.0 - 0.5 * a:.4f}" for a in t)
    (tmp_path / "one.csv").write_text(f"time_s,wheel_speed_3_rad_s,reference_speed_m_s\n{rows}\n")
    (tmp_path / "dataset.toml").write_text(
        'kind = "recorder"\nwheel_radius_m = 0.5\n[[run]]\nfile = "one.csv"\nvehicle_id = "12"\n'
    )
    run = recording.load(tmp_path).runs[0]
    assert run.vehicle_id == "12"
    assert run.channels["axle 3"].axle == 3
    np.testing.assert_allclose(
        run.channels["axle 3"].values, run.channels["reference"].values, atol=1e-3
    )
    (tmp_path / "one.csv").unlink()
    with pytest.raises(ConfigError, match=r"one\.csv: no such file; correct `file`"):
        recording.load(tmp_path)
