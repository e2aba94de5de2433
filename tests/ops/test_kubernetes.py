# SPDX-License-Identifier: MIT
"""The Kubernetes manifests: built by kubectl's kustomize, checked against schemas and policies, and against the programs.

Kubernetes' own schemas come with kubernetes-validate; those of PodMonitor and of KServe's objects are excerpts
(``custom_resource_schemas.json`` names them). The tests need no cluster.
"""

from __future__ import annotations

import functools
import importlib.metadata
import json
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import jsonschema
import kubernetes_validate
import pytest
import yaml
from referencing import Registry, Resource

from in_process import rfm_parsed
from paths import ROOT
from repositories import kill_model
from rfm.launch.ending import KILL_AFTER_S
from rfm_gateway.command import STOP_WITHIN_S
from servers import Endpoints, wait_for

pytestmark = pytest.mark.slow

KUBERNETES = ROOT / "docker" / "kubernetes"
BIN = Path(sys.executable).parent
PROMETHEUS = yaml.safe_load((ROOT / "docker" / "prometheus" / "prometheus.yml").read_text())
OVERLAYS = ("overlays/cpu", "overlays/gpu")
SETS = (*OVERLAYS, "kserve")
RELEASES = ("1.31", "1.37")  # the oldest that the manifests are for, and the newest known
CUSTOM = ("monitoring.coreos.com/", "serving.kserve.io/")
VOLUMES = {"configMap", "csi", "downwardAPI", "emptyDir", "ephemeral", "persistentVolumeClaim", "projected", "secret"}
PORT_OPTIONS = {
    "http": "http_port",
    "http1": "http_port",
    "grpc": "grpc_port",
    "metrics": "metrics_port",
    "status": "status_port",
    "gateway": "port",
}
PROBES = ("startupProbe", "readinessProbe", "livenessProbe")
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
def _built(folder: str) -> str:
    command = [BIN / "kubectl", "kustomize", KUBERNETES / folder]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def built(folder: str, *kinds: str) -> list[Object]:
    """Return the objects that ``kubectl apply -k`` sends; only those of ``kinds`` if given."""
    return [found for found in yaml.load_all(_built(folder), yaml.CSafeLoader) if not kinds or found["kind"] in kinds]


def named(folder: str, kind: str, name: str) -> Object:
    (found,) = (found for found in built(folder, kind) if found["metadata"]["name"] == name)
    return found


def pod_of(workload: Object) -> Object:
    """The pod's specification."""
    return workload["spec"] if workload["kind"] == "ServingRuntime" else workload["spec"]["template"]["spec"]


def container_of(workload: Object) -> Object:
    (container,) = pod_of(workload)["containers"]
    return container


def workloads(*folders: str) -> list[Any]:
    """Everything that makes pods, as parameters."""
    return [
        pytest.param(workload, id=f"{folder}-{workload['metadata']['name']}")
        for folder in folders
        for workload in built(folder, "Deployment", "ServingRuntime")
    ]


def selected(selector: dict[str, str], folder: str) -> list[Object]:
    """Deployments whose pods have these labels."""
    deployments = built(folder, "Deployment")
    return [one for one in deployments if selector.items() <= one["spec"]["template"]["metadata"]["labels"].items()]


def validate(manifest: Object, release: str) -> None:
    if not manifest["apiVersion"].startswith(CUSTOM):
        kubernetes_validate.validate(manifest, release, strict=True)
        return
    folder = f"v{kubernetes_validate.latest_version()}-local-strict"
    core = json.loads(
        (files("kubernetes_validate") / "kubernetes-json-schema" / folder / "_definitions.json").read_text()
    )
    excerpt = json.loads(Path(__file__).with_name("custom_resource_schemas.json").read_text())
    schema = {"$ref": f"#/$defs/{manifest['kind']}", **excerpt}
    registry = Registry().with_resource(core["$id"], Resource.from_contents(core))
    jsonschema.Draft202012Validator(schema, registry=registry).validate(manifest)


@pytest.mark.parametrize("release", RELEASES)
@pytest.mark.parametrize("folder", SETS)
def test_every_manifest_fits_its_schema(folder: str, release: str) -> None:
    for manifest in built(folder):
        validate(manifest, release)


