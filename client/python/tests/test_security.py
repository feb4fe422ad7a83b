"""A server that asks who calls: tokens over every kind of call, and what is said where one is missing or wrong."""

import hashlib
import json
import os
import shutil
import socket
import subprocess
import time

import pytest

import plantd


def entry(name, token, role="driver"):
    digest = hashlib.sha256(token.encode()).hexdigest()
    return f'[[tokens]]\nname = "{name}"\nsha256 = "{digest}"\ntenant = "lab"\nrole = "{role}"\n'


def start(folder, configuration):
    """A server with a configuration; its process and its addresses."""
    (folder / "plantd.toml").write_text(configuration)
    ready = folder / "ready.json"
    command = [os.environ["PLANTD_SERVER"], "serve", "--config", str(folder / "plantd.toml")]
    command += ["--grpc", "127.0.0.1:0", "--unix", str(folder / "plantd.sock"), "--link", "off"]
    command += ["--ready-file", str(ready), "--shutdown-grace-s", "0.2"]
    with (folder / "log").open("w") as log:
        server = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    deadline = time.monotonic() + 30
    while not ready.exists():
        assert server.poll() is None and time.monotonic() < deadline, (folder / "log").read_text()
        time.sleep(0.01)
    return server, json.loads(ready.read_text())


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """Addresses of a server that knows two tokens."""
    folder = tmp_path_factory.mktemp("guarded")
    tokens = folder / "tokens.toml"
    tokens.write_text(entry("anna", "annas-token") + entry("vera", "veras-token", "viewer"))
    server, addresses = start(folder, f'[auth]\ntokens = "{tokens}"\n')
    yield addresses
    server.terminate()
    server.wait(timeout=30)


@pytest.mark.parametrize("kind", ["grpc", "unix"])
def test_a_token_goes_with_every_kind_of_call(guarded, kind):
    with plantd.connect(guarded[kind], token="annas-token") as client:
        with client.plant("pendulum") as plant:
            plant.step([[0.1]])
            with plant.drive() as driver:
                assert driver.step([0.1]).step == 2
            assert next(iter(plant.watch())) is not None
        assert "annas-token" not in repr(client.__dict__)


def test_what_is_missing_or_wrong_is_said(guarded, monkeypatch):
    monkeypatch.delenv("PLANTD_TOKEN", raising=False)
    for token, reason in [(None, "NO_CREDENTIALS"), ("nobodys", "TOKEN_UNKNOWN")]:
        with plantd.connect(guarded["grpc"], token=token) as client:
            with pytest.raises(plantd.PlantdError) as caught:
                client.list_plants()
        assert (caught.value.code, caught.value.reason) == ("UNAUTHENTICATED", reason)
    monkeypatch.setenv("PLANTD_TOKEN", "veras-token")
    with plantd.connect(guarded["grpc"]) as client:
        assert client.list_plants() == []
        with pytest.raises(plantd.PlantdError) as caught:
            client.create_plant("pendulum")
    assert (caught.value.code, caught.value.reason) == ("PERMISSION_DENIED", "ROLE")


def test_files_that_are_not_there_are_named(tmp_path):
    address = "https://127.0.0.1:1"
    for files, said in [
        ({"ca": tmp_path / "none.pem"}, "`ca`"),
        ({"cert": tmp_path / "none.pem"}, "belong together"),
    ]:
        with pytest.raises(plantd.PlantdError, match=said):
            plantd.connect(address, **files)


def certificate(folder, name):
    """A certificate of somebody, its key, and the CA that issued it."""

    def openssl(*arguments):
        subprocess.run(["openssl", *arguments], check=True, capture_output=True, cwd=folder)

    def path(end):
        return str(folder / f"{name}{end}")

    key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    openssl("req", "-x509", *key, "-subj", f"/CN={name} CA", "-keyout", path(".ca.key"), "-out", path(".ca"))
    openssl("req", *key, "-subj", f"/CN={name}", "-keyout", path(".key"), "-out", path(".csr"))
    (folder / f"{name}.ext").write_text("subjectAltName=IP:127.0.0.1,DNS:localhost\n")
    signed = ["-CA", path(".ca"), "-CAkey", path(".ca.key"), "-CAcreateserial", "-extfile", path(".ext")]
    openssl("x509", "-req", "-in", path(".csr"), *signed, "-out", path(".pem"))
    return path(".pem"), path(".key"), path(".ca")


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")
def test_each_side_of_tls_says_what_it_refuses(tmp_path, monkeypatch):
    own, other, person = (certificate(tmp_path, name) for name in ("server", "other", "person"))
    tls = f'[tls]\ncertificate = "{own[0]}"\nkey = "{own[1]}"\nclient_ca = "{person[2]}"\nclient = "required"\n'
    rule = '[[auth.certificates]]\nsubject = "person"\nrole = "driver"\n'
    server, addresses = start(tmp_path, tls + rule)
    monkeypatch.setattr("plantd._connect._CONNECT_SECONDS", 2.0)

    def refusal(**files):
        with pytest.raises(plantd.PlantdError) as caught:
            plantd.connect(addresses["grpc"], **files)
        return caught.value.message

    try:
        shown = {"cert": person[0], "key": person[1]}
        for address in (addresses["grpc"], addresses["grpc"].replace("127.0.0.1", "localhost")):
            with plantd.connect(address, ca=own[2], **shown) as client:
                assert client.list_plants() == []
        assert "this client refuses the server's certificate" in refusal(ca=other[2], **shown)
        assert "only those with a certificate" in refusal(ca=own[2])
        refused = refusal(ca=own[2], cert=other[0], key=other[1])
        assert "TLS was refused" in refused, refused
    finally:
        server.terminate()
        server.wait(timeout=30)
    with socket.create_server(("127.0.0.1", 0)) as plain, pytest.raises(plantd.PlantdError):
        plantd.connect(f"https://127.0.0.1:{plain.getsockname()[1]}", ca=own[2])
