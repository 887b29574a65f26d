"""Checks the files of deploy/ against the binary GRASPD. Nothing is built or run in a container.

    GRASPD=target/release/graspd python -m unittest discover --start-directory tests/python --pattern test_deploy.py
"""

import os
import re
import subprocess
import sys
import tomllib
import unittest
from pathlib import Path

import kubernetes_validate
import yaml

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
KUBERNETES = DEPLOY / "kubernetes"
# Custom resources, for which there is no schema.
CUSTOM = {"PodMonitor", "ServingRuntime", "InferenceService"}


def load(path):
    """The non-empty documents of a file."""
    return [document for document in yaml.safe_load_all(path.read_text()) if document]


def flags():
    """The environment variables of `graspd --help`, with their defaults."""
    text = subprocess.run([os.environ["GRASPD"], "--help"], env={}, capture_output=True, text=True, check=True).stdout
    found = re.findall(r"\[env: (\w+)=\](?: \[default: (\S+)\])?", " ".join(text.split()))
    return {**dict(found), **({"ORT_DYLIB_PATH": ""} if "ORT_DYLIB_PATH" in text else {})}


def instructions():
    """The Dockerfile by stage: pairs of an instruction and its text, FROM first. The part before the stages is ""."""
    stage, stages = "", {"": []}
    text = re.sub(r"^#.*\n", "", (DEPLOY / "Dockerfile").read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    for word, rest in re.findall(r"^([A-Z]+) +(.*)$", text, flags=re.MULTILINE):
        if word == "FROM":
            base, stage = rest.split(" AS ")
            stages[stage] = [("FROM", base)]
        else:
            stages[stage].append((word, " ".join(rest.split())))
    return stages


def image(device):
    """The instructions of the image for a device: those of its base, then the common ones."""
    stages = instructions()
    return stages[device] + stages["graspd"]


def variables(stage):
    """The variables that ENV sets in a stage."""
    return dict(pair.split("=", 1) for word, rest in stage if word == "ENV" for pair in rest.split())


def port(address):
    return int(address.rsplit(":", 1)[1])


class DockerfileTest(unittest.TestCase):
    def setUp(self):
        self.stages = instructions()
        self.images = [image("cpu"), image("cuda")]

    def test_the_default_image_is_for_cpus(self):
        self.assertIn(("ARG", "DEVICE=cpu"), self.stages[""])
        *_, (name, steps) = self.stages.items()
        self.assertEqual((name, steps[0]), ("graspd", ("FROM", "${DEVICE}")))

    def test_the_user_is_not_root(self):
        user = dict(self.stages["graspd"])["USER"]
        self.assertTrue(all(int(number) > 0 for number in user.split(":")), f"{user}: must be numeric and not root")

    def test_environment_variables_are_flags(self):
        known = flags()
        for stage in self.images:
            self.assertLessEqual(set(variables(stage)), set(known))

    def test_listening_ports_are_exposed(self):
        for stage in self.images:
            environment = variables(stage)
            listened = {port(environment[name]) for name in ["GRASPD_LISTEN", "GRASPD_HTTP"]}
            self.assertEqual({int(number) for number in dict(stage)["EXPOSE"].split()}, listened)

    def test_only_the_wheels_are_used(self):
        ignored = (ROOT / ".dockerignore").read_text().splitlines()
        self.assertEqual([line for line in ignored if not line.startswith("#")], ["*", "!dist"])
        for device in ["cpu", "cuda"]:
            self.assertNotIn("COPY", dict(self.stages[device]))
            self.assertIn("--mount=type=bind,source=dist,target=/wheels", dict(self.stages[device])["RUN"])

    def test_versions_are_those_of_the_repository(self):
        package = tomllib.loads((DEPLOY / "wheel/pyproject.toml").read_text())["project"]
        client = tomllib.loads((ROOT / "client/python/pyproject.toml").read_text())["project"]
        version = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
        self.assertEqual({package["version"], client["version"]}, {version})
        self.assertEqual(client["optional-dependencies"]["server"], [f"graspd-server=={version}"])
        native = (DEPLOY / "native.py").read_text()
        pinned = [dependency.split(" ;")[0] for dependency in package["dependencies"]]
        (of_image,) = re.findall(r"onnxruntime-gpu==\S+", dict(self.stages["cuda"])["RUN"])
        for requirement in [*pinned, of_image]:
            self.assertIn(f'Wheel("{requirement}"', native)


class ComposeTest(unittest.TestCase):
    def setUp(self):
        (self.compose,) = load(DEPLOY / "compose.yaml")
        self.services = self.compose["services"]

    def test_mounted_files_exist(self):
        for name, service in self.services.items():
            for volume in service.get("volumes", []):
                source = volume.split(":")[0]
                known = (DEPLOY / source).exists() if source.startswith(".") else source in self.compose["volumes"]
                self.assertTrue(known, f"{name}: {volume}")

    def test_grafana_finds_dashboard_and_data_source(self):
        grafana = self.services["grafana"]
        mounted = {target: source for source, target, *_ in (volume.split(":") for volume in grafana["volumes"])}
        home = grafana["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]
        self.assertEqual(mounted[home], "./grafana/graspd.json")
        (provider,) = load(DEPLOY / "grafana/dashboards.yaml")[0]["providers"]
        self.assertEqual(provider["options"]["path"], os.path.dirname(home))
        (source,) = load(DEPLOY / "grafana/datasource.yaml")[0]["datasources"]
        self.assertIn(source["url"].removeprefix("http://").split(":")[0], self.services)
        (prometheus,) = load(DEPLOY / "prometheus/prometheus.yml")
        self.assertEqual(source["jsonData"]["timeInterval"], prometheus["global"]["scrape_interval"])

    def test_prometheus_scrapes_graspd(self):
        (prometheus,) = load(DEPLOY / "prometheus/prometheus.yml")
        ((target,),) = [config["targets"] for job in prometheus["scrape_configs"] for config in job["static_configs"]]
        self.assertIn(target.split(":")[0], self.services)
        self.assertEqual(port(target), port(variables(image("cpu"))["GRASPD_HTTP"]))

    def test_graspd_is_built_from_the_dockerfile_and_has_time_to_drain(self):
        graspd = self.services["graspd"]
        build = DEPLOY / graspd["build"]["context"] / graspd["build"]["dockerfile"]
        self.assertEqual(build.resolve(), DEPLOY / "Dockerfile")
        self.assertGreater(float(graspd["stop_grace_period"].removesuffix("s")), float(flags()["GRASPD_DRAIN_TIMEOUT"]))

    def test_services_are_confined_monitored_and_pinned(self):
        for name, service in self.services.items():
            self.assertTrue(service["read_only"], name)
            self.assertEqual(service["cap_drop"], ["ALL"], name)
            for published in service["ports"]:
                self.assertTrue(published.startswith("127.0.0.1:"), f"{name}: {published}")
            if "build" in service:
                self.assertIn("HEALTHCHECK", dict(image("cpu")))
            else:
                self.assertIn("healthcheck", service, name)
                self.assertRegex(service["image"], r":v?\d+\.\d+\.\d+$")


class KubernetesTest(unittest.TestCase):
    def setUp(self):
        (kustomization,) = load(KUBERNETES / "kustomization.yaml")
        files = [*kustomization["resources"], "options/podmonitor/podmonitor.yaml"]
        self.objects = {document["kind"]: document for file in files for document in load(KUBERNETES / file)}
        self.template = self.objects["Deployment"]["spec"]["template"]
        self.pod = self.template["spec"]
        (self.container,) = self.pod["containers"]
        self.ports = {port["name"]: port["containerPort"] for port in self.container["ports"]}

    def test_the_manifests_are_valid(self):
        for kind, manifest in self.objects.items():
            if kind not in CUSTOM:
                kubernetes_validate.validate(manifest, "1.33", strict=True)

    def test_kustomizations_name_existing_files_and_objects(self):
        named = {KUBERNETES / "prometheus-adapter.yaml"}
        for path in KUBERNETES.rglob("kustomization.yaml"):
            (kustomization,) = load(path)
            named |= {path, *(path.parent / file for file in kustomization.get("resources", []))}
            for patch in kustomization.get("patches", []):
                patch = yaml.safe_load(patch["patch"])
                patched = self.objects[patch["kind"]]
                self.assertEqual(patch["metadata"]["name"], patched["metadata"]["name"])
                containers = patch["spec"]["template"]["spec"]["containers"]
                self.assertEqual([container["name"] for container in containers], [self.container["name"]])
        self.assertEqual(named, set(KUBERNETES.rglob("*.yaml")))

    def test_selectors_match_the_pods(self):
        labels = self.template["metadata"]["labels"]
        spread = [constraint["labelSelector"] for constraint in self.pod["topologySpreadConstraints"]]
        self.assertEqual(spread, [{"matchLabels": labels}])
        self.assertEqual(self.objects["Service"]["spec"]["selector"], labels)
        self.assertEqual(self.objects["NetworkPolicy"]["spec"]["podSelector"]["matchLabels"], labels)
        for kind in ["Deployment", "PodDisruptionBudget", "PodMonitor"]:
            self.assertEqual(self.objects[kind]["spec"]["selector"]["matchLabels"], labels, kind)
        target = self.objects["HorizontalPodAutoscaler"]["spec"]["scaleTargetRef"]
        self.assertEqual(target["name"], self.objects[target["kind"]]["metadata"]["name"])
        self.assertEqual(self.pod["serviceAccountName"], self.objects["ServiceAccount"]["metadata"]["name"])
        (prometheus,) = load(DEPLOY / "prometheus/prometheus.yml")
        jobs = [job["job_name"] for job in prometheus["scrape_configs"]]
        self.assertIn(labels[self.objects["PodMonitor"]["spec"]["jobLabel"]], jobs)

    def test_the_ports_are_those_of_the_image(self):
        own = variables(image("cpu"))
        self.assertEqual(self.ports, {"grpc": port(own["GRASPD_LISTEN"]), "http": port(own["GRASPD_HTTP"])})
        for entry in self.objects["Service"]["spec"]["ports"]:
            self.assertEqual(entry["port"], self.ports[entry["targetPort"]])
        named = [entry["port"] for rule in self.objects["NetworkPolicy"]["spec"]["ingress"] for entry in rule["ports"]]
        named += [endpoint["port"] for endpoint in self.objects["PodMonitor"]["spec"]["podMetricsEndpoints"]]
        self.assertLessEqual(set(named), set(self.ports))

    def test_probes_use_existing_services(self):
        proto = (ROOT / "proto/proto/grasp/v1/grasp.proto").read_text()
        package, service = re.search(r"^package (\S+);", proto, re.M)[1], re.search(r"^service (\w+)", proto, re.M)[1]
        probe = {"port": self.ports["grpc"], "service": f"{package}.{service}"}
        for name in ["startupProbe", "readinessProbe"]:
            self.assertEqual(self.container[name]["grpc"], probe)
        self.assertEqual(self.container["livenessProbe"]["httpGet"], {"path": "/healthz", "port": "http"})

    def test_pods_have_time_to_drain(self):
        known = flags()
        environment = {entry["name"]: entry["value"] for entry in self.container["env"]}
        self.assertLessEqual(set(environment), set(known))
        drain = float(environment.get("GRASPD_DRAIN_TIMEOUT", known["GRASPD_DRAIN_TIMEOUT"]))
        before = self.container["lifecycle"]["preStop"]["sleep"]["seconds"]
        self.assertGreater(self.pod["terminationGracePeriodSeconds"], before + drain)

    def test_pods_are_confined(self):
        self.assertTrue(self.pod["securityContext"]["runAsNonRoot"])
        self.assertEqual(self.pod["securityContext"]["seccompProfile"], {"type": "RuntimeDefault"})
        self.assertFalse(self.pod["automountServiceAccountToken"])
        locked = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
        self.assertEqual(self.container["securityContext"], locked)

    def test_a_session_has_as_many_threads_as_cpus(self):
        resources = self.container["resources"]
        self.assertEqual(int(resources["limits"]["cpu"]), int(resources["requests"]["cpu"]))

    def test_the_autoscaler_uses_the_metric_of_the_adapter(self):
        (metric,) = self.objects["HorizontalPodAutoscaler"]["spec"]["metrics"]
        (adapter,) = load(KUBERNETES / "prometheus-adapter.yaml")
        (rule,) = adapter["rules"]["custom"]
        self.assertEqual(rule["name"]["as"], metric["pods"]["metric"]["name"])

    def test_options_set_flags_and_the_model_folder_of_the_image(self):
        (patch,) = load(KUBERNETES / "options/gpu/kustomization.yaml")[0]["patches"]
        (container,) = yaml.safe_load(patch["patch"])["spec"]["template"]["spec"]["containers"]
        self.assertLessEqual({entry["name"] for entry in container["env"]}, set(flags()))
        (patch,) = load(KUBERNETES / "options/models/kustomization.yaml")[0]["patches"]
        pod = yaml.safe_load(patch["patch"])["spec"]["template"]["spec"]
        (mount,) = pod["containers"][0]["volumeMounts"]
        self.assertEqual(mount["mountPath"], variables(image("cpu"))["GRASPD_MODELS"])
        self.assertEqual([volume["name"] for volume in pod["volumes"]], [mount["name"]])

    def test_kserve_runs_the_same_container(self):
        (runtime,), (service,) = (load(KUBERNETES / "kserve" / file) for file in ["runtime.yaml", "service.yaml"])
        self.assertEqual((runtime["kind"], service["kind"]), ("ServingRuntime", "InferenceService"))
        predictor = service["spec"]["predictor"]
        self.assertGreater(predictor["maxReplicas"], predictor["minReplicas"], "the service must scale")
        model = predictor["model"]
        self.assertEqual(model["runtime"], runtime["metadata"]["name"])
        self.assertIn(model["protocolVersion"], runtime["spec"]["protocolVersions"])
        formats = [known["name"] for known in runtime["spec"]["supportedModelFormats"]]
        self.assertIn(model["modelFormat"]["name"], formats)
        (container,) = runtime["spec"]["containers"]
        # There is no schema for the runtime, but its container must be valid in a pod.
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "graspd"}, "spec": {"containers": [container]}}
        kubernetes_validate.validate(pod, "1.33", strict=True)
        self.assertEqual(container["name"], "kserve-container")
        (entry,) = container["ports"]
        self.assertEqual((entry["name"], entry["containerPort"]), ("h2c", self.ports["grpc"]))
        self.assertEqual(container["readinessProbe"], self.container["readinessProbe"])
        self.assertEqual(container["livenessProbe"]["httpGet"]["port"], self.ports["http"])
        self.assertEqual(runtime["spec"]["annotations"]["prometheus.kserve.io/port"], str(self.ports["http"]))
        self.assertLessEqual({entry["name"] for entry in container["env"]}, set(flags()))


if __name__ == "__main__":
    unittest.main()
