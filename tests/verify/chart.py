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


def main() -> None:
    report = helm_python.lint(str(CHART), strict=True, values=CLOSED)
    assert not report["errors"], report
    for values in (CLOSED, SAFE):
        parts = rendered(values)
        kinds = sorted(part["kind"] for part in parts)
        assert kinds == [
            "ConfigMap", "NetworkPolicy", "PodDisruptionBudget", "Service", "Service", "StatefulSet",
        ], kinds
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
        # It is not cut off while it drains or saves.
        assert pod["terminationGracePeriodSeconds"] > float(said["PLANTD_DRAIN_S"]) + 10
        mounts = {mount["name"] for mount in pod["containers"][0]["volumeMounts"]}
        volumes = {volume["name"] for volume in pod["volumes"]} | {"state"}
        assert mounts == volumes, mounts ^ volumes

        # These checks find something where there is something.
        servers["spec"]["podManagmentPolicy"] = "Parallel"
        assert problems(servers, VERSIONS[0]), "a misspelt key passes"
    assert is_refused({}), "servers that everybody can reach, and nobody has said so"
    assert is_refused({"insecure": True, "replica": 3}), "an unknown value passes"
    assert is_refused({"insecure": True, "replicas": "three"}), "a wrong type passes"
    print(f"the chart is good for Kubernetes {', '.join(VERSIONS)}")


if __name__ == "__main__":
    main()