@pytest.mark.parametrize("workload", workloads(*SETS))
def test_pods_are_restricted(workload: Object) -> None:
    """Pods meet the pod security standard "restricted" and have a read-only root file system."""
    pod, container = pod_of(workload), container_of(workload)
    context = {**pod.get("securityContext", {}), **container["securityContext"]}
    assert {name: context.pop(name) for name in SECURITY} == SECURITY
    assert set(context) <= {"runAsGroup", "fsGroup", "fsGroupChangePolicy"}
    assert not {"hostNetwork", "hostPID", "hostIPC", "initContainers", "ephemeralContainers"} & set(pod)
    assert {kind for volume in pod["volumes"] for kind in volume} <= {"name", *VOLUMES}
    assert not [port for port in container["ports"] if "hostPort" in port]


@pytest.mark.parametrize("workload", workloads(*SETS))
def test_containers_have_limits_probes_and_the_release_s_image(workload: Object) -> None:
    container = container_of(workload)
    on_gpu = "nvidia.com/gpu" in container["resources"]["limits"]
    variants = ("", "-cpu") if container["args"][0] == "gateway" else ("",) if on_gpu else ("-cpu",)
    release = f"registry.example.com/rfm-triton:{importlib.metadata.version('rfm-triton')}"
    assert container["image"] in [release + variant for variant in variants]
    resources = container["resources"]
    assert resources["requests"]["memory"] and resources["limits"]["memory"] and resources["requests"]["cpu"]
    for kind in PROBES:
        assert container[kind]["periodSeconds"] and container[kind]["timeoutSeconds"]
    mounts = {mount["name"] for mount in container["volumeMounts"]}
    assert mounts == {volume["name"] for volume in pod_of(workload)["volumes"]}


def test_a_gpu_is_asked_for_where_there_is_one() -> None:
    cpu, gpu = (pod_of(named(folder, "Deployment", "rfm-triton")) for folder in OVERLAYS)
    assert gpu["containers"][0]["resources"]["limits"]["nvidia.com/gpu"] == "1"
    assert gpu["tolerations"] == [{"key": "nvidia.com/gpu", "operator": "Exists", "effect": "NoSchedule"}]
    assert "nvidia.com/gpu" not in cpu["containers"][0]["resources"]["limits"] and "tolerations" not in cpu
    threads = {"name": "OMP_NUM_THREADS", "value": cpu["containers"][0]["resources"]["limits"]["cpu"]}
    assert threads in cpu["containers"][0]["env"]


@pytest.mark.parametrize("workload", workloads(*SETS))
def test_arguments_are_those_of_the_program(workload: Object) -> None:
    container = container_of(workload)
    assert container["command"] == ["rfm"]
    given = rfm_parsed(*container["args"])
    assert given["host"] == "0.0.0.0"
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    assert ports == {name: given[PORT_OPTIONS[name]] for name in ports}
    is_gateway = container["args"][0] == "gateway"
    for kind in PROBES:
        if "httpGet" in container[kind]:
            port = container[kind]["httpGet"]["port"]
            assert ports.get(port, port) == given["port" if is_gateway else "status_port"]
    if is_gateway:
        return
    is_kserve = workload["kind"] == "ServingRuntime"
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert str(given["repository"]) == ("/mnt/models" if is_kserve else f"{mounts['repository']}/model_repository")


@pytest.mark.parametrize("workload", workloads(*OVERLAYS))
def test_keys_are_files_that_others_cannot_read(workload: Object) -> None:
    container, pod = container_of(workload), pod_of(workload)
    (secret,) = (volume for volume in pod["volumes"] if "secret" in volume)
    (mount,) = (mount for mount in container["volumeMounts"] if mount["name"] == secret["name"])
    given = rfm_parsed(*container["args"])
    file = given["api_key_file"] if container["args"][0] == "gateway" else given["admin_key_file"]
    assert file.parent == Path(mount["mountPath"])
    assert secret["secret"]["defaultMode"] == 0o400
    assert pod["securityContext"]["fsGroup"] == pod["securityContext"]["runAsGroup"]
    assert_readme_creates(secret["secret"]["secretName"], file.name)


def test_kserve_s_key_is_a_variable() -> None:
    container = container_of(named("kserve", "ServingRuntime", "rfm-triton"))
    assert rfm_parsed(*container["args"])["admin_key_file"] is None
    (key,) = (one["valueFrom"]["secretKeyRef"] for one in container["env"] if one["name"] == "RFM_ADMIN_KEY")
    assert_readme_creates(key["name"], key["key"])


