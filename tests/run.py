#!/usr/bin/env python3
"""Runs all checks that a change must pass, as `make test` does, and prints the seconds of each step.

    run.py [NAME]    all checks; or only compile, and run the tests whose names contain NAME

The last line counts the tests. Variables that replace downloads are described in deploy/native.py and tools.py.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Dict, List, NamedTuple, Optional

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "deploy"), str(ROOT / "tests")]

import native  # noqa: E402
import tools  # noqa: E402

CARGO = os.environ.get("CARGO", "cargo")
# The whole workspace in every call: other selections have other features, and compile the dependencies again.
WORKSPACE = ["--workspace", "--locked"]
# Training needs libtorch, which some platforms do not have.
HAS_LIBTORCH = bool(os.environ.get("LIBTORCH")) or native.PLATFORM in native.LIBTORCH
if not HAS_LIBTORCH:
    WORKSPACE += ["--exclude", "grasp-train"]
# Seconds after which a test program is stopped.
LIMIT = 1800

# Downloads by the variable that has their paths.
NEEDED_TO_COMPILE = {"LIBTORCH": native.libtorch} if HAS_LIBTORCH else {}
NEEDED_TO_RUN = {
    "ORT_DYLIB_PATH": native.onnxruntime,
    "GRASPD_PYTHON": tools.python,
    "GRASPD_PROMETHEUS": tools.prometheus,
    "GRASPD_PROMTOOL": tools.promtool,
    "GRASPD_CPP": tools.cpp,
    "GRASPD_CHROMIUM": tools.chromium,
    "GRASPD_HAPROXY": tools.haproxy,
    "GRASPD_PERF_ANALYZER": tools.perf_analyzer,
}


class Failure(Exception):
    """A step failed; its output says why."""


class TestProgram(NamedTuple):
    title: str
    executable: str
    folder: str  # of the package, in which Cargo runs tests


class Outcome(NamedTuple):
    passed: int
    failed: int
    ignored: int


class Steps:
    """Prints which step of how many runs, and its seconds when it ends."""

    def __init__(self, count: int) -> None:
        self.count, self.number, self.first = count, 0, time.monotonic()

    def run(self, title: str, action, *arguments):
        self.number += 1
        print(f"[{self.number}/{self.count}] {title}", flush=True)
        start = time.monotonic()
        result = action(*arguments)
        print(f"[{self.number}/{self.count}] {title}: {time.monotonic() - start:.0f} s", flush=True)
        return result

    def seconds(self) -> float:
        return time.monotonic() - self.first


def main(name: Optional[str]) -> int:
    steps = Steps(3 if name else 6)
    environment = compiling(dict(os.environ))
    if not name:
        steps.run("format", cargo, ["fmt", "--all", "--check"], environment)
    # Beside compilation, which needs the processor while they need the network.
    downloads = Downloads()
    programs = steps.run("compile", compiled_tests, environment)
    environment.update(steps.run("downloads", downloads.wait))
    outcome = steps.run("tests", run_tests, programs, name, testing(environment))
    if not name and not outcome.failed:
        steps.run("lints", cargo, ["clippy", *WORKSPACE, "--all-targets", "--", "-D", "warnings"], environment)
        flags = {"RUSTDOCFLAGS": f"{environment.get('RUSTDOCFLAGS', '')} -D warnings".strip()}
        steps.run("documentation", cargo, ["doc", *WORKSPACE, "--no-deps"], {**environment, **flags})
    print(f"{steps.seconds():.0f} s")
    print(f"{outcome.passed} passed, {outcome.failed} failed, {outcome.ignored} skipped", flush=True)
    return 1 if outcome.failed or not outcome.passed else 0


def compiling(environment: Dict[str, str]) -> Dict[str, str]:
    """The variables that compilation needs. A relative CARGO_TARGET_DIR is relative to the working directory."""
    for variable, path in NEEDED_TO_COMPILE.items():
        environment[variable] = str(path())
    if HAS_LIBTORCH:
        libraries = [f"{environment['LIBTORCH']}/lib", environment.get("LD_LIBRARY_PATH", "")]
        environment["LD_LIBRARY_PATH"] = os.pathsep.join(filter(None, libraries))
    else:
        print(f"no libtorch for {native.PLATFORM}: without the tests of grasp-train", flush=True)
    return environment


def testing(environment: Dict[str, str]) -> Dict[str, str]:
    """The variables of the tests: without proxies, because servers and clients are on this machine, and without options of
    the programs under test, which the shell may have set."""
    wanted = {*NEEDED_TO_COMPILE, *NEEDED_TO_RUN, "GRASPD_CACHE"}

    def is_kept(variable: str) -> bool:
        is_proxy = variable.lower() in {"http_proxy", "https_proxy", "grpc_proxy", "all_proxy"}
        is_option = variable.startswith(("GRASP_", "GRASPD_")) and variable not in wanted
        return not is_proxy and not is_option

    return {variable: value for variable, value in environment.items() if is_kept(variable)}


def cargo(arguments: List[str], environment: Dict[str, str]) -> None:
    if subprocess.run([CARGO, *arguments], cwd=ROOT, env=environment).returncode:
        raise Failure(f"cargo {arguments[0]} failed")


def compiled_tests(environment: Dict[str, str]) -> List[TestProgram]:
    """Compiles the programs and the tests, and returns the latter. In one command, because the tests need more features of some
    dependencies: apart, these and all that depends on them would be compiled twice."""
    targets = ["--bins", "--tests", "--example", "detect"]
    command = [CARGO, "build", *WORKSPACE, *targets, "--message-format", "json-render-diagnostics"]
    output = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
    if output.returncode:
        raise Failure("the tests do not compile")
    programs = []
    for line in output.stdout.splitlines():
        message = json.loads(line)
        if message.get("executable") and message["profile"]["test"]:
            folder = str(Path(message["manifest_path"]).parent)
            target = message["target"]
            title = f"{Path(folder).relative_to(ROOT)} {target['kind'][0]} {target['name']}"
            programs.append(TestProgram(title, message["executable"], folder))
    return sorted(programs)


def run_tests(programs: List[TestProgram], name: Optional[str], environment: Dict[str, str]) -> Outcome:
    """The end-to-end tests wait for processes much of the time, so the others, which compute, run beside them with a lower
    priority."""
    end_to_end = [program for program in programs if program.folder == str(ROOT / "tests")]
    others = [program for program in programs if program not in end_to_end]
    lower = ["nice"] if shutil.which("nice") else []
    with ThreadPoolExecutor() as lanes:
        beside = lanes.submit(lambda: [run_program(program, name, environment, lower) for program in others])
        outcomes = [run_program(program, name, environment, []) for program in end_to_end]
        outcomes += beside.result()
    outcomes.append(run_doctests(name, environment))
    return Outcome(*map(sum, zip(*outcomes)))


def run_program(
    program: TestProgram, name: Optional[str], environment: Dict[str, str], prefix: List[str]
) -> Outcome:
    command = [*prefix, program.executable, *([name] if name else [])]
    return counted(program.title, command, program.folder, environment)


def run_doctests(name: Optional[str], environment: Dict[str, str]) -> Outcome:
    command = [CARGO, "test", *WORKSPACE, "--doc", "--quiet", *([name] if name else [])]
    return counted("examples in the documentation of the code", command, str(ROOT), environment)


def counted(title: str, command: List[str], folder: str, environment: Dict[str, str]) -> Outcome:
    """Runs a test program and counts its tests. Its output is printed if a test fails."""
    start = time.monotonic()
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        errors="replace", start_new_session=True,
    )
    stopper = threading.Timer(LIMIT, os.killpg, [process.pid, signal.SIGKILL])
    stopper.start()
    try:
        output, _ = process.communicate()
    finally:
        stopper.cancel()
    results = re.findall(r"^test result: .* (\d+) passed; (\d+) failed; (\d+) ignored", output, re.MULTILINE)
    outcome = Outcome(*(sum(int(result[column]) for result in results) for column in range(3)))
    if process.returncode and not outcome.failed:
        outcome = outcome._replace(failed=1)  # it ended before its result
    if outcome.failed:
        print(output, flush=True)
        print(f"    {title}: exit status {process.returncode}", flush=True)
    print(f"    {title}: {outcome.passed} passed, {outcome.failed} failed, {time.monotonic() - start:.0f} s", flush=True)
    return outcome


class Downloads:
    """The downloads that tests need, in the background."""

    def __init__(self) -> None:
        self.paths: Dict[str, str] = {}
        self.error: Optional[native.Unavailable] = None
        self.thread = threading.Thread(target=self.fetch, daemon=True)
        self.thread.start()

    def fetch(self) -> None:
        try:
            for variable, path in NEEDED_TO_RUN.items():
                self.paths[variable] = str(path())
        except native.Unavailable as error:
            print(f"run.py: {error}", flush=True)  # now, while others compile
            self.error = error

    def wait(self) -> Dict[str, str]:
        self.thread.join()
        if self.error:
            raise self.error
        return self.paths


if __name__ == "__main__":
    if len(sys.argv) > 2 or sys.argv[1:] in (["-h"], ["--help"]):
        sys.exit(__doc__)
    try:
        sys.exit(main(*sys.argv[1:] or [None]))
    except (Failure, native.Unavailable) as error:
        sys.exit(f"run.py: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
