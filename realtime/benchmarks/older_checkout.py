"""Runs the code of an older checkout, to compare processor times: stops of a campaign, commands."""

import contextlib
import hashlib
import json
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children
from rollerrig.realtime.campaign import campaign

# the program of an older checkout: for each number of a chunk on standard input it runs the chunk,
# and prints the processor time in s
_OLDER = """
import json, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[4])
from rollerrig.realtime.campaign import campaign
imported = Path(campaign.__file__).resolve()
if not imported.is_relative_to(Path(sys.argv[3]).resolve()):
    sys.exit(f"{imported} is not in {sys.argv[3]}")
plan = campaign.load(sys.argv[1], **json.loads(sys.argv[2]))
campaign.run_chunk(plan._replace(points=plan.points[:1]), 0)
for line in sys.stdin:
    begun_s = time.process_time()
    campaign.run_chunk(plan, int(line))
    print(time.process_time() - begun_s, flush=True)
"""

# an older process has vehicles with one number of axles, which this variable sets
_AXLES = "ROLLERRIG_AXLES"

# the program that prints from where the command is imported
_WHERE = "from rollerrig.realtime import cli; print(cli.__file__)"


def check(folder: Path | None) -> None:
    """Raise ConfigError if a folder is given that is no checkout of rollerrig."""
    if folder is not None and not (folder / "realtime" / "campaign" / "campaign.py").is_file():
        raise ConfigError(
            f"--beside {folder}: there is no realtime/campaign/campaign.py; give the folder of a "
            "checkout of rollerrig"
        )


@contextlib.contextmanager
def chunks(
    folder: Path | None, name: str, plan: campaign.Plan, axles: int
) -> Iterator[Callable[[int], float] | None]:
    """Yield a function from the number of a chunk to the processor time in s of a checkout.

    `name` is that of the plan, `axles` is the number of its vehicle. Yields None without a folder.
    Raises ConfigError if its stops fail.
    """
    if folder is None:
        yield None
        return
    heads = {name: plan.head[name] for name in ("runs", "chunk", "scenario")}
    words = [name, json.dumps(heads), str(folder), str(import_folder(folder))]
    program = subprocess.Popen(
        [children.interpreter(), "-P", "-c", _OLDER, *words],
        env=os.environ | {_AXLES: str(axles)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert program.stdin is not None
    assert program.stdout is not None
    stdin = program.stdin
    stdout = program.stdout

    def chunk_s(chunk: int) -> float:
        try:
            stdin.write(f"{chunk}\n")
            stdin.flush()
            return float(stdout.readline())
        except (BrokenPipeError, ValueError):
            raise ConfigError(
                f"--beside {folder}: its stops failed; its message is above"
            ) from None

    try:
        yield chunk_s
    finally:
        program.kill()
        program.communicate()


def variables(folder: Path) -> dict[str, str]:
    """Return the environment variables with which Python imports `rollerrig` from a checkout.

    Raises ConfigError if it is imported from elsewhere, or not at all.
    """
    place = str(import_folder(folder))
    already = os.environ.get("PYTHONPATH")
    found = {"PYTHONPATH": os.pathsep.join([place, already] if already else [place])}
    done = subprocess.run(
        [children.interpreter(), "-P", "-c", _WHERE],
        env=os.environ | found,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        last_line = done.stderr.strip().rpartition("\n")[2]
        raise ConfigError(f"--beside {folder}: its command cannot be imported: {last_line}")
    imported = Path(done.stdout.strip()).resolve()
    if not imported.is_relative_to(folder.resolve()):
        raise ConfigError(
            f"--beside {folder}: Python imports {imported} instead; run this command from a clone "
            "with its .venv"
        )
    return found


def import_folder(folder: Path) -> Path:
    """Return the folder from which a checkout is imported as `rollerrig`.

    A package is found by its name, which the folder of a checkout need not have. Then a link has
    it. The link stays: compiled kernels are found again by the path of their source.
    """
    checkout = folder.resolve()
    if checkout.name == "rollerrig":
        return checkout.parent
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    name = hashlib.sha256(str(checkout).encode()).hexdigest()[:16]
    place = cache / "rollerrig" / f"beside-{name}"
    place.mkdir(parents=True, exist_ok=True)
    link = place / "rollerrig"
    if not link.is_symlink():
        link.symlink_to(checkout)
    return place