def assert_readme_creates(secret: str, key: str) -> None:
    command = f"create secret generic {secret} --from-literal={key}="
    assert command in (KUBERNETES / "README.md").read_text()


@pytest.mark.parametrize("workload", workloads(*OVERLAYS))
def test_requests_in_flight_have_time_to_end(workload: Object) -> None:
    sleep_s = container_of(workload)["lifecycle"]["preStop"]["sleep"]["seconds"]
    stops_within_s = STOP_WITHIN_S if container_of(workload)["args"][0] == "gateway" else KILL_AFTER_S
    assert pod_of(workload)["terminationGracePeriodSeconds"] > sleep_s + stops_within_s
    assert workload["spec"]["strategy"]["rollingUpdate"] == {"maxSurge": 1, "maxUnavailable": 0}
    startup = container_of(workload)["startupProbe"]
    deadline_s = workload["spec"].get("progressDeadlineSeconds", 600)
    assert startup["periodSeconds"] * startup["failureThreshold"] < deadline_s


@pytest.mark.parametrize("folder", OVERLAYS)
def test_selectors_find_their_pods(folder: str) -> None:
    for deployment in built(folder, "Deployment"):
        labels = deployment["spec"]["selector"]["matchLabels"]
        assert [one["metadata"]["name"] for one in selected(labels, folder)] == [deployment["metadata"]["name"]]
        for spread in pod_of(deployment)["topologySpreadConstraints"]:
            assert spread["labelSelector"]["matchLabels"] == labels
        for kind in ("PodDisruptionBudget", "PodMonitor"):
            assert named(folder, kind, deployment["metadata"]["name"])["spec"]["selector"]["matchLabels"] == labels
    for service in built(folder, "Service"):
        (deployment,) = selected(service["spec"]["selector"], folder)
        names = {port["name"] for port in container_of(deployment)["ports"]}
        assert {port["targetPort"] for port in service["spec"]["ports"]} <= names
    jobs, scraped = [job["job_name"] for job in PROMETHEUS["scrape_configs"]], []
    for monitor in built(folder, "PodMonitor"):
        (deployment,) = selected(monitor["spec"]["selector"]["matchLabels"], folder)
        names = {port["name"] for port in container_of(deployment)["ports"]}
        for endpoint in monitor["spec"]["podMetricsEndpoints"]:
            assert endpoint["port"] in names
            (relabeling,) = endpoint["relabelings"]
            assert relabeling["targetLabel"] == "job"
            scraped.append(relabeling["replacement"])
    assert sorted(scraped) == sorted(jobs)  # which the alerts name


@pytest.mark.parametrize("folder", OVERLAYS)
def test_policies_open_the_ports_that_there_are(folder: str) -> None:
    default = named(folder, "NetworkPolicy", "default")["spec"]
    assert default["podSelector"] == {} and default["policyTypes"] == ["Ingress", "Egress"] and "ingress" not in default
    (names,) = default["egress"]
    assert {(port["port"], port["protocol"]) for port in names["ports"]} == {(53, "UDP"), (53, "TCP")}
    assert {"ipBlock": {"cidr": "169.254.20.10/32"}} in names["to"]  # NodeLocal DNSCache
    labels = [peer["podSelector"]["matchLabels"]["k8s-app"] for peer in names["to"] if "podSelector" in peer]
    assert labels == ["kube-dns", "node-local-dns"]
    for deployment in built(folder, "Deployment"):
        policy = named(folder, "NetworkPolicy", deployment["metadata"]["name"])["spec"]
        assert selected(policy["podSelector"]["matchLabels"], folder) == [deployment]
        opened = {port["port"] for rule in policy["ingress"] for port in rule["ports"]}
        assert opened == {port["containerPort"] for port in container_of(deployment)["ports"]}
        assert all(rule["from"] for rule in policy["ingress"])


