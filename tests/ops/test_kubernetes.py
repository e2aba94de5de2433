# SPDX-License-Identifier: MIT
"""The Kubernetes manifests, built by kubectl's kustomize: schemas, policies, and what they name. Needs no cluster."""

from __future__ import annotations

import functools
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import kubernetes_validate
import pytest
import yaml

from in_process import rfm_parsed
from paths import ROOT

KUBERNETES = ROOT / "docker" / "kubernetes"
OVERLAYS = ("overlays/cpu", "overlays/gpu")
SETS = (*OVERLAYS, "kserve")
RELEASES = ("1.31", "1.37")  # the oldest that the manifests are for, and the newest known
CUSTOM = {"PodMonitor", "InferenceService", "ServingRuntime"}  # whose schemas are not Kubernetes' own
PORT_OPTIONS = {"http1": "http_port", "gateway": "port"}  # else the port's name and _port
SECURITY = {
    "allowPrivilegeEscalation": False,
    "capabilities": {"drop": ["ALL"]},
    "readOnlyRootFilesystem": True,
    "runAsNonRoot": True,
    "runAsUser": 10001,
    "seccompProfile": {"type": "RuntimeDefault"},
}

Object = dict[str, Any]


@functools.cache
def built(folder: str) -> list[Object]:
    """Return the objects that ``kubectl apply -k`` sends."""
    command = [Path(sys.executable).parent / "kubectl", "kustomize", KUBERNETES / folder]
    made = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return list(yaml.load_all(made, yaml.CSafeLoader))


def of_kind(folder: str, *kinds: str) -> dict[str, Object]:
    return {each["metadata"]["name"]: each for each in built(folder) if each["kind"] in kinds}


def pod_of(workload: Object) -> Object:
    """The pod's specification."""
    return workload["spec"] if workload["kind"] == "ServingRuntime" else workload["spec"]["template"]["spec"]


def container_of(workload: Object) -> Object:
    (container,) = pod_of(workload)["containers"]
    return container


@pytest.mark.parametrize("release", RELEASES)
def test_every_manifest_fits_its_schema(release: str) -> None:
    copying = yaml.safe_load((KUBERNETES / "copy.yaml").read_text())
    for manifest in [copying, *(each for folder in SETS for each in built(folder))]:
        if manifest["kind"] not in CUSTOM:
            kubernetes_validate.validate(manifest, release, strict=True)


@pytest.mark.parametrize("folder", SETS)
def test_pods_are_restricted_and_run_the_program_with_its_options(folder: str) -> None:
    for workload in of_kind(folder, "Deployment", "ServingRuntime").values():
        pod, container = pod_of(workload), container_of(workload)
        context = {**pod.get("securityContext", {}), **container["securityContext"]}
        assert {name: context.get(name) for name in SECURITY} == SECURITY
        assert not {"hostNetwork", "hostPID", "hostIPC"} & set(pod)
        assert container["resources"]["limits"]["memory"]
        mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
        assert mounts.keys() == {volume["name"] for volume in pod["volumes"]}
        assert container["command"] == ["rfm"]
        given = rfm_parsed(*container["args"])
        assert given["host"] == "0.0.0.0"
        ports = {port["name"]: port["containerPort"] for port in container["ports"]}
        assert ports == {name: given[PORT_OPTIONS.get(name, f"{name}_port")] for name in ports}
        is_gateway = container["args"][0] == "gateway"
        for kind in ("startupProbe", "readinessProbe", "livenessProbe"):
            if "httpGet" in container[kind]:
                port = container[kind]["httpGet"]["port"]
                assert ports.get(port, port) == given["port" if is_gateway else "status_port"]
        key = given["api_key_file"] if is_gateway else given["admin_key_file"]
        for secret in (volume for volume in pod["volumes"] if "secret" in volume):
            assert (str(key.parent), secret["secret"]["defaultMode"]) == (mounts[secret["name"]], 0o400)


@pytest.mark.parametrize("folder", OVERLAYS)
def test_services_monitors_and_policies_find_pods_with_their_ports(folder: str) -> None:
    deployments = of_kind(folder, "Deployment")

    def ports(selector: dict[str, str]) -> dict[str, int]:
        """Return the ports of the only deployment whose pods have these labels."""
        pods = [each["spec"]["template"] for each in deployments.values()]
        (pod,) = (pod for pod in pods if selector.items() <= pod["metadata"]["labels"].items())
        return {port["name"]: port["containerPort"] for port in pod["spec"]["containers"][0]["ports"]}

    for service in of_kind(folder, "Service").values():
        assert {port["targetPort"] for port in service["spec"]["ports"]} <= {*ports(service["spec"]["selector"])}
    for monitor in of_kind(folder, "PodMonitor").values():
        scraped = {endpoint["port"] for endpoint in monitor["spec"]["podMetricsEndpoints"]}
        assert scraped <= {*ports(monitor["spec"]["selector"]["matchLabels"])}
    policies = of_kind(folder, "NetworkPolicy")
    assert policies.pop("default")["spec"]["podSelector"] == {}
    for policy in policies.values():
        opened = {port["port"] for rule in policy["spec"]["ingress"] for port in rule["ports"]}
        assert opened == {*ports(policy["spec"]["podSelector"]["matchLabels"]).values()}
    gateway = rfm_parsed(*container_of(deployments["rfm-gateway"])["args"])
    assert urlsplit(gateway["triton"]).hostname in of_kind(folder, "Service")
