"""Writes a configuration of Envoy in front of several servers, by their names:

    python3 deploy/envoy.py plantd-1.lab=10.0.0.1:50051 plantd-2.lab=10.0.0.2:50051 > envoy.json
    envoy -c envoy.json

Clients reach a server by its name, `http://plantd-1.lab:8080`, which DNS leads to Envoy; that is `advertise` of the
server, which answers to no other name. The name of `--new` places new plants and batches on the servers that are ready, in turn, and tries the
next one where a server takes nothing. Whatever is no name gets 404. Loops on the same network connect without it: a
round trip through it takes about twice as long.

A server's host that is a name of DNS is looked up again every five seconds. With `--endpoints` the places of the
servers are numbers, and stand in files of their own, which Envoy reads again when they are replaced. Who has moved a
server writes them anew by the same command with its new place, and the name leads there at once; other servers'
streams notice nothing:

    python3 deploy/envoy.py --endpoints endpoints plantd-1.lab=10.0.0.7:50051 plantd-2.lab=10.0.0.2:50051 > envoy.json

TLS, tokens and rations at the edge are Envoy's too, and not here; what plantd itself knows of them is in
docs/security.md.
"""

import argparse
import ipaddress
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

HTTP = "type.googleapis.com/envoy.extensions.upstreams.http.v3.HttpProtocolOptions"
MANAGER = (
    "type.googleapis.com/envoy.extensions.filters.network.http_connection_manager.v3.HttpConnectionManager"
)
ASSIGNMENT = "type.googleapis.com/envoy.config.endpoint.v3.ClusterLoadAssignment"
ROUTER = "type.googleapis.com/envoy.extensions.filters.http.router.v3.Router"
PREVIOUS = "type.googleapis.com/envoy.extensions.retry.host.previous_hosts.v3.PreviousHostsPredicate"
BREAKERS = ("max_connections", "max_pending_requests", "max_requests", "max_retries")


def address(text: str) -> dict:
    host, port = text.rsplit(":", 1)
    return {"socket_address": {"address": host.strip("[]"), "port_value": int(port)}}


def route(cluster: str, **more) -> list[dict]:
    # A stream lives as long as its controller likes.
    return [{"match": {"prefix": "/"}, "route": {"cluster": cluster, "timeout": "0s", **more}}]


def assignment(name: str, servers: list[str]) -> dict:
    """Where the servers of a cluster are."""
    endpoints = [{"endpoint": {"address": address(server)}} for server in servers]
    return {"cluster_name": name, "endpoints": [{"lb_endpoints": endpoints}]}


def cluster(name: str, servers: list[str], folder: Path | None, **more) -> dict:
    http2 = {
        # As many as a server takes on one (`streams_per_connection`); for more there are more connections.
        "max_concurrent_streams": 256,
        "connection_keepalive": {"interval": "5s", "timeout": "5s"},
    }
    if folder:
        source = {"path": str(file_of(folder, name)), "watched_directory": {"path": str(folder)}}
        config = {"resource_api_version": "V3", "path_config_source": source}
        found = {"type": "EDS", "eds_cluster_config": {"service_name": name, "eds_config": config}}
    else:
        found = {"type": "STRICT_DNS", "load_assignment": assignment(name, servers)}
    return {
        "name": name,
        **found,
        "connect_timeout": "1s",
        # A driver is one request for as long as it drives; how many there may be is the server's business.
        "circuit_breakers": {"thresholds": [dict.fromkeys(BREAKERS, 1_000_000)]},
        "typed_extension_protocol_options": {
            "envoy.extensions.upstreams.http.v3.HttpProtocolOptions": {
                "@type": HTTP,
                "explicit_http_config": {"http2_protocol_options": http2},
            }
        },
        **more,
    }


def clusters_of(servers: dict[str, str], new: str) -> Iterator[tuple[str, list[str]]]:
    """Each name, and the places where it leads."""
    yield new, list(servers.values())
    for name, place in servers.items():
        yield name, [place]


def file_of(folder: Path, name: str) -> Path:
    return folder / f"{name}.json"