@pytest.mark.parametrize("folder", OVERLAYS)
def test_the_gateway_reaches_triton(folder: str) -> None:
    gateway = rfm_parsed(*container_of(named(folder, "Deployment", "rfm-gateway"))["args"])
    triton, metrics = urlsplit(gateway["triton"]), urlsplit(gateway["metrics_url"])
    pods = named(folder, "Service", triton.hostname)["spec"]
    assert triton.scheme == "grpc"
    assert pods["clusterIP"] == "None"  # the name has the addresses of all pods, also later ones
    assert triton.port in [port["port"] for port in pods["ports"] if port["name"] == "grpc"]
    one = named(folder, "Service", metrics.hostname)["spec"]
    assert metrics.port in [port["port"] for port in one["ports"] if port["name"] == "metrics"]
    assert pods["selector"] == one["selector"]
    wanted = {triton.port, metrics.port}
    (way_out,) = named(folder, "NetworkPolicy", "rfm-gateway")["spec"]["egress"]
    labels = named(folder, "Deployment", "rfm-gateway")["spec"]["selector"]["matchLabels"]
    ways_in = named(folder, "NetworkPolicy", "rfm-triton")["spec"]["ingress"]
    (way_in,) = (way for way in ways_in if way["from"] == [{"podSelector": {"matchLabels": labels}}])
    assert wanted == {port["port"] for port in way_out["ports"]} == {port["port"] for port in way_in["ports"]}


