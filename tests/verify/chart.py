"""Lints and renders deploy/chart with Helm's own library, and checks what comes out against the schemas of Kubernetes.

    python3 tests/verify/chart.py           # takes helm-python-sdk, kubernetes-validate and PyYAML
"""

import tomllib
from pathlib import Path

import helm_python
import kubernetes_validate
import yaml

CHART = Path(__file__).resolve().parents[2] / "deploy/chart"
VERSIONS = ("1.29", "1.34", "1.37")
CLOSED = {"insecure": True}
SAFE = {
    "tls": {"secret": "plantd-tls"},
    "auth": {"secret": "plantd-tokens"},
    "state": {"storageClass": "fast"},
    "networkPolicy": {"from": [{"podSelector": {"matchLabels": {"app": "lab"}}}]},
    "config": "state_interval_s = 1.0\n[limits]\nplants = 10\n",
}
STORED = {**CLOSED, "state": {"store": "s3://lab/plantd", "storeSecret": "lab-bucket"}}
KINDS = ["ConfigMap", "NetworkPolicy", "PodDisruptionBudget", "Service", "Service", "StatefulSet"]
#: Each target by itself, and all of them.
SCALED = [{"plants": 500, "waitingJobs": 0}, {"plants": 0, "waitingJobs": 0, "processors": 60}, {"processors": 60}]
METRICS = Path(__file__).resolve().parents[2] / "deploy/prometheus.yml"


def rendered(values: dict) -> list[dict]:
    with helm_python.Chart.load(str(CHART)) as chart:
        chart.validate_schema(values)
        texts = chart.render(values, name="plantd", namespace="lab").values()
        return [part for text in texts for part in yaml.safe_load_all(text) if part]


def is_refused(values: dict) -> bool:
    try:
        rendered(values)
    except helm_python.HelmError:
        return True
    return False


def problems(part: dict, version: str) -> list[str]:
    try:
        kubernetes_validate.validate(part, version, strict=True)
    except kubernetes_validate.ValidationError as error:
        return [f"Kubernetes {version}, {part['kind']}: {error.message}"]
    return []


def check_autoscaling(values: dict) -> None:
    """The servers are scaled by what they export, upwards alone."""
    parts = rendered({**CLOSED, "autoscaling": values})
    (scaler,) = (part for part in parts if part["kind"] not in KINDS)
    found = [text for part in parts for version in VERSIONS for text in problems(part, version)]
    assert not found, "\n".join(found)
    (servers,) = (part for part in parts if part["kind"] == "StatefulSet")
    # Its number is the scaler's business alone.
    assert "replicas" not in servers["spec"]
    spec = scaler["spec"]
    assert spec["scaleTargetRef"]["name"] == servers["metadata"]["name"] and spec["minReplicas"] == 2
    assert spec["behavior"]["scaleDown"] == {"selectPolicy": "Disabled"}
    of_pods = [metric["pods"]["metric"]["name"] for metric in spec["metrics"] if metric["type"] == "Pods"]
    of_servers = [metric["resource"]["name"] for metric in spec["metrics"] if metric["type"] == "Resource"]
    wanted = {"plantd_plants": values.get("plants", 1), "plantd_waiting_jobs": values.get("waitingJobs", 1)}
    assert of_pods == [name for name, target in wanted.items() if target], of_pods
    assert of_servers == ["cpu"] * ("processors" in values), of_servers
    exported = METRICS.read_text()
    assert all(f"# | `{name}` | gauge |" in exported for name in of_pods)


def main() -> None:
    report = helm_python.lint(str(CHART), strict=True, values=CLOSED)
    assert not report["errors"], report
    for values in (CLOSED, SAFE, STORED):
        parts = rendered(values)
        kinds = sorted(part["kind"] for part in parts)
        assert kinds == KINDS, kinds
        found = [text for part in parts for version in VERSIONS for text in problems(part, version)]
        assert not found, "\n".join(found)
        (configuration,) = (part for part in parts if part["kind"] == "ConfigMap")
        toml = tomllib.loads(configuration["data"]["plantd.toml"])
        assert ("tls" in toml and "auth" in toml) == ("tls" in values), toml
        (servers,) = (part for part in parts if part["kind"] == "StatefulSet")
        pod = servers["spec"]["template"]["spec"]
        said = {entry["name"]: entry.get("value") for entry in pod["containers"][0]["env"]}
        scheme = "https" if "tls" in values else "http"
        assert said["PLANTD_ADVERTISE"] == f"{scheme}://$(PLANTD_NAME).plantd.$(NAMESPACE).svc:50051"
        store = values.get("state", {}).get("store")
        assert said["PLANTD_STATE_DIRECTORY"] == (store or "/var/lib/plantd/plants")
        secrets = [entry["secretRef"]["name"] for entry in pod["containers"][0].get("envFrom", [])]
        assert secrets == (["lab-bucket"] if store else []), secrets
        # It is not cut off while it drains or saves.
        assert pod["terminationGracePeriodSeconds"] > float(said["PLANTD_DRAIN_S"]) + 10
        mounts = {mount["name"] for mount in pod["containers"][0]["volumeMounts"]}
        volumes = {volume["name"] for volume in pod["volumes"]} | {"state"}
        assert mounts == volumes, mounts ^ volumes

        # These checks find something where there is something.
        servers["spec"]["podManagmentPolicy"] = "Parallel"
        assert problems(servers, VERSIONS[0]), "a misspelt key passes"
    for scaled in SCALED:
        check_autoscaling({"enabled": True, "minReplicas": 2, **scaled})
    for wrong in ({"minReplicas": 11}, {"plants": 0, "waitingJobs": 0}, {"plants": -1}, {"plant": 1}):
        assert is_refused({**CLOSED, "autoscaling": {"enabled": True, **wrong}}), wrong
    assert is_refused({}), "servers that everybody can reach, and nobody has said so"
    assert is_refused({"insecure": True, "replica": 3}), "an unknown value passes"
    assert is_refused({**CLOSED, "state": {"store": "ftp://lab"}}), "a store that is none passes"
    assert is_refused({"insecure": True, "replicas": "three"}), "a wrong type passes"
    print(f"the chart is good for Kubernetes {', '.join(VERSIONS)}")


if __name__ == "__main__":
    main()