def publish(servers: dict[str, str], new: str, folder: Path) -> None:
    """Replaces the files of the places, each in one go: Envoy reads what is moved into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, places in clusters_of(servers, new):
        file = file_of(folder, name)
        text = json.dumps({"resources": [{"@type": ASSIGNMENT, **assignment(name, places)}]}, indent=1)
        if file.exists() and file.read_text() == text:
            continue
        ready = file.with_suffix(".new")
        ready.write_text(text)
        os.replace(ready, file)


def configuration(
    servers: dict[str, str], listen: str, new: str, admin: str | None = None, folder: Path | None = None
) -> dict:
    # What was refused unseen may be tried elsewhere: nothing has been made of it.
    retry = {
        "retry_on": "connect-failure,refused-stream,unavailable",
        "num_retries": len(servers),
        "host_selection_retry_max_attempts": 5,
        "retry_host_predicate": [
            {
                "name": "envoy.retry_host_predicates.previous_hosts",
                "typed_config": {"@type": PREVIOUS},
            }
        ],
    }
    # A server is called by its own name alone, or as one on this machine.
    placing = route(new, retry_policy=retry, host_rewrite_literal="localhost")
    hosts = [{"name": new, "domains": [new], "routes": placing}]
    hosts += [{"name": name, "domains": [name], "routes": route(name)} for name in servers]
    manager = {
        "@type": MANAGER,
        "stat_prefix": "plantd",
        "codec_type": "AUTO",
        "stream_idle_timeout": "0s",
        "common_http_protocol_options": {"idle_timeout": "0s"},
        "strip_any_host_port": True,
        "http2_protocol_options": {
            "max_concurrent_streams": 256,
            "connection_keepalive": {"interval": "10s", "timeout": "20s"},
        },
        "route_config": {"virtual_hosts": hosts},
        "http_filters": [
            {"name": "envoy.filters.http.router", "typed_config": {"@type": ROUTER}}
        ],
    }
    listener = {
        "name": "plantd",
        "address": address(listen),
        "filter_chains": [
            {
                "filters": [
                    {
                        "name": "envoy.filters.network.http_connection_manager",
                        "typed_config": manager,
                    }
                ]
            }
        ],
    }
    placing_on_ready = dict(
        lb_policy="ROUND_ROBIN",
        # Nobody ready means nobody, not everybody.
        common_lb_config={"healthy_panic_threshold": {"value": 0}},
        # What is published counts at once, not when a server that is gone fails its check.
        ignore_health_on_host_removal=True,
        health_checks=[
            {
                "timeout": "1s",
                "interval": "0.5s",
                "no_traffic_interval": "0.5s",
                "unhealthy_threshold": 1,
                "healthy_threshold": 1,
                "grpc_health_check": {
                    "service_name": "plantd.v1.PlantService",
                    "authority": "localhost",
                },
            }
        ],
    )
    clusters = [
        cluster(name, places, folder, **(placing_on_ready if name == new else {}))
        for name, places in clusters_of(servers, new)
    ]
    whole = {"static_resources": {"listeners": [listener], "clusters": clusters}}
    if folder:
        # Envoy reads such files only when it has a name itself.
        whole["node"] = {"id": "plantd", "cluster": "plantd"}
    return {"admin": {"address": address(admin)}, **whole} if admin else whole


def named(texts: list[str], new: str, are_numbers: bool) -> dict[str, str]:
    """The servers of the command line by their names; what is wrong with them is a `ValueError`."""
    servers: dict[str, str] = {}
    for text in texts:
        name, _, place = text.partition("=")
        host, _, port = place.rpartition(":")
        if not re.fullmatch(r"[A-Za-z0-9._-]+", name) or not host or not port.isdecimal():
            raise ValueError(f"`{text}` is not NAME=HOST:PORT")
        if name == new or name in servers:
            raise ValueError(f"the name `{name}` is there twice")
        if are_numbers:
            try:
                ipaddress.ip_address(host.strip("[]"))
            except ValueError:
                raise ValueError(f"`{host}`: with --endpoints hosts are numbers; Envoy looks up no name there") from None
        servers[name] = place
    return servers


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("servers", nargs="+", metavar="NAME=HOST:PORT", help="a server, and where it is")
    parser.add_argument("--listen", default="127.0.0.1:8080", metavar="HOST:PORT", help="where Envoy listens")
    parser.add_argument("--new", default="new.plantd", metavar="NAME", help="name that places new plants")
    parser.add_argument("--admin", metavar="HOST:PORT", help="Envoy's own page")
    parser.add_argument(
        "--endpoints",
        type=Path,
        metavar="FOLDER",
        help="where the files of the servers' places are written, and read by Envoy",
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="file of the configuration; else it is printed")
    arguments = parser.parse_args()
    folder = arguments.endpoints.absolute() if arguments.endpoints else None
    try:
        servers = named(arguments.servers, arguments.new, are_numbers=folder is not None)
    except ValueError as error:
        parser.error(str(error))
    if folder:
        publish(servers, arguments.new, folder)
    whole = configuration(servers, arguments.listen, arguments.new, arguments.admin, folder)
    text = json.dumps(whole, indent=1)
    if arguments.output:
        arguments.output.write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    main()
