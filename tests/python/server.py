"""The graspd that GRASPD names with the models of GRASPD_MODELS, for as long as a test needs it."""

import os
import re
import subprocess
from urllib.request import urlopen


class Server:
    """On free ports, or where `listen` says. Its log goes to stderr."""

    def __init__(self, *flags, listen="127.0.0.1:0"):
        models = ["--models", os.environ["GRASPD_MODELS"], "--provider", "cpu", "--threads", "1"]
        command = [os.environ["GRASPD"], *models, "--listen", listen, "--http", "127.0.0.1:0", *map(str, flags)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        # Both ports, then that it is ready.
        said = "".join(self.process.stdout.readline() for _ in range(3))
        self.grpc, self.http = re.fullmatch(r"grpc listening on (\S+)\nhttp listening on (\S+)\nready\n", said).groups()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()

    def stop(self):
        """Lets it finish what it has taken."""
        self.process.terminate()
        self.process.communicate()

    def metric(self, series):
        """The value of one metric, 0 as long as it has none. `series` is as Prometheus writes it, labels in order."""
        with urlopen(f"http://{self.http}/metrics") as page:
            found = re.search(f"^{re.escape(series)} (\\S+)$", page.read().decode(), re.MULTILINE)
        return float(found[1]) if found else 0.0
