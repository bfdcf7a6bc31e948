"""The manifests for KubeRay. No machine of ours runs Kubernetes: fields are compared with those that it publishes."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from accord.domain.enums import WorkerRole

REPOSITORY = Path(__file__).parents[3]
MANIFESTS: dict[str, dict[str, Any]] = {
    path.name: yaml.safe_load(path.read_text()) for path in (REPOSITORY / "docs/deploy/kuberay").glob("*.yaml")
}
#: fields of the types of ray.io/v1 that the manifests use, as KubeRay publishes them
CLUSTER = {
    *("authOptions", "autoscalerOptions", "enableInTreeAutoscaling", "headGroupSpec", "headServiceAnnotations"),
    *("rayVersion", "suspend", "workerGroupSpecs"),
}
JOB = {
    *("activeDeadlineSeconds", "backoffLimit", "clusterSelector", "deletionStrategy", "entrypoint"),
    *("entrypointNumCpus", "entrypointNumGpus", "entrypointResources", "jobId", "managedBy", "metadata"),
    *("rayClusterSpec", "runtimeEnvYAML", "shutdownAfterJobFinishes", "submissionMode", "submitterConfig"),
    *("submitterPodTemplate", "suspend", "ttlSecondsAfterFinished"),
}
HEAD = {"enableIngress", "headService", "rayStartParams", "serviceType", "template"}
GROUP = {
    *("groupName", "maxReplicas", "minReplicas", "numOfHosts", "rayStartParams", "replicas", "scaleStrategy"),
    "template",
}
AUTOSCALER = {
    *("env", "envFrom", "idleTimeoutSeconds", "image", "imagePullPolicy", "resources", "securityContext"),
    *("upscalingMode", "volumeMounts"),
}


def clusters() -> list[dict[str, Any]]:
    specs = [each["spec"] if each["kind"] == "RayCluster" else each["spec"].get("rayClusterSpec") for each in all_of()]
    return [spec for spec in specs if spec]


def all_of() -> list[dict[str, Any]]:
    return list(MANIFESTS.values())


@pytest.mark.parametrize("name", MANIFESTS)
def test_every_field_is_one_of_the_published_schema(name: str) -> None:
    manifest = MANIFESTS[name]
    assert manifest["apiVersion"] == "ray.io/v1"
    spec = manifest["spec"]
    assert spec.keys() <= {"RayCluster": CLUSTER, "RayJob": JOB}[manifest["kind"]]
    cluster = spec if manifest["kind"] == "RayCluster" else spec.get("rayClusterSpec")
    if cluster is None:
        return
    assert cluster.keys() <= CLUSTER
    assert cluster.get("autoscalerOptions", {}).keys() <= AUTOSCALER
    assert cluster["headGroupSpec"].keys() <= HEAD
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
        assert group["template"]["spec"]["containers"]
    assert all(group.keys() <= GROUP for group in cluster["workerGroupSpecs"])


def test_clusters_need_a_token_and_use_the_tested_version_and_one_image() -> None:
    pinned = dict(line.split("==") for line in (REPOSITORY / "constraints.txt").read_text().split("\n") if "==" in line)
    images = set()
    for cluster in clusters():
        assert cluster["authOptions"] == {"mode": "token"}
        assert cluster["rayVersion"] == pinned["ray"]
        for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
            images |= {container["image"] for container in group["template"]["spec"]["containers"]}
    assert len(images) == 1


def test_each_role_has_a_group_with_room_for_its_workers() -> None:
    groups = {each["groupName"]: each for each in MANIFESTS["cluster.yaml"]["spec"]["workerGroupSpecs"]}
    entrypoint = MANIFESTS["workers.yaml"]["spec"]["entrypoint"]
    settings = dict(word.split("=") for word in entrypoint.split() if word.startswith("ACCORD_"))
    assert groups.keys() == {role.value for role in WorkerRole}
    for role, group in groups.items():
        parameters = group["rayStartParams"]
        # Ray's command line gets the quotes too.
        [(resource, slots)] = yaml.safe_load(yaml.safe_load(parameters["resources"])).items()
        assert (resource, str(slots)) == (role, parameters["num-cpus"])
        assert group["maxReplicas"] * slots >= int(settings[f"ACCORD_{role.upper()}_WORKERS"])
    selected = MANIFESTS["workers.yaml"]["spec"]["clusterSelector"]
    assert selected == {"ray.io/cluster": MANIFESTS["cluster.yaml"]["metadata"]["name"]}


def test_the_rules_that_the_operator_checks_hold() -> None:
    for manifest in all_of():
        assert re.fullmatch("[a-z]([-a-z0-9]{0,46}[a-z0-9])?", manifest["metadata"]["name"])
        if manifest["kind"] == "RayJob":
            spec = manifest["spec"]
            # A job on an existing cluster has neither retries nor a cluster that ends with it.
            of_own_cluster = {"rayClusterSpec", "backoffLimit", "shutdownAfterJobFinishes", "ttlSecondsAfterFinished"}
            assert ("clusterSelector" in spec) != bool(of_own_cluster & spec.keys())
            assert ("clusterSelector" in spec) != ("rayClusterSpec" in spec)
    for cluster in clusters():
        for group in cluster["workerGroupSpecs"]:
            assert 0 <= group["minReplicas"] <= group["maxReplicas"]
        for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
            # Resources are in the parameters of Ray; the operator refuses them in both places.
            assert "resources" not in group
            pod = group["template"]["spec"]
            volumes = {volume["name"] for volume in pod.get("volumes", [])}
            for container in pod["containers"]:
                assert {mount["name"] for mount in container.get("volumeMounts", [])} <= volumes
