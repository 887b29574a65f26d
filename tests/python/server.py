"""Runs the binary GRASPD with the models of GRASPD_MODELS during a test."""

import os
import re
import subprocess
from urllib.request import urlopen


class Server:
    """A server on free ports, or at `listen`. Its log goes to stderr, or to the file `log`."""

    def __init__(self, *flags, listen="127.0.0.1:0", log=None):
        models = ["--models", os.environ["GRASPD_MODELS"], "--provider", "cpu", "--threads", "1"]
        command = [os.environ["GRASPD"], *models, "--listen", listen, "--http", "127.0.0.1:0", *map(str, flags)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True)
        # The addresses, then `ready`.
        lines = "".join(iter(self.process.stdout.readline, "ready\n"))
        match = re.fullmatch(r"grpc listening on (\S+)\nhttp listening on (\S+)\n(?:rest listening on (\S+)\n)?", lines)
        self.grpc, self.http, self.rest = match.groups()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def stop(self):
        """Shuts down after the accepted requests."""
        self.process.terminate()
        self.process.communicate()

    def metric(self, series):
        """The value of a series, or 0 if it does not exist. `series` has Prometheus' notation, with sorted labels."""
        with urlopen(f"http://{self.http}/metrics") as page:
            found = re.search(f"^{re.escape(series)} (\\S+)$", page.read().decode(), re.MULTILINE)
        return float(found[1]) if found else 0.0