@pytest.mark.parametrize("folder", OVERLAYS)
def test_kube_prometheus_stack_finds_monitors_and_rules(folder: str) -> None:
    """Prometheus selects both by the name of the Helm release, a label that only they have."""
    labelled = [one for one in built(folder) if "release" in one["metadata"].get("labels", {})]
    assert labelled == built(folder, "PodMonitor") != []
    (release,) = {one["metadata"]["labels"]["release"] for one in labelled}
    assert f"labels: {{release: {release}}}" in (KUBERNETES / "monitoring" / "kustomization.yaml").read_text()
    (rules,) = re.findall(r"    for file in .*\n(?:      .*\n)*    done\n", (KUBERNETES / "README.md").read_text())
    made = subprocess.run(
        ["bash", "-c", rules.replace("kubectl apply -f -", "cat; echo ---")],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    objects = [one for one in yaml.safe_load_all(made.stdout) if one]
    assert {one["metadata"]["name"] for one in objects} == {"rfm-alerts", "rfm-recording"}
    for one in objects:
        assert (one["kind"], one["metadata"]["labels"]) == ("PrometheusRule", {"release": release})
        assert one["spec"]["groups"]


@pytest.mark.parametrize("folder", OVERLAYS)
def test_the_autoscaler_s_metric_is_recorded_and_handed_on(folder: str) -> None:
    scaler = named(folder, "HorizontalPodAutoscaler", "rfm-triton")["spec"]
    target = scaler["scaleTargetRef"]
    assert "replicas" not in named(folder, target["kind"], target["name"])["spec"]
    (metric,) = scaler["metrics"]
    (rule,) = yaml.safe_load((KUBERNETES / "monitoring" / "prometheus-adapter.yaml").read_text())["rules"]["custom"]
    assert rule["name"]["as"] == metric["pods"]["metric"]["name"]
    series = rule["seriesQuery"].partition("{")[0]
    assert re.search(rule["name"]["matches"], series)
    groups = (yaml.safe_load(file.read_text())["groups"] for file in (ROOT / "docker/prometheus/rules").glob("*.yml"))
    recorded = {
        one["record"]: one["expr"] for group in groups for part in group for one in part["rules"] if "record" in one
    }
    assert " by " not in recorded[series]  # that would drop the labels namespace and pod


def test_what_the_readme_applies_is_there() -> None:
    readme = (KUBERNETES / "README.md").read_text()
    assert set(re.findall(r"-k docker/kubernetes/([\w/]+)", readme)) == set(SETS)
    files = re.findall(r"-f docker/(kubernetes/[\w/.]+)", readme)
    assert [(ROOT / "docker" / file).is_file() for file in files] == [True] * 3


def test_what_must_be_changed_stands_before_the_first_command_and_a_check_after_the_last() -> None:
    readme = (KUBERNETES / "README.md").read_text()
    assert "kubectl apply" not in readme.partition("## 2.")[0]
    headings = re.findall(r"^## (\d.*)$", readme, re.MULTILINE)
    assert headings == ["1. What to change", "2. Namespace and keys", "3. The repository", "4. Apply", "5. Check"]


@pytest.mark.parametrize("release", RELEASES)
def test_the_pod_that_copies_fits_its_schema_the_namespace_and_the_servers(release: str) -> None:
    pod = yaml.safe_load((KUBERNETES / "copy.yaml").read_text())
    validate(pod, release)
    (container,) = pod["spec"]["containers"]
    context = {**pod["spec"]["securityContext"], **container["securityContext"]}
    assert {name: context[name] for name in SECURITY} == SECURITY
    server = pod_of(named("overlays/gpu", "Deployment", "rfm-triton"))
    assert pod["spec"]["securityContext"]["fsGroup"] == server["securityContext"]["fsGroup"]
    (claim,) = (volume["persistentVolumeClaim"] for volume in server["volumes"] if "persistentVolumeClaim" in volume)
    (volume,) = pod["spec"]["volumes"]
    assert volume["persistentVolumeClaim"] == {"claimName": claim["claimName"]}  # which it may write
    (mount,) = container["volumeMounts"]
    assert (mount["name"], mount["mountPath"]) == (volume["name"], "/models")
    assert container["readinessProbe"]["exec"]["command"] == ["test", "-d", "/models/model_repository"]


def test_the_command_that_copies_the_repository_copies_it_and_adds_a_version(tmp_path: Path) -> None:
    """Run in a folder in the pod's place."""
    (command,) = re.findall(r"^    (tar .*)$", (KUBERNETES / "README.md").read_text(), re.MULTILINE)
    mine, pod = tmp_path / "my_models", tmp_path / "pod" / "models" / "model_repository"
    shutil.copytree(ROOT / "model_repository" / "rfm", mine / "rfm")
    pod.mkdir(parents=True)
    in_the_pod = 'kubectl() { while [ "$1" != -- ]; do shift; done; shift; "$@"; }'
    script = f"{in_the_pod}\n{command.replace('/models', str(pod.parent))}"
    for version in ("1", "2"):
        if version == "2":
            shutil.copytree(mine / "rfm" / "1", mine / "rfm" / "2")
        subprocess.run(["bash", "-euo", "pipefail", "-c", script], cwd=tmp_path, check=True)
        copied = {file.relative_to(pod): file.read_bytes() for file in pod.rglob("*") if file.is_file()}
        assert copied == {file.relative_to(mine): file.read_bytes() for file in mine.rglob("*") if file.is_file()}
        assert Path("rfm") / version / "model.py" in copied


def test_the_probes_tell_a_living_model_from_a_dead_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a pod's container command on local ports with the demo's ``rfm`` alone."""
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    repository, key, log = tmp_path / "model_repository", tmp_path / "admin-key", tmp_path / "log"
    shutil.copytree(ROOT / "model_repository" / "rfm", repository / "rfm")
    key.write_text("0123456789abcdef" * 4)
    key.chmod(0o400)
    container = container_of(named("overlays/cpu", "Deployment", "rfm-triton"))
    endpoints, status_port = Endpoints.free(), Endpoints.free().http_port
    values = {
        "--repository": repository,
        "--host": endpoints.host,
        "--http-port": endpoints.http_port,
        "--grpc-port": endpoints.grpc_port,
        "--metrics-port": endpoints.metrics_port,
        "--status-port": status_port,
        "--admin-key-file": key,
    }
    options = (word.partition("=") for word in container["args"])
    words = [f"{name}={values[name]}" if has_value else name for name, has_value, _ in options]
    with (
        log.open("wb") as lines,
        subprocess.Popen([BIN / container["command"][0], *words], stdout=lines, stderr=lines) as process,
    ):

        def passes(kind: str) -> bool:
            assert process.poll() is None, log.read_text()
            get = container[kind]["httpGet"]
            assert get["port"] == "status"
            with suppress(httpx.TransportError):
                return httpx.get(f"http://127.0.0.1:{status_port}{get['path']}").status_code == 200
            return False

        try:
            wait_for(lambda: passes("livenessProbe"))
            assert not passes("startupProbe")  # it loads
            wait_for(lambda: passes("startupProbe") and passes("readinessProbe"))
            kill_model(repository)
            wait_for(lambda: not passes("readinessProbe"))
            assert passes("livenessProbe")
            run_kserve_s_liveness_probe(status_port)
            wait_for(lambda: passes("readinessProbe"))  # rfm serve has healed it
        finally:
            process.terminate()
    assert process.returncode == 0, log.read_text()


def run_kserve_s_liveness_probe(status_port: int) -> None:
    """Raise CalledProcessError if the probe fails. Knative sends an httpGet only to the port of requests."""
    container = container_of(named("kserve", "ServingRuntime", "rfm-triton"))
    program, *words, script = container["livenessProbe"]["exec"]["command"]
    assert program == "python"
    port = rfm_parsed(*container["args"])["status_port"]
    subprocess.run([sys.executable, *words, script.replace(f":{port}/", f":{status_port}/")], check=True)
