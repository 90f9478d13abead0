"""Headless Chromium, driven over its own protocol: enough of it to open a page and use it."""

import base64
import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path

from websockets.sync.client import connect

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)
START_TIMEOUT_S = 30.0
ARROW = {"ArrowRight": 39, "ArrowLeft": 37}


def find_browser():
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


class Page:
    """One page of a browser; what it logs is kept."""

    def __init__(self, socket):
        self._socket = socket
        self._number = 0
        self.log = []  # (level, text) of console and uncaught faults
        self.requests = []  # addresses that were asked for

    def send(self, method, **parameters):
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            self._note(message)
            if message.get("id") == self._number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]

    def _note(self, message):
        about = message.get("params", {})
        match message.get("method"):
            case "Runtime.consoleAPICalled":
                texts = [str(a.get("value", a.get("description", ""))) for a in about["args"]]
                self.log.append((about["type"], " ".join(texts)))
            case "Runtime.exceptionThrown":
                details = about["exceptionDetails"]
                thrown = details.get("exception", {}).get("description", "")
                self.log.append(("error", f"{details['text']} {thrown}"))
            case "Log.entryAdded":
                self.log.append((about["entry"]["level"], about["entry"]["text"]))
            case "Network.requestWillBeSent":
                self.requests.append(about["request"]["url"])

    def evaluate(self, script):
        """The value of an expression, awaited if it is a promise."""
        found = self.send(
            "Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True
        )
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"])
        return found["result"].get("value")

    def wait_for(self, script, timeout_s=60.0):
        """Wait until an expression is true."""
        end = time.monotonic() + timeout_s
        while not self.evaluate(script):
            if time.monotonic() > end:
                raise TimeoutError(f"{script} did not come true; log: {self.log[-5:]}")
            time.sleep(0.1)

    def open(self, url):
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        self.send("Page.navigate", url=url)
        self.wait_for("document.readyState === 'complete'")

    def press(self, key):
        code = {"key": key, "code": key, "windowsVirtualKeyCode": ARROW[key]}
        self.send("Input.dispatchKeyEvent", type="keyDown", **code)
        self.send("Input.dispatchKeyEvent", type="keyUp", **code)

    def screenshot(self, file):
        """A picture of the whole page."""
        size = self.send("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        found = self.send("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)
        Path(file).write_bytes(base64.b64decode(found["data"]))


@contextlib.contextmanager
def browser_page(profile, width=1200, height=900, script=True, dark=False):
    """A page of a browser of its own.

    Args:
        profile: empty folder for what the browser writes.
        width: of the window.
        height: of the window.
        script: whether pages may run scripts.
        dark: whether pages are told that dark colours are preferred.
    """
    process = subprocess.Popen(
        [find_browser(), *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port_file = Path(profile) / "DevToolsActivePort"
        end = time.monotonic() + START_TIMEOUT_S
        while not (port_file.exists() and port_file.read_text().strip()):
            if time.monotonic() > end or process.poll() is not None:
                raise TimeoutError("the browser did not start")
            time.sleep(0.05)
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            targets = json.load(answer)
        address = next(t["webSocketDebuggerUrl"] for t in targets if t["type"] == "page")
        with connect(address, max_size=None) as socket:
            page = Page(socket)
            page.send(
                "Emulation.setDeviceMetricsOverride",
                width=width,
                height=height,
                deviceScaleFactor=1,
                mobile=False,
            )
            page.send("Emulation.setScriptExecutionDisabled", value=not script)
            scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
            page.send("Emulation.setEmulatedMedia", features=[scheme])
            yield page
    finally:
        process.terminate()
        process.wait(20)
