"""Writes the FMU of a rig: description, library, its sources, and the scenario.

The library is compiled from sources that are the same for every scenario: nothing of a scenario,
not even its name, becomes part of a program.
"""

import re
import shutil
import subprocess
import tempfile
import zipfile
from importlib import metadata
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, write_bytes, writing
from rollerrig.configs.processes import children
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.rig_fmu import description, rig
from rollerrig.realtime.bench.scenario import Scenario

SOURCES = ("rig_fmu.c", "unsupported.c")
_HEADERS = ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h")
_TOKEN = "token.h"
_PYTHON = "python.txt"  # resource: the Python that the library starts
# the standard fixes times in an archive for nobody; fixed ones make the same FMU again
_WRITTEN = (2025, 1, 1, 0, 0, 0)
_COMPILER = ("cc", "-shared", "-fPIC", "-O2", "-fvisibility=hidden")


def write(plan: Scenario, out: Path) -> int:
    """Write the FMU of a scenario; return how many variables it has. Raises ConfigError."""
    try:
        import fmpy
    except ImportError:
        raise ConfigError("FMUs need the extra: pip install 'rollerrig[fmu]'") from None
    if not shutil.which(_COMPILER[0]):
        raise ConfigError("export-fmu needs a C compiler (cc): apt-get install gcc libc6-dev")

    model = _identifier(plan.name)
    scenario_text = scenario.dump(plan)
    token = description.token(model, scenario_text)
    with tempfile.TemporaryDirectory(prefix="rollerrig-fmu-") as place, writing(out):
        folder = Path(place)
        (folder / rig.SCENARIO).write_text(scenario_text, encoding="utf-8")
        (folder / rig.NAME).write_text(model, encoding="utf-8")
        ports = rig.Rig(folder).ports

        sources = {name: Path(__file__).with_name(name).read_bytes() for name in SOURCES}
        for name in _HEADERS:
            sources[name] = (Path(fmpy.__file__).parent / "c-code" / name).read_bytes()
        sources[_TOKEN] = f'#define INSTANTIATION_TOKEN "{token}"\n'.encode()
        library = _compile(sources, folder)

        version = metadata.version("rollerrig")
        files = {"modelDescription.xml": description.xml(model, ports, token, version)}
        files[f"binaries/{fmpy.platform_tuple}/{description.IDENTIFIER}.so"] = library
        for name, content in sources.items():
            files[f"sources/{name}"] = content
        files["sources/buildDescription.xml"] = _build_description()
        files[f"resources/{rig.SCENARIO}"] = scenario_text.encode()
        files[f"resources/{rig.NAME}"] = model.encode()
        files[f"resources/{_PYTHON}"] = f"{children.interpreter()}\n".encode()
        archive = folder / "rig.fmu"
        _pack(files, archive)
        make_folder(out.parent)
        write_bytes(out, archive.read_bytes())
    return len(ports)


def _compile(sources: dict[str, bytes], folder: Path) -> bytes:
    """Return the compiled library. Raises ConfigError with what the compiler prints."""
    place = folder / "sources"
    place.mkdir()
    for name, content in sources.items():
        (place / name).write_bytes(content)
    library = folder / f"{description.IDENTIFIER}.so"
    command = [*_COMPILER, f"-I{place}", "-o", str(library), *(str(place / one) for one in SOURCES)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ConfigError(f"the library of the FMU cannot be compiled: {done.stderr.strip()}")
    return library.read_bytes()


def _build_description() -> bytes:
    """Return the file that lists the sources for importing tools that compile."""
    files = "".join(f'<SourceFile name="{name}"/>' for name in SOURCES)
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<fmiBuildDescription fmiVersion="3.0">'
        f'<BuildConfiguration modelIdentifier="{description.IDENTIFIER}">'
        f'<SourceFileSet language="C11">{files}</SourceFileSet>'
        "</BuildConfiguration></fmiBuildDescription>\n"
    ).encode()


def _pack(files: dict[str, bytes], path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _WRITTEN), content, zipfile.ZIP_DEFLATED)


def _identifier(name: str) -> str:
    """Return the name of a scenario as an identifier of FMI."""
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    return identifier if re.match("[A-Za-z_]", identifier) else f"rig_{identifier}"
