"""Runs the jobs of deploy/label as Kubernetes and Slurm would, with `grasp-sim` from GRASP_SIM."""

import os
import re
import subprocess
import tempfile
import unittest
from pathlib import Path

import kubernetes_validate
import yaml

DEPLOY = Path(__file__).resolve().parents[2] / "deploy/label"


class LabelJobsTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        bin = self.folder / "bin"
        bin.mkdir()
        (bin / "grasp-sim").symlink_to(os.environ["GRASP_SIM"])
        self.environment = {**os.environ, "PATH": f"{bin}:{os.environ['PATH']}"}

    def run_as(self, command, **environment):
        result = subprocess.run(
            [str(part) for part in command],
            env={**self.environment, **{key: str(value) for key, value in environment.items()}},
            cwd=DEPLOY.parents[1],
            capture_output=True,
            text=True,
        )
        self.assertEqual(result.returncode, 0, result.stderr)
        return result.stdout

    def scenes(self, folder):
        """The content of a data set, in one file."""
        out = self.folder / f"{folder.name}-converted"
        self.run_as(["grasp-sim", "convert", "--from", folder, "--out", out])
        (pack,) = out.glob("*.pack")
        return pack.read_bytes()

    def test_the_manifests_are_valid(self):
        for name in ["label.yaml", "merge.yaml"]:
            manifest = yaml.safe_load((DEPLOY / name).read_text())
            kubernetes_validate.validate(manifest, "1.33", strict=True)

    def test_the_kustomization_matches_the_job(self):
        kustomization = yaml.safe_load((DEPLOY / "kustomization.yaml").read_text())
        pod = yaml.safe_load((DEPLOY / "label.yaml").read_text())["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        self.assertEqual(kustomization["resources"], ["label.yaml"])
        self.assertEqual([image["name"] for image in kustomization["images"]], [container["image"]])
        (generator,) = kustomization["configMapGenerator"]
        self.assertIn(generator["name"], [volume.get("configMap", {}).get("name") for volume in pod["volumes"]])
        for file in generator["files"]:
            self.assertTrue((DEPLOY / file).exists(), file)

    def test_pods_generate_the_data_of_one_machine(self):
        job = yaml.safe_load((DEPLOY / "label.yaml").read_text())["spec"]
        (container,) = job["template"]["spec"]["containers"]
        environment = {entry["name"]: entry["value"] for entry in container["env"]}
        self.assertEqual(int(environment["PARTS"]), job["completions"])
        data = self.folder / "data/packed"
        command = [*container["command"], *container["args"], "--points", 6]
        command[command.index("/label/label.sh")] = DEPLOY / "label.sh"
        for index in range(job["completions"]):
            self.run_as(command, **{**environment, "DATA": data, "SCENES": 11, "JOB_COMPLETION_INDEX": index})

        merge = yaml.safe_load((DEPLOY / "merge.yaml").read_text())["spec"]["template"]["spec"]["containers"][0]
        output = self.run_as([part.replace("/data/packed", str(data)) for part in merge["command"]])
        self.assertIn("11 scenes from 8 folders", output)
        alone = self.folder / "alone"
        self.run_as(["grasp-sim", "label", *container["args"], "--points", 6, "--scenes", 11, "--out", alone])
        self.assertEqual(self.scenes(data / "whole"), self.scenes(alone))

    def test_slurm_tasks_label_every_scene_once(self):
        script = DEPLOY / "slurm.sbatch"
        first, last = map(int, re.search(r"#SBATCH --array=(\d+)-(\d+)", script.read_text()).groups())
        data = self.folder / "slurm"
        for task in range(first, last + 1):
            self.run_as(["sh", script], DATA=data, SCENES=9, SLURM_ARRAY_TASK_ID=task, SLURM_SUBMIT_DIR=DEPLOY.parents[1])
        parts = sorted(data.glob("part-*"))
        self.assertEqual(len(parts), last - first + 1)
        output = self.run_as(["grasp-sim", "merge", *parts, "--out", self.folder / "whole"])
        self.assertIn(f"9 scenes from {len(parts)} folders", output)

    def test_missing_variables_are_reported(self):
        result = subprocess.run(["sh", DEPLOY / "label.sh"], env={"PATH": os.environ["PATH"]}, capture_output=True, text=True)
        self.assertNotEqual(result.returncode, 0)
        self.assertIn("DATA", result.stderr)


if __name__ == "__main__":
    unittest.main()
