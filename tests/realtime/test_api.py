"""The Python API for notebooks and programs: `import rollerrig`."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import rollerrig
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.wsp_interface.signals import COLUMNS

EXAMPLE = Path(__file__).parents[2] / "docs/examples/first_stops.ipynb"


def python(code, *arguments):
    """Run code in a new Python process and return its output."""
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

    assert tuple(stop.table.column_names) == tuple(stop.frame().columns) == COLUMNS
    assert stop.frame()["vehicle_speed_m_s"].iloc[0] == pytest.approx(5.0)

    begun = [event.fields for event in stop.events if event.code == "fault.begins"]
    assert [fields["kind"] for fields in begun] == ["speed_noise_burst"]
    assert "axle=2" in begun[0]["fault"]


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


def test_a_folder_that_holds_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"scenario\.toml: no such file"):
        rollerrig.load(tmp_path)


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
