"""Writes a configuration of Envoy in front of several servers, by their names:

    python3 deploy/envoy.py plantd-1.lab=10.0.0.1:50051 plantd-2.lab=10.0.0.2:50051 > envoy.json
    envoy -c envoy.json

Clients reach a server by its name, `http://plantd-1.lab:8080`, which DNS leads to Envoy; that is `advertise` of the
server, which answers to no other name. The name of `--new` places new plants and batches on the servers that are ready, in turn, and tries the
next one where a server takes nothing. Whatever is no name gets 404. Loops on the same network connect without it: a
round trip through it takes about twice as long.

TLS, tokens and rations at the edge are Envoy's too, and not here; what plantd itself knows of them is in
docs/security.md.
"""

import argparse
import json

HTTP = "type.googleapis.com/envoy.extensions.upstreams.http.v3.HttpProtocolOptions"
MANAGER = (
    "type.googleapis.com/envoy.extensions.filters.network.http_connection_manager.v3.HttpConnectionManager"
)
ROUTER = "type.googleapis.com/envoy.extensions.filters.http.router.v3.Router"
PREVIOUS = "type.googleapis.com/envoy.extensions.retry.host.previous_hosts.v3.PreviousHostsPredicate"


def address(text: str) -> dict:
    host, port = text.rsplit(":", 1)
    return {"socket_address": {"address": host, "port_value": int(port)}}


def route(cluster: str, **more) -> list[dict]:
    # A stream lives as long as its controller likes.
    return [{"match": {"prefix": "/"}, "route": {"cluster": cluster, "timeout": "0s", **more}}]


def cluster(name: str, servers: list[str], **more) -> dict:
    endpoints = [{"endpoint": {"address": address(server)}} for server in servers]
    keepalive = {"connection_keepalive": {"interval": "5s", "timeout": "5s"}}
    return {
        "name": name,
        "type": "STRICT_DNS",
        "connect_timeout": "1s",
        "typed_extension_protocol_options": {
            "envoy.extensions.upstreams.http.v3.HttpProtocolOptions": {
                "@type": HTTP,
                "explicit_http_config": {"http2_protocol_options": keepalive},
            }
        },
        "load_assignment": {"cluster_name": name, "endpoints": [{"lb_endpoints": endpoints}]},
        **more,
    }


def configuration(servers: dict[str, str], listen: str, new: str, admin: str | None) -> dict:
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
    placing = route("new", retry_policy=retry, host_rewrite_literal="localhost")
    hosts = [{"name": "new", "domains": [new], "routes": placing}]
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
    placement = cluster(
        "new",
        list(servers.values()),
        lb_policy="ROUND_ROBIN",
        # Nobody ready means nobody, not everybody.
        common_lb_config={"healthy_panic_threshold": {"value": 0}},
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
    clusters = [placement, *(cluster(name, [server]) for name, server in servers.items())]
    whole = {"static_resources": {"listeners": [listener], "clusters": clusters}}
    return {"admin": {"address": address(admin)}, **whole} if admin else whole


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("servers", nargs="+", metavar="NAME=HOST:PORT", help="a server, and where it is")
    parser.add_argument("--listen", default="127.0.0.1:8080", metavar="HOST:PORT", help="where Envoy listens")
    parser.add_argument("--new", default="new.plantd", metavar="NAME", help="name that places new plants")
    parser.add_argument("--admin", metavar="HOST:PORT", help="Envoy's own page")
    arguments = parser.parse_args()
    servers = dict(server.split("=", 1) for server in arguments.servers)
    print(json.dumps(configuration(servers, arguments.listen, arguments.new, arguments.admin), indent=1))


if __name__ == "__main__":
    main()
