"""Modbus over TLS: a client with the right certificate is served, any other gets nothing."""

import shutil
import socket
import ssl
import struct
import subprocess

import pytest
from modbus_site import Client, Site, adu

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.modbus.access import TLS_KEYS, tls_context
from rollerrig.realtime import cli

pytestmark = pytest.mark.skipif(not shutil.which("openssl"), reason="needs the command openssl")
READ = struct.pack(">BHH", 3, 202, 1)


def openssl(*arguments):
    subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)


def authority(folder, name):
    openssl(
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
        "-days",
        2,
        "-subj",
        f"/CN={name}",
        "-keyout",
        folder / f"{name}.key",
        "-out",
        folder / f"{name}.pem",
    )


def certificate(folder, name, signer):
    openssl(
        "req",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
        "-subj",
        f"/CN={name}",
        "-keyout",
        folder / f"{name}.key",
        "-out",
        folder / f"{name}.csr",
    )
    extension = folder / "extension"
    extension.write_text("subjectAltName=IP:127.0.0.1\n")
    openssl(
        "x509",
        "-req",
        "-in",
        folder / f"{name}.csr",
        "-CA",
        folder / f"{signer}.pem",
        "-CAkey",
        folder / f"{signer}.key",
        "-CAcreateserial",
        "-days",
        2,
        "-extfile",
        extension,
        "-out",
        folder / f"{name}.pem",
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("certificates")
    for name in ("plant", "stranger"):
        authority(place, name)
    for name, signer in (("rig", "plant"), ("room", "plant"), ("intruder", "stranger")):
        certificate(place, name, signer)
    return place


def asked(folder, **other):
    """[modbus] with the files of the rig, or others."""
    files = (str(folder / name) for name in ("rig.pem", "rig.key", "plant.pem"))
    return dict(zip(TLS_KEYS, files, strict=True)) | other


@pytest.fixture
def site(folder):
    place = Site()
    place.listen(tls_context(asked(folder)))
    yield place
    place.close()


def client_context(folder, name=None):
    context = ssl.create_default_context(cafile=folder / "plant.pem")
    if name:
        context.load_cert_chain(folder / f"{name}.pem", folder / f"{name}.key")
    return context


def secured(site, context):
    plain = socket.create_connection(("127.0.0.1", site.port))
    plain.settimeout(60.0)
    try:
        return Client(0, context.wrap_socket(plain, server_hostname="127.0.0.1"))
    except BaseException:
        plain.close()
        raise


@pytest.mark.conformance("Modbus", "TLS with client certificates")
def test_a_client_with_a_certificate_of_the_plant_is_served(site, folder):
    client = secured(site, client_context(folder, "room"))
    site.clients.append(client)
    assert client.words(202, 1) == [1234]
    assert answer_to(site, client_context(folder, "room"))[2].hex() == "030204d2"
    client.send(b"".join(adu(READ, 1, number) for number in range(100)))
    assert [client.receive()[0] for _ in range(100)] == list(range(100))


def answer_to(site, context):
    """What a client with this context gets for a request; None for an alert or the end."""
    try:
        client = secured(site, context)
        site.clients.append(client)
        client.send(adu(READ))
        return client.receive()
    except (ssl.SSLError, ConnectionError):
        return None


@pytest.mark.conformance("Bad input", "TLS without a client certificate gets nothing")
@pytest.mark.conformance("Modbus", "TLS without a client certificate gets nothing")
@pytest.mark.parametrize("name", [None, "intruder"])
@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_a_client_without_one_gets_nothing(name, version, site, folder):
    context = client_context(folder, name)
    context.minimum_version = context.maximum_version = version
    assert answer_to(site, context) is None
    assert site.server.counters.requests == 0


def test_plain_modbus_gets_nothing_where_tls_is_spoken(site):
    client = site.connect()
    client.send(adu(READ))
    head = client.socket.recv(64)
    # an alert record of TLS, or the end
    assert head[:1] in (b"", b"\x15")
    assert site.server.counters.requests == 0


def test_tls_below_1_2_is_not_spoken(folder):
    context = tls_context(asked(folder))
    assert context.minimum_version == ssl.TLSVersion.TLSv1_2
    assert context.verify_mode == ssl.CERT_REQUIRED


def test_missing_or_wrong_files_are_named(folder):
    with pytest.raises(ConfigError, match="tls_client_ca"):
        tls_context(asked(folder, tls_client_ca=str(folder / "none.pem")))
    with pytest.raises(ConfigError, match=r"room\.key"):
        tls_context(asked(folder, tls_key=str(folder / "room.key")))


@pytest.mark.conformance("Bad input", "TLS that is asked for in part is refused")
@pytest.mark.parametrize("without", TLS_KEYS)
def test_a_part_of_tls_is_refused_before_anything_is_served(folder, without, tmp_path, capsys):
    given = asked(folder, **{without: ""})
    with pytest.raises(ConfigError, match=without):
        tls_context(given)
    sets = [
        word for key, path in given.items() if path for word in ("--set", f"modbus.{key}={path}")
    ]
    assert cli.main(["run", "dry_stop", "--out", str(tmp_path / "run"), *sets]) == cli.USAGE
    assert without in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_nothing_of_tls_is_plain_modbus():
    assert tls_context(dict.fromkeys(TLS_KEYS, "")) is None
