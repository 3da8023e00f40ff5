"""The Python API for notebooks and programs: `import rollerrig`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import rollerrig
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.wsp_interface import signals

EXAMPLE = Path(__file__).parents[2] / "docs/examples/first_stops.ipynb"


def python(code, *arguments):
    """Run code in a Python process that has loaded nothing, and return its output."""
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()


def test_the_import_loads_no_slow_module():
    code = (
        "import rollerrig, sys; "
        "slow = ('numpy', 'numba', 'subprocess'); "
        "print([module for module in slow if module in sys.modules])"
    )
    assert python(code) == "[]"


def test_a_run_returns_the_content_of_its_folder(tmp_path):
    stop = rollerrig.run(
        "velim_a1",
        pacing="free",
        out=tmp_path / "stop",
        adhesion="dry",
        initial_speed_m_s=5.0,
        vehicle={"wheel_radius_m": 0.467},
        faults=["speed_noise_burst axle=2 at=0.5 for=0.5"],
    )
    assert stop.folder == tmp_path / "stop"
    assert stop.summary == json.loads((stop.folder / "summary.json").read_text())
    assert stop.summary == rollerrig.load(stop.folder).summary
    assert stop.summary["stopped"]
    assert stop.scenario["vehicle"]["wheel_radius_m"] == 0.467

    assert tuple(stop.table.column_names) == tuple(stop.frame().columns)
    assert tuple(stop.table.column_names) == signals.table(COACH).columns
    assert stop.frame()["vehicle_speed_m_s"].iloc[0] == pytest.approx(5.0)

    begun = [event.fields for event in stop.events if event.code == "fault.begins"]
    assert [fields["kind"] for fields in begun] == ["speed_noise_burst"]
    assert "axle=2" in begun[0]["fault"]


def test_one_process_runs_a_coach_then_a_tram(tmp_path):
    coach = rollerrig.run("dry_stop", out=tmp_path / "coach", initial_speed_m_s=5.0)
    tram = rollerrig.run("tram_low_dynamic", out=tmp_path / "tram", initial_speed_m_s=5.0)
    again = rollerrig.load(coach.folder)
    assert tuple(again.table.column_names) == signals.table(COACH).columns
    table = signals.table(Kind(6, dynamic_brake=True))
    assert tuple(tram.table.column_names) == table.columns
    assert len(tram.summary["axles"]) == 6
    assert rollerrig.plot(tram).path.is_file()
    assert rollerrig.compare(coach, tram)["differences"]


def test_the_table_of_a_run_does_not_need_pandas(free_stop):
    # None in sys.modules makes `import pandas` fail
    code = (
        "import sys; sys.modules['pandas'] = None; import rollerrig; "
        "print(type(rollerrig.load(sys.argv[1]).table).__module__)"
    )
    assert python(code, free_stop.out) == "pyarrow.lib"


def test_the_api_and_the_command_line_have_the_same_version():
    code = (
        "import sys; sys.argv = ['rollerrig', '--version']; "
        "from rollerrig.realtime import cli; cli.main()"
    )
    assert python(code) == f"rollerrig {rollerrig.__version__}"


@pytest.mark.nightly
def test_a_run_that_is_not_valid_causes_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="the coach did not stop within 1 s"):
        stop = rollerrig.run("velim_a1", pacing="free", out=tmp_path / "stop", duration_max_s=1.0)
    assert not stop.summary["valid"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: rollerrig.run("velim_a1", adhesoin="soap"), "did you mean 'adhesion'"),
        (
            lambda: rollerrig.run("velim_a1", pacing="fast"),
            "choose from 'wall', 'lockstep', 'free'",
        ),
        (lambda: rollerrig.explain("open_rail_cleanin"), "open_rail_cleaning"),
    ],
)
def test_an_invalid_argument_raises_the_message_of_the_command_line(call, message):
    with pytest.raises(RollerrigError, match=message):
        call()


def test_an_error_is_reported_once_with_its_type_and_in_words_of_python(capfd):
    with pytest.raises(ConfigError) as refused:
        rollerrig.run("velim_a1", faults=["speed_sensor_stuk axle=2"])
    assert str(refused.value).startswith(
        "rollerrig.run(faults=...) 'speed_sensor_stuk axle=2': kind = 'speed_sensor_stuk' is not a "
        "fault; did you mean 'speed_sensor_stuck'?"
    )
    with pytest.raises(ConfigError, match=r"rollerrig\.run\(\.\.\.\) \[vehicle\]: unknown key"):
        rollerrig.run("velim_a1", vehicle={"mas_kg": 40000.0})
    with pytest.raises(ConfigError, match="did you mean 'free'"):
        rollerrig.run("velim_a1", pacing="fre")
    shown = capfd.readouterr()
    assert shown.out == shown.err == ""
    assert ConfigError.__mro__[1] is rollerrig.RollerrigError is RollerrigError


def test_the_package_shows_its_public_names_only():
    assert python("import rollerrig; print(dir(rollerrig) == sorted(rollerrig.__all__))") == "True"
    assert all(hasattr(rollerrig, name) for name in rollerrig.__all__)
    assert not {"json", "sys", "Any", "Path", "NamedTuple"} & set(dir(rollerrig))


def test_a_run_shows_itself_in_three_lines(free_stop):
    stop = rollerrig.load(free_stop.out)
    first, second, third = repr(stop).splitlines()
    distance_m = stop.summary["stop_distance_m"]
    assert first.startswith(f"<Run velim_a1: stopped after {distance_m:.1f} m in ")
    assert first.endswith("free, unit reference, valid")
    assert f"{stop.table.num_rows} samples of {stop.table.num_columns} channels" in second
    assert third.strip() == f"{free_stop.out}>"
    assert "in progress" in repr(stop._replace(summary={}))


def test_a_frame_without_pandas_says_how_to_get_it(free_stop):
    code = (
        "import sys; sys.modules['pandas'] = None; import rollerrig\n"
        "try: rollerrig.load(sys.argv[1]).frame()\n"
        "except ImportError as error: print(error)"
    )
    assert "pip install pandas" in python(code, free_stop.out)


def test_runs_are_compared_and_drawn(free_stop, stop_on_leaves, tmp_path):
    result = rollerrig.compare(free_stop.out, stop_on_leaves.out, tolerances={"m_s": 0.1})
    assert not result["passed"]
    assert rollerrig.compare(free_stop.out, rollerrig.load(free_stop.out))["passed"]
    with pytest.raises(ConfigError, match="did you mean 'm_s'"):
        rollerrig.compare(free_stop.out, free_stop.out, tolerances={"M_S": 0.1})

    picture = rollerrig.plot(free_stop.out, tmp_path / "stop.svg")
    assert picture.path == tmp_path / "stop.svg"
    assert picture._repr_svg_().lstrip().startswith(("<svg", "<?xml"))


@pytest.mark.nightly
def test_a_campaign_returns_a_row_for_each_run(tmp_path):
    plan = tmp_path / "two.toml"
    plan.write_text(
        'scenario = "dry_stop"\n[vary]\ninitial_speed_m_s = [4.0, 6.0]\n', encoding="utf-8"
    )
    done = rollerrig.campaign(plan, out=tmp_path / "result", workers=1)
    assert done.table["initial_speed_m_s"].to_pylist() == [4.0, 6.0]
    assert done.report.is_file()
    assert repr(done).splitlines()[0] == "<Campaign 2 runs, 0 not valid, 0 with an error"
    assert len(done.frame()) == 2


@pytest.mark.nightly
def test_a_sequence_returns_its_verdict(tmp_path):
    path = tmp_path / "short.toml"
    path.write_text(
        'title = "A stop from walking speed"\n[start]\nspeed = "5 km/h"\nadhesion = "dry"\n'
        '[[step]]\nset = { brake_demand = "3 bar" }\nuntil = "vehicle_speed < 0.1 km/h"\n',
        encoding="utf-8",
    )
    result = rollerrig.sequence(path, out=tmp_path / "report", about={"tested by": "A. Meier"})
    assert result["result"] == "pass"
    assert result["sequences"] == {"short": "pass"}
    assert "A. Meier" in Path(result["report"]).read_text()


def test_a_folder_that_holds_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"scenario\.toml: no such file"):
        rollerrig.load(tmp_path)


@pytest.mark.nightly
def test_the_notebook_of_the_documentation_runs(tmp_path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    # The notebook runs in a Jupyter kernel of this Python. Other kernels of the machine are hidden.
    kernel = tmp_path / "kernels/python3"
    kernel.mkdir(parents=True)
    (kernel / "kernel.json").write_text(
        json.dumps(
            {
                "argv": [sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"],
                "display_name": "Python",
                "language": "python",
            }
        )
    )
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(EXAMPLE, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    printed = "".join(
        output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ())
    )
    assert "with WSP" in printed
    assert "verdict" in printed
    assert (tmp_path / "runs/leaf_film/summary.json").is_file()
