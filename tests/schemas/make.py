"""Makes kubernetes.json: the JSON schemas of the objects in deploy/kubernetes, and nothing else.

    python3 -m venv venv
    venv/bin/pip install kubernetes-validate==1.37.0 kubeflow-trainer-api==2.3.0 cloudcoil-models-prometheus-operator==0.80.1.0
    venv/bin/python tests/schemas/make.py

The three packages, all under the Apache License 2.0, carry the published schemas of Kubernetes, of JobSet and of the
Prometheus Operator. Taken over are names, types, what is required and which values are allowed. What is left out:
descriptions; `status`, which no manifest has; null, which stands for nothing; patterns of strings. No field is allowed
that is not there.
"""

import json
from importlib.resources import files
from pathlib import Path

from cloudcoil.models.prometheus_operator.v1 import PodMonitor
from kubeflow_trainer_api.models.jobset_v1alpha2_job_set import JobsetV1alpha2JobSet

# The oldest release that the manifests are for: what is valid in it stays valid.
KUBERNETES = "v1.31.0"
# Object -> its definition.
ROOTS = {
    "v1 ConfigMap": "io.k8s.api.core.v1.ConfigMap",
    "v1 PersistentVolumeClaim": "io.k8s.api.core.v1.PersistentVolumeClaim",
    "v1 Pod": "io.k8s.api.core.v1.Pod",
    "v1 Service": "io.k8s.api.core.v1.Service",
    "batch/v1 Job": "io.k8s.api.batch.v1.Job",
    "networking.k8s.io/v1 NetworkPolicy": "io.k8s.api.networking.v1.NetworkPolicy",
    "jobset.x-k8s.io/v1alpha2 JobSet": "jobset.JobSet",
    "monitoring.coreos.com/v1 PodMonitor": "podmonitor.PodMonitor",
}
# JobSet's models give these in their descriptions only.
JOBSET_VALUES = {
    ("DependsOn", "status"): ["Ready", "Complete"],
    ("FailurePolicy", "restartStrategy"): ["Recreate", "BlockingRecreate", "InPlaceRestart"],
    ("FailurePolicyRule", "action"): [
        "FailJobSet",
        "RestartJobSet",
        "RestartJobSetAndIgnoreMaxRestarts",
        "RestartJob",
        "RestartJobAndIgnoreMaxRestarts",
    ],
    ("StartupPolicy", "startupPolicyOrder"): ["AnyOrder", "InOrder"],
    ("SuccessPolicy", "operator"): ["All", "Any"],
    ("VolumeRetentionPolicy", "whenDeleted"): ["Delete", "Retain"],
}
# What tests/src/schemas.rs checks.
KEYWORDS = {"$ref", "additionalProperties", "anyOf", "const", "enum", "format", "items", "properties", "required", "type"}
FORMATS = {"int32", "int64"}
META = "io.k8s.apimachinery.pkg.apis.meta.v1."


def small(schema, rename):
    """`schema` without what is left out; `rename` gives the new name of a definition."""
    # Each of the few oneOf is between two types, and so the same as anyOf.
    choices = schema.get("anyOf", schema.get("oneOf", []))
    choices = [choice for choice in choices if choice != {"type": "null"}]
    schema = {key: value for key, value in schema.items() if key in KEYWORDS - {"anyOf"}}
    if len(choices) == 1:
        return small(schema | choices[0], rename)
    if choices:
        schema["anyOf"] = [small(choice, rename) for choice in choices]
    if schema.get("format") not in FORMATS:
        schema.pop("format", None)
    if "$ref" in schema:
        schema["$ref"] = "#/$defs/" + rename(schema["$ref"].rsplit("/", 1)[1])
    if isinstance(schema.get("type"), list):
        (schema["type"],) = set(schema["type"]) - {"null"}
    if "properties" in schema:
        schema["properties"] = {name: small(value, rename) for name, value in schema["properties"].items()}
        schema.setdefault("additionalProperties", False)
    for key in ("items", "additionalProperties"):
        if isinstance(schema.get(key), dict):
            schema[key] = small(schema[key], rename)
    return schema


def root(schema):
    """An object of its own says what it is and what it is called, and a manifest not how it stands."""
    schema["properties"].pop("status", None)
    schema["required"] = sorted({*schema.get("required", []), "apiVersion", "kind", "metadata"})
    return schema


def kubernetes():
    packaged = files("kubernetes_validate") / f"kubernetes-json-schema/{KUBERNETES}-local-strict/_definitions.json"
    definitions = json.loads(packaged.read_text())["$defs"]
    return {name: small(schema, str) for name, schema in definitions.items()}


def jobset():
    schema = JobsetV1alpha2JobSet.model_json_schema(by_alias=True)
    definitions = schema.pop("$defs") | {"JobsetV1alpha2JobSet": schema}

    def rename(name):
        if name.startswith("JobsetV1alpha2"):
            return "jobset." + name.removeprefix("JobsetV1alpha2")
        # IoK8sApiBatchV1JobTemplateSpec -> io.k8s.api.batch.v1.JobTemplateSpec
        for prefix, package in {
            "IoK8sApiBatchV1": "io.k8s.api.batch.v1.",
            "IoK8sApiCoreV1": "io.k8s.api.core.v1.",
            "IoK8sApimachineryPkgApisMetaV1": META,
        }.items():
            if name.startswith(prefix):
                return package + name.removeprefix(prefix)
        return name

    ours = {rename(name): small(schema, rename) for name, schema in definitions.items() if name.startswith("Jobset")}
    for (name, field), values in JOBSET_VALUES.items():
        ours[f"jobset.{name}"]["properties"][field]["enum"] = values
    ours["jobset.JobSet"]["properties"]["apiVersion"]["enum"] = ["jobset.x-k8s.io/v1alpha2"]
    ours["jobset.JobSet"]["properties"]["kind"]["enum"] = ["JobSet"]
    return ours


def pod_monitor():
    schema = PodMonitor.model_json_schema(by_alias=True)
    definitions = schema.pop("$defs") | {"PodMonitor": schema}
    rename = lambda name: META + name if name == "ObjectMeta" else "podmonitor." + name
    return {rename(name): small(schema, rename) for name, schema in definitions.items() if name != "ObjectMeta"}


def references(schema):
    if isinstance(schema, dict):
        if isinstance(schema.get("$ref"), str):
            yield schema["$ref"].removeprefix("#/$defs/")
        for value in schema.values():
            yield from references(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from references(value)


def main():
    definitions = kubernetes() | jobset() | pod_monitor()
    for name in ROOTS.values():
        root(definitions[name])
    needed, todo = {}, list(ROOTS.values())
    while todo:
        name = todo.pop()
        if name not in needed:
            needed[name] = definitions[name]
            todo += references(definitions[name])
    compact = lambda value: json.dumps(value, sort_keys=True, separators=(",", ":"))
    lines = ",\n".join(f"{compact(name)}:{compact(needed[name])}" for name in sorted(needed))
    comment = (
        f"Kubernetes {KUBERNETES}, JobSet v1alpha2, PodMonitor v1: made by make.py, which names the packages."
        " Of their authors, under the Apache License 2.0."
    )
    text = f'{{"$comment":{compact(comment)},\n"roots":{compact(ROOTS)},\n"$defs":{{\n{lines}\n}}}}\n'
    json.loads(text)
    Path(__file__).with_name("kubernetes.json").write_text(text)


main()
