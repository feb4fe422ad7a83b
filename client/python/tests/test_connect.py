"""What is said of an address at which there is no server: a sentence of its own for each mistake."""

import socket

import pytest

import plantd
from plantd import _connect


@pytest.fixture(autouse=True)
def no_patience(monkeypatch):
    monkeypatch.setattr(_connect, "_CONNECT_SECONDS", 0.5)


def refusal(address):
    with pytest.raises(plantd.PlantdError) as caught:
        plantd.connect(address)
    assert address in caught.value.message
    return caught.value


def test_addresses_that_are_none():
    for address, said in [
        ("https://", "no host"),
        ("ftp://127.0.0.1:1", "scheme"),
        ("http://", "no host"),
        ("unix:relative", "begins with `/`"),
        ("127.0.0.1:one", "cannot be read"),
    ]:
        error = refusal(address)
        assert error.code == "INVALID_ARGUMENT" and said in error.message


def test_places_without_a_server(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    assert "no server listens there" in refusal(f"http://127.0.0.1:{port}").message
    assert "no host of that name" in refusal("no-such-host.invalid:1").message
    assert "no such socket" in refusal(f"unix:{tmp_path}/none").message
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(f"{tmp_path}/dead")
    assert "has ended" in refusal(f"unix:{tmp_path}/dead").message


def test_a_server_of_something_else():
    with socket.create_server(("127.0.0.1", 0)) as other:
        error = refusal(f"http://127.0.0.1:{other.getsockname()[1]}")
    assert error.code == "UNAVAILABLE" and "does not speak gRPC" in error.message


def test_every_notation_of_an_address(addresses):
    place = addresses["grpc"].removeprefix("http://")
    path = addresses["unix"].removeprefix("unix:")
    for address in [place, f"http://{place}", f"http://{place}/", f"unix:{path}", f"unix://{path}"]:
        with plantd.connect(address) as client:
            assert client.list_plants() == []
