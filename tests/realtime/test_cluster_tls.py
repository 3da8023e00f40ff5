"""A Dask cluster with certificates, as the how-to sets it up, runs no code of others."""

import asyncio
import contextlib
import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from bench_process import until

distributed = pytest.importorskip("distributed")
PAGE = Path(__file__).parents[2] / "docs" / "howto_cluster.md"
PLAN = 'scenario = "dry_stop"\nunit = "none"\n[vary]\ninitial_speed_m_s = [3.0]\n'
DASK = f"{sys.executable} -m distributed.cli.dask_"
PATIENCE_S = 300.0

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(not shutil.which("openssl"), reason="this machine has no openssl"),
]


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


def lines_of_page(port):
    """The commands of the section with certificates, for a free port and a small plan."""
    section = PAGE.read_text().partition("## With certificates")[2].partition("\n## ")[0]
    text = "\n".join(re.findall(r"^    (.*)$", section, re.MULTILINE))
    text = text.replace("dask scheduler", f"{DASK}scheduler --port {port}")
    text = text.replace("dask worker", f"{DASK}worker").replace("8786", str(port))
    return text.replace("rollerrig campaign low_adhesion", "$ROLLERRIG campaign plan.toml")


async def refused(address, security=None):
    """Return whether a scheduler refuses a client."""
    with contextlib.suppress(OSError, TypeError, RuntimeError, TimeoutError, ValueError):
        async with distributed.Client(
            address, asynchronous=True, timeout="10s", security=security
        ) as client:
            await client.submit(os.getpid)
            return False
    return True


def test_a_cluster_with_certificates_runs_the_campaign_and_no_code_of_others(tmp_path):
    port = free_port()
    (tmp_path / "plan.toml").write_text(PLAN)
    begin, campaign = lines_of_page(port).split("export", maxsplit=1)
    session = subprocess.Popen(
        ["sh", "-ec", f"{begin}\nwait"],
        cwd=tmp_path,
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:

        def listens():
            with socket.socket() as probe:
                return not probe.connect_ex(("127.0.0.1", port))

        until(listens, "the scheduler")
        subprocess.run(
            "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=x -keyout other.key -out other.pem",
            shell=True,
            cwd=tmp_path,
            check=True,
            capture_output=True,
        )
        foreign = distributed.security.Security(
            tls_ca_file=str(tmp_path / "authority.pem"),
            tls_client_cert=str(tmp_path / "other.pem"),
            tls_client_key=str(tmp_path / "other.key"),
            require_encryption=True,
        )
        assert asyncio.run(refused(f"tcp://127.0.0.1:{port}"))
        assert asyncio.run(refused(f"tls://127.0.0.1:{port}", foreign))

        done = subprocess.run(
            ["sh", "-ec", f"export{campaign}"],
            cwd=tmp_path,
            env=os.environ | {"ROLLERRIG": f"{sys.executable} -m rollerrig.realtime.cli"},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        assert done.returncode == 0, done.stderr
        assert list((tmp_path / "campaigns" / "cluster" / "results").iterdir())
    finally:
        os.killpg(session.pid, 15)
        session.wait()
