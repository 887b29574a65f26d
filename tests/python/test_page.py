"""Tests the web page of graspd in a real browser, with a real server.

    GRASPD=target/release/graspd GRASPD_MODELS=models/zoo ORT_DYLIB_PATH=$(python3 deploy/native.py onnxruntime) \\
    GRASPD_CHROMIUM=$(python3 tests/tools.py chromium) \\
    $(python3 tests/tools.py python) -m unittest discover --start-directory tests/python --pattern test_page.py

GRASPD_SCREENSHOTS: output folder for screenshots. GRASPD_PAGE: file that replaces the page of the binary.
"""

import base64
import json
import os
import re
import socket
import subprocess
import tempfile
import time
import unittest
from pathlib import Path

import grpc
import numpy as np
import scene
from server import Server
from test_client import generate
from tritonclient.grpc import InferenceServerClient, InferInput

ROOT = Path(__file__).resolve().parents[2]
# Timeout, seconds. On an idle machine a second suffices.
TIMEOUT = 30
DESKTOP = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
CANVAS = "document.querySelector('canvas').getBoundingClientRect()"
# Minimum height of a touch target, CSS pixels.
TOUCHABLE = 44


class Browser:
    """Headless Chromium with WebGL on the CPU, and one tab, controlled with the DevTools protocol."""

    # The sandbox does not work as root, and is not needed for our own page.
    FLAGS = ["--headless", "--no-sandbox", "--remote-debugging-pipe"]
    FLAGS += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

    def __init__(self, folder):
        self.socket, theirs = socket.socketpair()
        self.socket.settimeout(TIMEOUT)
        command = [os.environ["GRASPD_CHROMIUM"], *self.FLAGS, f"--user-data-dir={folder}/profile"]
        with open(f"{folder}/chromium.log", "w") as log, theirs:
            # Chromium reads from descriptor 3 and writes to 4.
            shell = ["sh", "-c", 'exec "$@" 3<&0 4>&0 </dev/null', "sh", *command]
            self.process = subprocess.Popen(shell, stdin=theirs, stdout=log, stderr=log)
        self.log, self.received, self.number, self.session, self.errors = Path(log.name), b"", 0, {}, []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = {"sessionId": self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ["Page", "Runtime", "Log", "Network"]:
            self.call(f"{domain}.enable")
        if "GRASPD_PAGE" in os.environ:
            self.call("Fetch.enable", patterns=[{"resourceType": "Document"}])

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()
        self.socket.close()

    def send(self, method, **params):
        self.number += 1
        message = {"id": self.number, "method": method, "params": params, **self.session}
        self.socket.sendall(json.dumps(message).encode() + b"\0")
        return self.number

    def call(self, method, **params):
        """Sends a command and returns its result."""
        number = self.send(method, **params)
        while True:
            while b"\0" not in self.received:
                self.receive()
            message, self.received = self.received.split(b"\0", 1)
            message = json.loads(message)
            if "method" in message:
                self.handle(message["method"], message["params"])
            elif message["id"] == number and "error" in message:
                raise AssertionError(f"{method}: {message['error']}")
            elif message["id"] == number:
                return message["result"]

    def receive(self):
        try:
            more = self.socket.recv(1 << 20)
        except ConnectionError:
            more = b""
        if not more:
            raise AssertionError(f"Chromium exited:\n{self.log.read_text()}")
        self.received += more

    def handle(self, event, params):
        match event, params:
            case "Runtime.exceptionThrown", {"exceptionDetails": details}:
                self.errors.append(details["exception"]["description"])
            case "Runtime.consoleAPICalled", {"type": "error" | "warning", "args": values}:
                self.errors.append(str(values))
            case "Log.entryAdded", {"entry": {"level": "error" | "warning", "text": text}}:
                self.errors.append(text)
            case "Fetch.requestPaused", {"requestId": request}:
                page = base64.b64encode(Path(os.environ["GRASPD_PAGE"]).read_bytes()).decode()
                self.send("Fetch.fulfillRequest", requestId=request, responseCode=200, body=page)

    def open(self, url, screen=DESKTOP, scheme="light"):
        self.call("Emulation.setDeviceMetricsOverride", **screen)
        self.call("Emulation.setTouchEmulationEnabled", enabled=screen["mobile"])
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
        self.call("Page.navigate", url=url)
        self.eventually("document.readyState === 'complete'")

    def run(self, script):
        """The value of an expression, or of its promise."""
        reply = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in reply:
            raise AssertionError(f"{script}: {reply['exceptionDetails']['exception']['description']}")
        return reply["result"].get("value")

    def eventually(self, script):
        """Evaluates an expression until its value is true, and returns the value."""
        end = time.monotonic() + TIMEOUT
        while time.monotonic() < end:
            value = self.run(script)
            if value:
                return value
            time.sleep(0.02)
        raise AssertionError(f"timeout after {TIMEOUT} s: {script}\n{self.run('document.body.innerText')}")

    def text(self, selector):
        return self.run(f"document.querySelector({json.dumps(selector)}).innerText")

    def each(self, selector, expression):
        """The values of an expression of `found`, for each element that matches the selector."""
        return self.run(f"[...document.querySelectorAll({json.dumps(selector)})].map((found) => {expression})")

    def texts(self, selector):
        return self.each(selector, "found.innerText")

    def middle(self, selector):
        """Scrolls an element into view and returns its centre. Fails if another element covers it."""
        return self.run(f"""(() => {{
          const found = document.querySelector({json.dumps(selector)});
          found.scrollIntoView({{ block: "end" }});
          const {{ x, y, width, height }} = found.getBoundingClientRect();
          const middle = [x + width / 2, y + height / 2];
          if (!found.contains(document.elementFromPoint(...middle))) throw new Error("the element is covered");
          return middle;
        }})()""")

    def mouse(self, *points, held=True):
        """Moves the mouse along the points, with the left button pressed if `held`."""
        for kind, (x, y) in [("mousePressed", points[0])] * held + [("mouseMoved", point) for point in points]:
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left" if held else "none", clickCount=1)
        if held:
            x, y = points[-1]
            self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)

    def fingers(self, *paths):
        """Touches the screen with one finger per path."""
        moments = [[{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(moment)] for moment in zip(*paths)]
        moves = [("touchMove", moment) for moment in moments]
        for kind, points in [("touchStart", moments[0]), *moves, ("touchEnd", [])]:
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def screenshot(self, name):
        """A screenshot as PNG; also written to GRASPD_SCREENSHOTS if set."""
        self.run("new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)))")
        png = self.call("Page.captureScreenshot", format="png")["data"]
        if "GRASPD_SCREENSHOTS" in os.environ:
            folder = Path(os.environ["GRASPD_SCREENSHOTS"])
            folder.mkdir(parents=True, exist_ok=True)
            (folder / f"{name}.png").write_bytes(base64.b64decode(png))
        return png

    def pixels(self, name):
        """A screenshot as an array [row][column][red, green, blue]."""
        png = self.screenshot(name)
        width, height, pixels = self.run(f"""(async () => {{
          const image = new Image(), reader = new FileReader();
          image.src = "data:image/png;base64,{png}";
          await image.decode();
          const picture = new OffscreenCanvas(image.width, image.height).getContext("2d");
          picture.drawImage(image, 0, 0);
          reader.readAsDataURL(new Blob([picture.getImageData(0, 0, image.width, image.height).data]));
          await new Promise((resolve) => {{ reader.onload = resolve; }});
          return [image.width, image.height, reader.result.split(",")[1]];
        }})()""")
        pixels = np.frombuffer(base64.b64decode(pixels), np.uint8)
        return pixels.reshape(height, width, 4)[..., :3].astype(int)

    def scene(self, name):
        """The part of a screenshot with the scene."""
        x, y, width, height = map(int, self.run(f"(({{ x, y, width, height }}) => [x, y, width, height])({CANVAS})"))
        return self.pixels(name)[y : y + height, x : x + width]


class PageTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        os.environ.setdefault("GRASPD_PROTO", str(ROOT / "proto/proto"))
        folder = cls.enterClassContext(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        cls.pb, cls.services = generate(folder)
        cls.server = cls.enterClassContext(Server())
        cls.grasps = cls.stub(cls.server)
        cls.browser = cls.enterClassContext(Browser(folder))
        values = scene.volume(*(scene.camera(35, azimuth) for azimuth in [-60, 60, 180]))
        size = {"resolution": scene.RESOLUTION, "voxel_size": scene.SIZE / scene.RESOLUTION}
        cls.volume = cls.pb.Volume(data=values.tobytes(), dtype=cls.pb.DATA_TYPE_F32, **size)

    @classmethod
    def stub(cls, server):
        channel = grpc.insecure_channel(server.grpc)
        cls.addClassCleanup(channel.close)
        return cls.services.GraspServiceStub(channel)

    def tearDown(self):
        self.assertEqual(self.browser.errors, [])

    def detect(self, name, grasps=None, table_height=None, **options):
        """Sends a request with this id and returns the reply."""
        check = self.pb.CollisionCheck(mode=self.pb.CollisionCheck.MODE_FLAG, table_height=table_height)
        options = self.pb.Options(threshold=0.1, collision=check, **options)
        request = self.pb.DetectGraspsRequest(volume=self.volume, options=options, request_id=name)
        return (grasps or self.grasps).DetectGrasps(request, timeout=TIMEOUT)

    def open(self, *how, name, **options):
        """Sends a request, and opens the page until it shows the request. Returns the reply."""
        reply = self.detect(name, **options)
        self.browser.open(f"http://{self.server.http}/", *how)
        self.wait_for(name)
        return reply

    def wait_for(self, name):
        self.browser.eventually(f"document.querySelector('#what').innerText.endsWith('{name}')")

    def row(self, name):
        return f'#requests button[title$=" {name}"]'

    def test_requests_appear_when_they_end(self):
        self.open(name="one")
        reply = self.detect("two")
        self.wait_for("two")
        time, model, code, grasps, best, milliseconds = self.browser.texts(f"{self.row('two')} span")
        self.assertRegex(time, r"^\d\d:\d\d:\d\d$")
        self.assertEqual((model, code, grasps), (f"{reply.model} {reply.version}", "OK", str(len(reply.grasps))))
        self.assertEqual((best, milliseconds), (f"{reply.grasps[0].quality:.2f}", f"{1000 * reply.latency.total:.1f}"))
        newest = self.browser.run("document.querySelector('#requests button.row').title")
        self.assertTrue(newest.endswith(" two"), newest)

    def test_refused_requests_have_their_message(self):
        self.open(name="good")
        with self.assertRaises(grpc.RpcError) as refused:
            self.detect("wrong", model="missing")
        self.wait_for("wrong")
        for place in [f"{self.row('wrong')} .message", "#note"]:
            self.assertIn(refused.exception.details(), self.browser.text(place))
        colour = self.browser.run(f"getComputedStyle(document.querySelector('{self.row('wrong')} .code')).color")
        red, green, blue = map(int, re.findall(r"\d+", colour))
        self.assertGreater(red, 2 * max(green, blue))
        self.browser.screenshot("refused")

    def test_warnings_are_shown_over_the_scene(self):
        self.open(name="correct")
        self.assertEqual(self.browser.text("#warnings"), "")
        reply = self.detect("warned", table_height=0.01)
        self.wait_for("warned")
        (warning,) = reply.warnings
        self.assertEqual(self.browser.text("#warnings"), warning.message)
        self.assertEqual(self.browser.texts(f"{self.row('warned')} span")[2], "⚠")
        self.browser.screenshot("warned")

    def test_requests_for_maps_are_marked(self):
        self.open(name="grasps")
        tensor = InferInput("tsdf", [1, 1, *[scene.RESOLUTION] * 3], "FP32")
        tensor.set_data_from_numpy(scene.volume(scene.camera(30, -90))[np.newaxis, np.newaxis])
        with InferenceServerClient(self.server.grpc) as client:
            client.infer("vgn-packed", [tensor], request_id="maps")
        self.wait_for("maps")
        _, model, code, grasps, best, milliseconds = self.browser.texts(f"{self.row('maps')} span")
        self.assertEqual((model.split()[0], code, grasps, best), ("vgn-packed", "OK", "maps", "–"))
        self.assertGreater(float(milliseconds), 0)
        self.assertIn("no grasps were decoded", self.browser.text("#note"))
        self.browser.screenshot("maps")

    def test_a_selected_request_stays_until_the_newest_is_selected(self):
        self.open(name="earlier")
        self.browser.mouse(self.browser.middle(self.row("earlier")))
        self.detect("later")
        self.browser.eventually("document.querySelector('#follow').innerText.includes('1 newer')")
        self.wait_for("earlier")
        self.browser.mouse(self.browser.middle("#follow"))
        self.wait_for("later")

    def test_the_scene_is_drawn(self):
        reply = self.open(name="drawn")
        self.assertEqual({grasp.collides for grasp in reply.grasps}, {True, False})
        red, green, blue = np.moveaxis(self.browser.scene("scene"), -1, 0)
        grey = (abs(red - green) < 25) & (abs(green - blue) < 25)
        self.assertGreater(np.mean(grey & (red > 80) & (red < 225)), 0.1, "no surface")
        self.assertGreater(len(np.unique(red[grey])), 50, "no shading")
        self.assertGreater(np.sum((green > red + 60) & (green > blue + 30)), 500, "no good grasps")
        self.assertGreater(np.sum((red > green + 15) & (green > blue + 30)), 100, "no poor grasps")

    def test_latency_and_qualities_are_shown(self):
        reply = self.open(name="measured")
        bar = self.browser.each("#stages i", "found.title")
        for stage in ["queue", "preprocessing", "inference", "postprocessing"]:
            text = f"{stage} {1000 * getattr(reply.latency, stage):.2f}"
            self.assertIn(f"{text} ms", bar)
            self.assertIn(text, [entry.replace("\n", " ") for entry in self.browser.texts("#legend div")])
        qualities = [grasp.quality for grasp in reply.grasps]
        heights = self.browser.each("#histogram i", "parseFloat(found.style.height)")
        counts = np.histogram(qualities, len(heights), (0, 1))[0]
        np.testing.assert_allclose(heights, 100 * counts / counts.max(), atol=0.1)
        self.assertEqual(len(self.browser.texts("#grasps button")), len(qualities))
        self.assertIn(f"{reply.model} {reply.version} cpu fp32", self.browser.texts("#models li"))

    def test_a_grasp_is_highlighted_from_the_table_and_from_the_scene(self):
        reply = self.open(name="highlight")
        before = self.browser.scene("all")
        self.browser.mouse(self.browser.middle("#grasps li:nth-child(2) button"))
        self.assertIn("grasp 2", self.browser.text("#readout"))
        self.assertIn(f"{reply.grasps[1].quality:.3f}", self.browser.text("#readout"))
        self.assertGreater(np.mean(np.any(self.browser.scene("highlighted") != before, axis=-1)), 0.003)
        left, top = self.browser.run(f"(({{ x, y }}) => [x, y])({CANVAS})")
        x, y = self.browser.run("projected(stroke(shown.grasps[0]).at(3))")
        self.browser.mouse([left + x, top + y], held=False)
        self.assertIn("grasp 1", self.browser.text("#readout"))
        self.assertIn("lit", self.browser.run("document.querySelector('#grasps button').className"))

    def test_the_scene_rotates_and_zooms(self):
        self.open(name="rotated")
        x, y = self.browser.middle("canvas")
        pictures = [self.browser.scene("initial")]
        self.browser.mouse([x, y], [x + 150, y + 20])
        pictures.append(self.browser.scene("rotated"))
        self.browser.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=-300)
        pictures.append(self.browser.scene("near"))
        for one, other in zip(pictures, pictures[1:]):
            self.assertGreater(np.mean(np.any(one != other, axis=-1)), 0.1)
        self.browser.mouse(self.browser.middle("#reset"))
        np.testing.assert_array_equal(self.browser.scene("reset"), pictures[0])

    def test_the_page_fits_a_phone(self):
        self.open(PHONE, name="phone", model="shaf")
        with self.assertRaises(grpc.RpcError):
            self.detect("refused", model="missing" * 20)
        self.wait_for("refused")
        x, y = self.browser.middle(self.row("phone"))
        self.browser.fingers([[x, y]])
        self.wait_for("phone")
        self.browser.screenshot("phone-light")
        self.assertEqual(self.browser.run("[innerWidth, document.documentElement.scrollWidth]"), [PHONE["width"]] * 2)
        # The scene clips its own elements.
        rights = self.browser.each("body *:not(#view *)", "found.getBoundingClientRect().right")
        self.assertLessEqual(max(rights), PHONE["width"])
        self.assertGreaterEqual(min(self.browser.each("button", "found.getBoundingClientRect().height")), TOUCHABLE)

        # A grasp that is tapped in the table is highlighted in the scene.
        x, y = self.browser.middle("#grasps li:nth-child(3) button")
        self.browser.fingers([[x, y]])
        self.assertIn("grasp 3", self.browser.text("#readout"))
        x, y = self.browser.middle("canvas")
        before = self.browser.scene("phone-grasps")
        self.browser.fingers([[x - 20, y], [x - 60, y]], [[x + 20, y], [x + 60, y]])
        self.assertGreater(np.mean(np.any(self.browser.scene("pinched") != before, axis=-1)), 0.1)
        self.assertIn("grasp 3", self.browser.text("#readout"))

    def test_colours_follow_the_system_theme(self):
        light, dark = [], []
        for screen, kind in [(DESKTOP, "desktop"), (PHONE, "phone")]:
            self.open(screen, "dark", name=f"dark {kind}")
            dark.append(self.browser.pixels(f"{kind}-dark").mean())
            self.open(screen, "light", name=f"light {kind}")
            light.append(self.browser.pixels(f"{kind}-light").mean())
        self.assertLess(max(dark), 70)
        self.assertGreater(min(light), 185)

    def test_the_page_works_without_webgl(self):
        without = "HTMLCanvasElement.prototype.getContext = () => null"
        script = self.browser.call("Page.addScriptToEvaluateOnNewDocument", source=without)
        self.addCleanup(self.browser.call, "Page.removeScriptToEvaluateOnNewDocument", **script)
        reply = self.open(name="flat")
        self.assertIn("no WebGL", self.browser.text("#note"))
        self.assertEqual(len(self.browser.texts("#grasps button")), len(reply.grasps))

    def test_the_page_reconnects(self):
        self.open(name="before")
        conditions = {"latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        self.browser.call("Network.emulateNetworkConditions", offline=True, **conditions)
        self.detect("meanwhile")
        self.browser.eventually("document.querySelector('#connection').innerText.includes('retrying')")
        self.browser.call("Network.emulateNetworkConditions", offline=False, **conditions)
        self.wait_for("meanwhile")
        self.browser.eventually("document.querySelector('#connection').innerText.includes('live')")
        self.assertTrue(self.browser.errors)
        self.browser.errors.clear()

    def test_the_page_shows_that_the_server_is_not_reachable(self):
        server = Server()
        self.addCleanup(server.process.kill)
        self.detect("the last", self.stub(server))
        self.browser.open(f"http://{server.http}/")
        self.wait_for("the last")
        server.stop()
        self.browser.eventually("document.querySelector('#connection').innerText.includes('retrying')")
        self.wait_for("the last")
        self.browser.screenshot("disconnected")
        self.browser.open("about:blank")
        self.browser.errors.clear()


if __name__ == "__main__":
    unittest.main()
