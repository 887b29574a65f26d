"""Tests deploy/prometheus and deploy/grafana with a real Prometheus that scrapes a real graspd under mixed requests.

    GRASPD=target/release/graspd GRASPD_MODELS=models/zoo ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    GRASPD_PROMETHEUS=$(python3 tests/tools.py prometheus) GRASPD_PROMTOOL=$(python3 tests/tools.py promtool) \\
    python -m unittest discover --start-directory tests/python --pattern test_monitoring.py
"""

import json
import math
import os
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
import unittest
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import urlencode
from urllib.request import urlopen

import grpc
import numpy as np
import yaml
from test_client import generate

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
RULES = DEPLOY / "prometheus"
# Timeout, seconds. On an idle machine a few seconds suffice.
TIMEOUT = 90


def eventually(what, attempt):
    """Calls `attempt` until its result is true, and returns the result."""
    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        result = attempt()
        if result:
            return result
        time.sleep(0.1)
    raise AssertionError(f"timeout after {TIMEOUT} s: {what}")


def rules(name):
    return [rule for group in yaml.safe_load((RULES / name).read_text())["groups"] for rule in group["rules"]]


def measured(alert):
    """The expression that an alert compares with its threshold."""
    return re.fullmatch(r"(.+) [<>] [\d.]+", alert["expr"])[1]


def dashboard():
    return json.loads((DEPLOY / "grafana/graspd.json").read_text())


def panels():
    return [panel for panel in dashboard()["panels"] if panel["type"] != "row"]


class FilesTest(unittest.TestCase):
    """Checks of the files themselves."""

    def promtool(self, *arguments):
        result = subprocess.run([os.environ["GRASPD_PROMTOOL"], *arguments], cwd=RULES, capture_output=True, text=True)
        self.assertEqual(result.returncode, 0, result.stdout + result.stderr)

    def test_promtool_finds_no_errors(self):
        self.promtool("check", "rules", "--lint-fatal", "rules.yml", "alerts.yml")
        self.promtool("check", "config", "--lint-fatal", "prometheus.yml")

    def test_the_rule_tests_pass(self):
        self.promtool("test", "rules", "tests.yml")

    def test_rule_tests_cover_every_alert_and_a_silent_case(self):
        silent, fired = False, set()
        for case in yaml.safe_load((RULES / "tests.yml").read_text())["tests"]:
            for test in case["promql_expr_test"]:
                silent = silent or test["exp_samples"] == [] and "alertname" not in test["expr"]
                for sample in test["exp_samples"]:
                    fired.update(re.findall(r'alertname="(\w+)"', sample["labels"]))
        self.assertTrue(silent)
        self.assertEqual(fired, {alert["alert"] for alert in rules("alerts.yml")})

    def test_every_alert_has_severity_summary_and_description(self):
        for alert in rules("alerts.yml"):
            self.assertIn(alert["labels"]["severity"], ["critical", "warning"], alert)
            self.assertEqual(set(alert["annotations"]), {"summary", "description"}, alert)

    def test_panels_do_not_overlap(self):
        ids = [panel["id"] for panel in dashboard()["panels"]]
        self.assertEqual(len(ids), len(set(ids)))
        taken = {}
        for panel in dashboard()["panels"]:
            place = panel["gridPos"]
            self.assertLessEqual(place["x"] + place["w"], 24, panel["title"])
            for x in range(place["x"], place["x"] + place["w"]):
                for y in range(place["y"], place["y"] + place["h"]):
                    self.assertNotIn((x, y), taken, f"{panel['title']} covers {taken.get((x, y))}")
                    taken[x, y] = panel["title"]


class MonitoringTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.folder = Path(folder.name)
        cls.start_graspd()
        cls.keep_requesting()
        cls.start_prometheus()

    @classmethod
    def run_process(cls, name, command):
        """Starts a process, and returns a function that reads its output. The process ends with the tests."""
        output = cls.folder / f"{name}.log"
        with output.open("w") as file:
            process = subprocess.Popen(command, stdout=file, stderr=file, start_new_session=True)

        def end():
            for number in [signal.SIGTERM, signal.SIGKILL]:
                if process.poll() is None:
                    os.killpg(process.pid, number)
                    try:
                        process.wait(10)
                    except subprocess.TimeoutExpired:
                        continue

        def read():
            if process.poll() is not None:
                raise AssertionError(f"{name} exited:\n{output.read_text()}")
            return output.read_text()

        cls.addClassCleanup(end)
        return read

    @classmethod
    def start_graspd(cls):
        """Starts graspd with one session and a short queue, so that it refuses requests, and adds an invalid file."""
        models = cls.folder / "models"
        models.mkdir()
        for model in Path(os.environ["GRASPD_MODELS"]).glob("*.onnx"):
            shutil.copy(model, models)
        command = [os.environ["GRASPD"], "--models", str(models), "--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"]
        read = cls.run_process("graspd", [*command, "--threads", "1", "--queue", "1", "--watch", "0.2"])
        eventually("graspd is ready", lambda: "\nready\n" in read())
        cls.grpc, cls.http = re.findall(r"listening on (127\.\S+)", read())
        (models / "broken.onnx").write_text("no model")

    @classmethod
    def keep_requesting(cls):
        """Sends requests during the tests: valid, concurrent, late and invalid ones, and for a missing model."""
        os.environ.setdefault("GRASPD_PROTO", str(ROOT / "proto/proto"))
        stubs = tempfile.TemporaryDirectory()
        cls.addClassCleanup(stubs.cleanup)
        pb, services = generate(stubs.name)
        channel = grpc.insecure_channel(cls.grpc)
        cls.addClassCleanup(channel.close)
        grasps = services.GraspServiceStub(channel)
        listed = grasps.ListModels(pb.ListModelsRequest()).models
        model = next(model for model in listed if model.resolution)
        cls.model = f"{model.name} {model.version}"
        values = np.random.default_rng(0).random(model.resolution**3, np.float32)
        size = {"resolution": model.resolution, "voxel_size": model.voxel_size}
        volume = pb.Volume(data=values.tobytes(), dtype=pb.DATA_TYPE_F32, **size)
        good = pb.DetectGraspsRequest(volume=volume)
        wrong = pb.DetectGraspsRequest(volume=pb.Volume(data=b"short", dtype=pb.DATA_TYPE_F32, **size))
        missing = pb.DetectGraspsRequest(volume=volume, options=pb.Options(model="missing"))

        def outcome(request, timeout=10):
            try:
                grasps.DetectGrasps(request, timeout=timeout)
                return "OK"
            except grpc.RpcError as error:
                return error.code().name

        cls.outcomes, cls.stopped = set(), threading.Event()

        def send():
            with ThreadPoolExecutor(8) as several:
                while not cls.stopped.wait(0.1):
                    cls.outcomes.update(several.map(outcome, [good] * 8))
                    cls.outcomes.add(outcome(good, timeout=0.001))
                    cls.outcomes.update(map(outcome, [good, wrong, missing]))

        thread = threading.Thread(target=send)
        thread.start()
        cls.addClassCleanup(thread.join)
        cls.addClassCleanup(cls.stopped.set)

    @classmethod
    def start_prometheus(cls):
        """Starts Prometheus with the shipped configuration, except for the targets and the intervals."""
        config = yaml.safe_load((RULES / "prometheus.yml").read_text())
        config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
        config["rule_files"] = [str(RULES / file) for file in config["rule_files"]]
        (job,) = config["scrape_configs"]
        # In a cluster these two labels identify the pod.
        job["static_configs"] = [{"targets": [cls.http], "labels": {"namespace": "robots", "pod": "graspd-0"}}]
        path = cls.folder / "prometheus.yml"
        path.write_text(yaml.safe_dump(config))
        command = [os.environ["GRASPD_PROMETHEUS"], f"--config.file={path}", f"--storage.tsdb.path={cls.folder}/data"]
        read = cls.run_process("prometheus", [*command, "--web.listen-address=127.0.0.1:0"])
        listening = re.compile(r'msg="?Listening on"?.* address=(127\.0\.0\.1:\d+)')
        cls.prometheus = eventually("Prometheus listens", lambda: listening.search(read()))[1]
        eventually("Prometheus is ready", lambda: "Server is ready to receive web requests" in read())

    def query(self, page, **parameters):
        """Queries Prometheus' HTTP API."""
        with urlopen(f"http://{self.prometheus}/api/v1/{page}?{urlencode(parameters)}", timeout=10) as reply:
            return json.load(reply)["data"]

    def data(self, expression):
        """Waits until an expression yields finite values, and returns them."""

        def numbers():
            result = self.query("query", query=expression)["result"]
            return [series for series in result if math.isfinite(float(series["value"][1]))]

        return eventually(expression, numbers)

    def test_graspd_counts_every_status_that_clients_can_cause(self):
        expected = {"OK", "RESOURCE_EXHAUSTED", "DEADLINE_EXCEEDED", "INVALID_ARGUMENT", "NOT_FOUND"}
        eventually(f"{expected}", lambda: self.outcomes >= expected)
        counted = {series["metric"]["code"] for series in self.data("graspd_requests_total > 0")}
        self.assertLessEqual(counted, self.outcomes | {"CANCELLED"})

    def test_recording_rules_yield_data(self):
        for rule in rules("rules.yml"):
            with self.subTest(rule["record"]):
                self.data(rule["record"])

    def test_expressions_of_alerts_yield_data(self):
        for alert in rules("alerts.yml"):
            with self.subTest(alert["alert"]):
                self.data(measured(alert))

    def test_an_alert_is_raised_with_its_text(self):
        def raised():
            alerts = self.query("alerts")["alerts"]
            return [alert for alert in alerts if alert["labels"]["alertname"] == "GraspdRejectedFiles"]

        (alert,) = eventually("GraspdRejectedFiles is pending", raised)
        self.assertEqual(alert["annotations"]["summary"], f"{self.http} cannot serve 1 of its model files.")

    def test_no_rule_has_an_error(self):
        def evaluated():
            known = [rule for group in self.query("rules")["groups"] for rule in group["rules"]]
            return known if all(rule["health"] != "unknown" for rule in known) else []

        known = eventually("all rules are evaluated", evaluated)
        self.assertEqual({rule["name"]: rule["lastError"] for rule in known if rule["health"] != "ok"}, {})
        self.assertEqual(len(known), len(rules("rules.yml")) + len(rules("alerts.yml")))

    def test_panels_show_data(self):
        # As in Grafana: first without, then with a selected instance and model.
        anything = {"instance": ".*", "model": ".*"}
        chosen = {"instance": re.escape(self.http), "model": re.escape(self.model)}
        for panel in panels():
            for target in panel["targets"]:
                for variables in [anything, chosen]:
                    expression = target["expr"].replace("$__rate_interval", "1m")
                    for name, value in variables.items():
                        expression = expression.replace(f"${name}", value.replace("\\", "\\\\"))
                    with self.subTest(panel["title"], expression=expression):
                        self.assertNotIn("$", expression)
                        lines = [series["metric"] for series in self.data(expression)]
                        if "legendFormat" in target and "vector(0)" not in expression:
                            # Legends are unique.
                            legend = target["legendFormat"].replace("{{", "{").replace("}}", "}")
                            self.assertEqual(len({legend.format(**labels) for labels in lines}), len(lines))

    def test_gpu_panels_show_0_without_a_gpu(self):
        for panel in panels():
            for target in panel["targets"]:
                if "DCGM" in target["expr"]:
                    self.assertEqual([series["value"][1] for series in self.data(target["expr"])], ["0"])

    def test_variables_of_the_dashboard_have_values(self):
        choices = [variable for variable in dashboard()["templating"]["list"] if variable["type"] == "query"]
        for variable, expected in zip(choices, [self.http, self.model], strict=True):
            selector, label = re.fullmatch(r"label_values\((.+), (\w+)\)", variable["query"]["query"]).groups()
            self.assertEqual(variable["name"], label)
            there = lambda: self.query(f"label/{label}/values", **{"match[]": selector})
            self.assertIn(expected, eventually(selector, there))

    def test_the_autoscaler_receives_the_number_of_waiting_requests(self):
        adapter = yaml.safe_load((DEPLOY / "kubernetes/prometheus-adapter.yaml").read_text())
        (rule,) = adapter["rules"]["custom"]
        series = self.data(rule["seriesQuery"])[0]
        matchers = 'namespace="robots", pod=~"graspd-0"'
        filled = {"GroupBy": "pod", "Series": series["metric"]["__name__"], "LabelMatchers": matchers}
        (sample,) = self.data(re.sub(r"<<\.(\w+)>>", lambda name: filled[name[1]], rule["metricsQuery"]))
        self.assertEqual(sample["metric"], {"pod": "graspd-0"})


if __name__ == "__main__":
    unittest.main()
